"""The last words of a pipeline run: how good the result is, what there is, and where."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from utils.pipeline.record import PipelineRecord

LEAST_EXPLAINED = 0.9
LEAST_KEYFRAMES = 12
LEAST_CLEAN_SHARE = 0.25
MOST_EMPTY_SHARE = 0.05


def tracking_warnings(meta: dict[str, Any]) -> list[str]:
    """Sentences about a run that went through and still looks doubtful, from the description of the export."""
    counters = meta["counters"]
    read = max(counters.get("frames_read", 0), 1)
    warnings = []
    if str(meta["weights"]).startswith("random:"):
        warnings.append("the network is untrained, so neither path nor cloud mean anything")
    if meta["tracked_share"] < LEAST_EXPLAINED:
        warnings.append(f"the geometry explains only {meta['tracked_share']:.0%} of the frames: check the calibration, "
                        "try shorter windows")
    if meta["n_keyframes"] < LEAST_KEYFRAMES:
        warnings.append(f"only {meta['n_keyframes']} keyframes: the camera hardly moved, or the recording is short")
    if meta["n_skipped_voxels"] > MOST_EMPTY_SHARE * read:
        warnings.append(f"{meta['n_skipped_voxels']} of {read} windows were too empty: try longer windows")
    if counters.get("ba_failures"):
        warnings.append(f"{counters['ba_failures']} optimisation steps failed")
    return warnings


def cleaning_warnings(raw: int, cleaned: int) -> list[str]:
    """A sentence if hardly any point was kept."""
    if cleaned >= LEAST_CLEAN_SHARE * raw > 0:
        return []
    if not cleaned:
        return [f"none of the {raw} points passed the cleaning, so picture and page show the raw cloud: little "
                "parallax, or a wrong calibration"]
    return [f"only {cleaned} of {raw} points passed the cleaning: little parallax, or a wrong calibration"]


def quality_line(record: PipelineRecord, name: str) -> str:
    """One line: keyframes, points before and after cleaning, share of frames explained, warnings."""
    export, cleanup = record.stage("export"), record.stage("cleanup")
    if export is None or not export.facts:
        return f"{name}: no trajectory and no cloud"
    facts = export.facts
    parts = [f"{facts['message']} ({facts['tracked_share']:.0%} of the frames explained)"]
    raw = facts["point_cloud_shape"][0]
    if cleanup is not None and cleanup.facts:
        cleaned = cleanup.facts["cleaned"]
        parts.append(f"{raw} points, {cleaned} after cleaning ({cleaned / max(raw, 1):.0%})")
    else:
        parts.append(f"{raw} points, not cleaned")
    warnings = record.warnings
    parts.append(f"{len(warnings)} warning{'s' if len(warnings) > 1 else ''}" if warnings else "no warnings")
    return f"{name}: " + "; ".join(parts)


def summary_lines(record: PipelineRecord, name: str, products: dict[str, Path]) -> list[str]:
    """Quality, warnings, failures, and the products that exist with their places.

    Args:
        record: all stages.
        name: what to call the recording.
        products: what a file is -> file, in the order to list them.
    """
    lines = [quality_line(record, name)]
    lines += [f"  warning: {warning}" for warning in record.warnings]
    lines += [f"  {stage.name} {stage.status}: {stage.reason}" for stage in record.stages
              if stage.status in ("failed", "not run")]
    shown = {what: path for what, path in products.items() if path.exists()}
    width = max(map(len, shown), default=0)
    lines += [f"  {what:{width}}  {path}" for what, path in shown.items()]
    if shown:
        lines.append("lengths are in arbitrary trajectory units: one camera cannot know the scale")
    return lines
