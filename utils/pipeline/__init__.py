"""One command from a recording to cloud, picture and page: stages that are recorded, resumed and told about."""

from __future__ import annotations

from utils.pipeline.options import CleanupOptions, EmvsStageOptions, PipelineOptions
from utils.pipeline.run import PipelineResult, run_pipeline

__all__ = ["CleanupOptions", "EmvsStageOptions", "PipelineOptions", "PipelineResult", "run_pipeline"]
