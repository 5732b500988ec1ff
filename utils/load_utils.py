"""Iterators and loaders under the module name that users of DEVO know; the code lives in `utils.datasets`."""

from __future__ import annotations

from utils.datasets.eds import eds_evs_iterator
from utils.datasets.files import read_image_list
from utils.datasets.folders import video_iterator, voxel_iterator
from utils.datasets.mvsec import mvsec_evs_iterator
from utils.datasets.registry import DATASETS, SequenceOptions, open_sequence
from utils.datasets.tumvie import tumvie_evs_iterator
from utils.datasets.vector import vector_evs_iterator

__all__ = [
    "DATASETS",
    "SequenceOptions",
    "eds_evs_iterator",
    "mvsec_evs_iterator",
    "open_sequence",
    "read_image_list",
    "tumvie_evs_iterator",
    "vector_evs_iterator",
    "video_iterator",
    "voxel_iterator",
]
