"""Run stages one after the other: what is unchanged is left alone, what fails is recorded."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from devo.errors import DevoError
from utils.pipeline.record import PipelineRecord, StageRecord, fingerprint, fingerprints

FINISHED = ("done", "unchanged")


@dataclass
class StageResult:
    """What a stage made: files, counts for the summary, warnings for people."""

    outputs: list[Path]
    facts: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Stage:
    """One step of the pipeline.

    Attributes:
        name: short, for records and messages.
        purpose: what it does, for people.
        inputs: files and folders that decide about the result.
        settings: everything else that does; plain values.
        products: what it will make, as far as that is known before.
        run: does it.
        skip: why there is nothing to do; empty where there is.
    """

    name: str
    purpose: str
    inputs: tuple[Path, ...]
    settings: dict[str, Any]
    products: tuple[Path, ...]
    run: Callable[[], StageResult]
    skip: str = ""


def plan(stages: Sequence[Stage], previous: dict[str, StageRecord]) -> list[str]:
    """One line per stage that says what a run would do, and why; nothing is touched."""
    lines = []
    changed: set[Path] = set()
    for number, stage in enumerate(stages, 1):
        reason = stage.skip or ("" if changed & set(stage.inputs) else _unchanged(stage, previous.get(stage.name)))
        if reason:
            lines.append(f"{number}. {stage.name}: nothing to do, {reason}")
            continue
        changed |= set(stage.products)
        products = ", ".join(str(path) for path in stage.products)
        lines.append(f"{number}. {stage.name}: {stage.purpose}; makes {products}")
    return lines


def run_stages(stages: Sequence[Stage], record: PipelineRecord, previous: dict[str, StageRecord], *,
               keep_going: bool = False) -> None:
    """Run all stages and record each in `record`, which is written after every stage.

    A stage whose inputs and settings are those of `previous` and whose outputs are untouched is not run again. After
    a failure the rest is not run; with `keep_going` the stages whose inputs exist are.

    Args:
        stages: in order.
        record: is filled and written.
        previous: stages of an earlier run by name; empty to run everything.
        keep_going: go on after a failed stage.
    """
    for number, stage in enumerate(stages, 1):
        said = f"[{number}/{len(stages)}] {stage.name}"
        failed = record.status == "failed"
        missing = [path for path in stage.inputs if not path.exists()]
        entry = StageRecord(stage.name, "not run", settings=_plain(stage.settings))
        record.stages.append(entry)
        if stage.skip:
            entry.status, entry.reason = "skipped", stage.skip
        elif failed and not keep_going:
            entry.reason = "an earlier stage failed"
        elif failed and missing:
            entry.reason = f"{missing[0]} is missing since an earlier stage failed"
        elif reason := _unchanged(stage, previous.get(stage.name)):
            record.stages[-1] = entry = previous[stage.name]
            entry.status, entry.reason = "unchanged", reason
        else:
            say(f"{said}: {stage.purpose}")
            _run(stage, entry, record)
        record.write()
        if entry.status != "not run" or keep_going:
            told = f"done in {entry.seconds:.1f} s" if entry.status == "done" else entry.status
            say(f"{said}: {told}" + (f", {entry.reason}" if entry.reason else ""))


def _run(stage: Stage, entry: StageRecord, record: PipelineRecord) -> None:
    entry.inputs = fingerprints(stage.inputs)
    started = time.perf_counter()
    try:
        result = stage.run()
    except DevoError as error:
        entry.status, entry.reason = "failed", " ".join(str(error).split())
    except BaseException as error:  # recorded and passed on: a defect of the program, or Ctrl-C
        entry.status, entry.reason = "failed", f"{type(error).__name__} {error}".strip()
        entry.seconds = round(time.perf_counter() - started, 3)
        record.write()
        raise
    else:
        entry.status, entry.facts, entry.warnings = "done", result.facts, result.warnings
        entry.outputs = fingerprints(dict.fromkeys(result.outputs))
    entry.seconds = round(time.perf_counter() - started, 3)


def _unchanged(stage: Stage, before: StageRecord | None) -> str:
    """Why a stage need not run again; empty if it must."""
    if before is None or before.status not in FINISHED or before.settings != _plain(stage.settings):
        return ""
    if before.inputs != fingerprints(stage.inputs):
        return ""
    if any(fingerprint(Path(path)) != mark for path, mark in before.outputs.items()):
        return ""
    return "inputs, settings and products are unchanged"


def _plain(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings as they look after a round trip through JSON, so that old and new ones can be compared."""
    plain: dict[str, Any] = json.loads(json.dumps(settings, default=str))
    return plain


def say(text: str) -> None:
    """One line on stderr that does not tear a progress bar."""
    tqdm.write(text, file=sys.stderr)
