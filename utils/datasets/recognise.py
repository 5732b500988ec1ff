"""Recognise a data set by the files of a folder, and find the one sequence that is meant.

A table says which files mark a data set: those that its reader needs ("ready") and those that its preprocessing makes
them from ("raw"). Nothing is opened but the list of topics of ROS bags, so this is quick on any recording.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from devo.errors import InputError
from utils.datasets.files import CALIBRATION_NAMES, EVENT_SUFFIXES, NOT_EVENT_NAMES

AUTO = "auto"
GENERIC = "generic"
_BAG = ".bag"
_OTHER = {"left": "right", "right": "left"}


@dataclass(frozen=True)
class Layout:
    """Which files mark a data set.

    Patterns are names relative to the sequence folder: `*` as in shells, `{side}` is left or right, a final `/` means
    a folder, a leading `../` the folder around it, `|` either.

    Attributes:
        dataset: name in the table of data sets.
        ready: what the reader needs.
        raw: what preprocessing needs, nothing where there is none; with an `archive`, relative to its folder.
        archive: ending of a raw file of which preprocessing makes a folder of the same stem beside it; empty where
            preprocessing writes into the raw folder itself.
        topics: topics of which a ROS bag of this data set has at least one.
        waived: pattern -> part of a sequence's name that makes the file unnecessary.
    """

    dataset: str
    ready: tuple[str, ...]
    raw: tuple[str, ...] = ()
    archive: str = ""
    topics: tuple[str, ...] = ()
    waived: tuple[tuple[str, str], ...] = ()


LAYOUTS = (
    Layout("fpv", ("events.txt", "t_offset_us.txt", "images_timestamps_us.txt", "calib_undist.txt", "rectify_map.h5"),
           ("events.txt", "images.txt", "*img*/")),
    Layout("ecd", ("events.txt", "tss_us.txt", "calib_undist.txt", "rectify_map.h5"),
           ("events.txt", "images.txt", "images/", "calib.txt")),
    Layout("rpg", ("evs_{side}.txt", "tss_imgs_us_{side}.txt", "calib_undist_{side}.txt", "rectify_map_{side}.h5"),
           archive=_BAG, topics=("/optitrack/davis_stereo", "/davis/left/pose", "/davis/right/pose"),
           waived=(("rectify_map_{side}.h5", "simulation_3planes"),)),
    Layout("hku", ("evs_{side}.h5", "tss_imgs_us_{side}.txt", "calib_undist_{side}.txt", "rectify_map_{side}.h5"),
           archive=_BAG, topics=("/cpy_uav/viconros/odometry",)),
    Layout("vector", ("*1.synced.{side}_event.hdf5", "tss_imgs_us_{side}.txt", "calib_undist_evs_{side}.txt",
                      "rectify_map_{side}.h5"),
           ("*1.synced.{side}_event.hdf5", "*1.synced.{side}_camera/timestamp.txt", "../0_calib/|0_calib/")),
    Layout("tumvie", ("*events_{side}.h5", "calib_undist.json", "rectify_map_{side}.h5",
                      "{side}_images_undistorted/image_timestamps_{side}.txt"),
           ("*events_{side}.h5", "{side}_images/image_timestamps_{side}.txt", "mocap_data.txt",
            "../camera-calibration*.json")),
    Layout("eds", ("events.h5", "t_offset_us.txt", "images_timestamps_us.txt", "rectify_map_calib*.h5"),
           ("events.h5", "images_timestamps.txt", "images/")),
    Layout("mvsec", ("*_data.hdf5", "tss_imgs_us_{side}.txt", "calib_undist_{side}.txt", "rectify_map_{side}.h5"),
           ("indoor_flying_calib/camchain-imucam-indoor_flying.yaml",), archive="_data.hdf5"),
    Layout("tartan", ("h5/0*.h5",)),
)
"""The data sets that can be told by their files; recordings of your own ("generic") are whatever else holds events."""

_BY_NAME = {layout.dataset: layout for layout in LAYOUTS}


class AmbiguousError(InputError):
    """More than one data set or sequence fits; the message lists them."""


@dataclass(frozen=True)
class Recognised:
    """What a path was recognised as.

    Attributes:
        dataset: name of the data set.
        path: sequence folder (absolute), or the event file of a generic recording. The folder of an archive that was
            not preprocessed need not exist yet.
        side: camera for which this holds.
        found: names of the files that decided.
        missing: files that preprocessing still has to make; none = the sequence can be read as it is.
        source: what preprocessing starts from: the folder, or the archive (ROS bag, HDF5).
    """

    dataset: str
    path: Path
    side: str
    found: tuple[str, ...]
    missing: tuple[str, ...]
    source: Path

    @property
    def ready(self) -> bool:
        """Whether the sequence can be read without preprocessing."""
        return not self.missing

    @property
    def command(self) -> str:
        """The preprocessing command that makes what is missing."""
        return preprocessing_command(self.dataset, self.source, self.side)

    def __str__(self) -> str:
        text = f"{self.path} is {self.dataset} by its {_list(self.found)}"
        return text if self.ready else f"{text}; not preprocessed: {_list(self.missing)} missing"

    def require_ready(self) -> Recognised:
        """Return this if it can be read as it is.

        Raises:
            InputError: preprocessing has to come first; the message says which command does it.
        """
        if self.ready:
            return self
        alternative = ""
        if _generic_in(self.path, self.side, calibrated=False) is not None:
            alternative = f"; or read it as a recording of your own with --dataset {GENERIC}"
        raise InputError(f"{self}; make it with: {self.command}{alternative}")


def preprocessing_command(dataset: str, source: Path, side: str) -> str:
    """The command line that preprocesses a raw sequence."""
    return f"python scripts/pp_{dataset}.py --indir {shlex.quote(str(source))}" + (
        "" if side == "left" else f" --side {side}")


def recognise(path: str | os.PathLike[str], side: str = "left", dataset: str = AUTO,
              calibrated: bool = False) -> Recognised:
    """Find the sequence that a path means, and its data set.

    Looked at in this order: the path itself, the folder of the same name in it, and the only sub-folder that
    qualifies. A preprocessed sequence goes before a raw one, a named data set before "generic".

    Args:
        path: folder, ROS bag, or event file; relative paths count from the working directory.
        side: camera of a stereo recording.
        dataset: accept only this data set; "auto" accepts all.
        calibrated: the caller has a calibration, so a generic recording needs none.

    Raises:
        InputError: the path is missing, or nothing fits; the message says what comes closest and what it lacks.
        AmbiguousError: several fit.
    """
    given = Path(os.path.abspath(path))  # noqa: PTH100 - normalises `..` without following links, unlike resolve()
    if side not in _OTHER:
        raise InputError(f"side is {side!r}, expected left or right")
    if dataset not in (AUTO, GENERIC, *_BY_NAME):
        raise InputError(f"data set {dataset!r} has no layout to look for, known are: {', '.join(_BY_NAME)}, {GENERIC}")
    layouts = LAYOUTS if dataset == AUTO else tuple(layout for layout in LAYOUTS if layout.dataset == dataset)
    own = dataset in (AUTO, GENERIC)
    if not given.exists():
        raise InputError(f"{path} does not exist, expected a folder of a sequence, a bag or an event file"
                         + _suggestion(given))
    if given.is_file():
        return _of_file(given, side, layouts, own)
    for folder in (given, given / given.name):
        found = _best(_matches(folder, side, layouts, own, calibrated), folder)
        if found is not None:
            return found
    if own and _generic_in(given, side, calibrated=True) is not None:
        raise InputError(_explain(given, side, layouts, own))  # a calibration is missing, not the recording
    return _of_children(given, side, layouts, own, calibrated)


def _of_file(file: Path, side: str, layouts: Sequence[Layout], own: bool) -> Recognised:
    archives = [layout for layout in layouts if layout.archive and file.name.endswith(layout.archive)]
    matches = [match for layout in archives if (match := _of_archive(file, side, layout)) is not None]
    found = _best(matches, file)
    if found is not None:
        return found
    if not own:
        names = " or ".join(layout.dataset for layout in layouts)
        raise InputError(f"{file} is no raw recording of {names}; pass the folder of the sequence, or --dataset auto")
    return Recognised(GENERIC, file, side, (file.name,), (), file)


def _of_children(folder: Path, side: str, layouts: Sequence[Layout], own: bool, calibrated: bool) -> Recognised:
    children = [child for child in sorted(folder.iterdir()) if child.is_dir() and not child.name.startswith(".")]
    fitting = []
    for child in children:
        found = _best(_matches(child, side, layouts, own, calibrated), child)
        if found is not None:
            fitting.append(found)
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise AmbiguousError(f"{folder} holds several sequences, pass one of them: "
                             + ", ".join(f"{match.path} ({match.dataset})" for match in fitting))
    raise InputError(_explain(folder, side, layouts, own))


def _matches(folder: Path, side: str, layouts: Sequence[Layout], own: bool, calibrated: bool) -> list[Recognised]:
    """Everything that a folder can be, archives in it and beside it included."""
    matches = []
    for layout in layouts:
        found, missing = _look(folder, layout.ready, side, layout)
        if not missing:
            matches.append(Recognised(layout.dataset, folder, side, found, (), folder))
        elif layout.archive:
            matches += [match for file in _archives_of(folder, layout)
                        if (match := _of_archive(file, side, layout)) is not None]
        elif layout.raw and folder.is_dir():
            raw, absent = _look(folder, layout.raw, side)
            if not absent:
                matches.append(Recognised(layout.dataset, folder, side, raw, missing, folder))
    generic = _generic_in(folder, side, calibrated) if own else None
    return [*matches, generic] if generic is not None else matches


def _archives_of(folder: Path, layout: Layout) -> list[Path]:
    """The archive that a sequence folder was or will be made from, else all archives in the folder."""
    beside = folder.parent / f"{folder.name}.{layout.archive.rpartition('.')[2]}"
    if beside.is_file() and beside.name.endswith(layout.archive):
        return [beside]
    return sorted(file for file in folder.glob(f"*{layout.archive}") if file.is_file())


def _of_archive(file: Path, side: str, layout: Layout) -> Recognised | None:
    """The sequence of an archive, preprocessed or not; None if the archive is not one of this data set."""
    folder = file.with_name(file.name.split(".")[0])
    found, missing = _look(folder, layout.ready, side, layout)
    if not missing:
        return Recognised(layout.dataset, folder, side, found, (), folder)
    if layout.topics:
        try:
            topics = sorted(set(layout.topics) & _topics(file))
        except InputError:  # raised by `_explain` should nothing else fit
            return None
        return Recognised(layout.dataset, folder, side, (f"{file.name} with {topics[0]}",), missing,
                          file) if topics else None
    raw, absent = _look(file.parent, layout.raw, side)
    return None if absent else Recognised(layout.dataset, folder, side, (file.name, *raw), missing, file)


def _best(matches: Iterable[Recognised], where: Path) -> Recognised | None:
    """The match to take: ready before raw, named before generic, never one of several equals."""
    ranked = [[match for match in matches if match.ready and match.dataset != GENERIC],
              [match for match in matches if not match.ready],
              [match for match in matches if match.dataset == GENERIC]]
    for group in ranked:
        if len(group) == 1:
            return group[0]
        if group:
            raise AmbiguousError(f"{where} fits several recordings, pass one of them or --dataset: "
                                 + ", ".join(f"{match.source} ({match.dataset})" for match in group))
    return None


def _generic_in(folder: Path, side: str, calibrated: bool) -> Recognised | None:
    """A recording of one's own: an event file and, unless the caller has it, a calibration."""
    if not folder.is_dir():
        return None
    events = [folder / f"events{suffix}" for suffix in EVENT_SUFFIXES if (folder / f"events{suffix}").is_file()]
    if not events:
        events = sorted(file for file in folder.iterdir() if file.is_file() and file.suffix.lower() in EVENT_SUFFIXES
                        and file.name not in NOT_EVENT_NAMES)
    calibration = next((name for name in CALIBRATION_NAMES if (folder / name).is_file()), None)
    if not events or (calibration is None and not calibrated):
        return None
    found = (events[0].name,) if calibration is None else (events[0].name, calibration)
    return Recognised(GENERIC, folder, side, found, (), folder)


