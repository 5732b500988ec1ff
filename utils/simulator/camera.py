"""The simulated camera: the usual sensors, and the viewing rays of a calibrated, possibly distorted one."""

from __future__ import annotations

import re

import cv2
import numpy as np
import torch

from devo.errors import InputError
from utils.calibration import Calibration
from utils.simulator.renderer import Rays, pinhole_rays

PRESET_FOCAL = {(240, 180): 199.0, (346, 260): 272.0, (640, 480): 520.0}
"""Focal length in pixels of the usual sensors (DAVIS240, DAVIS346, Gen3 VGA) with their common lenses."""

TYPICAL_DISTORTION = (-0.36, 0.15, 0.0004, -0.0003)
"""A barrel-distorted wide-angle lens, `k1 k2 p1 p2`."""


def camera_preset(width: int, height: int, distorted: bool = False) -> Calibration:
    """The usual camera of this size in pixels; other sizes get the horizontal field of view of the 240x180 one."""
    focal = PRESET_FOCAL.get((width, height), 199.0 * width / 240.0)
    return Calibration(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2,
                       "radtan" if distorted else "none", TYPICAL_DISTORTION if distorted else ())


def camera_rays(camera: Calibration, device: torch.device | str = "cpu") -> Rays:
    """Viewing rays of all pixels; with distortion, the rays that the lens bends onto the pixel centres.

    Raises:
        InputError: a fisheye camera, which this simulator does not draw.
    """
    if camera.distortion_model == "fisheye":
        raise InputError("the simulator draws pinhole and radtan cameras, found a fisheye calibration")
    if not camera.is_distorted:
        return pinhole_rays((camera.fx, camera.fy, camera.cx, camera.cy), camera.height, camera.width, device)
    rows, columns = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
    pixels = np.stack([columns, rows], -1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    ideal = cv2.undistortPoints(pixels, camera.camera_matrix, np.array(camera.coefficients), criteria=criteria)
    grid = torch.from_numpy(ideal.reshape(camera.height, camera.width, 2).astype(np.float32)).to(device)
    return Rays(grid[..., 0].contiguous(), grid[..., 1].contiguous(), (camera.fx * camera.fy) ** 0.5)


def parse_size(text: str) -> tuple[int, int]:
    """Read `WIDTHxHEIGHT`.

    Raises:
        InputError: another form, or a size that cannot be simulated.
    """
    match = re.fullmatch(r"(\d+)[xX](\d+)", text.strip())
    if match is None:
        raise InputError(f"image size {text!r} is not WIDTHxHEIGHT, for example 240x180")
    width, height = int(match[1]), int(match[2])
    if not (16 <= width <= 2048 and 16 <= height <= 2048):
        raise InputError(f"image size {width}x{height} cannot be simulated, expected 16 to 2048 pixels a side")
    return width, height
