"""Event Camera Dataset (DAVIS240C): text events and calibration in one folder, preprocessed by scripts/pp_ecd.py."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from utils.datasets.next_stamp import TextLayout, open_text_sequence
from utils.datasets.options import SequenceOptions
from utils.datasets.prepared import refuse_options, require_size
from utils.datasets.registry import register
from utils.datasets.sequence import Frame, Sequence

SIZE = (240, 180)


@register("ecd", "Event Camera Dataset: DAVIS240C 240x180, preprocessed by scripts/pp_ecd.py")
def open_ecd(path: Path, options: SequenceOptions) -> Sequence:
    """Open a sequence folder with `events.txt` and the files that `pp_ecd.py` makes.

    Windows: from image stamp to image stamp (or `[s_i, s_i + window_dt_ms)`); the last stamp gets no window. A frame
    has the stamp of the middle of its window or that of the next image in use, whichever is earlier.

    Raises:
        InputError: files are missing or damaged, or do not fit together.
    """
    refuse_options(options, "ecd", "side", because="its recordings have one camera")
    layout = TextLayout(
        "ecd", f"python scripts/pp_ecd.py {path}", SIZE, events="events.txt", stamps="tss_us.txt",
        pinhole="calib_undist.txt", images="images_undistorted", poses="groundtruth.txt", rectify_map="rectify_map.h5",
        events_unit="s", window_ms=(5, 1000), poses_unit="s", up_to_next=True)
    return open_text_sequence(path, options, layout)


def ecd_evs_iterator(scenedir: str | os.PathLike[str], DELTA_MS: float | None = None, H: int = 180, W: int = 240,
                     timing: bool = False, parallel: bool = False, cors: int = 8) -> Iterator[Frame]:
    """Return the stream of `(voxel grid (5,H,W) float32, intrinsics (4,) float64, t_us)` of a sequence.

    Args:
        scenedir: sequence folder.
        DELTA_MS: length of the windows in milliseconds, None for windows from image to image.
        H, W: size of the sensor, 180x240.
        timing, parallel, cors: accepted, without effect; the stream is always the whole recording.

    Raises:
        InputError: see `open_ecd`.
    """
    sequence = open_ecd(Path(scenedir), SequenceOptions(window_dt_ms=DELTA_MS))
    require_size(sequence, H, W)
    return sequence.voxels()
