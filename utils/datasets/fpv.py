"""UZH-FPV: a DAVIS346 on a racing drone; text events, preprocessed by scripts/pp_fpv.py."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.datasets.next_stamp import TextLayout, open_text_sequence
from utils.datasets.options import SequenceOptions
from utils.datasets.prepared import Stamps, refuse_options, require_files, require_size
from utils.datasets.registry import register
from utils.datasets.sequence import Frame, Sequence

SIZE = (346, 260)
_CROP_US = 5e6
"""How much longer than the ground truth, and how much earlier, a recording must be to be cut to it."""


@register("fpv", "UZH-FPV: DAVIS346 346x260 on a racing drone, preprocessed by scripts/pp_fpv.py")
def open_fpv(path: Path, options: SequenceOptions, tss_gt_us: npt.ArrayLike | None = None) -> Sequence:
    """Open a sequence folder with `events.txt` and the files that `pp_fpv.py` makes.

    Windows: `[s_i, s_i + L)` at the image stamps but the last, L = the mean image interval (or `window_dt_ms`); the
    last of the stamps in use gets no window. A frame has the stamp of the middle of its window or that of the next
    image in use, whichever is earlier. The clock starts at the earliest event, image or pose.

    Args:
        path: the sequence folder.
        options: see `SequenceOptions`.
        tss_gt_us: (N,) stamps of ground truth in microseconds, to which long recordings are cut; evaluations do so.

    Raises:
        InputError: files are missing or damaged, or do not fit together.
    """
    refuse_options(options, "fpv", "side", because="its recordings have one camera")
    command = f"python scripts/pp_fpv.py {path}"
    require_files(path, ["t_offset_us.txt"], command)
    layout = TextLayout(
        "fpv", command, SIZE, events="events.txt", stamps="images_timestamps_us.txt", pinhole="calib_undist.txt",
        images="images_undistorted", poses="stamped_groundtruth_us_cam.txt", rectify_map="rectify_map.h5",
        events_unit="s", window_ms=(3, 200))
    gt_us = None if tss_gt_us is None else np.asarray(tss_gt_us, np.float64)
    return open_text_sequence(path, options, layout, choose=lambda stamps: stamps_in_use(stamps, gt_us),
                              offset_us=read_offset_us(path / "t_offset_us.txt"))


def stamps_in_use(stamps_us: Stamps, gt_us: Stamps | None = None) -> Stamps:
    """Return all image stamps but the last, cut to those inside the ground truth where that is much shorter.

    Raises:
        InputError: nothing is left.
    """
    stamps = stamps_us[:-1]
    if gt_us is not None and len(gt_us) and len(stamps):
        longer = (stamps[-1] - stamps[0]) - (gt_us[-1] - gt_us[0])
        if longer > _CROP_US and gt_us[0] - stamps[0] > _CROP_US:
            first = int(np.searchsorted(stamps, gt_us[0], "right"))
            last_inside = int(np.searchsorted(stamps, gt_us[-1], "left")) - 1
            stamps = stamps[first:max(last_inside, first)]
    if len(stamps) < 2:
        raise InputError(f"{len(stamps)} of {len(stamps_us)} image stamps are in use, expected at least 2; check the "
                         "ground truth and its clock")
    return stamps


def read_offset_us(file: Path) -> int:
    """Return the offset of the clock in whole microseconds.

    Raises:
        InputError: the file is missing or holds no number.
    """
    try:
        return int(float(file.read_text("ascii")))
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror or error}") from error
    except (ValueError, OverflowError):
        raise InputError(f"{file}: expected one number, the offset of the clock in microseconds") from None


def fpv_evs_iterator(scenedir: str | os.PathLike[str], stride: int = 1, timing: bool = False,
                     dT_ms: float | None = None, H: int = 260, W: int = 346, parallel: bool = False, cors: int = 4,
                     tss_gt_us: npt.ArrayLike | None = None) -> Iterator[Frame]:
    """Return the stream of `(voxel grid (5,H,W) float32, intrinsics (4,) float64, t_us)` of a UZH-FPV sequence.

    Args:
        scenedir: sequence folder.
        stride: use every stride-th image; windows do not get longer.
        timing, parallel, cors: accepted, without effect; the stream is always the whole recording.
        dT_ms: length of the windows in milliseconds, None for the mean image interval.
        H, W: size of the sensor, 260x346.
        tss_gt_us: (N,) stamps of ground truth to which long recordings are cut.

    Raises:
        InputError: see `open_fpv`.
    """
    sequence = open_fpv(Path(scenedir), SequenceOptions(stride=stride, window_dt_ms=dT_ms), tss_gt_us)
    require_size(sequence, H, W)
    return sequence.voxels()