def _look(folder: Path, patterns: Sequence[str], side: str, layout: Layout | None = None) -> tuple[
        tuple[str, ...], tuple[str, ...]]:
    """Names that were found and patterns that were not."""
    waived = {pattern for pattern, part in (layout.waived if layout else ()) if part in folder.name}
    found, missing = [], []
    for pattern in patterns:
        name = _first(folder, pattern.format(side=side))
        if name is not None:
            found.append(name)
        elif pattern not in waived:
            missing.append(pattern.format(side=side))
    return tuple(found), tuple(missing)


def _first(folder: Path, pattern: str) -> str | None:
    """The first file or folder that fits, as a user would type it from the folder."""
    for choice in pattern.split("|"):
        base, prefix = (folder.parent, "../") if choice.startswith("../") else (folder, "")
        name = choice.removeprefix("../")
        wants_folder = name.endswith("/")
        for hit in sorted(base.glob(name.rstrip("/"))):
            if hit.is_dir() == wants_folder:
                return prefix + hit.relative_to(base).as_posix() + ("/" if wants_folder else "")
    return None


def _topics(bag: Path) -> set[str]:
    from utils.events.bags import bag_errors, open_bag

    reader = open_bag(bag)
    try:
        with bag_errors(bag):
            return {connection.topic for connection in reader.connections}
    finally:
        reader.close()


