"""MVSEC indoor flying: both cameras in one HDF5 file; the calibration in a folder beside all recordings."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from devo.errors import InputError
from utils.calibration import read_calibration
from utils.datasets.mvsec import DATA_SUFFIX, POSES_SUFFIX, SIZE, read_array
from utils.events.hdf5 import hdf5_errors, open_hdf5
from utils.preprocessing.products import Image, Products
from utils.preprocessing.registry import PreprocessOptions, Preprocessor, register, walk_folders
from utils.undistort import ImageUndistorter

CALIBRATION_FILE = Path("indoor_flying_calib", "camchain-imucam-indoor_flying.yaml")
_CAMERAS = {"left": "cam0", "right": "cam1"}
_IMAGES_PER_READ = 64


def run(folder: Path, options: PreprocessOptions) -> list[Path]:
    """Make the folder `{name}_data` of one recording with stamps, undistorted camera, rectification map and images.

    The two HDF5 files are linked into the folder, or copied where the file system has no links.
    """
    products, side = Products(options), options.side
    data = folder / f"{folder.name}.hdf5"
    calibration = read_calibration(folder.parent / CALIBRATION_FILE, SIZE, camera=_CAMERAS[side],
                                   default_model="fisheye")
    for name in (data.name, data.name.removesuffix(DATA_SUFFIX) + POSES_SUFFIX):
        _bring(products, folder.parent / name, folder / name)
    if not data.is_file():
        raise InputError(f"{folder}: {data.name} is missing, in the folder and beside it")
    stamps_us = read_array(data, f"davis/{side}/image_raw_ts").astype(np.float64).reshape(-1) * 1e6
    if products.missing(folder / f"tss_imgs_us_{side}.txt"):
        products.table(folder / f"tss_imgs_us_{side}.txt", stamps_us)
    intrinsics = products.pinhole(folder / f"calib_undist_{side}.txt", calibration)
    products.map(folder / f"rectify_map_{side}.h5", calibration, intrinsics)
    if options.images:
        undistort = ImageUndistorter(calibration, intrinsics)
        products.image_folder(folder / f"images_undistorted_{side}", len(stamps_us), lambda: (
            (f"{number:06d}.png", undistort(image))
            for number, image in enumerate(_images(data, f"davis/{side}/image_raw"))))
    return products.made


def _bring(products: Products, source: Path, target: Path) -> None:
    """Make a recording appear in the folder that preprocessing makes, without a second copy if possible."""
    if target.is_file() or not source.is_file():
        return
    with products.file(target) as temporary:
        temporary.unlink()
        try:
            os.link(source, temporary)
        except OSError:  # another file system, or one without hard links
            shutil.copyfile(source, temporary)


def _images(path: Path, name: str) -> Iterator[Image]:
    with open_hdf5(path) as file, hdf5_errors(path):
        stored = file[name]
        if stored.ndim != 3 or stored.dtype != np.uint8:
            raise InputError(f"{path}: {name} is {stored.dtype} {stored.shape}, expected uint8 (N, height, width)")
        for first in range(0, len(stored), _IMAGES_PER_READ):
            yield from stored[first:first + _IMAGES_PER_READ]


def find_sequences(root: Path, side: str) -> list[Path]:
    """Return the folders `{name}_data` for all recordings `{name}_data.hdf5` at or below `root`, made or to be made."""
    if root.is_file():
        return [_folder_of(root)] if root.name.endswith(DATA_SUFFIX) else []
    if not root.exists():
        return [root] if root.name.endswith("_data") and root.with_name(f"{root.name}.hdf5").is_file() else []
    holders = walk_folders(root, lambda folder: any(folder.glob(f"*{DATA_SUFFIX}")))
    return sorted({_folder_of(file) for folder in holders for file in folder.glob(f"*{DATA_SUFFIX}")})


def _folder_of(data: Path) -> Path:
    data = data.absolute() if data.parent == Path() else data
    name = data.name.removesuffix(".hdf5")
    return data.parent if data.parent.resolve().name == name else data.parent / name


def outputs(folder: Path, side: str) -> list[Path]:
    """Files that an event run needs."""
    return [folder / f"{folder.name}.hdf5", folder / f"tss_imgs_us_{side}.txt", folder / f"calib_undist_{side}.txt",
            folder / f"rectify_map_{side}.h5"]


register(Preprocessor("mvsec", "recordings {name}_data.hdf5 and {name}_gt.hdf5 beside indoor_flying_calib/",
                      find_sequences, run, outputs))
