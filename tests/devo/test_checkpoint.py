"""Weight files: published layouts, hostile and damaged files, names, random networks, atomic writing."""

from __future__ import annotations

import collections
import pickle
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import devo.checkpoint as checkpoint
from devo.checkpoint import (
    builtin_weights,
    default_weights,
    load_encoders,
    load_network,
    read_checkpoint,
    read_state_dict,
    save_checkpoint,
)
from devo.enet import eVONet
from devo.errors import CheckpointError, OutputError
from devo.net import VONet

SMALL = "16,8,4"


def quiet(name: str, **options: str) -> nn.Module:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return load_network(name, **options)


@pytest.fixture(scope="module")
def network() -> nn.Module:
    return quiet(f"random:3:{SMALL}")


def same_weights(first: nn.Module, second: nn.Module) -> bool:
    one, two = first.state_dict(), second.state_dict()
    return list(one) == list(two) and all(torch.equal(one[name], two[name]) for name in one)


class Payload:
    """Pickles as a call that creates a file."""

    def __init__(self, witness: Path) -> None:
        self.witness = witness

    def __reduce__(self) -> tuple:
        return open, (str(self.witness), "w")


# --- layouts ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("modern", [True, False], ids=["zip", "legacy"])
@pytest.mark.parametrize("layout", ["wrapped", "flat", "prefixed", "half"])
def test_published_layouts(tmp_path: Path, network: nn.Module, layout: str, modern: bool) -> None:
    state = network.state_dict()
    content = {
        "wrapped": {"steps": 10, "model_state_dict": state, "optimizer_state_dict": {}, "scheduler_state_dict": {}},
        "flat": state,
        "prefixed": {"module.update.lmbda": torch.ones(1)} | {f"module.{name}": state[name] for name in state},
        "half": {name: value.bfloat16() for name, value in state.items()},
    }[layout]
    file = tmp_path / "weights.pth"
    torch.save(content, file, _use_new_zipfile_serialization=modern)
    loaded = load_network(file)
    assert isinstance(loaded, eVONet) and not loaded.training
    assert (loaded.dim_inet, loaded.dim_fnet, loaded.dim, loaded.P) == (16, 8, 4, 3)
    assert all(value.requires_grad and value.dtype == torch.float32 for value in loaded.parameters())
    if layout == "half":
        assert torch.equal(loaded.update.norm.weight, state["update.norm.weight"])
    else:
        assert same_weights(loaded, network)


def test_published_training_checkpoint_with_scheduler_objects(tmp_path: Path, network: nn.Module) -> None:
    """Old schedulers store a bound method, so the file names classes that the safe reader does not know."""
    optimizer = torch.optim.AdamW(network.parameters())
    scheduler = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-3, 10)
    state = {**scheduler.state_dict(), "anneal_func": scheduler.get_last_lr, "max_lr": np.float64(1e-3)}
    file = tmp_path / "weights.pth"
    content = {"model_state_dict": network.state_dict(), "scheduler_state_dict": state, "steps": 7}
    torch.save({**content, "optimizer_state_dict": optimizer.state_dict()}, file)
    with pytest.raises(pickle.UnpicklingError):
        torch.load(file, weights_only=True)
    assert same_weights(load_network(file), network)
    payload = read_checkpoint(file)
    assert payload["steps"] == 7 and payload["optimizer_state_dict"]["param_groups"][0]["lr"] == pytest.approx(4e-5)


@pytest.mark.parametrize(
    "kind, channels, selector",
    [(eVONet, 5, "scorer"), (eVONet, 5, "gradient"), (VONet, 3, "random"), (VONet, 3, "gradient")],
)
@pytest.mark.parametrize("patch_size", [1, 3, 5])
def test_kind_and_sizes_are_inferred(tmp_path: Path, kind, channels: int, selector: str, patch_size: int) -> None:
    original = kind(P=patch_size, dim_inet=24, dim_fnet=8, dim=4, patch_selector=selector)
    loaded = load_network(save_checkpoint(tmp_path / "weights.pth", original), patch_selector=selector.upper())
    assert type(loaded) is kind and loaded.bins == channels and patch_size == loaded.P
    assert loaded.patch_selector == selector
    assert (loaded.dim_inet, loaded.dim_fnet, loaded.dim) == (24, 8, 4)
    assert same_weights(loaded, original)


