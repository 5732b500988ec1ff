"""Settings: defaults, presets, overrides, and what is refused."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from devo.config import DEFAULTS, Config, cfg
from devo.errors import InputError

PRESETS = sorted((Path(__file__).resolve().parents[2] / "config").glob("*.yaml"))


@pytest.mark.parametrize("preset", PRESETS, ids=lambda path: path.stem)
def test_presets_load_and_keep_the_window_invariants(preset: Path) -> None:
    settings = Config().merge_from_file(preset)
    assert settings.REMOVAL_WINDOW >= settings.PATCH_LIFETIME
    assert settings.REMOVAL_WINDOW >= settings.OPTIMIZATION_WINDOW
    assert settings.ring_size() >= settings.REMOVAL_WINDOW + settings.PATCH_LIFETIME


def test_published_defaults() -> None:
    assert (cfg.BUFFER_SIZE, cfg.PATCHES_PER_FRAME, cfg.REMOVAL_WINDOW, cfg.OPTIMIZATION_WINDOW) == (4096, 80, 20, 12)
    assert (cfg.PATCH_LIFETIME, cfg.KEYFRAME_INDEX, cfg.KEYFRAME_THRESH, cfg.MOTION_DAMPING) == (12, 4, 12.5, 0.5)
    assert (cfg.NORM, cfg.PATCH_SELECTOR, cfg.SCORER_EVAL_MODE, cfg.MIXED_PRECISION) == ("std", "scorer", "multi", True)


def test_clone_is_independent() -> None:
    copy = cfg.clone()
    copy.KEYFRAME_THRESH = 3
    assert DEFAULTS["KEYFRAME_THRESH"] == cfg.KEYFRAME_THRESH
    assert copy.KEYFRAME_THRESH == 3.0 and isinstance(copy.KEYFRAME_THRESH, float)
    assert copy != cfg and pickle.loads(pickle.dumps(copy)) == copy


def test_overrides_from_text() -> None:
    settings = Config().merge_from_list(["KEYFRAME_THRESH", "7.5", "MIXED_PRECISION", "false", "NORM", "none"])
    assert settings.KEYFRAME_THRESH == 7.5 and settings.MIXED_PRECISION is False and settings.NORM == "none"


@pytest.mark.parametrize(("key", "value"), [
    ("KEYFRAME_TRESH", 3.0), ("PATCHES_PER_FRAME", 2.5), ("PATCHES_PER_FRAME", 0), ("MIXED_PRECISION", 1),
    ("NORM", 3), ("KEYFRAME_THRESH", "abc"), ("KEYFRAME_THRESH", float("nan")), ("BUFFER_SIZE", True),
])
def test_unknown_keys_and_wrong_values_are_errors(key: str, value: object) -> None:
    with pytest.raises(InputError, match=key):
        Config({key: value})


def test_reading_an_unknown_key_names_it() -> None:
    with pytest.raises(AttributeError, match="KEYFRAME_TRESH"):
        _ = Config().KEYFRAME_TRESH


@pytest.mark.parametrize("content", ["- 1\n- 2\n", "KEYFRAME_TRESH: 3\n", "a: [1\n", ""])
def test_bad_files_are_named(tmp_path: Path, content: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(content)
    with pytest.raises(InputError, match="bad.yaml"):
        Config().merge_from_file(path)


def test_missing_file_and_odd_lists(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none.yaml"):
        Config().merge_from_file(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="pairs"):
        Config().merge_from_list(["NORM"])


def test_settings_with_choices() -> None:
    assert Config({"STILL_FRAMES": "hold"}).STILL_FRAMES == "hold"
    with pytest.raises(InputError, match="interpolate, hold"):
        Config({"STILL_FRAMES": "guess"})
