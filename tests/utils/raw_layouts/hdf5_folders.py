"""VECtor, TUM-VIE, EDS and MVSEC: events in HDF5, with the images, clocks and calibrations of each.

All writers put the recording in the middle of the sensor of their data set.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import yaml

from tests.utils.event_samples import write_flat_h5
from tests.utils.raw_layouts.recording import RawRecording
from tests.utils.raw_layouts.text_folders import seconds, write_poses
from utils.calibration import Calibration
from utils.events import write_events_h5
from utils.preprocessing.poses import inverse, times_transform
from utils.trajectory_io import rotation_matrices

VGA, HD, DAVIS346 = (640, 480), (1280, 720), (346, 260)
UNIX_US = 1_642_661_808_000_000
"""Where the clocks of VECtor, EDS and MVSEC stand."""

VECTOR_EVENT_CAMERA = Calibration(640, 480, 327.3, 327.4, 304.1, 236.9, "radtan",
                                  (-0.03, 0.042, -0.0003, 0.0007, -0.01))
VECTOR_FRAME_CAMERA = Calibration(1224, 1024, 886.2, 886.6, 610.6, 514.6, "radtan",
                                  (-0.315, 0.104, 0.0004, -0.0006, 0.0))
TUMVIE_CAMERAS = (
    Calibration(1024, 1024, 747.1, 747.1, 491.8, 505.9, "fisheye", (0.019, -0.002, 0.005, -0.001)),
    Calibration(1024, 1024, 746.9, 746.8, 505.2, 493.8, "fisheye", (0.018, -0.001, 0.004, -0.002)),
    Calibration(1280, 720, 1049.6, 1049.4, 637.5, 346.4, "fisheye", (-0.07, 0.13, -0.23, 0.19)),
    Calibration(1280, 720, 1050.2, 1050.1, 641.3, 352.2, "fisheye", (-0.08, 0.14, -0.22, 0.17)),
)
MVSEC_CAMERAS = {
    "left": Calibration(346, 260, 226.4, 226.2, 173.6, 133.7, "fisheye", (-0.048, -0.011, -0.055, 0.021)),
    "right": Calibration(346, 260, 226.0, 225.8, 174.5, 124.2, "fisheye", (-0.049, -0.014, -0.051, 0.019)),
}


def transform(seed: int) -> np.ndarray:
    """A rigid motion (4, 4) as between two cameras of one rig."""
    rng = np.random.default_rng(seed)
    vector = np.array([*rng.normal(0, 0.2, 3), 1.0])
    result = np.eye(4)
    result[:3, :3] = rotation_matrices(vector / np.linalg.norm(vector))
    result[:3, 3] = rng.normal(0, 0.1, 3)
    return result


VECTOR_CAM0_T = {camera: transform(number) for number, camera in enumerate(("body", "cam1", "cam2", "cam3"))}


def write_vector(root: Path, recording: RawRecording, side: str = "left", name: str = "corridors_walk",
                 frames: bool = True, beside: bool = True) -> Path:
    """Write one side of a sequence; the recording's poses are those of the event camera of that side."""
    folder = root / name
    folder.mkdir(parents=True, exist_ok=True)
    absolute = recording.later(UNIX_US).on_sensor(VGA)
    write_events_h5(folder / f"{name}1.synced.{side}_event.hdf5", absolute.events, UNIX_US)
    images = folder / f"{name}1.synced.{side}_camera"
    images.mkdir()
    exposure_us = 4000
    lines = [f"{seconds(t - exposure_us // 2)} {seconds(t + exposure_us // 2)}\n" for t in absolute.stamps_us.tolist()]
    (images / "timestamp.txt").write_text("# exposure\n# start[s] end[s]\n" + "".join(lines))
    if frames:
        size = (VECTOR_FRAME_CAMERA.width, VECTOR_FRAME_CAMERA.height)
        for number, image in enumerate(recording.on_sensor(size).images):
            cv2.imwrite(str(images / f"{number:06d}_{number}.png"), image)
    cam0_T_event = VECTOR_CAM0_T["cam2" if side == "left" else "cam3"]
    body = times_transform(recording.world_T_cam, inverse(cam0_T_event) @ VECTOR_CAM0_T["body"])
    write_poses(folder / f"{name}1.synced.gt.txt", "# ground truth\n# t[s] tx ty tz qx qy qz qw", absolute.poses_us,
                body)
    write_vector_calibrations((root if beside else folder) / "0_calib")
    return folder


