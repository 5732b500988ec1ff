"""Random event recordings and writers of test files in forms the project itself does not write."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from utils.events import Events, write_events_h5, write_events_npz, write_events_text

WIDTH, HEIGHT = 64, 48


def random_events(count: int, seed: int = 0, start_us: int = 0, longest_gap_us: int = 50) -> Events:
    """Sorted events on a 64x48 sensor with repeated stamps."""
    rng = np.random.default_rng(seed)
    gaps = rng.integers(0, longest_gap_us + 1, count)
    gaps[:1] = 0
    return Events(rng.integers(0, WIDTH, count).astype(np.uint16), rng.integers(0, HEIGHT, count).astype(np.uint16),
                  start_us + np.cumsum(gaps).astype(np.int64), rng.integers(0, 2, count).astype(np.uint8))


def same(one: Events, other: Events) -> bool:
    """Whether all columns are equal."""
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ("x", "y", "t_us", "p"))


def write_npy_records(path: Path, events: Events) -> None:
    """Structured NPY with the byte layout of Metavision's decoder."""
    records = np.zeros(len(events), dtype=[("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    records["x"], records["y"], records["p"], records["t"] = events.x, events.y, events.p, events.t_us
    np.save(path, records)


def write_npy_table(path: Path, events: Events) -> None:
    """NPY table (N,4) of float64 with the columns t[s] x y p and polarity -1/+1."""
    np.save(path, np.column_stack([events.t_us / 1e6, events.x, events.y, 2.0 * events.p - 1]))


def write_flat_h5(path: Path, events: Events, **replaced: Any) -> None:
    """HDF5 with the columns at the root, contiguous, without ms_to_idx."""
    columns = {"x": events.x, "y": events.y, "t": events.t_us, "p": events.p, **replaced}
    with h5py.File(path, "w") as stream:
        for name, column in columns.items():
            if column is not None:
                stream.create_dataset(name, data=column)


WRITERS = {
    "text": (".txt", write_events_text),
    "npz": (".npz", write_events_npz),
    "npy records": (".npy", write_npy_records),
    "npy table": (".npy", write_npy_table),
    "hdf5 dsec": (".h5", write_events_h5),
    "hdf5 flat": (".h5", write_flat_h5),
}


def write_as(kind: str, folder: Path, events: Events) -> Path:
    """Write events in one of the `WRITERS` forms; the name gives nothing away about the content."""
    suffix, write = WRITERS[kind]
    written = folder / f"recording{suffix}"
    write(written, events)
    return written.rename(folder / f"{kind.replace(' ', '_')}.bin")