def test_selector_rules(tmp_path: Path, network: nn.Module) -> None:
    with_scorer = save_checkpoint(tmp_path / "with.pth", network)
    without = save_checkpoint(tmp_path / "without.pth", quiet(f"random:0:{SMALL}", patch_selector="random"))
    frames = save_checkpoint(tmp_path / "frames.pth", quiet(f"random:0:{SMALL}:rgb"))
    chosen = [load_network(file).patch_selector for file in (with_scorer, without, frames)]
    assert chosen == ["scorer", "gradient", "random"]
    dropped = load_network(with_scorer, patch_selector="gradient")
    assert not any("scorer" in name for name in dropped.state_dict())
    for file in (without, frames):
        with pytest.raises(CheckpointError, match="holds no scorer; use PATCH_SELECTOR gradient or random"):
            load_network(file, patch_selector="scorer")
    with pytest.raises(CheckpointError, match="'corner'.*scorer, gradient, random"):
        load_network(with_scorer, patch_selector="corner")


def test_loading_leaves_the_random_state_alone(tmp_path: Path, network: nn.Module) -> None:
    file = save_checkpoint(tmp_path / "weights.pth", network)
    before = torch.get_rng_state()
    load_network(file)
    quiet(f"random:5:{SMALL}")
    assert torch.equal(torch.get_rng_state(), before)


# --- hostile files ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("modern", [True, False], ids=["zip", "legacy"])
def test_code_in_a_checkpoint_does_not_run(tmp_path: Path, network: nn.Module, modern: bool) -> None:
    witness, file = tmp_path / "witness", tmp_path / "weights.pth"
    content = {"payload": Payload(witness), "model_state_dict": network.state_dict(), "list": [Payload(witness)]}
    torch.save(content, file, _use_new_zipfile_serialization=modern)
    assert same_weights(load_network(file), network)
    assert not witness.exists()
    torch.load(file, weights_only=False)
    assert witness.exists(), "the payload does nothing even where it may, so the test shows nothing"


@pytest.mark.parametrize("modern", [True, False], ids=["zip", "legacy"])
@pytest.mark.parametrize("wrapped", [True, False])
def test_code_among_the_weights_is_refused(tmp_path: Path, network: nn.Module, modern: bool, wrapped: bool) -> None:
    witness, file = tmp_path / "witness", tmp_path / "weights.pth"
    state = {**network.state_dict(), "update.norm.bias": Payload(witness)}
    torch.save({"model_state_dict": state} if wrapped else state, file, _use_new_zipfile_serialization=modern)
    with pytest.raises(CheckpointError, match=r"'update\.norm\.bias' is no tensor"):
        load_network(file)
    assert not witness.exists()


@pytest.mark.parametrize("what", ["root", "key", "state"])
def test_code_in_other_places_does_not_run(tmp_path: Path, network: nn.Module, what: str) -> None:
    witness, file = tmp_path / "witness", tmp_path / "weights.pth"
    payload = Payload(witness)
    state = collections.OrderedDict(network.state_dict())
    state.note = payload  # type: ignore[attr-defined]  # travels in the state of the dictionary object
    torch.save({"root": payload, "key": {**network.state_dict(), payload: torch.ones(1)}, "state": state}[what], file)
    if what == "state":
        assert same_weights(load_network(file), network)
    else:
        with pytest.raises(CheckpointError):
            load_network(file)
    assert not witness.exists()


def test_torchscript_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "program.pth"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.script(nn.Linear(2, 2)).save(str(file))
        with pytest.raises(CheckpointError):
            load_network(file)


# --- damaged and foreign files ------------------------------------------------------------------------------


def expect_one_line(file: Path | str, pattern: str) -> None:
    with pytest.raises(CheckpointError, match=pattern) as caught:
        load_network(file)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 600
    assert caught.value.exit_code == 2


@pytest.mark.parametrize("modern", [True, False], ids=["zip", "legacy"])
@pytest.mark.parametrize("kept", [1, 3, 100, 0.3, 0.9, -1])
def test_truncated_file(tmp_path: Path, network: nn.Module, modern: bool, kept: float) -> None:
    file = tmp_path / "weights.pth"
    torch.save({"model_state_dict": network.state_dict()}, file, _use_new_zipfile_serialization=modern)
    content = file.read_bytes()
    file.write_bytes(content[: int(kept * len(content)) if 0 < kept < 1 else int(kept)])
    expect_one_line(file, "cannot be read as weights")


