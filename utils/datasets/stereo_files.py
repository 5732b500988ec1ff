"""Names of the files that preprocessing makes of a bag with two cameras, as the readers of RPG and HKU expect them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple


class StereoFiles(NamedTuple):
    """Files of one side of a recording.

    Attributes:
        events: events, stamps in microseconds.
        stamps: image stamps in microseconds.
        poses: camera poses, camera to world; missing where nothing was tracked.
        pinhole: undistorted camera.
        rectify_map: where each pixel lies in the undistorted image; missing for a camera without distortion.
        images: folder of undistorted images.
    """

    events: Path
    stamps: Path
    poses: Path
    pinhole: Path
    rectify_map: Path
    images: Path


def stereo_files(folder: Path, side: str, events_suffix: str) -> StereoFiles:
    """Return the files of a side; events are text (".txt") or HDF5 (".h5")."""
    return StereoFiles(folder / f"evs_{side}{events_suffix}", folder / f"tss_imgs_us_{side}.txt",
                       folder / f"gt_stamped_{side}.txt", folder / f"calib_undist_{side}.txt",
                       folder / f"rectify_map_{side}.h5", folder / f"images_undistorted_{side}")
