"""Folders of ready-made frames: images, or voxel grids in one HDF5 file each."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F  # noqa: N812

from devo.errors import InputError
from utils.datasets.files import natural_key, read_image_list
from utils.datasets.sequence import Frame, read_image
from utils.events.hdf5 import hdf5_errors, open_hdf5

_TARTAN_INTRINSICS = (320.0, 320.0, 320.0, 240.0)


def video_iterator(imagedir: str | os.PathLike[str], tss_file: str | os.PathLike[str] | None = None, ext: str = ".png",
                   intrinsics: Sequence[float] = _TARTAN_INTRINSICS, stride: int = 1,
                   scale: float = 1.0) -> Iterator[Frame]:
    """Yield `(image (3,H,W) uint8 BGR, intrinsics (4,) float64, t_us)` for the images of a folder.

    Args:
        imagedir: folder; numbers in the names are compared as numbers.
        tss_file: one stamp per image in microseconds; without it the stamp is the index of the image.
        ext: ending of the image files.
        intrinsics: `fx fy cx cy` of the images on disk in pixels; yielded times `scale`.
        stride: use every stride-th image.
        scale: size of the yielded images relative to those on disk.

    Raises:
        InputError: no images, a number of stamps that differs from theirs, or an image that cannot be read.
    """
    paths, stamps = _files_and_stamps(Path(imagedir), ext, tss_file, stride)
    camera = torch.tensor([float(value) * scale for value in intrinsics], dtype=torch.float64)
    for path, stamp_us in zip(paths, stamps):
        image = read_image(path)
        if scale != 1.0:
            size = (int(image.shape[1] * scale), int(image.shape[0] * scale))
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
        yield torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))), camera.clone(), float(stamp_us)


def voxel_iterator(voxeldir: str | os.PathLike[str], tss_file: str | os.PathLike[str] | None = None, ext: str = ".h5",
                   intrinsics: Sequence[float] = _TARTAN_INTRINSICS, stride: int = 1,
                   scale: float = 1.0) -> Iterator[Frame]:
    """Yield `(voxel grid (B,H,W) float32, intrinsics (4,) float64, t_us)` from files with the dataset `voxel`.

    Arguments and errors as for `video_iterator`; voxel grids are scaled bilinearly.
    """
    paths, stamps = _files_and_stamps(Path(voxeldir), ext, tss_file, stride)
    camera = torch.tensor([float(value) * scale for value in intrinsics], dtype=torch.float64)
    for path, stamp_us in zip(paths, stamps):
        voxel = read_voxel(path)
        if scale != 1.0:
            voxel = F.interpolate(voxel[None], size=(int(voxel.shape[1] * scale), int(voxel.shape[2] * scale)),
                                  mode="bilinear", align_corners=False, antialias=False)[0]
        yield voxel, camera.clone(), float(stamp_us)


def read_voxel(path: Path) -> torch.Tensor:
    """Read the voxel grid (B, H, W) of one file as float32.

    Raises:
        InputError: the file is missing or damaged, or holds no voxel grid.
    """
    with open_hdf5(path) as stream, hdf5_errors(path):
        if "voxel" not in stream:
            raise InputError(f"{path}: dataset voxel missing, found {', '.join(sorted(stream)) or 'nothing'}")
        voxel = torch.from_numpy(np.asarray(stream["voxel"][()], np.float32))
    if voxel.ndim != 3:
        raise InputError(f"{path}: voxel grid has shape {tuple(voxel.shape)}, expected (bins, H, W)")
    return voxel


def _files_and_stamps(folder: Path, ext: str, tss_file: str | os.PathLike[str] | None,
                      stride: int) -> tuple[list[Path], npt.NDArray[np.float64]]:
    if stride < 1:
        raise InputError(f"stride is {stride}, expected at least 1")
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder, expected {ext} files")
    paths = sorted((path for path in folder.iterdir() if path.suffix == ext), key=natural_key)
    if not paths:
        raise InputError(f"{folder}: no {ext} files")
    stamps = np.arange(len(paths), dtype=np.float64)
    if tss_file is not None:
        stamps = np.sort(read_image_list(Path(tss_file), "us").stamps_us)
        if len(stamps) != len(paths):
            raise InputError(f"{tss_file}: {len(stamps)} stamps for {len(paths)} {ext} files in {folder}")
    return paths[::stride], stamps[::stride]
