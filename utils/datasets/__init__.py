"""Data sets: each module reads one and enters itself in the table; importing this package fills the table."""

from __future__ import annotations

from utils.datasets import ecd, eds, fpv, generic, hku, mvsec, rpg, tartan, tumvie, vector
from utils.datasets.registry import DATASETS, DatasetSpec, SequenceOptions, open_sequence, register
from utils.datasets.sequence import Recording, Sequence

__all__ = [
    "DATASETS",
    "DatasetSpec",
    "Recording",
    "Sequence",
    "SequenceOptions",
    "ecd",
    "eds",
    "fpv",
    "generic",
    "hku",
    "mvsec",
    "open_sequence",
    "register",
    "rpg",
    "tartan",
    "tumvie",
    "vector",
]
