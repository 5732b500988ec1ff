"""Lens distortion: where each sensor pixel lies in the undistorted image, and undistorted frames.

The map is a forward map: `map[y, x]` is the position `(x', y')` of the raw sensor pixel (x, y) in the undistorted
image, which is what events need. (`cv2.remap` wants the inverse map; `undistort_image` builds that one itself.)
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.calibration import Calibration
from utils.events.hdf5 import hdf5_errors, open_hdf5
from utils.events.hdf5_output import create_hdf5

RectifyMap = npt.NDArray[np.float32]
_CRITERIA = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 100, 0.001)
_MOST_FAILING_PIXELS = 0.1


def undistorted_intrinsics(calibration: Calibration, *, alpha: float = 0.0,
                           balance: float = 0.0) -> npt.NDArray[np.float64]:
    """Return `fx fy cx cy` (4,) of the undistorted image, which has the size of the sensor.

    Args:
        calibration: the camera.
        alpha: radtan only; 0 keeps only valid pixels, 1 keeps all.
        balance: fisheye only; 0 keeps only valid pixels, 1 keeps all.

    Values depend on the OpenCV version by up to 0.7 % (4.8 changed the radtan formula), so a map and its
    intrinsics must come from the same run.
    """
    size = (calibration.width, calibration.height)
    K, D = calibration.camera_matrix, np.array(calibration.coefficients)
    if not calibration.is_distorted:
        return calibration.intrinsics
    if calibration.distortion_model == "fisheye":
        new = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(K, D, size, np.eye(3), balance=balance)
    else:
        new = cv2.getOptimalNewCameraMatrix(K, D, size, alpha, size)[0]
    result = np.array([new[0, 0], new[1, 1], new[0, 2], new[1, 2]], np.float64)
    if not np.isfinite(result).all() or result[:2].min() <= 0:
        raise InputError(f"calibration: the distortion {list(calibration.coefficients)} cannot be undone (the "
                         f"undistorted camera would be {result.tolist()}); check the coefficients and their order")
    return result


def rectify_map(calibration: Calibration, *, intrinsics: npt.ArrayLike | None = None, alpha: float = 0.0,
                balance: float = 0.0) -> tuple[RectifyMap, npt.NDArray[np.float64]]:
    """Compute where every sensor pixel lies in the undistorted image.

    Args:
        calibration: the camera.
        intrinsics: (4,) `fx fy cx cy` of the undistorted image; None chooses them, see `undistorted_intrinsics`.
        alpha, balance: see `undistorted_intrinsics`.

    Returns:
        The (H, W, 2) float32 forward map in pixels and the (4,) float64 intrinsics of the undistorted image.

    Raises:
        InputError: the distortion cannot be undone.
    """
    new = undistorted_intrinsics(calibration, alpha=alpha, balance=balance) if intrinsics is None else np.asarray(
        intrinsics, np.float64)
    rows, columns = np.mgrid[:calibration.height, :calibration.width].astype(np.float32)
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=-1)[:, None]
    K, D, P = calibration.camera_matrix, np.array(calibration.coefficients), _matrix(new)
    positions: npt.NDArray[Any]
    if not calibration.is_distorted:
        positions = ((pixels[:, 0] - calibration.intrinsics[2:]) / calibration.intrinsics[:2] * new[:2] + new[2:])
    elif calibration.distortion_model == "fisheye":
        positions = cv2.fisheye.undistortPoints(pixels, K, D, R=np.eye(3), P=P)
    elif hasattr(cv2, "undistortPointsIter"):  # OpenCV 4; version 5 merged it into undistortPoints
        positions = cv2.undistortPointsIter(pixels, K, D, np.eye(3), P, _CRITERIA)
    else:
        positions = cv2.undistortPoints(pixels, K, D, R=np.eye(3), P=P, criteria=_CRITERIA)
    positions = positions.reshape(-1, 2)
    if calibration.is_distorted:
        _check_inverse(calibration, positions, pixels[:, 0], new)
    return positions.reshape(calibration.height, calibration.width, 2).astype(np.float32), new


def _check_inverse(calibration: Calibration, positions: npt.NDArray[Any], pixels: npt.NDArray[np.float32],
                   intrinsics: npt.NDArray[np.float64]) -> None:
    """Refuse a map that the lens model does not lead back to the sensor, as wrong coefficients make it.

    A few corner pixels may fail: fitted lens models are often not invertible there.
    """
    rays = np.column_stack([(positions - intrinsics[2:]) / intrinsics[:2], np.ones(len(positions))])[:, None]
    K, D, zero = calibration.camera_matrix, np.array(calibration.coefficients), np.zeros(3)
    project = cv2.fisheye.projectPoints if calibration.distortion_model == "fisheye" else cv2.projectPoints
    error = np.abs(project(rays, zero, zero, K, D)[0].reshape(-1, 2) - pixels).max(axis=1)
    share = float(np.mean(~(error < 1.0)))
    if share > _MOST_FAILING_PIXELS:
        raise InputError(f"calibration: the {calibration.distortion_model} distortion {list(calibration.coefficients)} "
                         f"cannot be undone for {share:.0%} of the pixels; check the coefficients, their order and "
                         "the model")


class ImageUndistorter:
    """Undistort many images of one camera; size is kept, black where the sensor saw nothing.

    Args:
        calibration: the camera.
        intrinsics: (4,) `fx fy cx cy` of the undistorted image, as `rectify_map` returns them.
        interpolation: OpenCV's flag; bicubic unless a data set was made with another.
    """

    def __init__(self, calibration: Calibration, intrinsics: npt.ArrayLike,
                 interpolation: int = cv2.INTER_CUBIC) -> None:
        self._size = size = (calibration.width, calibration.height)
        self._interpolation = interpolation
        is_fisheye = calibration.distortion_model == "fisheye"
        build = cv2.fisheye.initUndistortRectifyMap if is_fisheye else cv2.initUndistortRectifyMap
        self._map_x, self._map_y = build(calibration.camera_matrix, np.array(calibration.coefficients), np.eye(3),
                                         _matrix(np.asarray(intrinsics, np.float64)), size, cv2.CV_32FC1)

    def __call__(self, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Return the undistorted (H, W) or (H, W, 3) uint8 image.

        Raises:
            InputError: the image has another size than the calibration.
        """
        if image.shape[1::-1] != self._size:
            raise InputError(f"image of {image.shape[1]}x{image.shape[0]} pixels, but the calibration is for "
                             f"{self._size[0]}x{self._size[1]}")
        return cv2.remap(image, self._map_x, self._map_y, self._interpolation)  # type: ignore[return-value]


