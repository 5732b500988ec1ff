"""Tracker settings: the published keys, their defaults, YAML presets and overrides."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from devo.errors import InputError

PIXELS = ("shifted", "drawn", "best")
"""Values of `SCORER_EVAL_PIXEL`, see `devo.selector.PatchSelector`."""
DEFAULTS: dict[str, Any] = {
    # keyframes held before the buffers grow (they double on demand)
    "BUFFER_SIZE": 4096,
    # accepted for old files, has no effect
    "GRADIENT_BIAS": False,
    # how patches are chosen: scorer (learned), gradient (of the event image), random
    "PATCH_SELECTOR": "scorer",
    # how patches are drawn from the score map: multi, topk, nms, 3xrandom, random
    "SCORER_EVAL_MODE": "multi",
    # draw the same number of patches in each quadrant of the image
    "SCORER_EVAL_USE_GRID": True,
    # `multi` only, the pixel of a 4x4 cell: shifted (drawn by the score of its upper left neighbour, as published),
    # drawn (by its own score), best (the highest score, which puts patches onto edges)
    "SCORER_EVAL_PIXEL": "shifted",
    # voxel normalisation: none, rescale (norm), standard (std)
    "NORM": "std",
    "PATCHES_PER_FRAME": 80,
    # edges whose source keyframe is older than this many keyframes are dropped
    "REMOVAL_WINDOW": 20,
    # newest keyframes whose poses bundle adjustment may move
    "OPTIMIZATION_WINDOW": 12,
    # a new keyframe is connected with this many keyframes before it
    "PATCH_LIFETIME": 12,
    # the keyframe test looks at the keyframe this many places before the newest
    "KEYFRAME_INDEX": 4,
    # mean flow around a keyframe below which it is removed [quarter-resolution px]
    "KEYFRAME_THRESH": 12.5,
    # pose prediction: DAMPED_LINEAR or anything else for a copy of the previous pose
    "MOTION_MODEL": "DAMPED_LINEAR",
    "MOTION_DAMPING": 0.5,
    # half precision for networks and features where the device is faster with it
    "MIXED_PRECISION": True,
    # frames whose features are kept; 0 = max(32, REMOVAL_WINDOW + PATCH_LIFETIME), 32 = as published
    "RING_SIZE": 0,
    # inverse depth of new patches before initialisation; 0 = random in (0,1) as published, which on scenes with little
    # relief often ends in the mirrored solution (scene and motion inverted)
    "INITIAL_INV_DEPTH": 0.5,
    # before initialisation, a frame whose median flow since the last keyframe is below this is passed over
    # [quarter-resolution px]; 8 frames above it are needed
    "PROBE_FLOW": 2.0,
    # updates of the first structure, once enough keyframes are there
    "INITIAL_UPDATES": 12,
    # solve for the first structure twice, the second time from its reversed relief, and keep what explains more; False
    # as published
    "MIRROR_TEST": True,
    # the same for flatter and deeper reliefs, up to that often from the best found so far; each round costs four times
    # INITIAL_UPDATES updates of 8 keyframes
    "START_ROUNDS": 0,
    # poses of frames that were passed over before initialisation because the camera had hardly moved: interpolate (in
    # time, between the keyframes around them) or hold (that of the keyframe before, as published)
    "STILL_FRAMES": "interpolate",
    # keep the principal point when columns are cropped, as the published 346-px results did
    "LEGACY_PRINCIPAL_POINT": False,
    # accepted for old frame-network files, has no effect
    "CENTROID_SEL_STRAT": "RANDOM",
}

_AT_LEAST = {
    "BUFFER_SIZE": 9, "PATCHES_PER_FRAME": 1, "REMOVAL_WINDOW": 1, "OPTIMIZATION_WINDOW": 1, "PATCH_LIFETIME": 1,
    "KEYFRAME_INDEX": 2, "KEYFRAME_THRESH": 0.0, "MOTION_DAMPING": 0.0, "RING_SIZE": 0,
    "INITIAL_INV_DEPTH": 0.0, "INITIAL_UPDATES": 1, "START_ROUNDS": 0, "PROBE_FLOW": 0.0,
}
_CHOICES = {"SCORER_EVAL_PIXEL": PIXELS, "STILL_FRAMES": ("interpolate", "hold")}


def _coerce(key: str, value: Any) -> Any:
    """Bring `value` to the type of the key's default; numbers given as text are read as YAML."""
    if key not in DEFAULTS:
        raise InputError(f"unknown setting {key!r}; known settings: {', '.join(sorted(DEFAULTS))}")
    default = DEFAULTS[key]
    if isinstance(value, str) and not isinstance(default, str):
        value = yaml.safe_load(value)
    if isinstance(default, bool):
        usable = isinstance(value, bool)
    elif isinstance(default, int):
        usable = isinstance(value, int) and not isinstance(value, bool)
    elif isinstance(default, float):
        usable = isinstance(value, (int, float)) and not isinstance(value, bool) and value == value
        value = float(value) if usable else value
    else:
        usable = isinstance(value, str)
    if not usable:
        raise InputError(f"setting {key} is {value!r}; expected {type(default).__name__}, for example {default!r}")
    if key in _CHOICES and value not in _CHOICES[key]:
        raise InputError(f"setting {key} is {value!r}; expected one of {', '.join(_CHOICES[key])}")
    if key in _AT_LEAST and value < _AT_LEAST[key]:
        raise InputError(f"setting {key} is {value!r}; expected at least {_AT_LEAST[key]}")
    return value


