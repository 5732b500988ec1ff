"""Local correlation of patch features with feature maps, and patch extraction (the torch twins of two CUDA kernels)."""

from devo.altcorr.block import CorrBlock
from devo.altcorr.correlation import corr
from devo.altcorr.lookup import corr_features
from devo.altcorr.patches import patchify

__all__ = ["CorrBlock", "corr", "corr_features", "patchify"]
