"""TUM-VIE: events in HDF5 and frames behind fisheye lenses; one of two calibrations by name of the sequence."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import cv2

from devo.errors import InputError
from utils.calibration import read_mapping
from utils.datasets.prepared import only_match, read_stamps
from utils.datasets.tumvie import (
    CALIBRATION_FILE,
    CAMERAS,
    EVENT_BALANCE,
    FRAME_BALANCE,
    event_pattern,
    frame_camera,
    read_camera,
    read_undistorted,
)
from utils.preprocessing.image_lists import counted_images, undistort_files
from utils.preprocessing.products import Products
from utils.preprocessing.registry import PreprocessOptions, Preprocessor, folders_around, register, walk_folders
from utils.undistort import undistorted_intrinsics

RAW_CALIBRATION = "calibration.json"
_CALIBRATION_A = ("loop-floor", "mocap-desk", "skate-easy")  # mocap-desk2 included


def run(folder: Path, options: PreprocessOptions) -> list[Path]:
    """Make calibrations, rectification map and images of one side of a sequence; the clock stays as it is."""
    products, side = Products(options), options.side
    events = only_match(folder, event_pattern(side), f"event file of the {side} camera of TUM-VIE")
    source, target = folder / f"{side}_images", folder / f"{side}_images_undistorted"
    stamps = source / f"image_timestamps_{side}.txt"
    count = len(read_stamps(stamps))
    raw, undistorted = folder / RAW_CALIBRATION, folder / CALIBRATION_FILE
    if products.missing(raw, undistorted):
        _make_calibrations(products, raw, undistorted, find_calibration(folder, events.name))
    products.map(folder / f"rectify_map_{side}.h5", read_camera(undistorted, CAMERAS[side]),
                 read_undistorted(undistorted, CAMERAS[side]))
    if options.images:
        _make_images(products, source, target, count, undistorted, side)
    for text in (stamps, source / f"image_exposures_{side}.txt"):  # the images' folder is replaced as a whole
        if text.is_file() and products.missing(target / text.name):
            with products.file(target / text.name) as temporary:
                shutil.copyfile(text, temporary)
    return products.made


def find_calibration(folder: Path, event_file: str) -> Path:
    """Return the calibration of a sequence: `camera-calibration{A,B}.json` beside it, else the copy in it.

    The names of the folder and of its event file decide which; those of the folders around it do not.

    Raises:
        InputError: there is none.
    """
    names = (event_file, Path(os.path.abspath(folder)).name, folder.resolve().name)  # noqa: PTH100 - keeps links
    letter = "A" if any(part in name for part in _CALIBRATION_A for name in names) else "B"
    name = f"camera-calibration{letter}.json"
    for candidate in (*(holder / name for holder in folders_around(folder)), folder / name, folder / RAW_CALIBRATION):
        if candidate.is_file():
            return candidate
    raise InputError(f"{folder}: no calibration; put {name} of TUM-VIE beside the sequence")


def _make_calibrations(products: Products, raw: Path, undistorted: Path, source: Path) -> None:
    content: dict[str, Any] = read_mapping(source)
    cameras = []
    for number in range(4):  # frame cameras first; each entry describes the images that are really made
        balance = FRAME_BALANCE if number < 2 else EVENT_BALANCE
        values = undistorted_intrinsics(read_camera(source, number), balance=balance)
        cameras.append(dict(zip(("fx", "fy", "cx", "cy"), values.tolist())))
    if source != raw:
        with products.file(raw) as temporary:
            shutil.copyfile(source, temporary)
    content["value0"]["intrinsics_undistorted"] = cameras
    products.text(undistorted, json.dumps(content, indent=4) + "\n")


def _make_images(products: Products, source: Path, target: Path, count: int, calibration: Path, side: str) -> None:
    camera = read_camera(calibration, frame_camera(side))
    intrinsics = undistorted_intrinsics(camera, balance=FRAME_BALANCE)
    undistort_files(products, target, counted_images(source, count), camera, intrinsics, cv2.INTER_LINEAR)


def _is_sequence(folder: Path, side: str) -> bool:
    return any(folder.glob(event_pattern(side))) or (folder / f"{side}_images").is_dir()


def outputs(folder: Path, side: str) -> list[Path]:
    """Files that an event run needs."""
    return [folder / CALIBRATION_FILE, folder / f"rectify_map_{side}.h5",
            folder / f"{side}_images_undistorted" / f"image_timestamps_{side}.txt"]


register(Preprocessor(
    "tumvie", "folders with *events_{left,right}.h5 and {left,right}_images/, beside camera-calibration{A,B}.json",
    lambda root, side: walk_folders(root, lambda folder: _is_sequence(folder, side)),
    run, outputs))
