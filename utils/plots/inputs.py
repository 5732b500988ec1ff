"""From the files that a user names to what is drawn: shared by the plotting and viewing commands."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.clouds.cloud import PointCloud
from utils.clouds.filters import range_filter, voxel_downsample
from utils.finished_run import FinishedRun, read_any_cloud, read_camera_path, read_trajectory
from utils.plots.scene import FloatArray, camera_pyramid


@dataclass(frozen=True, eq=False)
class Inputs:
    """What is looked at.

    Attributes:
        cloud: the points after thinning.
        world_T_cam: `(T, 7)` float64, finite poses only.
        t_us: `(T,)` their stamps, None where they are unknown.
        pyramid: shape of the camera, None if unknown.
        title: name of the run.
        unit: what one unit of length is.
    """

    cloud: PointCloud
    world_T_cam: FloatArray  # noqa: N815 - the frame notation of the project
    t_us: npt.NDArray[np.float64] | None
    pyramid: FloatArray | None
    title: str
    unit: str


def read_inputs(args: argparse.Namespace) -> Inputs:
    """Read what the options of `add_input_flags` name; poses and camera of the same run are found by their names.

    Raises:
        InputError: neither cloud nor poses, unreadable files, or numbers out of range.
    """
    cloud_file, pose_file = getattr(args, "cloud", None), args.poses
    if not cloud_file and not pose_file:
        raise InputError("name a cloud or the poses of a camera")
    run = FinishedRun.of(cloud_file or pose_file)
    if pose_file is None and args.find_poses:
        pose_file = run.poses_file()
    poses, t_us = (np.empty((0, 7)), None) if pose_file is None else _poses(Path(pose_file), args.pose_convention)
    cloud = PointCloud(np.empty((0, 3), np.float32)) if not cloud_file else read_any_cloud(cloud_file)
    cloud = _thinned(cloud, poses, args)
    return Inputs(cloud, poses, t_us, _pyramid(run, args), args.title or Path(cloud_file or pose_file).stem, args.unit)


def _poses(path: Path, convention: str) -> tuple[FloatArray, npt.NDArray[np.float64] | None]:
    poses = read_camera_path(path, convention)
    finite = np.isfinite(poses).all(axis=1)
    if path.suffix.lower() == ".npy" and not FinishedRun.of(path).file("_tstamps.npy").is_file():
        return poses[finite], None
    if not finite.all():
        return poses[finite], None
    return poses, read_trajectory(path, convention=convention).t_us.astype(np.float64)


def _thinned(cloud: PointCloud, poses: FloatArray, args: argparse.Namespace) -> PointCloud:
    if args.radius is not None:
        if not len(poses):
            raise InputError("--radius keeps points near the mean camera position, which needs --poses")
        cloud = cloud.select(range_filter(cloud, max_range=args.radius, center=poses[:, :3].mean(axis=0).tolist())[0])
    if args.voxel_size is not None:
        cloud = cloud.select(voxel_downsample(cloud, voxel_size=args.voxel_size)[0])
    if args.downsample < 1:
        raise InputError(f"--downsample is {args.downsample}, expected at least 1 (use every n-th point)")
    return cloud.select(slice(None, None, args.downsample))


def _pyramid(run: FinishedRun, args: argparse.Namespace) -> FloatArray | None:
    """The camera's shape: as given, else as the description of the run says."""
    if args.intrinsics is not None:
        return camera_pyramid(args.intrinsics, args.width, args.height)
    camera = run.camera()
    return None if camera is None else camera_pyramid(camera[0], *camera[1])


def default_output(args: argparse.Namespace, ending: str) -> Path:
    """`<folder of the input>/<stem><ending>`."""
    source = Path(getattr(args, "cloud", None) or args.poses)
    return source.with_name(source.stem + ending)