def write_vector_calibrations(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    body = {"cam0": {"T_cam_body": VECTOR_CAM0_T["body"].ravel().tolist()}}
    (folder / "camera_mocap_extrinsic_results1.yaml").write_text(yaml.safe_dump(body))
    joint = {camera: {f"T_cam0_{camera}": VECTOR_CAM0_T[camera].ravel().tolist()}
             for camera in ("cam1", "cam2", "cam3")}
    (folder / "small_scale_joint_camera_extrinsic_results.yaml").write_text(yaml.safe_dump(joint))
    for side in ("left", "right"):
        for kind, camera in (("event", VECTOR_EVENT_CAMERA), ("regular", VECTOR_FRAME_CAMERA)):
            fields: dict[str, Any] = {
                "image_width": camera.width, "image_height": camera.height,
                "camera_matrix": {"rows": 3, "cols": 3, "data": camera.camera_matrix.ravel().tolist()},
                "distortion_coefficients": {"rows": 1, "cols": 5, "data": list(camera.coefficients)}}
            (folder / f"{side}_{kind}_camera_intrinsic_results.yaml").write_text(yaml.safe_dump(fields))


def write_tumvie(root: Path, recording: RawRecording, side: str = "left", name: str = "mocap-1d-trans",
                 frames: bool = True) -> Path:
    """Write one side of a sequence; calibrations A and B differ in one focal length."""
    folder = root / name
    folder.mkdir(parents=True, exist_ok=True)
    write_events_h5(folder / f"{name}-events_{side}.h5", recording.on_sensor(HD).events, 0)
    images = folder / f"{side}_images"
    images.mkdir()
    np.savetxt(images / f"image_timestamps_{side}.txt", recording.stamps_us, fmt="%d")
    np.savetxt(images / f"image_exposures_{side}.txt", np.full(len(recording.stamps_us), 4000), fmt="%d")
    if frames:
        for number, image in enumerate(recording.on_sensor((1024, 1024)).images):
            cv2.imwrite(str(images / f"{number:05d}.jpg"), image)
    lines = [" ".join([str(t_us), *map(repr, pose)])
             for t_us, pose in zip(recording.poses_us.tolist(), recording.world_T_cam.tolist())]
    (folder / "mocap_data.txt").write_text("\n".join(["# timestamp[us] px py pz qx qy qz qw", *lines, ""]))
    for letter in "AB":
        write_tumvie_calibration(root / f"camera-calibration{letter}.json", -40.0 if letter == "A" else 0.0)
    return folder


def write_tumvie_calibration(file: Path, change_of_fx: float) -> None:
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
    entries = []
    for camera in TUMVIE_CAMERAS:
        values = dict(zip(names, [*camera.intrinsics.tolist(), *camera.coefficients]))
        entries.append({"camera_type": "kb4", "intrinsics": {**values, "fx": values["fx"] + change_of_fx}})
    sizes = [[camera.width, camera.height] for camera in TUMVIE_CAMERAS]
    file.write_text(json.dumps({"value0": {"intrinsics": entries, "resolution": sizes, "T_imu_cam": []}}))


def write_eds(root: Path, recording: RawRecording, name: str = "00_peanuts_dark", frames: bool = True) -> Path:
    """Write a sequence on the absolute clock."""
    folder = root / name
    (folder / "images").mkdir(parents=True)
    absolute = recording.later(UNIX_US).on_sensor(VGA)
    write_flat_h5(folder / "events.h5", absolute.events)
    np.savetxt(folder / "images_timestamps.txt", absolute.stamps_us, fmt="%d")
    if frames:
        for number, image in enumerate(absolute.images):
            cv2.imwrite(str(folder / "images" / f"frame_{number:010d}.png"), image)
    write_poses(folder / "stamped_groundtruth.txt", "# timestamp[s] tx ty tz qx qy qz qw", absolute.poses_us,
                recording.world_T_cam)
    return folder


def shift_eds_in_place(folder: Path) -> None:
    """Do to a raw sequence what the published preprocessing does to its events: subtract the offset inside the file."""
    with h5py.File(folder / "events.h5", "r+") as file:
        offset_us = min(int(file["t"][0]), int(np.loadtxt(folder / "images_timestamps.txt")[0]),
                        int(np.loadtxt(folder / "stamped_groundtruth.txt")[0, 0] * 1e6))
        file["t"][...] = file["t"][...] - offset_us
    np.savetxt(folder / "t_offset_us.txt", [offset_us])


def write_mvsec(root: Path, recordings: dict[str, RawRecording], name: str = "indoor_flying1") -> Path:
    """Write a recording of both cameras; returns the folder that preprocessing makes."""
    calibrations = root / "indoor_flying_calib"
    calibrations.mkdir(parents=True, exist_ok=True)
    chain = {f"cam{number}": {"camera_model": "pinhole", "distortion_model": "equidistant",
                              "intrinsics": camera.intrinsics.tolist(), "resolution": [346, 260],
                              "distortion_coeffs": list(camera.coefficients)}
             for number, camera in enumerate(MVSEC_CAMERAS.values())}
    (calibrations / "camchain-imucam-indoor_flying.yaml").write_text(yaml.safe_dump(chain))
    with h5py.File(root / f"{name}_data.hdf5", "w") as data, h5py.File(root / f"{name}_gt.hdf5", "w") as truth:
        for side, recording in recordings.items():
            absolute = recording.on_sensor(DAVIS346).later(UNIX_US)
            events, group = absolute.events, data.create_group(f"davis/{side}")
            group["events"] = np.column_stack([events.x, events.y, events.t_us / 1e6, 2.0 * events.p - 1])
            group["image_raw"] = np.stack(absolute.images)
            group["image_raw_ts"] = absolute.stamps_us / 1e6
            closing = np.searchsorted(events.t_us, absolute.stamps_us)
            group["image_raw_event_inds"] = np.where(closing == 0, -1, closing)
            matrices = np.tile(np.eye(4), (len(absolute.poses_us), 1, 1))
            matrices[:, :3, :3] = rotation_matrices(absolute.world_T_cam[:, 3:])
            matrices[:, :3, 3] = absolute.world_T_cam[:, :3]
            truth[f"davis/{side}/pose"] = matrices
            truth[f"davis/{side}/pose_ts"] = absolute.poses_us / 1e6
    return root / f"{name}_data"
