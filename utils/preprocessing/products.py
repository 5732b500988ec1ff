"""The files that preprocessing leaves behind, in the formats of folders that were preprocessed elsewhere before.

| file | content |
|---|---|
| pinhole text | one line `fx fy cx cy`, no newline at its end |
| rectification map | HDF5 with the one dataset `rectify_map`, (H, W, 2) float32 |
| stamps | one number per line, microseconds |
| poses | `t_us tx ty tz qx qy qz qw` per line, camera to world |
| undistorted images | one folder, names as given |
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from devo.errors import InputError, OutputError
from utils.atomic import atomic_folder, atomic_path
from utils.calibration import Calibration, read_calibration
from utils.datasets.files import natural_order
from utils.preprocessing.registry import PreprocessOptions
from utils.undistort import rectify_map, undistorted_intrinsics, write_rectify_map

Floats = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]


class Products:
    """Account of what one run makes: complete files are kept unless all are to be made anew.

    Attributes:
        made: the files and folders made so far.
        has_new_camera: an undistorted camera was made, so maps and images of an earlier one are made again.
    """

    def __init__(self, options: PreprocessOptions) -> None:
        self.options = options
        self.made: list[Path] = []
        self.has_new_camera = False

    def missing(self, *paths: Path) -> bool:
        """Whether any of these has to be made."""
        return self.options.overwrite or not all(path.exists() for path in paths)

    @contextlib.contextmanager
    def file(self, path: Path) -> Iterator[Path]:
        """Yield a temporary name that becomes `path` when the block ends without an error."""
        with atomic_path(path) as temporary:
            yield temporary
        self.made.append(path)

    def text(self, path: Path, text: str) -> None:
        """Write a text file."""
        with self.file(path) as temporary:
            temporary.write_text(text, encoding="ascii")

    def table(self, path: Path, values: npt.ArrayLike, number_format: str = "%r", header: str = "") -> None:
        """Write numbers, one row per line, blanks between columns.

        Args:
            path: the file.
            values: (N,) or (N, C) numbers.
            number_format: printf-style format of one number; `%r` prints floats so that they come back exactly.
            header: first line as it stands, without the newline.
        """
        rows = np.asarray(values).reshape(len(np.asarray(values)), -1)
        line = " ".join([number_format] * rows.shape[1]) + "\n"
        self.text(path, (header + "\n" if header else "") + line * len(rows) % tuple(rows.ravel().tolist()))

    def pinhole(self, path: Path, calibration: Calibration, *, balance: float = 0.0) -> Floats:
        """Return `fx fy cx cy` of the undistorted camera from the file, which is made if it is missing.

        An existing file decides, because maps and images made before fit to it; OpenCV versions choose
        differently (see `undistorted_intrinsics`).
        """
        if not self.missing(path):
            return read_calibration(path, image_size=(calibration.width, calibration.height)).intrinsics
        intrinsics = undistorted_intrinsics(calibration, balance=balance)
        self.text(path, pinhole_text(intrinsics))
        self.has_new_camera = True
        return intrinsics

    def map(self, path: Path, calibration: Calibration, intrinsics: npt.ArrayLike) -> None:
        """Make the rectification map of the events, if it is missing or belongs to an earlier camera."""
        if self.missing(path) or self.has_new_camera:
            write_rectify_map(path, rectify_map(calibration, intrinsics=intrinsics)[0])
            self.made.append(path)

    def image_folder(self, folder: Path, count: int, images: Callable[[], Iterable[tuple[str, Image]]]) -> None:
        """Write images into a folder that appears when it is complete.

        Args:
            folder: where to; kept if it holds `count` images already.
            count: how many images there are.
            images: opens the stream of names and (H, W) or (H, W, 3) uint8 images.

        Raises:
            OutputError: an image cannot be written.
        """
        from tqdm import tqdm

        is_complete = _count_images(folder) == count and not self.has_new_camera and not self.options.overwrite
        if is_complete or not self.options.images:
            return
        bar = tqdm(images(), total=count, unit="image", desc=folder.name, leave=False,
                   disable=not self.options.progress)
        with atomic_folder(folder) as temporary:
            for name, image in bar:
                if not cv2.imwrite(str(temporary / name), image):
                    raise OutputError(f"cannot write {folder / name}; check the free disk space")
        self.made.append(folder)


def pinhole_text(intrinsics: npt.ArrayLike) -> str:
    """Return the line `fx fy cx cy`."""
    return " ".join(repr(value) for value in np.asarray(intrinsics, np.float64).tolist())


def read_raw_image(path: Path) -> Image:
    """Read an 8-bit image as it is stored, (H, W) gray or (H, W, 3) BGR.

    Raises:
        InputError: the file is missing, damaged or not of 8 bits.
    """
    image: Any = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint8:
        problem = "the file is missing or damaged" if image is None else f"{image.dtype}, expected 8 bits"
        raise InputError(f"cannot read image {path}: {problem}")
    return image  # type: ignore[no-any-return]


def _count_images(folder: Path) -> int:
    return len(natural_order(folder)) if folder.is_dir() else 0
