"""A stand-in for the export: writes what it writes, without tracking."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from utils.clouds.cloud import PointCloud
from utils.clouds.io import write_cloud
from utils.export_run import ExportOptions

FRAMES, POINTS = 20, 300


class StandIn:
    """Writes what an export writes, without tracking; counts its calls and can be told to fail."""

    def __init__(self) -> None:
        self.calls: list[ExportOptions] = []
        self.error: Exception | None = None
        self.share = 1.0

    def __call__(self, options: ExportOptions) -> dict[str, Any]:
        self.calls.append(options)
        if self.error is not None:
            raise self.error
        base = Path(options.out).with_suffix("")
        generator = np.random.default_rng(options.seed)
        points = generator.uniform(-1, 1, (POINTS, 3)).astype(np.float32) + np.float32([0, 0, 3])
        scalars = {"observations": np.full(POINTS, 5), "parallax_deg": np.full(POINTS, 4.0), "depth": points[:, 2],
                   "inv_depth_sigma": np.full(POINTS, 0.01), "host_frame": np.arange(POINTS) % 10,
                   "clamped": np.zeros(POINTS, np.uint8)}
        scalars["observations"][:50] = 1  # those do not pass the quality filter
        cloud = PointCloud(points, scalars=scalars)
        poses = np.zeros((FRAMES, 7), np.float32)
        poses[:, 0], poses[:, 6] = np.linspace(0, 1, FRAMES), 1
        files = [base.with_suffix(suffix) for suffix in (".npy", ".npz", ".ply")]
        for file in files:
            write_cloud(file, cloud)
        if options.export_edge_cloud:
            files.append(base.with_name(f"{base.name}_edges.npy"))
            write_cloud(files[-1], cloud)
        arrays = {"_poses": poses, "_tstamps": np.arange(FRAMES) * 1e4}
        for name, array in arrays.items():
            files.append(base.with_name(f"{base.name}{name}.npy"))
            np.save(files[-1], array)
        meta = {"files": list(map(str, files)), "num_poses": FRAMES, "n_keyframes": 14, "tracked_share": self.share,
                "point_cloud_shape": [POINTS, 3], "message": f"tracked {FRAMES} frames with 14 keyframes",
                "runtime_s": 0.1, "n_skipped_voxels": 0, "weights": "devo-tiny",
                "counters": {"frames_read": FRAMES, "ba_failures": 0}}
        base.with_name(f"{base.name}_meta.json").write_text(json.dumps(meta))
        return meta