def _explain(folder: Path, side: str, layouts: Sequence[Layout], own: bool) -> str:
    """What a folder that fits nothing comes closest to, what that lacks, and what makes it.

    Raises:
        InputError: there is a bag that cannot be looked into.
    """
    for bag in sorted(folder.glob(f"*{_BAG}")):
        _topics(bag)
    looks = []
    for layout in layouts:
        found, _ = _look(folder, tuple(dict.fromkeys((*layout.ready, *layout.raw))), side, layout)
        other, absent = _look(folder, layout.ready, _OTHER[side], layout)
        looks.append((len(found) + (0 if absent else len(other)), layout, found, not absent))
    most = max((count for count, *_ in looks), default=0)
    lines = [_lacks(folder, side, layout, found, other) for count, layout, found, other in looks
             if count == most and (most or len(layouts) == 1)]
    if own:
        lines.append(f"a recording of your own needs an event file (events.h5, .raw, .bag, .txt, ...) and "
                     f"{' or '.join(CALIBRATION_NAMES)}, and has {_own_parts(folder)}")
    return f"{folder} is not recognised as a recording: " + "; ".join(lines[:4])


def _lacks(folder: Path, side: str, layout: Layout, found: tuple[str, ...], other_side_is_ready: bool) -> str:
    missing = _list(_look(folder, layout.ready, side, layout)[1])
    text = f"{layout.dataset} ({_list(found) or 'nothing'} found) lacks {missing}"
    if other_side_is_ready:
        text += f" but is complete for --side {_OTHER[side]}"
    if layout.archive:
        origin = f"{folder.name}.{layout.archive.rpartition('.')[2]}"
        return f"{text}; `python scripts/pp_{layout.dataset}.py` makes it from {origin} beside the folder"
    if not layout.raw:
        return text
    absent = _list(_look(folder, layout.raw, side)[1])
    return f"{text}; `{preprocessing_command(layout.dataset, folder, side)}` makes it, once there is {absent}"


def _own_parts(folder: Path) -> str:
    has = [name for name in CALIBRATION_NAMES if (folder / name).is_file()]
    with_events = _generic_in(folder, "left", calibrated=True)
    if with_events is not None:
        has.insert(0, with_events.found[0])
    if has:
        return f"only {_list(has)}"
    return f"neither ({len(list(folder.iterdir()))} entries)"


def _suggestion(path: Path) -> str:
    """Names in the same folder that begin like a path that is missing."""
    if not path.parent.is_dir():
        return ""
    similar = sorted(entry.name for entry in path.parent.iterdir() if entry.name.startswith(path.name))
    return f"; did you mean {_list(similar[:3])}?" if similar else ""


def _list(names: Sequence[str]) -> str:
    return ", ".join(name.replace("|", " or ") for name in names)
