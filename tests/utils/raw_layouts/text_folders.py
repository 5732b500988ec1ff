"""UZH-FPV and the Event Camera Dataset: one folder per sequence with text events and PNG images."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from tests.utils.raw_layouts.recording import RawRecording
from utils.events.text import format_events
from utils.preprocessing.poses import times_transform


def seconds(t_us: int) -> str:
    return f"{t_us // 1_000_000}.{t_us % 1_000_000:06d}"


def write_poses(file: Path, header: str, poses_us: np.ndarray, poses: np.ndarray) -> None:
    lines = [" ".join([seconds(int(t_us)), *(repr(value) for value in pose)])
             for t_us, pose in zip(poses_us, poses.tolist())]
    file.write_text("\n".join([*([header] if header else []), *lines, ""]))


def write_fpv(root: Path, recording: RawRecording, name: str = "indoor_forward_3_davis_with_gt",
              cam_T_imu: np.ndarray | None = None) -> Path:
    """Write a sequence; with `cam_T_imu` (4, 4) it has ground truth, which is that of the inertial unit."""
    folder = root / name
    (folder / "img").mkdir(parents=True)
    (folder / "events.txt").write_text("# timestamp x y polarity\n" + format_events(recording.events))
    lines = ["# id timestamp image_name"]
    for number, (t_us, image) in enumerate(zip(recording.stamps_us.tolist(), recording.images)):
        lines.append(f"{number} {seconds(t_us)} img/image_0_{number}.png")
        cv2.imwrite(str(folder / "img" / f"image_0_{number}.png"), image)
    (folder / "images.txt").write_text("\n".join([*lines, ""]))
    if cam_T_imu is not None:
        write_poses(folder / "groundtruth.txt", "# timestamp tx ty tz qx qy qz qw", recording.poses_us,
                    times_transform(recording.world_T_cam, cam_T_imu))
    return folder


def write_ecd(root: Path, recording: RawRecording, calibration: str, name: str = "slider_test") -> Path:
    """Write a sequence; `calibration` is the line of calib.txt."""
    folder = root / name
    (folder / "images").mkdir(parents=True)
    (folder / "events.txt").write_text(format_events(recording.events))
    lines = []
    for number, (t_us, image) in enumerate(zip(recording.stamps_us.tolist(), recording.images)):
        lines.append(f"{seconds(t_us)} images/frame_{number:08d}.png\n")
        cv2.imwrite(str(folder / "images" / f"frame_{number:08d}.png"), image)
    (folder / "images.txt").write_text("".join(lines))
    (folder / "calib.txt").write_text(calibration + "\n")
    write_poses(folder / "groundtruth.txt", "", recording.poses_us, recording.world_T_cam)
    return folder