@pytest.mark.parametrize(
    "content",
    [b"hello world, these are no weights\n" * 9, bytes(range(256)) * 40, b"PK\x03\x04" + bytes(90), b"\x80\x02]q\x00."],
)
def test_garbage(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "weights.pth"
    file.write_bytes(content)
    expect_one_line(file, re.escape(str(file)) + " cannot be read as weights")


def test_random_garbage(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    file = tmp_path / "weights.pth"
    for _ in range(60):
        file.write_bytes(b"\x80\x02" + generator.integers(0, 128, 200, dtype=np.uint8).tobytes() + b".")
        expect_one_line(file, "cannot be read as weights|holds")


def test_missing_empty_and_folder(tmp_path: Path) -> None:
    expect_one_line(tmp_path / "nothing.pth", r"no weights file .*nothing\.pth.*random:0")
    expect_one_line("no_such_name", "no weights file no_such_name")
    expect_one_line(tmp_path, "is a folder")
    (tmp_path / "empty.pth").touch()
    expect_one_line(tmp_path / "empty.pth", "is empty")


@pytest.mark.parametrize(
    "change, pattern",
    [
        (lambda s: s.pop("update.c1.0.bias"), r"does not fit eVONet: missing: update\.c1\.0\.bias$"),
        (lambda s: s.update(extra=torch.ones(2)), "unknown: extra$"),
        (lambda s: s.update({"update.norm.bias": torch.ones(7)}), r"update\.norm\.bias \(7,\) instead of \(16,\)"),
        (lambda s: [s.pop(name) for name in list(s) if "gru" in name], "missing: .* and 12 more"),
        (lambda s: s.pop("patchify.fnet.conv1.weight"), "no odometry network"),
        (lambda s: s.update({"patchify.fnet.conv1.weight": torch.ones(4, 1, 7, 7)}), "1 input channels; expected 5"),
        (lambda s: s.update({"update.corr.0.weight": torch.ones(16, 883)}), "883 correlation features"),
        (lambda s: s.update({"update.corr.0.weight": torch.ones(16, 98 * 4)}), "392 correlation features"),
        (lambda s: s.update({"patchify.inet.conv2.weight": torch.ones(20, 8, 1, 1)}), "of wrong shape: .*conv2.bias"),
        (
            lambda s: s.update({"update.norm.bias": torch.full((16,), float("nan"))}),
            "NaN or infinite weights in update.norm",
        ),
        (lambda s: s.update({"update.norm.bias": torch.full((16,), float("inf"))}), "NaN or infinite"),
        (lambda s: s.update({"update.norm.bias": torch.ones(16, dtype=torch.int64)}), "int64"),
        (lambda s: s.update({"update.norm.bias": 3.0}), "no tensor"),
        (lambda s: s.clear(), "holds no weights"),
    ],
)
def test_unfit_weights_are_named(tmp_path: Path, network: nn.Module, change, pattern: str) -> None:
    state = dict(network.state_dict())
    change(state)
    torch.save({"model_state_dict": state}, tmp_path / "weights.pth")
    expect_one_line(tmp_path / "weights.pth", pattern)


@pytest.mark.parametrize("content", [[1, 2], torch.ones(3), {"model_state_dict": None}, "text", {1: torch.ones(2)}])
def test_other_content(tmp_path: Path, content: object) -> None:
    torch.save(content, tmp_path / "weights.pth")
    expect_one_line(tmp_path / "weights.pth", "expected")


# --- names --------------------------------------------------------------------------------------------------


def test_random_networks_repeat_by_seed() -> None:
    with pytest.warns(UserWarning, match="untrained"):
        first = load_network(f"random:1:{SMALL}")
    assert same_weights(first, quiet(f"random:1:{SMALL}"))
    assert not same_weights(first, quiet(f"random:2:{SMALL}"))
    assert type(quiet(f"random:1:{SMALL}:rgb")) is VONet
    assert quiet("random:1:rgb").dim_inet == 384


@pytest.mark.parametrize("name", ["", "x", "-1", "0:1,2", "0:0,8,4", "0:1,2,3:bgr", "rgb"])
def test_bad_random_names(name: str) -> None:
    expect_one_line(f"random:{name}", "expected random:SEED")


def test_builtin_names(tmp_path: Path, network: nn.Module, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "WEIGHTS_FOLDER", tmp_path)
    assert builtin_weights() == {} and default_weights() is None
    save_checkpoint(tmp_path / "a-rgb.pth", quiet(f"random:0:{SMALL}:rgb"))
    save_checkpoint(tmp_path / "tiny.pth", network)
    assert builtin_weights() == {"a-rgb": tmp_path / "a-rgb.pth", "tiny": tmp_path / "tiny.pth"}
    assert default_weights() == "tiny"
    assert same_weights(load_network("tiny"), network)
    expect_one_line("huge", r"built-in name \(a-rgb, tiny\)")


def test_shipped_weights_load() -> None:
    """Whatever ships in devo/weights must load (the folder may be empty)."""
    for name in builtin_weights():
        assert load_network(name).P == 3


# --- writing ------------------------------------------------------------------------------------------------


def test_save_reads_back_with_extras(tmp_path: Path, network: nn.Module) -> None:
    optimizer = torch.optim.AdamW(network.parameters())
    extras = {"steps": 4, "optimizer_state_dict": optimizer.state_dict()}
    file = save_checkpoint(tmp_path / "deep" / "weights.pth", network, **extras)
    content = torch.load(file, weights_only=True)
    assert list(content) == ["model_state_dict", "steps", "optimizer_state_dict"] and content["steps"] == 4
    assert list(read_state_dict(file)) == list(network.state_dict())
    assert [path.name for path in file.parent.iterdir()] == ["weights.pth"], "temporary file left behind"


def test_failed_save_keeps_the_old_file(tmp_path: Path, network: nn.Module) -> None:
    file = save_checkpoint(tmp_path / "weights.pth", network)
    before = file.read_bytes()
    for extra in (Payload(tmp_path / "witness"), lambda: None):
        with pytest.raises(OutputError, match="more than tensors"):
            save_checkpoint(file, network, extra=extra)
    broken = quiet(f"random:0:{SMALL}")
    with torch.no_grad():
        broken.update.norm.bias[3] = float("nan")
    with pytest.raises(CheckpointError, match=r"update\.norm\.bias"):
        save_checkpoint(file, broken)
    with pytest.raises(OutputError, match="not written"):
        save_checkpoint(file / "below" / "weights.pth", network)
    assert file.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["weights.pth"]


def test_target_only_ever_appears_complete(tmp_path: Path, network: nn.Module, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything is written elsewhere first; a full disk leaves the old file and no debris."""
    file = save_checkpoint(tmp_path / "weights.pth", network)
    before, real_save, written = file.read_bytes(), torch.save, []

    def spying_save(content: object, target: Path, **options: object) -> None:
        written.append(Path(target))
        real_save(content, target, **options)

    def full_disk(content: object, target: Path, **options: object) -> None:
        Path(target).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", spying_save)
    save_checkpoint(file, network)
    assert written and file not in written and all(path.parent == tmp_path for path in written)
    monkeypatch.setattr(torch, "save", full_disk)
    with pytest.raises(OutputError, match="No space left"):
        save_checkpoint(file, network)
    assert file.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["weights.pth"]


def test_encoders_must_be_finite_and_known() -> None:
    network = quiet(f"random:0:{SMALL}:rgb")
    arrays = {
        name: value.numpy() * 2 for name, value in network.state_dict().items()
        if name.startswith(("patchify.fnet", "patchify.inet"))
    }  # fmt: skip
    expected = {name: value.copy() for name, value in arrays.items()}
    load_encoders(network, arrays)
    assert all(np.array_equal(network.state_dict()[name].numpy(), value) for name, value in expected.items())
    with pytest.raises(CheckpointError, match="unknown: more"):
        load_encoders(network, {**arrays, "more": np.ones(2)})
    with pytest.raises(CheckpointError, match="NaN or infinite"):
        load_encoders(network, {**arrays, "patchify.fnet.conv1.bias": np.full(4, np.nan)})
