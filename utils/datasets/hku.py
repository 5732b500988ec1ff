"""HKU stereo recordings (two DAVIS346): HDF5 events per side, preprocessed by scripts/pp_hku.py."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from devo.errors import InputError
from utils.datasets.options import SequenceOptions
from utils.datasets.prepared import (
    Stamps,
    find_images,
    mean_interval_us,
    poses_reader,
    read_pinhole,
    read_stamps,
    refuse_own_camera,
    require_files,
    require_size,
    stamp_windows,
)
from utils.datasets.registry import register
from utils.datasets.sequence import Frame, Sequence
from utils.datasets.stereo_files import stereo_files
from utils.events.reader import EventReader, open_events
from utils.sequence_names import find_in_path
from utils.undistort import read_rectify_map

_SIZE = (346, 260)


class ImageRange(NamedTuple):
    """Images `[start:stop]` in use after those of a camera drop-out `[gone[0], gone[1]]` were taken away."""

    start: int
    stop: int
    gone: tuple[int, int] | None = None


IMAGE_RANGES: dict[str, ImageRange] = {
    "hdr_tran_rota": ImageRange(135, 3230),
    "HDR_slow": ImageRange(240, 4150, (3238, 3242)),
    "HDR_circle": ImageRange(155, 2115, (1349, 1354)),
    "hdr_agg": ImageRange(145, 3600),
    "dark_normal": ImageRange(150, 2805),
    "aggressive_walk": ImageRange(150, 2385),
    "aggressive_translation": ImageRange(165, 1795),
    "aggressive_small_flip": ImageRange(150, 1585),
    "aggressive_rotation": ImageRange(157, 1660),
}
"""By part of the sequence's name, upper and lower case alike; the ends show the start and the landing."""

OTHER_NAMES = {"agg_walk": "aggressive_walk", "agg_translation": "aggressive_translation",
               "agg_small_flip": "aggressive_small_flip", "agg_flip": "aggressive_small_flip",
               "agg_rotation": "aggressive_rotation"}
"""Names under which the data set's own page lists the same sequences."""

_ALL_BUT_LAST = ImageRange(0, -1)


def image_range(path: Path) -> ImageRange:
    """Return which images of a sequence are in use, by its name; all but the last for a name that is not listed."""
    part = find_in_path(path, [*IMAGE_RANGES, *OTHER_NAMES])
    return _ALL_BUT_LAST if part is None else IMAGE_RANGES[OTHER_NAMES.get(part, part)]


def stamps_in_use(stamps_us: Stamps, images: ImageRange) -> Stamps:
    """Return the stamps of the images in use.

    Raises:
        InputError: none is left.
    """
    kept = stamps_us
    if images.gone is not None:
        numbers = np.arange(len(stamps_us))
        kept = stamps_us[(numbers < images.gone[0]) | (numbers > images.gone[1])]
    kept = kept[images.start:images.stop]
    if not len(kept):
        raise InputError(f"the images {images.start} to {images.stop} of this sequence are used, but there are only "
                         f"{len(stamps_us)}; download it again, or rename a shortened copy")
    return kept


@register("hku", "HKU stereo: DAVIS346 346x260, preprocessed by scripts/pp_hku.py")
def open_hku(path: Path, options: SequenceOptions) -> Sequence:
    """Open a sequence folder as `pp_hku.py` makes it beside the bag.

    Windows: `[s_i, s_i + L)` at the image stamps of `IMAGE_RANGES`, L = the mean interval of all images (or
    `window_dt_ms`). A frame has the stamp of the middle of its window.

    Raises:
        InputError: files are missing or damaged, or do not fit together.
    """
    refuse_own_camera(options, "hku")
    side = options.side
    command = f"python scripts/pp_hku.py {path} --side {side}"
    made = stereo_files(path, side, ".h5")
    files = {"events": made.events, "image stamps": made.stamps, "intrinsics": made.pinhole,
             "rectify map": made.rectify_map}
    require_files(path, [file.name for file in files.values()], command)
    all_stamps = read_stamps(files["image stamps"])
    try:
        stamps = stamps_in_use(all_stamps, image_range(path))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    windows, options = stamp_windows(stamps, options, mean_interval_us(all_stamps, files["image stamps"]))
    if made.poses.is_file():
        files["ground truth"] = made.poses

    def open_reader() -> EventReader:
        return open_events(files["events"], sensor_size=_SIZE, time_unit="us", on_unsorted=options.on_unsorted)

    intrinsics = read_pinhole(files["intrinsics"], _SIZE)
    return Sequence(
        path.resolve().name, path, options, size=_SIZE, intrinsics=intrinsics, open_reader=open_reader,
        windows=windows, rectify_map=read_rectify_map(files["rectify map"], _SIZE),
        images=find_images(made.images, all_stamps, lambda: intrinsics, command),
        read_ground_truth=poses_reader(made.poses), files=files)


def hku_evs_iterator(indir: str | os.PathLike[str], side: str = "left", stride: int = 1, timing: bool = False,
                     dT_ms: float | None = None, H: int = 260, W: int = 346) -> Iterator[Frame]:
    """Return the stream of `(voxel grid (5,H,W) float32, intrinsics (4,) float64, t_us)` of one camera.

    Args:
        indir: sequence folder.
        side: "left" or "right".
        stride: use every stride-th of the images in use; windows do not get longer.
        timing: accepted, without effect.
        dT_ms: length of the windows in milliseconds, None for the mean image interval.
        H, W: size of the sensor, 260x346.

    Raises:
        InputError: see `open_hku`.
    """
    sequence = open_hku(Path(indir), SequenceOptions(side=side, stride=stride, window_dt_ms=dT_ms))
    require_size(sequence, H, W)
    return sequence.voxels()
