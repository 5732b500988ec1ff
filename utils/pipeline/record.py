"""What a pipeline run leaves behind about itself: `pipeline.json`, and fingerprints that tell whether files changed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from devo.errors import InputError
from utils.atomic import atomic_path

FILE_NAME = "pipeline.json"
FORMAT_VERSION = 1
_HASHED_UP_TO = 32 << 20  # bytes; larger files are told by size and time of change, else a resume would take minutes


@dataclass
class StageRecord:
    """What happened to one stage.

    Attributes:
        name: of the stage.
        status: `done`, `unchanged` (resumed), `skipped` (nothing to do), `failed`, or `not run`.
        seconds: how long it took; of an unchanged stage, when it was done.
        settings: everything but files that decides about the result.
        inputs, outputs: file -> fingerprint.
        facts: counts and the like, for the summary.
        warnings: sentences for people.
        reason: why it was skipped, not run, or failed.
    """

    name: str
    status: str
    seconds: float = 0.0
    settings: dict[str, Any] = field(default_factory=dict)
    inputs: dict[str, str] = field(default_factory=dict)
    outputs: dict[str, str] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    reason: str = ""


def fingerprint(path: Path) -> str:
    """A short text that changes when a file or folder does; "missing" where there is none.

    Files up to 32 MiB are hashed; larger ones are told by size and time of change. A folder is the names, sizes and
    times of the files directly in it.
    """
    if path.is_dir():
        entries = sorted((entry.name, entry.stat().st_size, entry.stat().st_mtime_ns)
                         for entry in path.iterdir() if entry.is_file())
        return f"folder:{len(entries)}:{_digest(repr(entries).encode())}"
    if not path.is_file():
        return "missing"
    status = path.stat()
    if status.st_size > _HASHED_UP_TO:
        return f"file:{status.st_size}:{status.st_mtime_ns}"
    return f"sha256:{_digest(path.read_bytes())}"


def fingerprints(paths: Iterable[Path]) -> dict[str, str]:
    """Fingerprint of each path, by its name."""
    return {str(path): fingerprint(path) for path in paths}


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:32]


class PipelineRecord:
    """The content of `pipeline.json`; written anew after every stage, so that a torn run can be resumed.

    Args:
        folder: where the products are.
        about: what was asked for and recognised, as plain values.
    """

    def __init__(self, folder: Path, about: Mapping[str, Any]) -> None:
        self.path = folder / FILE_NAME
        self._about = dict(about)
        self.stages: list[StageRecord] = []
        self.summary: list[str] = []

    @property
    def status(self) -> str:
        """`ok` unless a stage failed or was not run."""
        return "failed" if any(stage.status in ("failed", "not run") for stage in self.stages) else "ok"

    @property
    def warnings(self) -> list[str]:
        """The warnings of all stages."""
        return [warning for stage in self.stages for warning in stage.warnings]

    def stage(self, name: str) -> StageRecord | None:
        """The record of a stage; None where it was not reached."""
        return next((stage for stage in self.stages if stage.name == name), None)

    def write(self) -> None:
        """Write the file, completely or not at all."""
        content = {"format": FORMAT_VERSION, **self._about, "status": self.status, "summary": self.summary,
                   "stages": [asdict(stage) for stage in self.stages]}
        with atomic_path(self.path) as temporary:
            temporary.write_text(json.dumps(content, indent=2, default=str) + "\n", encoding="utf-8")


def read_stages(folder: Path) -> dict[str, StageRecord]:
    """The stages of an earlier run by name; none where there was no run.

    Raises:
        InputError: the file is damaged or of another version.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return {}
    advice = "leave --resume out to start anew"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != FORMAT_VERSION:
            raise InputError(f"{path}: written by another version (format {content['format']}, expected "
                             f"{FORMAT_VERSION}); {advice}")
        return {stage["name"]: StageRecord(**stage) for stage in content["stages"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a record of a pipeline run ({error}); {advice}") from error
