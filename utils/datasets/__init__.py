"""Data sets: each module reads one and enters itself in the table; importing this package fills the table."""

from __future__ import annotations

from utils.datasets import eds, generic, mvsec, tartan, tumvie, vector
from utils.datasets.registry import DATASETS, DatasetSpec, SequenceOptions, open_sequence, register
from utils.datasets.sequence import Recording, Sequence

__all__ = [
    "DATASETS",
    "DatasetSpec",
    "Recording",
    "Sequence",
    "SequenceOptions",
    "eds",
    "generic",
    "mvsec",
    "open_sequence",
    "register",
    "tartan",
    "tumvie",
    "vector",
]
