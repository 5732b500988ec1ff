"""EDS: events in HDF5 and PNG frames of cameras that share a lens; two published calibrations.

The event file is left as it is: `t_offset_us.txt` says what its stamps are ahead of the other files, and the reader
subtracts that.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np

from devo.errors import InputError
from utils.datasets.eds import (
    CALIBRATIONS,
    CAMERAS,
    EVENTS_UNCHANGED,
    OFFSET_FILE,
    POSES_FILE,
    SIZE,
    STAMPS_FILE,
    read_offset,
    undistorted_camera,
)
from utils.datasets.prepared import Stamps, only_match, read_stamps
from utils.events.reader import open_events
from utils.preprocessing.image_lists import counted_images, undistort_files
from utils.preprocessing.products import Products
from utils.preprocessing.registry import PreprocessOptions, Preprocessor, register, walk_folders
from utils.trajectory_io import Trajectory, read_tum
from utils.undistort import undistorted_intrinsics

RAW_STAMPS_FILE, RAW_POSES_FILE = "images_timestamps.txt", "stamped_groundtruth.txt"
_POSES_HEADER = "# #timestamp[us] px py pz qx qy qz qw"


def run(folder: Path, options: PreprocessOptions) -> list[Path]:
    """Make offset, stamps, poses, undistorted cameras and rectification maps, and images of the first calibration."""
    products = Products(options)
    events = only_match(folder, "events.h5", "event file of EDS")
    stamps = read_stamps(folder / RAW_STAMPS_FILE)
    poses_file = folder / RAW_POSES_FILE
    poses = read_tum(poses_file, skip_lines=1, skip_repeated=True) if poses_file.is_file() else None
    offset_us = _offset_us(products, folder / OFFSET_FILE, events, stamps, poses)
    if products.missing(folder / STAMPS_FILE):
        products.table(folder / STAMPS_FILE, np.floor(stamps).astype(np.int64) - offset_us, "%d")
    if poses is not None and products.missing(folder / POSES_FILE):
        rows = np.column_stack([(poses.t_us - offset_us).astype(np.float64), poses.world_T_cam])
        products.table(folder / POSES_FILE, rows, "%.18e", _POSES_HEADER)
    for calibration in CALIBRATIONS:
        _make_cameras(products, folder, calibration)
    if options.images:
        _make_images(products, folder, CALIBRATIONS[0], len(stamps))
    return products.made


def _offset_us(products: Products, file: Path, events: Path, stamps_us: Stamps, poses: Trajectory | None) -> int:
    """Return the whole microseconds that are subtracted from all stamps.

    An existing file is kept in any case: it tells what was done to events that were shifted in place.
    """
    if file.is_file():
        return read_offset(file)[0]
    with open_events(events, time_unit="us", sensor_size=SIZE) as reader:
        first_us, last_us = reader.time_range_us()
    if last_us < stamps_us[0] or first_us > stamps_us[-1]:
        raise InputError(f"{events}: events from {first_us} us to {last_us} us, but images from {stamps_us[0]:.0f} us "
                         f"to {stamps_us[-1]:.0f} us; if another program shifted the events in place and was "
                         "interrupted, download the event file again")
    starts = [float(first_us), float(stamps_us[0]), *([] if poses is None else [float(poses.t_us[0])])]
    offset_us = math.floor(min(starts))
    products.text(file, f"{offset_us:.18e}\n{EVENTS_UNCHANGED}\n")
    return offset_us


def _make_cameras(products: Products, folder: Path, calibration: str) -> None:
    cameras, file = CAMERAS[calibration], folder / f"calib_undist_{calibration}.json"
    rectify_map = folder / f"rectify_map_{calibration}.h5"
    if products.missing(file) and products.missing(rectify_map):  # an existing map fits to the published numbers
        entries = [dict(zip(("fx", "fy", "cx", "cy"), undistorted_intrinsics(cameras[name]).tolist()))
                   for name in ("rgb", "evs")]
        products.text(file, json.dumps({"intrinsics_undistorted": entries}, indent=4) + "\n")
    products.map(rectify_map, cameras["evs"], undistorted_camera(folder, calibration, "evs"))


def _make_images(products: Products, folder: Path, calibration: str, count: int) -> None:
    undistort_files(products, folder / f"images_undistorted_{calibration}",
                    counted_images(folder / "images", count), CAMERAS[calibration]["rgb"],
                    undistorted_camera(folder, calibration, "rgb"), cv2.INTER_LINEAR)


def outputs(folder: Path, side: str) -> list[Path]:
    """Files that an event run needs."""
    return [folder / OFFSET_FILE, folder / STAMPS_FILE, folder / "rectify_map_calib0.h5"]


register(Preprocessor(
    "eds", "folders with events.h5, images_timestamps.txt, images/ and stamped_groundtruth.txt",
    lambda root, side: walk_folders(root, lambda folder: (folder / RAW_STAMPS_FILE).is_file()),
    run, outputs, ("left",)))
