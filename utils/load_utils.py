"""Iterators and loaders under the module name that users of DEVO know; the code lives in `utils.datasets`."""

from __future__ import annotations

from utils.datasets.ecd import ecd_evs_iterator
from utils.datasets.eds import eds_evs_iterator
from utils.datasets.files import read_image_list
from utils.datasets.folders import video_iterator, voxel_iterator
from utils.datasets.fpv import fpv_evs_iterator
from utils.datasets.ground_truth import load_ecd_gt, load_eds_traj, load_gt_us, load_mvsec_traj, load_tumvie_traj
from utils.datasets.hku import hku_evs_iterator
from utils.datasets.mvsec import mvsec_evs_iterator
from utils.datasets.registry import DATASETS, SequenceOptions, open_sequence
from utils.datasets.rpg import rpg_evs_iterator
from utils.datasets.tumvie import tumvie_evs_iterator
from utils.datasets.vector import vector_evs_iterator

__all__ = [
    "DATASETS",
    "SequenceOptions",
    "ecd_evs_iterator",
    "eds_evs_iterator",
    "fpv_evs_iterator",
    "hku_evs_iterator",
    "load_ecd_gt",
    "load_eds_traj",
    "load_gt_us",
    "load_mvsec_traj",
    "load_tumvie_traj",
    "mvsec_evs_iterator",
    "open_sequence",
    "read_image_list",
    "rpg_evs_iterator",
    "tumvie_evs_iterator",
    "vector_evs_iterator",
    "video_iterator",
    "voxel_iterator",
]