def undistort_image(image: npt.NDArray[np.uint8], calibration: Calibration,
                    intrinsics: npt.ArrayLike) -> npt.NDArray[np.uint8]:
    """Return one undistorted image, see `ImageUndistorter`."""
    return ImageUndistorter(calibration, intrinsics)(image)


def write_rectify_map(path: str | os.PathLike[str], positions: npt.ArrayLike) -> None:
    """Write a forward map (H, W, 2) as HDF5 with the one dataset `rectify_map`, float32, uncompressed.

    Raises:
        InputError: the map has another shape.
        OutputError: the file cannot be written.
    """
    values = np.asarray(positions, "<f4")
    if values.ndim != 3 or values.shape[2] != 2:
        raise InputError(f"rectification map has shape {values.shape}, expected (H, W, 2)")
    with create_hdf5(path) as output:
        output.file.create_dataset("rectify_map", data=values)


def read_rectify_map(path: str | os.PathLike[str], image_size: tuple[int, int] | None = None) -> RectifyMap:
    """Read a forward map (H, W, 2) float32 from HDF5.

    Args:
        path: file with the dataset `rectify_map`.
        image_size: (width, height) the map must have.

    Raises:
        InputError: the file is missing or damaged, holds no such map, or is for another sensor size.
    """
    path = Path(path)
    with open_hdf5(path) as stream, hdf5_errors(path):
        if "rectify_map" not in stream:
            raise InputError(f"{path}: dataset rectify_map missing, found {', '.join(sorted(stream)) or 'nothing'}")
        values = np.asarray(stream["rectify_map"][()])
    if values.ndim != 3 or values.shape[2] != 2 or values.dtype.kind != "f":
        raise InputError(f"{path}: rectify_map is {values.dtype} {values.shape}, expected float (H, W, 2)")
    if image_size is not None and values.shape[:2] != (image_size[1], image_size[0]):
        raise InputError(f"{path}: the map is for {values.shape[1]}x{values.shape[0]} pixels, the sensor has "
                         f"{image_size[0]}x{image_size[1]}")
    return values.astype(np.float32)


def _matrix(intrinsics: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    fx, fy, cx, cy = intrinsics
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
