"""From the arguments for a bag to those of the export: which topic, which camera, where to."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import yaml

from devo.errors import InputError
from utils.atomic import atomic_path
from utils.calibration import Calibration
from utils.events.bags import BagEventReader
from utils.events.reader import open_events
from utils.ros_output.camera_info import read_camera_info


def export_arguments(args: argparse.Namespace, bag_flags: Sequence[str]) -> argparse.Namespace:
    """Arguments of `run_export_pointcloud` for the events of a bag.

    The camera is written as `<output_dir>/calib.yaml`, unless the user gave one.

    Args:
        args: flags of the export and `bag, delta_ms, output_dir, camera_info_topic`.
        bag_flags: names that the export does not know.

    Raises:
        InputError: no bag, no or several topics with events, or no camera.
        OutputError: the camera's file cannot be written.
    """
    bag = Path(args.bag)
    if not bag.exists():
        raise InputError(f"{bag}: there is no such bag")
    topic = _event_topic(bag, args.stream or (args.side if args.side != "left" else None))
    given = argparse.Namespace(**{name: value for name, value in vars(args).items() if name not in bag_flags})
    folder = Path(args.output_dir) if args.output_dir else bag.with_suffix("")
    if folder.resolve() == bag.resolve():  # the bag is a folder itself
        folder = bag.with_name(bag.name + "_export")
    given.datapath, given.dataset, given.side, given.stream = str(bag), "generic", "left", topic
    given.out = args.out or str(folder / "point_cloud.npy")
    given.window_ms = args.delta_ms if args.delta_ms is not None else args.window_ms
    if args.calib is None and args.intrinsics is None:
        given.calib = str(_write_camera(folder / "calib.yaml", read_camera_info(bag, args.camera_info_topic, topic)))
    return given


def _event_topic(bag: Path, wanted: str | None) -> str:
    """The topic that the reader chooses; a word such as left is tried where a bag has several."""
    try:
        reader = open_events(bag, stream=wanted)
    except InputError:
        if wanted is not None:
            raise
        reader = open_events(bag, stream="left")
    with reader:
        if not isinstance(reader, BagEventReader):
            raise InputError(f"{bag} is no ROS bag but {reader.format_name}; use export_pointcloud.py --datapath")
        return reader.topic


def _write_camera(path: Path, camera: Calibration) -> Path:
    with atomic_path(path) as temporary:
        temporary.write_text(yaml.safe_dump(camera.as_dict(), sort_keys=False), encoding="utf-8")
    return path
