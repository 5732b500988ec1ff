"""Preprocessed folders of vector, tumvie, eds, mvsec and tartan with few events and a map that moves nothing."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np

from tests.utils.event_samples import write_flat_h5
from utils.events import Events, write_events_h5
from utils.undistort import write_rectify_map

VGA, HD, DAVIS346 = (640, 480), (1280, 720), (346, 260)
GAPS_MS = (30, 50, 40, 35, 45, 60, 20, 40, 40)
"""Uneven distances of image stamps, so that the mean distance (40 ms) and the actual one can be told apart."""


def image_stamps(first_us: int = 5000) -> np.ndarray:
    """(10,) microseconds."""
    return first_us + 1000 * np.concatenate([[0], np.cumsum(GAPS_MS)])


def steady_events(last_us: int, first_us: int = 0, step_us: int = 500) -> Events:
    """One event every `step_us`, up to `last_us`, at changing pixels of the upper left 64x48."""
    t_us = np.arange(first_us, last_us + 1, step_us)
    number = np.arange(len(t_us))
    return Events((number * 7 % 64).astype(np.uint16), (number * 5 % 48).astype(np.uint16), t_us.astype(np.int64),
                  (number % 3 > 0).astype(np.uint8))


def write_identity_map(path: Path, size: tuple[int, int]) -> None:
    columns, rows = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    write_rectify_map(path, np.stack([columns, rows], axis=-1))


def write_numbers(path: Path, numbers: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text("".join(f"{number!r}\n" for number in np.asarray(numbers).tolist()))


def prepared_vector(folder: Path, stamps_us: np.ndarray, events: Events, name: str = "corridors_walk",
                    side: str = "left") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    write_events_h5(folder / f"{name}1.synced.{side}_event.hdf5", events, int(events.t_us[0]))
    write_numbers(folder / f"tss_imgs_us_{side}.txt", stamps_us)
    (folder / f"calib_undist_evs_{side}.txt").write_text("500.5 501.5 320.25 240.75")
    write_identity_map(folder / f"rectify_map_{side}.h5", VGA)
    return folder


def prepared_tumvie(folder: Path, stamps_us: np.ndarray, events: Events, side: str = "left") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    write_events_h5(folder / f"mocap-6dof-events_{side}.h5", events, 0)
    write_numbers(folder / f"{side}_images_undistorted" / f"image_timestamps_{side}.txt", stamps_us)
    pinholes = [{"fx": 900.0 + number, "fy": 901.0, "cx": 640.0, "cy": 360.0} for number in range(4)]
    (folder / "calib_undist.json").write_text(json.dumps({"value0": {"intrinsics_undistorted": pinholes}}))
    write_identity_map(folder / f"rectify_map_{side}.h5", HD)
    return folder


def prepared_eds(folder: Path, stamps_us: np.ndarray, events: Events, calibration: str = "calib0") -> Path:
    """As the published preprocessing leaves it: events shifted in place, no intrinsics file."""
    folder.mkdir(parents=True, exist_ok=True)
    write_flat_h5(folder / "events.h5", events)
    write_numbers(folder / "images_timestamps_us.txt", stamps_us)
    (folder / "t_offset_us.txt").write_text("1.600000000000000000e+15\n")
    write_identity_map(folder / f"rectify_map_{calibration}.h5", VGA)
    return folder


def prepared_mvsec(folder: Path, stamps_us: np.ndarray, events: Events, closing: np.ndarray) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    with h5py.File(folder / f"{folder.name}.hdf5", "w") as file:
        file["davis/left/events"] = np.column_stack([events.x, events.y, events.t_us / 1e6, 2.0 * events.p - 1])
        file["davis/left/image_raw_event_inds"] = closing
    write_numbers(folder / "tss_imgs_us_left.txt", stamps_us)
    (folder / "calib_undist_left.txt").write_text("200 201 173 130")
    write_identity_map(folder / "rectify_map_left.h5", DAVIS346)
    return folder
