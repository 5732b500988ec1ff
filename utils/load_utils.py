"""Iterators and loaders under the module name that users of DEVO know; the code lives in `utils.datasets`."""

from __future__ import annotations

from utils.datasets.files import read_image_list
from utils.datasets.folders import video_iterator, voxel_iterator
from utils.datasets.registry import DATASETS, SequenceOptions, open_sequence

__all__ = ["DATASETS", "SequenceOptions", "open_sequence", "read_image_list", "video_iterator", "voxel_iterator"]