class Config:
    """The tracker's settings as attributes (`cfg.PATCHES_PER_FRAME`); unknown keys and wrong types are errors.

    Drivers work on `clone()`, so a run never changes the object it was given.
    """

    def __init__(self, values: Mapping[str, Any] | None = None) -> None:
        self.__dict__.update(copy.deepcopy(DEFAULTS))
        self.merge(values or {})

    def __setattr__(self, key: str, value: Any) -> None:
        self.__dict__[key] = _coerce(key, value)

    def __getattr__(self, key: str) -> Any:  # only reached for keys that do not exist
        raise AttributeError(f"unknown setting {key!r}; known settings: {', '.join(sorted(DEFAULTS))}")

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        self.__dict__.update(state)

    def __iter__(self) -> Iterator[str]:
        return iter(DEFAULTS)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Config) and self.as_dict() == other.as_dict()

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"Config({self.as_dict()!r})"

    def as_dict(self) -> dict[str, Any]:
        """All settings as a plain dictionary, in the order of `DEFAULTS`."""
        return {key: self.__dict__[key] for key in DEFAULTS}

    def clone(self) -> Config:
        """An independent copy."""
        return Config(self.as_dict())

    def merge(self, values: Mapping[str, Any]) -> Config:
        """Override settings from a mapping; returns self.

        Raises:
            InputError: an unknown key, or a value of the wrong type or range.
        """
        for key, value in values.items():
            setattr(self, key, value)
        return self

    def merge_from_file(self, path: str | os.PathLike[str]) -> Config:
        """Override settings from a YAML file; returns self.

        Raises:
            InputError: the file is missing, is not a YAML mapping, or has unknown keys or bad values.
        """
        file = Path(path)
        try:
            values = yaml.safe_load(file.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"cannot read the configuration {file}: {error}") from error
        except yaml.YAMLError as error:
            detail = " ".join(str(error).split())
            raise InputError(f"{file} is no valid YAML: {detail}") from error
        if not isinstance(values, dict):
            raise InputError(f"{file} holds {type(values).__name__}; expected a mapping such as 'KEYFRAME_THRESH: 15'")
        try:
            return self.merge(values)
        except InputError as error:
            raise InputError(f"{file}: {error}") from error

    def merge_from_list(self, items: Sequence[Any]) -> Config:
        """Override settings from `[key, value, key, value, ...]`; returns self.

        Raises:
            InputError: an odd number of items, an unknown key or a bad value.
        """
        if len(items) % 2:
            raise InputError(f"{len(items)} items in a list of settings; expected KEY VALUE pairs")
        return self.merge(dict(zip(items[::2], items[1::2], strict=True)))

    def ring_size(self) -> int:
        """Frames whose features are kept: edges reach back at most REMOVAL_WINDOW + PATCH_LIFETIME frames."""
        return self.RING_SIZE or max(32, self.REMOVAL_WINDOW + self.PATCH_LIFETIME)


cfg = Config()
"""The default settings; drivers copy it, so changing it in a notebook affects only later runs."""
