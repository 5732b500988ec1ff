"""Recordings that list their images in a text file: where the images are, and their undistorted copies."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy.typing as npt

from devo.errors import InputError
from utils.calibration import Calibration
from utils.datasets.files import natural_order
from utils.preprocessing.products import Image, Products, read_raw_image
from utils.undistort import ImageUndistorter


def listed_images(folder: Path, names: list[str] | None, subfolder: Path, list_file: Path) -> list[Path]:
    """Return the image files of a list; names are relative to the recording or to its folder of images.

    Raises:
        InputError: the list has no names, or a file is missing.
    """
    if names is None:
        raise InputError(f"{list_file}: holds no names of images, expected lines with stamp and name")
    paths = [folder / name if "/" in name else subfolder / name for name in names]
    missing = [path for path in paths if not path.is_file()]
    if missing:
        raise InputError(f"{list_file}: {len(missing)} of {len(paths)} images are missing, the first is {missing[0]}; "
                         "unpack the recording again, or leave images out with --no-images")
    return paths


def counted_images(folder: Path, count: int) -> list[Path]:
    """Return the `count` image files of a folder in natural order.

    Raises:
        InputError: the folder is missing or holds another number of images.
    """
    paths = natural_order(folder)
    if len(paths) != count:
        raise InputError(f"{folder}: {len(paths)} images for {count} stamps; unpack the recording again, or leave "
                         "images out with --no-images")
    return paths


def undistort_files(products: Products, folder: Path, paths: list[Path], calibration: Calibration,
                    intrinsics: npt.ArrayLike, interpolation: int | None = None, *, numbered: bool = False) -> None:
    """Write undistorted copies of image files into `folder`; see `Products.image_folder`.

    Args:
        products: account of what is made.
        folder: where to.
        paths: the images.
        calibration: their camera.
        intrinsics: (4,) `fx fy cx cy` of the undistorted camera.
        interpolation: OpenCV's flag, None for bicubic.
        numbered: name the copies 000000.png, 000001.png, ... instead of keeping the names.
    """
    def images() -> Iterator[tuple[str, Image]]:
        undistort = ImageUndistorter(calibration, intrinsics, *([] if interpolation is None else [interpolation]))
        for number, path in enumerate(paths):
            image = read_raw_image(path)
            try:
                yield f"{number:06d}.png" if numbered else path.name, undistort(image)
            except InputError as error:
                raise InputError(f"{path}: {error}") from None

    products.image_folder(folder, len(paths), images)
