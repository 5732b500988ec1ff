"""Semi-dense mapping of the tracked recording: the built-in EMVS mapper, or bag and flag file for that of ROS."""

from __future__ import annotations

import collections
import shutil
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from devo import __version__
from devo.errors import DevoError, InputError
from utils.datasets.registry import Sequence, open_sequence
from utils.emvs.run import EmvsOptions, run_emvs
from utils.emvs.settings import EmvsSettings
from utils.pipeline.record import FILE_NAME
from utils.pipeline.runner import Stage, StageResult
from utils.ros_output.emvs_bag import EmvsBagOptions, prepare_emvs_bag

if TYPE_CHECKING:
    from utils.pipeline.stages import Plan

_LAST_LINES = 5  # of the output of a program that failed


def emvs_stages(plan: Plan) -> list[Stage]:
    """The stages that were asked for, in order.

    Raises:
        InputError: settings out of range, a bag that may not be replaced, or no ROS where it is needed.
    """
    asked = plan.options.emvs
    stages = [_bag(plan)] if asked.needs_bag else []
    if asked.run:
        stages.append(_run_ros(plan) if asked.backend == "ros" else _map(plan))
    return stages


def _map(plan: Plan) -> Stage:
    """Dense depth from the same events, along the trajectory that was found."""
    folder, poses, asked = plan.folder / "emvs", plan.product("_poses.npy"), plan.options.emvs
    # a whole recording does not fit into one view, and its unit is arbitrary
    settings = EmvsSettings(min_depth=asked.min_depth, max_depth=asked.max_depth, dimZ=asked.dimZ, radius_search=None,
                            reference="baseline")

    def run() -> StageResult:
        folder.mkdir(parents=True, exist_ok=True)
        options = EmvsOptions(out=str(folder / "emvs"), poses=str(poses), cloud=str(plan.shown_cloud()),
                              settings=settings, device=plan.export.device)
        result = run_emvs(options, _tracked_sequence(plan))
        return StageResult(sorted(folder.glob("emvs*")), {"points": len(result.cloud), "views": len(result.views)})

    return Stage("emvs", "map densely along the trajectory (EMVS)", (*plan.sequence_files(), poses, plan.cleaned),
                 {**asdict(settings), "version": __version__}, (folder / "emvs.ply", folder / "emvs.npy"), run)


def _tracked_sequence(plan: Plan) -> Sequence:
    sequence = open_sequence(plan.found.dataset, plan.found.path, plan.export.sequence_options())
    if not isinstance(sequence, Sequence):
        raise InputError(f"{plan.found.path}: {plan.found.dataset} holds voxel grids, but EMVS needs events")
    return sequence


def _bag(plan: Plan) -> Stage:
    """Events, camera and poses for the ROS implementation, poses camera to world."""
    asked, export = plan.options.emvs, plan.export
    bag, conf, poses = plan.folder / asked.bag_name, plan.folder / asked.conf_name, plan.product("_poses.npy")
    own = (plan.folder / FILE_NAME).is_file()
    if bag.exists() and not (own or asked.overwrite):
        raise InputError(f"{bag} exists and is of no earlier run; replace it with --emvs-overwrite, or choose another "
                         "--emvs-bag-name")
    options = EmvsBagOptions(
        poses=str(poses), out_bag=str(bag), out_conf=str(conf), datapath=str(plan.found.path),
        dataset=plan.found.dataset, side=asked.side or plan.found.side, calib=export.calib,
        image_size=export.image_size, event_topic=asked.event_topic, camera_info_topic=asked.camera_info_topic,
        pose_topic=asked.pose_topic, min_depth=asked.min_depth, max_depth=asked.max_depth, dimZ=asked.dimZ,
        t_margin_s=asked.t_margin_s, cloud=str(plan.cleaned), overwrite=True)
    options.check()

    def run() -> StageResult:
        return StageResult([bag, conf], prepare_emvs_bag(replace(options, cloud=str(plan.shown_cloud()))))

    inputs = (*plan.sequence_files(), poses, plan.cleaned)
    return Stage("emvs bag", "write events, camera and poses for EMVS in ROS", inputs,
                 {**asdict(options), "version": __version__}, (bag, conf), run)


def _run_ros(plan: Plan) -> Stage:
    """The ROS implementation; it writes into its working directory, which is `emvs/` in the folder of results."""
    if shutil.which("rosrun") is None:
        raise InputError("--emvs-backend ros needs rosrun on the PATH (ROS 1 with mapper_emvs); the built-in mapper "
                         "needs no ROS: --emvs-backend python")
    folder, conf = plan.folder / "emvs", plan.folder / plan.options.emvs.conf_name
    command = ["rosrun", "mapper_emvs", "run_emvs", f"--flagfile={conf.absolute()}"]

    def run() -> StageResult:
        folder.mkdir(parents=True, exist_ok=True)
        _stream(command, folder)
        return StageResult(sorted(path for path in folder.iterdir() if path.is_file()))

    return Stage("emvs", f"map densely with {' '.join(command[:3])}", (conf, plan.folder / plan.options.emvs.bag_name),
                 {"command": command}, (folder,), run)


def _stream(command: list[str], folder: Path) -> None:
    """Run a program in a folder; what it says goes to stderr.

    Raises:
        DevoError: it ended with an error; the message holds its last words.
    """
    last: collections.deque[str] = collections.deque(maxlen=_LAST_LINES)
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                          errors="replace") as process:
        for line in process.stdout or ():
            sys.stderr.write(line)
            last.append(line.strip())
    if process.returncode:
        raise DevoError(f"`{' '.join(command)}` in {folder} ended with {process.returncode}: {' | '.join(last)}")
