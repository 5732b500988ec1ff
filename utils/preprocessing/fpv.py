"""UZH-FPV: text events and PNG frames of a DAVIS346 on a racing drone; calibration by name of the sequence."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.calibration import Calibration
from utils.datasets.files import ImageList, read_image_list
from utils.datasets.fpv import SIZE, read_offset_us
from utils.events.reader import open_events
from utils.preprocessing.image_lists import listed_images, undistort_files
from utils.preprocessing.poses import inverse, rigid, times_transform
from utils.preprocessing.products import Products
from utils.preprocessing.registry import PreprocessOptions, Preprocessor, register, walk_folders
from utils.sequence_names import find_in_path
from utils.trajectory_io import Trajectory, read_tum

POSE_HEADER = "# #timestamp[us] px py pz qx qy qz qw"
# Calibrations as published with the data set: lens (fx fy cx cy k1..k4, equidistant) and cam_T_imu (three rows).
_LENSES = {
    "indoor_45_": (
        (173.07989681517137, 173.0734479068749, 163.31033691005516, 134.99889292308214),
        (-0.03252275347038443, 0.0010042799356776398, -0.0048537750326187136, 0.0014604134198771906)),
    "indoor_forward_": (
        (172.98992850734132, 172.98303181090185, 163.33639726024606, 134.99537889030861),
        (-0.027576733308582076, -0.006593578674675004, 0.0008566938165177085, -0.00030899587045247486)),
    "outdoor_forward_": (
        (174.23979032083346, 174.11105443010973, 163.91078563399876, 140.9726709818771),
        (-0.03560363132286886, 0.001974723646350411, -0.0045671620060236855, 0.0011707729112974909)),
}
_CAM_T_IMU = {
    "indoor_45_": (
        (0.9999641031275889, 0.003197881415389814, -0.007846401129833277, 0.001265030971654739),
        (-0.003216308945288942, 0.9999920967707336, -0.002337039332281246, -0.0025652081547025674),
        (0.007838865543278494, 0.0023621918900207225, 0.9999664855566258, -0.022231533861925983)),
    "indoor_forward_": (
        (0.9999711474430529, 0.0013817010649267755, -0.007469617365767657, 0.00018050225881571712),
        (-0.0014085305353606873, 0.9999925720306121, -0.00358774655345255, -0.004316353415695194),
        (0.007464604688444933, 0.0035981642219379494, 0.9999656658561218, -0.027547385763471585)),
    "outdoor_forward_": (
        (0.9998829655327196, 0.005335413966337045, -0.014338360969823338, -0.0015224098391112568),
        (-0.005432624310654592, 0.9999624656424586, -0.006749362884958196, -0.006621897399791399),
        (0.014301812143655866, 0.00682646790524808, 0.9998744208676132, -0.023154837302635834)),
}


def fpv_calibration(folder: Path) -> tuple[Calibration, npt.NDArray[np.float64]]:
    """Return the camera and `cam_T_imu` (4, 4) of the sequence in a folder, found by its name.

    Raises:
        InputError: the name is of no sequence with a known calibration.
    """
    kind = find_in_path(folder, _LENSES)
    if kind is None:
        raise InputError(f"{folder}: the calibration is found by the name of the sequence, expected one with "
                         f"{', '.join(_LENSES)} in it (there is none for outdoor_45_)")
    intrinsics, coefficients = _LENSES[kind]
    return Calibration(*SIZE, *intrinsics, "fisheye", coefficients), rigid(_CAM_T_IMU[kind])


def run(folder: Path, options: PreprocessOptions) -> list[Path]:
    """Make stamps, ground truth, undistorted camera, rectification map and images of one sequence."""
    products = Products(options)
    calibration, cam_T_imu = fpv_calibration(folder)
    images = read_image_list(folder / "images.txt", "s", whole=False)
    poses = _ground_truth(folder)
    offset_us = _offset_us(products, folder, images, poses)
    stamps_file = folder / "images_timestamps_us.txt"
    if products.missing(stamps_file):
        products.table(stamps_file, np.floor(images.stamps_us).astype(np.int64) - offset_us, "%d")
    if poses is not None:
        _write_poses(products, folder, poses, offset_us, inverse(cam_T_imu))
    intrinsics = products.pinhole(folder / "calib_undist.txt", calibration)
    products.map(folder / "rectify_map.h5", calibration, intrinsics)
    if options.images:
        paths = listed_images(folder, images.names, _image_folder(folder), folder / "images.txt")
        undistort_files(products, folder / "images_undistorted", paths, calibration, intrinsics)
    return products.made


def _ground_truth(folder: Path) -> Trajectory | None:
    file = folder / "groundtruth.txt"
    if not file.is_file():
        if find_in_path(folder, ["_with_gt"]) is None:
            return None
        raise InputError(f"{folder}: groundtruth.txt is missing, although the name says that there is ground truth")
    return read_tum(file, skip_lines=1, skip_repeated=True)


def _offset_us(products: Products, folder: Path, images: ImageList, poses: Trajectory | None) -> int:
    """Return the whole microseconds that are subtracted from all stamps: the beginning of whatever comes first."""
    file = folder / "t_offset_us.txt"
    if not products.missing(file):
        return read_offset_us(file)
    with open_events(folder / "events.txt", time_unit="s", sensor_size=SIZE) as reader:
        first_us = [float(next(reader.chunks()).t_us[0]), float(images.stamps_us[0])]
    if poses is not None:
        first_us.append(float(poses.t_us[0]))
    offset_us = math.floor(min(first_us))
    products.text(file, f"{offset_us:.18e}\n")
    return offset_us


def _write_poses(products: Products, folder: Path, poses: Trajectory, offset_us: int,
                 imu_T_cam: npt.NDArray[np.float64]) -> None:
    body, camera = folder / "stamped_groundtruth_us.txt", folder / "stamped_groundtruth_us_cam.txt"
    stamps = (poses.t_us - offset_us).astype(np.float64)
    if products.missing(body):
        products.table(body, np.column_stack([stamps, poses.world_T_cam]), "%.18e", POSE_HEADER)
    if products.missing(camera):
        products.table(camera, np.column_stack([stamps, times_transform(poses.world_T_cam, imu_T_cam)]), "%.6f")


def _image_folder(folder: Path) -> Path:
    found = sorted(path for path in folder.iterdir() if path.is_dir() and "img" in path.name)
    return found[0] if found else folder / "img"


def _is_sequence(folder: Path) -> bool:
    return ((folder / "images.txt").is_file() and (folder / "events.txt").is_file()
            and any("img" in path.name and path.is_dir() for path in folder.iterdir()))


def outputs(folder: Path, side: str) -> list[Path]:
    """Files that an event run needs."""
    return [folder / name for name in ("t_offset_us.txt", "images_timestamps_us.txt", "calib_undist.txt",
                                       "rectify_map.h5")]


register(Preprocessor(
    "fpv", "folders with events.txt, images.txt, img/ and, where there is ground truth, groundtruth.txt",
    lambda root, side: walk_folders(root, _is_sequence), run, outputs, ("left",)))
