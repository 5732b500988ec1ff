#!/usr/bin/env python3
"""Compare a finished run with the ground truth of its recording: path, and for simulated recordings the cloud too.

Example: python evals/compare_run.py results/board/pointcloud.npy --datapath datasets/board

The estimate is aligned to the ground truth by a similarity (Sim3), since one camera cannot know the scale. Points of
the cleaned cloud, moved the same way, are compared with the planes that the simulator drew (scene.json).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from utils.cli import AliasParser, run_cli  # noqa: E402 - needs the path above

if TYPE_CHECKING:
    import numpy as np

    from evals.trajectory_metrics import TrajectoryErrors

SCENE_FILE = "scene.json"


@dataclass(frozen=True)
class Comparison:
    """How far a run is from the truth.

    Attributes:
        trajectory: errors of the path.
        points: number of points of the cloud that was compared; 0 where the surfaces are not known.
        surface_median, surface_p90: distance of those points to the true surface as a share of their depth: median
            and 90 % quantile.
    """

    trajectory: TrajectoryErrors
    points: int
    surface_median: float
    surface_p90: float

    def lines(self) -> list[str]:
        """The figures, for people."""
        errors = self.trajectory
        share = errors.ate_rmse_cm / 100 / errors.reference_path_length_m
        lines = [f"path: ATE {errors.ate_rmse_cm:.2f} cm on {errors.reference_path_length_m:.2f} m ({share:.2%}), "
                 f"rotation {errors.rotation_rmse_deg:.2f} deg; {errors.matches} of {errors.estimate_poses} poses "
                 f"matched; one trajectory unit is {errors.scale:.3f} m"]
        if self.points:
            lines.append(f"cloud: {self.points} points lie {self.surface_median:.1%} of their depth from the true "
                         f"surface (median), 90 % of them within {self.surface_p90:.1%}")
        return lines


def compare_run(run: str, datapath: str, dataset: str = "auto", side: str = "left") -> Comparison:
    """Compare the files of a run with the ground truth of its recording.

    Args:
        run: any file of the run, for example `results/board/pointcloud.npy`.
        datapath, dataset, side: the recording, as for `open_sequence`.

    Raises:
        InputError: files are missing or damaged, or the recording has no ground truth.
    """
    from devo.errors import InputError
    from evals.alignment import umeyama_sim3
    from evals.trajectory_metrics import associate, evaluate_trajectory
    from utils.datasets.registry import SequenceOptions, open_sequence
    from utils.finished_run import FinishedRun, read_trajectory
    from utils.trajectory_io import Trajectory

    files = FinishedRun.of(run)
    poses = files.poses_file()
    if poses is None:
        raise InputError(f"{run}: there is no {files.file('_poses.npy').name} beside it; name a file of a run")
    sequence = open_sequence(dataset, datapath, SequenceOptions(side=side))
    truth = sequence.ground_truth()
    if truth is None:
        raise InputError(f"{datapath}: the recording has no ground truth to compare with")
    reference, estimate = Trajectory(*truth), read_trajectory(poses)
    errors = evaluate_trajectory(reference, estimate)
    scene = sequence.path / SCENE_FILE
    cloud = files.file("_cleaned.ply")
    if not (scene.is_file() and cloud.is_file()):
        return Comparison(errors, 0, float("nan"), float("nan"))
    rows, columns = associate(reference.t_us, estimate.t_us, max_difference_ms=errors.max_difference_ms)
    alignment = umeyama_sim3(estimate.world_T_cam[columns, :3], reference.world_T_cam[rows, :3])
    return Comparison(errors, *_surface_errors(scene, cloud, alignment))


def _surface_errors(scene: Path, file: Path, alignment: Any) -> tuple[int, float, float]:
    """Number of points, median and 90 % quantile of their distance to the surface over their depth."""
    import numpy as np

    from utils.clouds.io import read_cloud

    cloud = read_cloud(file)
    cloud = cloud.select(cloud.finite_mask())
    if not len(cloud) or "depth" not in cloud.scalars:
        return 0, float("nan"), float("nan")
    distance = surface_distances(alignment.apply(cloud.points), json.loads(scene.read_text("utf-8"))["planes"])
    share = distance / (alignment.scale * np.abs(cloud.scalars["depth"].astype(np.float64)))
    return len(cloud), float(np.median(share)), float(np.quantile(share, 0.9))


def surface_distances(points: np.ndarray, planes: Sequence[dict[str, Any]]) -> np.ndarray:
    """Distance of `(N, 3)` points to the nearest of some rectangles, `(N,)`, in the unit of the points.

    Args:
        points: in the frame of the scene.
        planes: pieces as in `scene.json`: `origin`, `axis_u`, `axis_v`, `normal`, `half_extent` (None = endless).
    """
    import numpy as np

    nearest = np.full(len(points), np.inf)
    for piece in planes:
        offset = points - np.asarray(piece["origin"])
        squares = (offset @ np.asarray(piece["normal"])) ** 2
        for axis, half in zip(("axis_u", "axis_v"), piece["half_extent"]):
            if half is not None:
                squares += np.maximum(np.abs(offset @ np.asarray(piece[axis])) - half, 0) ** 2
        nearest = np.minimum(nearest, np.sqrt(squares))
    return nearest


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = AliasParser(prog="compare_run.py", description=__doc__)
    parser.add_argument("run", help="any file of the run, for example results/board/pointcloud.npy")
    parser.add_argument("--datapath", required=True, help="the recording, with ground truth")
    parser.add_argument("--dataset", default="auto", help="how to read it; auto looks at its files")
    parser.add_argument("--side", choices=("left", "right"), default="left", help="camera of a stereo recording")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    args = build_arg_parser().parse_args(argv)
    print("\n".join(compare_run(args.run, args.datapath, args.dataset, args.side).lines()))
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
