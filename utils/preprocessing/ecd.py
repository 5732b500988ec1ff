"""Event Camera Dataset: text events, PNG frames and the calibration of a DAVIS240C in one folder."""

from __future__ import annotations

from pathlib import Path

from devo.errors import InputError
from utils.calibration import Calibration, read_calibration
from utils.datasets.ecd import SIZE
from utils.datasets.files import read_image_list
from utils.preprocessing.image_lists import listed_images, undistort_files
from utils.preprocessing.products import Products
from utils.preprocessing.registry import PreprocessOptions, Preprocessor, register, walk_folders


def ecd_calibration(folder: Path) -> Calibration:
    """Return the camera of a sequence from its `calib.txt` with `fx fy cx cy k1 k2 p1 p2 k3`.

    Raises:
        InputError: the file is missing or holds something else.
    """
    calibration = read_calibration(folder / "calib.txt", image_size=SIZE)
    if calibration.distortion_model != "radtan":
        raise InputError(f"{folder / 'calib.txt'}: no distortion coefficients, expected fx fy cx cy k1 k2 p1 p2 k3")
    return calibration


def run(folder: Path, options: PreprocessOptions) -> list[Path]:
    """Make stamps, undistorted camera, rectification map and images of one sequence; the clock stays as it is."""
    products = Products(options)
    calibration = ecd_calibration(folder)
    if not (folder / "events.txt").is_file():
        raise InputError(f"{folder}: events.txt is missing")
    images = read_image_list(folder / "images.txt", "s", whole=False)
    if products.missing(folder / "tss_us.txt"):
        products.table(folder / "tss_us.txt", images.stamps_us)
    intrinsics = products.pinhole(folder / "calib_undist.txt", calibration)
    products.map(folder / "rectify_map.h5", calibration, intrinsics)
    if options.images:
        paths = listed_images(folder, images.names, folder / "images", folder / "images.txt")
        undistort_files(products, folder / "images_undistorted", paths, calibration, intrinsics)
    return products.made


def _is_sequence(folder: Path) -> bool:
    return (folder / "images.txt").is_file() and (folder / "images").is_dir()


def outputs(folder: Path, side: str) -> list[Path]:
    """Files that an event run needs."""
    return [folder / name for name in ("tss_us.txt", "calib_undist.txt", "rectify_map.h5")]


register(Preprocessor(
    "ecd", "folders with events.txt, images.txt, images/ and calib.txt",
    lambda root, side: walk_folders(root, _is_sequence), run, outputs, ("left",)))
