"""The validation experiment: is the cloud that the odometry exports right?

The exported cloud is judged as in the paper *Extending Deep Event Visual Odometry with Sparse Point-Cloud Export*:
against maps of event-based multi-view stereo (EMVS) made with ground-truth poses and with poses of the odometry, with
experiments that isolate scale and pose density; where depth is known, against that as well. `experiment.validate` runs
everything, `report.write_report` writes the folder; `evals/validate_pointcloud.py` and the notebook call both.
"""

from __future__ import annotations

from evals.validation.experiment import Validation, validate
from evals.validation.report import write_report
from evals.validation.settings import ValidationSettings

__all__ = ["Validation", "ValidationSettings", "validate", "write_report"]
