"""EDS: one event camera of 640x480 pixels that looks through the same lens as a frame camera."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.calibration import Calibration, read_mapping
from utils.datasets.options import SequenceOptions
from utils.datasets.prepared import (
    find_images,
    mean_interval_us,
    only_match,
    pinhole_of,
    poses_reader,
    read_stamps,
    refuse_options,
    refuse_own_camera,
    require_files,
    stamp_windows,
)
from utils.datasets.recognise import preprocessing_command
from utils.datasets.registry import register
from utils.datasets.sequence import Frame, Sequence
from utils.events.reader import EventReader, open_events
from utils.events.shifted import ShiftedReader
from utils.undistort import read_rectify_map

SIZE = (640, 480)
HOT_PIXEL_STDS = 10.0
CALIBRATIONS = ("calib0", "calib1")
OFFSET_FILE, STAMPS_FILE, POSES_FILE = "t_offset_us.txt", "images_timestamps_us.txt", "stamped_groundtruth_us.txt"
EVENTS_UNCHANGED = "# events.h5 is as it was downloaded: subtract this from its stamps"
"""Second line of `t_offset_us.txt` where the offset was not subtracted inside `events.h5`."""

CAMERAS: dict[str, dict[str, Calibration]] = {
    "calib0": {
        "rgb": Calibration(640, 480, 766.536025127154, 767.5749459126396, 291.0503512057777, 227.4060484950132,
                           "radtan", (-0.36965913545735024, 0.17414034009883844, 0.003915245015812422,
                                      0.003666687416655559)),
        "evs": Calibration(640, 480, 560.8520948927032, 560.6295819972383, 313.00733235019237, 217.32858679842997,
                           "radtan", (-0.09776467241921379, 0.2143738428636279, -0.004710710105172864,
                                      -0.004215916089401789)),
    },
    "calib1": {
        "rgb": Calibration(640, 480, 758.1291471478728, 759.5125594392973, 289.0985666049996, 228.23374237672056,
                           "radtan", (-0.36599825863847607, 0.15566628749131536, 0.003684464282510181,
                                      0.004564651739351755)),
        "evs": Calibration(640, 480, 548.8989250692618, 550.0282089284915, 313.5293514832678, 219.6325753720951,
                           "radtan", (-0.08095806072593555, 0.15743578875760092, -0.0035154416164982195,
                                      -0.003950567808338846)),
    },
}
"""The two published calibrations of the frame camera ("rgb") and the event camera ("evs")."""

_PUBLISHED_INTRINSICS: dict[str, dict[str, tuple[float, ...]]] = {
    "calib0": {"evs": (562.9412231445312, 563.5700073242188, 310.53467429134616, 215.59711647292897),
               "rgb": (713.6517944335938, 737.5368041992188, 288.29385382423607, 226.97368855930836)},
    "calib1": {"evs": (548.6773071289062, 551.0106201171875, 310.9592609123247, 218.11182443004145),
               "rgb": (704.6842041015625, 729.3246459960938, 286.39991203466707, 227.79612335843012)},
}
"""`fx fy cx cy` after undistortion of folders without the JSON file, as OpenCV 4.6 chose them."""

_JSON_ENTRY = {"rgb": 0, "evs": 1}


@register("eds", "EDS: event camera 640x480, preprocessed by scripts/pp_eds.py")
def open_eds(path: Path, options: SequenceOptions, voxel_size: tuple[int, int] | None = None,
             calib1: bool | None = None) -> Sequence:
    """Open a sequence folder with `events.h5` and the files that `pp_eds.py` makes.

    Windows: `[s_i, s_i + D/2)` at all image stamps but the last, with the mean image interval D; a frame has the stamp
    of the middle of its window. Cells of a voxel grid beyond 10 standard deviations are set to zero. Stamps count from
    the offset in `t_offset_us.txt`; folders whose `events.h5` was shifted in place are recognised. The ground truth is
    that of the motion capture body, not of the camera.

    Args:
        path: the sequence folder.
        options: see `SequenceOptions`.
        voxel_size: (width, height) of the voxel grids, None for the sensor's 640x480.
        calib1: use the second calibration; None takes the first one unless only the second was preprocessed.

    Raises:
        InputError: files are missing or damaged, or do not belong together.
    """
    refuse_own_camera(options, "eds")
    refuse_options(options, "eds", "side", because="it has one event camera")
    if calib1 is None:
        calib1 = not (path / "rectify_map_calib0.h5").is_file() and (path / "rectify_map_calib1.h5").is_file()
    calibration = CALIBRATIONS[calib1]
    command = preprocessing_command("eds", path, "left")
    events = only_match(path, "events.h5", "event file of EDS")
    files = {"events": events, "image stamps": path / STAMPS_FILE,
             "rectify map": path / f"rectify_map_{calibration}.h5"}
    require_files(path, [file.name for file in files.values()], command)
    if (path / f"calib_undist_{calibration}.json").is_file():
        files["intrinsics"] = path / f"calib_undist_{calibration}.json"

    all_stamps = read_stamps(files["image stamps"])
    interval_us = mean_interval_us(all_stamps, files["image stamps"])
    windows, bounded = stamp_windows(all_stamps[:-1], options, interval_us / 2)
    poses = path / POSES_FILE
    if poses.is_file():
        files["ground truth"] = poses

    def open_reader() -> EventReader:
        return open_shifted_events(events, path / OFFSET_FILE, options)

    return Sequence(
        path.resolve().name, path, bounded, size=SIZE, intrinsics=undistorted_camera(path, calibration, "evs"),
        open_reader=open_reader, windows=windows, rectify_map=read_rectify_map(files["rectify map"], SIZE),
        hot_pixel_stds=HOT_PIXEL_STDS,
        images=find_images(path / f"images_undistorted_{calibration}", all_stamps,
                           lambda: undistorted_camera(path, calibration, "rgb"), command),
        read_ground_truth=poses_reader(poses, skip_lines=1), poses_of="motion capture body", files=files,
        voxel_size=voxel_size)


def undistorted_camera(path: Path, calibration: str, camera: str) -> npt.NDArray[np.float64]:
    """Return `fx fy cx cy` (4,) of the undistorted "evs" or "rgb" camera: from the folder, else as published.

    Raises:
        InputError: the JSON file is damaged.
    """
    file = path / f"calib_undist_{calibration}.json"
    if not file.is_file():
        return np.array(_PUBLISHED_INTRINSICS[calibration][camera])
    entries = read_mapping(file).get("intrinsics_undistorted")
    try:
        return pinhole_of(entries[_JSON_ENTRY[camera]])  # type: ignore[index]
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(f"{file}: no camera {_JSON_ENTRY[camera]} in intrinsics_undistorted ({error!r}); make the "
                         "file again with scripts/pp_eds.py --overwrite") from None


def read_offset(path: Path) -> tuple[int, bool]:
    """Read `t_offset_us.txt`: the offset in microseconds, and whether it says that `events.h5` is unchanged.

    Raises:
        InputError: the file is missing or holds something else than one number.
    """
    try:
        lines = path.read_text("ascii").splitlines()
        numbers = [float(line) for line in lines if line.strip() and not line.startswith("#")]
        offset = int(numbers[0])
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except (UnicodeDecodeError, ValueError, IndexError, OverflowError):
        raise InputError(f"{path}: expected one number, the offset of the stamps in microseconds") from None
    if len(numbers) != 1:
        raise InputError(f"{path}: {len(numbers)} numbers, expected one, the offset of the stamps in microseconds")
    return offset, EVENTS_UNCHANGED in lines


def open_shifted_events(events: Path, offset_file: Path, options: SequenceOptions) -> EventReader:
    """Open `events.h5` on the clock of the preprocessed stamps, whether its own stamps were shifted or not.

    The offset is the earliest stamp of events, images and poses. So a file whose first event comes after the offset was
    not shifted, and a file without any offset beside it counts as shifted.

    Raises:
        InputError: a file is missing or damaged.
    """
    reader = open_events(events, sensor_size=SIZE, time_unit="us", on_unsorted=options.on_unsorted)
    try:
        offset_us, unchanged = read_offset(offset_file) if offset_file.is_file() else (0, False)
        shifted = not unchanged and reader.time_range_us()[0] < offset_us
    except BaseException:
        reader.close()
        raise
    return reader if shifted or not offset_us else ShiftedReader(reader, -offset_us)


def eds_evs_iterator(scenedir: str | os.PathLike[str], calib1: bool = False, stride: int = 1, timing: bool = False,
                     H: int = 480, W: int = 640, parallel: bool = False, cors: int = 16) -> Iterator[Frame]:
    """Return the stream of `(voxel grid (5,H,W) float32, intrinsics (4,) float64, t_us)` of a sequence of EDS.

    Args:
        scenedir: sequence folder.
        calib1: use the second of the two published calibrations.
        stride: use every stride-th image.
        timing, parallel, cors: accepted, without effect.
        H, W: size of the voxel grids in pixels; intrinsics are scaled along.

    Raises:
        InputError: see `open_eds`.
    """
    return open_eds(Path(scenedir), SequenceOptions(stride=stride), (W, H), calib1).voxels()
