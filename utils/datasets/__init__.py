"""Data sets: each module reads one and enters itself in the table; importing this package fills the table."""

from __future__ import annotations

from utils.datasets import generic
from utils.datasets.registry import DATASETS, DatasetSpec, SequenceOptions, open_sequence, register
from utils.datasets.sequence import Sequence

__all__ = ["DATASETS", "DatasetSpec", "Sequence", "SequenceOptions", "generic", "open_sequence", "register"]
