"""From a folder to all products: the work behind `scripts/start_pipline.py`."""

from __future__ import annotations

import datetime
from dataclasses import asdict, dataclass
from pathlib import Path

from devo import __version__
from devo.errors import InputError, OutputError
from utils.datasets.recognise import Recognised
from utils.datasets.registry import locate_sequence
from utils.export_run import ExportOptions
from utils.pipeline.options import PipelineOptions
from utils.pipeline.record import PipelineRecord, read_stages
from utils.pipeline.runner import plan as plan_lines
from utils.pipeline.runner import run_stages, say
from utils.pipeline.stages import Plan
from utils.pipeline.summary import summary_lines


@dataclass(frozen=True)
class PipelineResult:
    """What a run leaves.

    Attributes:
        record: as written to `pipeline.json` in the folder of results; its `status` is `ok` or `failed`.
        lines: to end with: quality, warnings, failures, products; of a dry run, what a run would do.
        page: where the page is or would be that shows the cloud.
    """

    record: PipelineRecord
    lines: list[str]
    page: Path

    def details(self) -> list[str]:
        """What every filter removed."""
        cleanup = self.record.stage("cleanup")
        return [f"  {line}" for line in cleanup.facts.get("filters", [])] if cleanup is not None else []


def run_pipeline(options: PipelineOptions) -> PipelineResult:
    """Run all stages; what they do is told on stderr. A dry run touches nothing.

    Raises:
        InputError: nothing can be run with these arguments.
        OutputError: the record cannot be written.
    """
    found = locate_sequence(options.dataset, options.indir, ExportOptions.from_flags(options.export).sequence_options())
    say(f"recognised: {found}")
    plan = Plan(options, found)
    stages = plan.stages()
    previous = read_stages(plan.folder) if options.resume else {}
    record = PipelineRecord(plan.folder, _about(options, found))
    if options.dry_run:
        return PipelineResult(record, [f"results in {plan.folder}", *plan_lines(stages, previous)], plan.page)
    try:
        record.write()  # an unwritable folder is found before minutes of work, not after
    except OutputError as error:
        raise InputError(f"--outdir {plan.folder}: {error}") from error
    run_stages(stages, record, previous, keep_going=options.keep_going)
    record.summary = summary_lines(record, found.path.name, _products(plan))
    record.write()
    return PipelineResult(record, record.summary, plan.page)


def _products(plan: Plan) -> dict[str, Path]:
    """What to look at first, in this order."""
    return {
        "cleaned cloud": plan.cleaned, "raw cloud": plan.product(".ply"), "trajectory": plan.product("_trajectory.txt"),
        "picture": plan.picture, "HTML view": plan.page,
        "dense map": plan.folder / "emvs" / "emvs.ply", "ROS bag": plan.folder / plan.options.emvs.bag_name,
        "per frame": plan.folder / plan.options.frame_out, "description": plan.product("_meta.json"),
        "record": plan.folder / "pipeline.json",
    }


def _about(options: PipelineOptions, found: Recognised) -> dict[str, object]:
    return {"version": __version__, "command": list(options.command), "working_directory": str(Path.cwd()),
            "started": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
            "recognised": {**asdict(found), "path": str(found.path), "source": str(found.source)}}
