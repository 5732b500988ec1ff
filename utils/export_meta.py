"""`<base>_meta.json`: settings, versions, conventions, counts and files of one export, so that it explains itself."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from devo.config import Config
from devo.kernels import active_kernels
from devo.result import TrackingResult
from utils.clouds.filters import FilterReport
from utils.export_options import ExportOptions
from utils.export_products import CONVENTIONS, run_environment

_FROM_OPTIONS = ("dataset", "datapath", "side", "start_us", "stop_us", "stride", "export_frame_data", "frame_mode",
                 "save_per_frame_cloud", "per_frame_keep", "voxel_size", "rgb", "seed", "device", "workers")


@dataclass
class ExportRecord:
    """What is known about a run once it was tracked; the later products add to it.

    Attributes:
        options: as asked for, with the data set recognised. config, cfg: settings file and the settings in effect.
        weights: name or file. sequence: `Recording.describe()` of the tracked pass. width, height: of the frames [px].
        intrinsics: `(4,)` full-resolution `fx fy cx cy` of the undistorted camera [px].
        result: the run. cleaned_points: None if nothing was cleaned. filters: what each filter of the cloud did.
        frame_clouds: clouds per frame that were written.
        files: product -> main file, for the optional products (`frame_data`, `edge_cloud`, `focus_edge_cloud`, ...).
        edge_filters: product -> what its outlier filter did. edge_points: product -> number of points.
    """

    options: ExportOptions
    config: Path
    cfg: Config
    weights: str
    sequence: dict[str, Any]
    width: int
    height: int
    intrinsics: np.ndarray
    result: TrackingResult
    cleaned_points: int | None = None
    filters: list[FilterReport] = field(default_factory=list)
    frame_clouds: int = 0
    files: dict[str, Path] = field(default_factory=dict)
    edge_filters: dict[str, list[FilterReport]] = field(default_factory=dict)
    edge_points: dict[str, int] = field(default_factory=dict)

    @property
    def tracked(self) -> bool:
        """Whether there is a trajectory with numbers in it."""
        return len(self.result.poses) > 0 and bool(np.isfinite(self.result.poses).all())

    def describe(self) -> dict[str, Any]:
        """The content of `<base>_meta.json`; keys of the published tool keep their names."""
        return {**CONVENTIONS, **self._input(), **self._options(), **self._outcome(), **self._products(),
                **run_environment()}

    def _input(self) -> dict[str, Any]:
        calibration = self.sequence.get("files", {}).get("calibration")
        return {
            "config": str(self.config), "settings": self.cfg.as_dict(), "weights": self.weights,
            "H": self.height, "W": self.width, "intrinsics_file": calibration,
            "intrinsics_fx_fy_cx_cy": [float(value) for value in self.intrinsics], "sequence": self.sequence,
        }

    def _options(self) -> dict[str, Any]:
        values = vars(self.options)
        flags: dict[str, Any] = {}
        for prefix, settings in (("edge", self.options.edge), ("focus", self.options.focus)):
            flags |= {f"{prefix}_{name}": value for name, value in vars(settings).items()}
        return {name: values[name] for name in _FROM_OPTIONS} | flags

    def _outcome(self) -> dict[str, Any]:
        result = self.result
        count = 0 if result.observables is None else len(result.observables)
        return {
            "status": result.status.value, "message": result.message,
            "tracked_share": round(result.tracked_share, 4),
            "start_pose_xyz_quat_xyzw": result.poses[0].tolist() if self.tracked else None,
            "start_timestamp_us": float(result.tstamps[0]) if len(result.tstamps) else None,
            "num_poses": len(result.poses), "point_cloud_shape": [count, 3], "depths_shape": [count],
            "n_keyframes": result.counters.get("keyframes", 0),
            "n_skipped_voxels": result.counters.get("frames_too_empty", 0), "counters": result.counters,
            "timings_s": {stage: round(seconds, 3) for stage, seconds in result.timings.items()},
            "kernels": active_kernels(), "cleaned_points": self.cleaned_points, "filters": _reports(self.filters),
        }

    def _products(self) -> dict[str, Any]:
        values: dict[str, Any] = {"flow_saved": self.result.flowdata is not None,
                                  "n_per_frame_clouds": self.frame_clouds,
                                  "frame_data_path": _text(self.files.get("frame_data")),
                                  "dpviewer_cloud_path": _text(self.files.get("dpviewer_cloud"))}
        for product in ("edge_cloud", "focus_edge_cloud"):
            path = self.files.get(product)
            values |= {f"{product}_exported": path is not None, f"{product}_path": _text(path),
                       f"{product}_points": self.edge_points.get(product, 0),
                       f"{product}_filters": _reports(self.edge_filters.get(product, []))}
        return values


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


def _reports(reports: list[FilterReport]) -> list[dict[str, Any]]:
    return [{"name": r.name, "before": r.before, "after": r.after, "parameters": r.parameters, "removed": r.removed,
             "skipped": list(r.skipped)} for r in reports]
