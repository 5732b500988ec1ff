"""HKU stereo recordings (two DAVIS346, handheld and on a drone): one bag per recording."""

from __future__ import annotations

from pathlib import Path

from utils.calibration import Calibration
from utils.datasets.stereo_files import stereo_files
from utils.preprocessing.bag_camera import BagCamera, Topics
from utils.preprocessing.poses import inverse, rigid
from utils.preprocessing.registry import PreprocessOptions, Preprocessor, register
from utils.preprocessing.stereo_bag import BagRecipe, find_bags, run_bag

CAMERAS = {
    "left": Calibration(
        346, 260, 249.69341447817564, 248.41625664694038, 176.74240257052816, 129.47631010746218, "radtan",
        (-0.3794794654640921, 0.15393049046270296, 0.0011400586965363895, -0.0019042695753031854)),
    "right": Calibration(
        346, 260, 258.61441518089174, 258.00363445501824, 178.44356547141308, 135.84792628403616, "radtan",
        (-0.3864639588089853, 0.1707517912637013, -0.00046695742172563157, 0.0006610867041757214)),
}
# The data set calls it T_cam0_imu; the body of the motion capture is taken to be the inertial unit.
_LEFT_T_BODY = rigid((
    (0.9999552277012158, -0.00603191153357543, 0.007290996931816412, 0.00011018857347815285),
    (0.005994670026470383, 0.9999689294906282, 0.005118982773930891, -0.0007730487905611042),
    (-0.007321647648062164, -0.005075046464534421, 0.9999603179022153, -0.060160984076249716)))
# Published as T_cam0_cam1, but its translation is that from the left to the right camera; see rpg.py.
_RIGHT_T_LEFT = rigid((
    (0.9999189999842378, 0.00927392731970859, -0.00871709484799569, -0.05968052204060377),
    (-0.009231577824269699, 0.9999454511978819, 0.004885959428529005, -0.0005334476469976882),
    (0.008761931373541011, -0.004805091126247473, 0.9999500685823629, 0.0005990728587972945)))
BODY_T_CAM = {"left": inverse(_LEFT_T_BODY), "right": inverse(_RIGHT_T_LEFT @ _LEFT_T_BODY)}
"""From the camera to the body that the motion capture follows, by side."""
_POSES = "/cpy_uav/viconros/odometry"


def run(folder: Path, options: PreprocessOptions) -> list[Path]:
    """Make events, stamps, ground truth, camera, rectification map and images of one side of one recording."""
    side = options.side

    def find_topics(bag: BagCamera) -> Topics:
        return Topics(bag.first_topic([f"/davis_{side}/events"]), bag.first_topic([f"/davis_{side}/image_raw"]),
                      _POSES if _POSES in bag.topics else None)

    recipe = BagRecipe(folder, stereo_files(folder, side, ".h5"), find_topics, CAMERAS[side], BODY_T_CAM[side])
    return run_bag(recipe, options)


def outputs(folder: Path, side: str) -> list[Path]:
    """Files that an event run needs."""
    files = stereo_files(folder, side, ".h5")
    return [files.events, files.stamps, files.pinhole, files.rectify_map]


register(Preprocessor(
    "hku", "bags (ROS 1) with /davis_left/events and /davis_left/image_raw",
    lambda root, side: find_bags(root), run, outputs))
