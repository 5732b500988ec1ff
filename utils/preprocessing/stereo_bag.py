"""What the bags of RPG and HKU have in common: one bag per recording, a folder of its name beside it for the products.

All stamps are counted from the first event, image or pose of the side, whichever comes first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.calibration import Calibration
from utils.datasets.stereo_files import StereoFiles
from utils.events.writers import EventH5Writer
from utils.preprocessing.bag_camera import BagCamera, EventBlock, Topics
from utils.preprocessing.poses import times_transform
from utils.preprocessing.products import Image, Products
from utils.preprocessing.registry import PreprocessOptions
from utils.ros_output.camera_info import read_camera_info
from utils.undistort import ImageUndistorter


@dataclass(frozen=True)
class BagRecipe:
    """How the bag of one recording becomes products.

    Attributes:
        folder: where the products go; the bag is beside it.
        files: what to make.
        find_topics: chooses the topics of the side.
        calibration: the camera; None takes a camera without distortion from the topic of camera info.
        body_T_cam: (4, 4) from the camera to the body that the poses are of.
    """

    folder: Path
    files: StereoFiles
    find_topics: Callable[[BagCamera], Topics]
    calibration: Calibration | None
    body_T_cam: npt.NDArray[np.float64]


def run_bag(recipe: BagRecipe, options: PreprocessOptions) -> list[Path]:
    """Make the products of one side of one recording; returns the files made.

    Raises:
        InputError: no bag, a missing topic, no events or images, or a damaged bag.
        OutputError: a product cannot be written.
    """
    products, files = Products(options), recipe.files
    with BagCamera(bag_of(recipe.folder)) as bag:
        topics = recipe.find_topics(bag)
        calibration = recipe.calibration
        if calibration is None:
            assert topics.camera_info is not None
            info = read_camera_info(bag.path, topics.camera_info)
            calibration = Calibration(info.width, info.height, *info.intrinsics.tolist())
        _write_clocked(bag, topics, calibration, recipe, products)
        intrinsics = products.pinhole(files.pinhole, calibration)
        if calibration.is_distorted:
            products.map(files.rectify_map, calibration, intrinsics)
        undistort = ImageUndistorter(calibration, intrinsics) if calibration.is_distorted else None
        products.image_folder(files.images, bag.count(topics.images), lambda: _images(bag, topics.images, undistort))
    return products.made


def _write_clocked(bag: BagCamera, topics: Topics, calibration: Calibration, recipe: BagRecipe,
                   products: Products) -> None:
    """Make the products whose stamps are counted from the beginning of the recording."""
    files = recipe.files
    has_poses = topics.poses is not None and bag.count(topics.poses) > 0
    if not products.missing(files.stamps, files.events, *([files.poses] if has_poses else [])):
        return
    poses = bag.poses(topics.poses) if topics.poses is not None else None
    stamps_ns = bag.image_stamps_ns(topics.images)
    first_ns = [bag.first_event_ns(topics.events, products.options.on_unsorted), int(stamps_ns.min())]
    if poses is not None:
        first_ns.append(int(poses.t_us[0]))
    zero_ns = min(first_ns)
    if products.missing(files.stamps):
        products.table(files.stamps, (stamps_ns - zero_ns) / 1000.0, "%.12f")
    if poses is not None and products.missing(files.poses):
        camera = times_transform(poses.world_T_cam, recipe.body_T_cam)
        products.table(files.poses, np.column_stack([(poses.t_us - zero_ns) / 1000.0, camera]))
    if products.missing(files.events):
        size = (calibration.width, calibration.height)
        blocks = bag.event_blocks(topics.events, zero_ns, size, products.options.on_unsorted)
        _write_events(products, files.events, blocks, size)


def _write_events(products: Products, path: Path, blocks: Iterator[EventBlock], size: tuple[int, int]) -> None:
    from tqdm import tqdm

    bar = tqdm(blocks, unit="block", desc=path.name, leave=False, disable=not products.options.progress)
    if path.suffix == ".h5":
        with EventH5Writer(path, sensor_size=size) as writer:
            for events, _ in bar:
                writer.write(events)
        products.made.append(path)
        return
    with products.file(path) as temporary, temporary.open("w", encoding="ascii", newline="\n") as stream:
        for events, remainder_ns in bar:
            table = np.column_stack([events.t_us, 10 * remainder_ns, events.x, events.y, events.p])
            stream.write("%d.%04d %d %d %d\n" * len(table) % tuple(table.ravel().tolist()))


def _images(bag: BagCamera, topic: str, undistort: ImageUndistorter | None) -> Iterator[tuple[str, Image]]:
    for number, (_, image) in enumerate(bag.images(topic)):
        yield f"{number:012d}.png", image if undistort is None else undistort(image)


def find_bags(root: Path) -> list[Path]:
    """Return the folders of all bags at or below `root`: beside the bag, named like it up to the first dot."""
    if root.is_file():
        return [_folder_of(root)] if root.suffix == ".bag" else []
    if root.is_dir():
        found = {_folder_of(bag) for bag in root.rglob("*.bag") if not bag.name.startswith(".") and bag.is_file()}
        if found:
            return sorted(found)
    return [root] if _bags_beside(root) else []


def bag_of(folder: Path) -> Path:
    """Return the bag that belongs to the folder of a recording.

    Raises:
        InputError: there is none or more than one.
    """
    found = _bags_beside(folder)
    if len(found) != 1:
        listing = f"several ({', '.join(bag.name for bag in found)})" if found else "none"
        raise InputError(f"{folder}: expected the bag {folder.name}.bag beside the folder, found {listing}")
    return found[0]


def _folder_of(bag: Path) -> Path:
    return bag.parent / bag.name.split(".")[0]


def _bags_beside(folder: Path) -> list[Path]:
    folder = folder.absolute()
    if not folder.parent.is_dir():
        return []
    return sorted(path for path in folder.parent.iterdir()
                  if path.suffix == ".bag" and path.name.split(".")[0] == folder.name and path.is_file())
