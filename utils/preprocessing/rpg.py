"""Stereo DAVIS240C recordings of the ECCV 2018 paper on stereo event cameras (RPG): one bag per recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from utils.calibration import Calibration
from utils.datasets.rpg import is_simulated
from utils.datasets.stereo_files import stereo_files
from utils.preprocessing.bag_camera import BagCamera, Topics
from utils.preprocessing.poses import inverse, rigid
from utils.preprocessing.registry import PreprocessOptions, Preprocessor, register
from utils.preprocessing.stereo_bag import BagRecipe, find_bags, run_bag

CAMERAS = {
    "left": Calibration(
        240, 180, 196.63936292910697, 196.7329768429481, 105.06412666477927, 72.47170071387173, "radtan",
        (-0.3367326394292646, 0.11178850939644308, -0.0014005281258491276, -0.00045959441440687044)),
    "right": Calibration(
        240, 180, 196.42564072599785, 196.56440793223533, 110.74517642512458, 88.11310058123058, "radtan",
        (-0.3462937629552321, 0.12772002965572962, -0.00027205054024332645, -0.00019580078540073353)),
}
_MARKER_T_LEFT = rigid((
    (5.36262328777285e-01, -1.748374625145743e-02, -8.438296573030597e-01, -7.009849865398374e-02),
    (8.433577587813513e-01, -2.821937531845164e-02, 5.366109927684415e-01, 1.881333563905305e-02),
    (-3.31943162375816e-02, -9.994488408486204e-01, -3.897382049768972e-04, -6.966829200678797e-02)))
# Published as T_cam0_cam1, but its translation is that from the left to the right camera (a point on the left camera
# lies at negative x in the right one), so its inverse leads from the right camera to the left.
_RIGHT_T_LEFT = rigid((
    (0.9991089760393723, -0.04098010198963204, 0.010093821797214667, -0.1479883582369969),
    (0.04098846609277917, 0.9991594254283246, -0.000623077121092687, -0.003289908601915284),
    (-0.010059803423311134, 0.0010362522169301642, 0.9999488619606629, 0.0026798262366239016)))
MARKER_T_CAM = {"left": _MARKER_T_LEFT, "right": _MARKER_T_LEFT @ inverse(_RIGHT_T_LEFT)}
"""From the camera to the body that the motion capture follows, by side."""


def run(folder: Path, options: PreprocessOptions) -> list[Path]:
    """Make events, stamps, ground truth, camera, rectification map and images of one side of one recording."""
    simulated, side = is_simulated(folder), options.side

    def find_topics(bag: BagCamera) -> Topics:
        events = bag.first_topic([f"/davis_{side}/events", f"/davis/{side}/events"])
        prefix = events.removesuffix("/events")
        poses = f"/davis/{side}/pose" if simulated else "/optitrack/davis_stereo"
        return Topics(events, bag.first_topic([f"{prefix}/image_raw"]), poses if poses in bag.topics else None,
                      bag.first_topic([f"{prefix}/camera_info"]) if simulated else None)

    files = stereo_files(folder, side, ".txt")
    return run_bag(BagRecipe(folder, files, find_topics, None if simulated else CAMERAS[side],
                             np.eye(4) if simulated else MARKER_T_CAM[side]), options)


def outputs(folder: Path, side: str) -> list[Path]:
    """Files that an event run needs."""
    files = stereo_files(folder, side, ".txt")
    return [files.events, files.stamps, files.pinhole] + ([] if is_simulated(folder) else [files.rectify_map])


register(Preprocessor(
    "rpg", "bags (ROS 1) with /davis_left/events and /davis_left/image_raw or /davis/left/...",
    lambda root, side: find_bags(root), run, outputs))
