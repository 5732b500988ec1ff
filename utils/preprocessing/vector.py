"""VECtor: events in HDF5, PNG frames and poses of a motion capture body; calibrations in a folder of their own."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.calibration import flat_numbers, read_calibration, read_mapping
from utils.datasets.prepared import mean_interval_us, only_match, require_increasing
from utils.datasets.vector import EVENT_SIZE, FRAME_SIZE, event_file_suffix, sequence_name
from utils.preprocessing.image_lists import counted_images, undistort_files
from utils.preprocessing.poses import inverse, rigid, times_transform
from utils.preprocessing.products import Products
from utils.preprocessing.registry import PreprocessOptions, Preprocessor, folders_around, register, walk_folders
from utils.trajectory_io import read_tum

CALIBRATION_FOLDER = "0_calib"
_FRAME_INTERVAL_MS, _FRAME_TOLERANCE_MS = 33.3, 3.0
_CAMERAS = {"left": (None, "cam2"), "right": ("cam1", "cam3")}  # gray (cam0 is the left one), event


def run(folder: Path, options: PreprocessOptions) -> list[Path]:
    """Make stamps, poses, undistorted cameras, rectification map and images of one side of a sequence.

    The clock stays as it is, absolute microseconds.
    """
    products, side = Products(options), options.side
    event_file = only_match(folder, f"*{event_file_suffix(side)}", f"event file of the {side} camera of VECtor")
    name, calibrations = sequence_name(event_file, side), find_calibrations(folder)
    frames = folder / f"{name}1.synced.{side}_camera"
    stamps = folder / f"tss_imgs_us_{side}.txt"
    if products.missing(stamps):
        products.table(stamps, read_exposures(frames / "timestamp.txt"))
    truth = folder / f"{name}1.synced.gt.txt"
    if truth.is_file():
        _make_poses(products, folder, truth, calibrations, side)
    event_camera = read_calibration(calibrations / f"{side}_event_camera_intrinsic_results.yaml", EVENT_SIZE,
                                    default_model="radtan")
    intrinsics = products.pinhole(folder / f"calib_undist_evs_{side}.txt", event_camera)
    products.map(folder / f"rectify_map_{side}.h5", event_camera, intrinsics)
    if options.images:
        frame_camera = read_calibration(calibrations / f"{side}_regular_camera_intrinsic_results.yaml", FRAME_SIZE,
                                        default_model="radtan")
        frame_intrinsics = products.pinhole(folder / f"calib_undist_regular_{side}.txt", frame_camera)
        paths = counted_images(frames, len(read_exposures(frames / "timestamp.txt")))
        undistort_files(products, folder / f"images_undistorted_{side}", paths, frame_camera, frame_intrinsics,
                        numbered=True)
    return products.made


def find_calibrations(folder: Path) -> Path:
    """Return the folder of the calibrations, beside the sequence or in it.

    Raises:
        InputError: there is none.
    """
    for holder in (*folders_around(folder), folder):
        if (holder / CALIBRATION_FOLDER).is_dir():
            return holder / CALIBRATION_FOLDER
    raise InputError(f"{folder}: no calibrations; put the folder {CALIBRATION_FOLDER} of VECtor beside the sequence")


def read_exposures(path: Path) -> npt.NDArray[np.float64]:
    """Return the middles (N,) of the exposures in absolute microseconds.

    Args:
        path: two lines of text, then begin and end of each exposure in seconds.

    Raises:
        InputError: the file is missing or damaged, or the images are not 33.3 ms apart.
    """
    try:
        lines = [line.split() for line in path.read_text("utf-8").splitlines()[2:] if line.strip()]
        # as decimals, because float64 seconds since 1970 are no better than a quarter of a microsecond
        stamps_us = np.array([float(500_000 * (Decimal(begin) + Decimal(end))) for begin, end, *_ in lines])
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except (UnicodeDecodeError, ValueError, InvalidOperation):
        raise InputError(f"{path}: expected begin and end of an exposure in seconds on each line after two lines of "
                         "text") from None
    if not np.isfinite(stamps_us).all():
        raise InputError(f"{path}: stamp {int(np.argmin(np.isfinite(stamps_us)))} is not finite")
    require_increasing(stamps_us, path)
    interval_ms = mean_interval_us(stamps_us, path) / 1000
    if abs(interval_ms - _FRAME_INTERVAL_MS) > _FRAME_TOLERANCE_MS:
        raise InputError(f"{path}: images are {interval_ms:.1f} ms apart, expected {_FRAME_INTERVAL_MS:g} within "
                         f"{_FRAME_TOLERANCE_MS:g} ms; frames or stamps are missing")
    return stamps_us


def _make_poses(products: Products, folder: Path, truth: Path, calibrations: Path, side: str) -> None:
    """Write the poses of event and frame camera: `world_T_body inv(cam0_T_body) cam0_T_camera`."""
    gray, event = _CAMERAS[side]
    targets = {folder / f"poses_gray_{side}.txt": gray, folder / f"poses_evs_{side}.txt": event}
    if not products.missing(*targets):
        return
    body = read_tum(truth, skip_lines=2, skip_repeated=True)
    body_T_cam0 = inverse(read_transform(calibrations / "camera_mocap_extrinsic_results1.yaml", "cam0", "T_cam_body"))
    joint = calibrations / "small_scale_joint_camera_extrinsic_results.yaml"
    for target, camera in targets.items():
        cam0_T_camera = np.eye(4) if camera is None else read_transform(joint, camera, f"T_cam0_{camera}")
        poses = times_transform(body.world_T_cam, body_T_cam0 @ cam0_T_camera)
        products.table(target, np.column_stack([body.t_us, poses]))


def read_transform(path: Path, camera: str, name: str) -> npt.NDArray[np.float64]:
    """Return the 4x4 transform `camera: {name: 16 numbers}` of a YAML file.

    Raises:
        InputError: the file is missing or damaged, or the numbers are no rigid motion.
    """
    fields = read_mapping(path).get(camera)
    if not isinstance(fields, dict) or name not in fields:
        raise InputError(f"{path}: no {name} in {camera}")
    numbers = np.array(flat_numbers(fields[name], name))
    if len(numbers) != 16 or not np.isfinite(numbers).all():
        raise InputError(f"{path}: {name} has {len(numbers)} numbers, expected the 16 of a 4x4 matrix, all finite")
    transform = rigid(numbers[:12])
    if np.abs(transform[:3, :3] @ transform[:3, :3].T - np.eye(3)).max() > 1e-3 or not np.allclose(
            numbers[12:], [0, 0, 0, 1]):
        raise InputError(f"{path}: {name} is no rigid motion: {numbers.round(3).tolist()}")
    return transform


def _is_sequence(folder: Path, side: str) -> bool:
    wanted = (f"*{event_file_suffix(side)}", f"*1.synced.{side}_camera")
    return folder.name != CALIBRATION_FOLDER and any(any(folder.glob(pattern)) for pattern in wanted)


def outputs(folder: Path, side: str) -> list[Path]:
    """Files that an event run needs."""
    return [folder / f"tss_imgs_us_{side}.txt", folder / f"calib_undist_evs_{side}.txt",
            folder / f"rectify_map_{side}.h5"]


register(Preprocessor(
    "vector", "folders with {sequence}1.synced.{left,right}_event.hdf5, ..._camera/ and ...gt.txt, beside 0_calib/",
    lambda root, side: walk_folders(root, lambda folder: _is_sequence(folder, side)),
    run, outputs))
