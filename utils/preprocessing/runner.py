"""Preprocess all sequences below a folder: in parallel, resumable, to the end even if one of them fails."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path

from devo.errors import DevoError, InputError
from utils.preprocessing.registry import PREPROCESSORS, PreprocessOptions, Preprocessor


def preprocess(dataset: str, root: str | os.PathLike[str], *, side: str = "left", jobs: int = 1,
               overwrite: bool = False, images: bool = True, on_unsorted: str = "error",
               progress: bool = False) -> dict[Path, list[Path]]:
    """Make what the reader of a data set needs from the raw files of all sequences at or below a folder.

    Args:
        dataset: key of `PREPROCESSORS`.
        root: folder of one sequence, a folder that contains sequences, or a bag.
        side: camera of a stereo recording.
        jobs: sequences that are processed at the same time, each in a process of its own.
        overwrite, images, on_unsorted: see `PreprocessOptions`.
        progress: progress bars on stderr.

    Returns:
        Folder of each sequence and the files made in it (none where all were there).

    Raises:
        InputError: unknown data set, no sequence found, or all failures are unusable input.
        DevoError: a sequence failed; the message names it. The others were processed to their end before.
    """
    preprocessor, folders = find_sequences(dataset, root, side)
    if jobs < 1:
        raise InputError(f"jobs is {jobs}, expected at least 1")
    jobs = min(jobs, len(folders))
    options = PreprocessOptions(side, overwrite, images, progress and jobs == 1,
                                on_unsorted)  # type: ignore[arg-type]
    made: dict[Path, list[Path]] = {}
    failures: dict[Path, DevoError] = {}
    for folder, result in _progress_bar(_results(preprocessor, folders, options, jobs), len(folders), dataset,
                                        progress):
        if isinstance(result, DevoError):
            failures[folder] = result
        else:
            made[folder] = result
    if failures:
        _report(failures, len(folders))
    return dict(sorted(made.items()))


def find_sequences(dataset: str, root: str | os.PathLike[str], side: str = "left") -> tuple[Preprocessor, list[Path]]:
    """Return the preprocessor of a data set and the sequences at or below a folder.

    Raises:
        InputError: unknown data set, a side it does not have, a missing folder, or no sequence in it.
    """
    preprocessor = PREPROCESSORS.get(dataset)
    if preprocessor is None:
        raise InputError(f"data set {dataset!r} has no preprocessor, known are: {', '.join(sorted(PREPROCESSORS))}")
    options = PreprocessOptions(side)
    if options.side not in preprocessor.sides:
        raise InputError(f"side {side!r} was given, but recordings of {dataset} have one camera; leave --side out")
    root = Path(root)
    folders = preprocessor.find_sequences(root, side)
    if not folders:
        if not root.exists():
            raise InputError(f"{root} does not exist, expected recordings of {dataset}: {preprocessor.layout}")
        raise InputError(f"{root}: no recording of {dataset} found, expected {preprocessor.layout}")
    return preprocessor, folders


def _results(preprocessor: Preprocessor, folders: list[Path], options: PreprocessOptions,
             jobs: int) -> Iterator[tuple[Path, list[Path] | DevoError]]:
    if jobs == 1:
        for folder in folders:
            yield folder, _run_one(preprocessor.name, folder, options)
        return
    # Forking a process that used threads (OpenCV, torch) may hang the child, hence fresh interpreters.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context) as pool:
        waiting = {pool.submit(_run_one, preprocessor.name, folder, replace(options, progress=False)): folder
                   for folder in folders}
        try:
            for done in as_completed(waiting):
                yield waiting[done], done.result()
        except BrokenProcessPool:
            raise DevoError(f"a process that preprocessed {preprocessor.name} was killed, probably for want of memory; "
                            "run the command again with fewer --jobs, it goes on where it was") from None


def _run_one(dataset: str, folder: Path, options: PreprocessOptions) -> list[Path] | DevoError:
    """Return what was made, or the failure as a value: the other sequences go on."""
    try:
        return PREPROCESSORS[dataset].run(folder, options)
    except DevoError as error:
        return error


def _progress_bar(results: Iterator[tuple[Path, list[Path] | DevoError]], total: int, dataset: str,
                  progress: bool) -> Iterator[tuple[Path, list[Path] | DevoError]]:
    from tqdm import tqdm

    return iter(tqdm(results, total=total, unit="sequence", desc=f"preprocessing {dataset}", disable=not progress))


def _report(failures: dict[Path, DevoError], total: int) -> None:
    listing = "; ".join(f"{folder}: {str(error).removeprefix(f'{folder}: ')}"
                        for folder, error in sorted(failures.items()))
    kind = InputError if all(isinstance(error, InputError) for error in failures.values()) else DevoError
    raise kind(f"{len(failures)} of {total} recordings failed: {listing}")
