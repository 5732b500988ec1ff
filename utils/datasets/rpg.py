"""Stereo DAVIS240C recordings of ECCV 2018 (RPG): text events per side, preprocessed by scripts/pp_rpg.py."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from utils.datasets.next_stamp import TextLayout, open_text_sequence
from utils.datasets.options import SequenceOptions
from utils.datasets.prepared import require_size
from utils.datasets.registry import register
from utils.datasets.sequence import Frame, Sequence
from utils.datasets.stereo_files import stereo_files

_SIZE = (240, 180)
_SIMULATED_SIZE = (346, 260)
SIMULATION = "simulation_3planes"
"""The one recording that is simulated: 346x260 pixels, no distortion, poses of the camera itself."""


def is_simulated(folder: Path) -> bool:
    """Whether a recording is the simulated one, told by its path."""
    return SIMULATION in str(folder.absolute())


@register("rpg", "RPG stereo (ECCV 2018): DAVIS240C 240x180, preprocessed by scripts/pp_rpg.py")
def open_rpg(path: Path, options: SequenceOptions) -> Sequence:
    """Open a sequence folder as `pp_rpg.py` makes it beside the bag.

    Windows: `[s_i, s_i + L)` at the image stamps, L = the mean image interval (or `window_dt_ms`); the last of the
    stamps in use gets no window. A frame has the stamp of the middle of its window or that of the next image in use,
    whichever is earlier. Recordings with `simulation_3planes` in their path have no distortion.

    Raises:
        InputError: files are missing or damaged, or do not fit together.
    """
    side, simulated = options.side, is_simulated(path)
    files = stereo_files(path, side, ".txt")
    layout = TextLayout(
        "rpg", f"python scripts/pp_rpg.py {path} --side {side}", _SIMULATED_SIZE if simulated else _SIZE,
        events=files.events.name, stamps=files.stamps.name, pinhole=files.pinhole.name, images=files.images.name,
        poses=files.poses.name, rectify_map=None if simulated else files.rectify_map.name, events_unit="us",
        window_ms=(3, 1000))
    return open_text_sequence(path, options, layout)


def rpg_evs_iterator(scenedir: str | os.PathLike[str], side: str = "left", stride: int = 1,
                     dT_ms: float | None = None, H: int = 180, W: int = 240, timing: bool = False,
                     parallel: bool = False, cors: int = 8) -> Iterator[Frame]:
    """Return the stream of `(voxel grid (5,H,W) float32, intrinsics (4,) float64, t_us)` of one camera.

    Args:
        scenedir: sequence folder.
        side: "left" or "right".
        stride: use every stride-th image; windows do not get longer.
        dT_ms: length of the windows in milliseconds, None for the mean image interval.
        H, W: size of the sensor, 180x240; 260x346 for `simulation_3planes`.
        timing, parallel, cors: accepted, without effect; the stream is always the whole recording.

    Raises:
        InputError: see `open_rpg`.
    """
    sequence = open_rpg(Path(scenedir), SequenceOptions(side=side, stride=stride, window_dt_ms=dT_ms))
    require_size(sequence, H, W)
    return sequence.voxels()
