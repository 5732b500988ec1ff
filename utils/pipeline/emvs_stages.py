"""Semi-dense mapping of the tracked recording: with the built-in EMVS mapper."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

from devo import __version__
from devo.errors import InputError
from utils.datasets.registry import Sequence, open_sequence
from utils.emvs.run import EmvsOptions, run_emvs
from utils.emvs.settings import EmvsSettings
from utils.pipeline.runner import Stage, StageResult

if TYPE_CHECKING:
    from utils.pipeline.stages import Plan


def emvs_stages(plan: Plan) -> list[Stage]:
    """The stages that were asked for, in order."""
    return [_map(plan)] if plan.options.emvs.run else []


def _map(plan: Plan) -> Stage:
    """Dense depth from the same events, along the trajectory that was found."""
    folder, poses = plan.folder / "emvs", plan.product("_poses.npy")
    asked = plan.options.emvs
    # a whole recording does not fit into one view, and its unit is arbitrary
    settings = EmvsSettings(min_depth=asked.min_depth, max_depth=asked.max_depth, dimZ=asked.dimZ, radius_search=None,
                            reference="baseline")

    def run() -> StageResult:
        folder.mkdir(parents=True, exist_ok=True)
        options = EmvsOptions(out=str(folder / "emvs"), poses=str(poses), cloud=str(plan.shown_cloud()),
                              settings=settings, device=plan.export.device)
        result = run_emvs(options, open_events_of(plan))
        return StageResult(sorted(folder.glob("emvs*")), {"points": len(result.cloud), "views": len(result.views)})

    return Stage("emvs", "map densely along the trajectory (EMVS)", (*plan.sequence_files(), poses, plan.cleaned),
                 {**asdict(settings), "version": __version__}, (folder / "emvs.ply", folder / "emvs.npy"), run)


def open_events_of(plan: Plan) -> Sequence:
    """The sequence as it was tracked.

    Raises:
        InputError: it holds voxel grids instead of events.
    """
    sequence = open_sequence(plan.found.dataset, plan.found.path, plan.export.sequence_options())
    if not isinstance(sequence, Sequence):
        raise InputError(f"{plan.found.path}: {plan.found.dataset} holds voxel grids, but EMVS needs events")
    return sequence

