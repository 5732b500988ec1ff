"""From raw recordings of published data sets to the folders that their readers open; nothing here needs ROS.

Importing this package fills `PREPROCESSORS`: each module reads the raw files of one data set and enters itself.
"""

from __future__ import annotations

from utils.preprocessing import ecd, eds, fpv, hku, mvsec, rpg, tumvie, vector  # noqa: F401 - importing them fills the table
from utils.preprocessing.registry import PREPROCESSORS, PreprocessOptions, Preprocessor, register
from utils.preprocessing.runner import find_sequences, preprocess

__all__ = ["PREPROCESSORS", "PreprocessOptions", "Preprocessor", "find_sequences", "preprocess", "register"]
