"""Weight files: safe reading of all published layouts, built-in and random weights, atomic writing."""

from __future__ import annotations

import contextlib
import os
import pickle
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from devo.enet import eVONet
from devo.errors import CheckpointError, OutputError
from devo.net import VONet
from devo.patchifier import SELECTORS
from devo.safe_pickle import READ_ERRORS, read_inert
from devo.update import correlation_size

WEIGHTS_FOLDER = Path(__file__).parent / "weights"
PREFERRED_WEIGHTS = "devo-tiny"  # what runs on a laptop
RANDOM_PREFIX = "random:"
RANDOM_USAGE = "random:SEED[:dim_inet,dim_fnet,dim][:rgb], for example random:0 or random:0:128,64,16"
SCORER_PREFIX = "patchify.scorer."
MAX_NAMED = 4


def builtin_weights() -> dict[str, Path]:
    """Networks that ship with the package: name -> file, sorted by name."""
    return {path.stem: path for path in sorted(WEIGHTS_FOLDER.glob("*.pth"))}


def default_weights() -> str | None:
    """Name of the built-in event network used when none is asked for, None if the package ships without."""
    names = [name for name in builtin_weights() if "rgb" not in name]
    return PREFERRED_WEIGHTS if PREFERRED_WEIGHTS in names else next(iter(names), None)


def load_network(
    path_or_name: str | os.PathLike[str],
    patch_selector: str | None = None,
    device: str | torch.device = "cpu",
) -> nn.Module:
    """Build the network a weights file holds, in evaluation mode; the global random state is left alone.

    Args:
        path_or_name: a file (training checkpoint or bare weights), a name out of `builtin_weights`, or
            `random:SEED[:dim_inet,dim_fnet,dim][:rgb]` for an untrained network (with a warning).
        patch_selector: `scorer`, `gradient` or `random`; by default `scorer` if the file holds one, else
            `gradient` for events and `random` for frames. Weights of a scorer that is not asked for are dropped.
        device: where the network goes.

    Returns:
        `eVONet` for weights with five input channels, `VONet` for three; all sizes are taken from the weights.

    Raises:
        CheckpointError: no such file, damaged, unsafe, or weights that are no such network.
    """
    text = os.fspath(path_or_name)
    if patch_selector is not None and patch_selector.lower() not in SELECTORS:
        raise CheckpointError(f"unknown patch selector {patch_selector!r}; expected one of {', '.join(SELECTORS)}")
    if text.startswith(RANDOM_PREFIX):
        return _random_network(text, patch_selector).eval().to(device)
    path = _resolve(text)
    return network_from_state(read_state_dict(path), patch_selector, str(path)).eval().to(device)


def _resolve(text: str) -> Path:
    path = Path(text)
    known = builtin_weights()
    if text in known and not path.is_file():
        return known[text]
    if path.is_dir():
        raise CheckpointError(f"{path} is a folder; expected a weights file (.pth)")
    if not path.is_file():
        names = ", ".join(known) or "none"
        raise CheckpointError(f"no weights file {path}; give an existing file, a built-in name ({names}) or random:0")
    if path.stat().st_size == 0:
        raise CheckpointError(f"{path} is empty; expected a weights file, copy or download it again")
    return path


def read_checkpoint(path: str | os.PathLike[str]) -> Any:
    """Read a weights file without running code from it: tensors on the CPU, plain containers, inert stand-ins.

    Raises:
        CheckpointError: missing, damaged or no weights file.
    """
    file = _resolve(os.fspath(path))
    try:
        try:
            return torch.load(file, map_location="cpu", weights_only=True)
        except pickle.UnpicklingError:
            return read_inert(file)
    except READ_ERRORS as error:
        raise CheckpointError(
            f"{file} cannot be read as weights ({_reason(error)}); copy or download it again"
        ) from error


def _reason(error: BaseException) -> str:
    """First sentence of an error, with its type where it says little by itself."""
    sentence = str(error).strip().split("\n")[0].split(". ")[0]
    return f"{type(error).__name__}: {sentence[:120]}".rstrip(": .")


def read_state_dict(path: str | os.PathLike[str]) -> dict[str, Tensor]:
    """Read the network weights of a file: a training checkpoint (`model_state_dict`) or a flat collection of tensors.

    In flat files `update.lmbda` is dropped and every `module.` removed from the names.

    Returns:
        Name -> float32 CPU tensor, in the order of the file.

    Raises:
        CheckpointError: unreadable file, or something else than finite tensors among the weights.
    """
    payload = read_checkpoint(path)
    if not isinstance(payload, Mapping):
        raise CheckpointError(f"{path} holds a {type(payload).__name__}; expected a training checkpoint or weights")
    wrapped = "model_state_dict" in payload
    weights = payload["model_state_dict"] if wrapped else payload
    if not isinstance(weights, Mapping) or not weights:
        raise CheckpointError(f"{path} holds no weights; expected tensors by name, or model_state_dict with them")
    state = {}
    for name, value in weights.items():
        if not isinstance(name, str) or not isinstance(value, Tensor):
            found = f"{name!r} is {'no tensor' if isinstance(name, str) else 'no name'}"
            raise CheckpointError(f"{path}: {found}; expected tensors by name only, so the file is not trusted")
        if "update.lmbda" not in name:
            state[name.replace("module.", "")] = _plain(value, name, path)
    _require_finite(state, str(path))
    return state


def _plain(value: Tensor, name: str, path: str | os.PathLike[str]) -> Tensor:
    if value.layout != torch.strided or not value.is_floating_point():
        raise CheckpointError(f"{path}: {name} is {value.dtype}, {value.layout}; expected dense floating-point weights")
    return value.detach().to(torch.float32).clone(memory_format=torch.contiguous_format)


def _require_finite(state: Mapping[str, Tensor], where: str) -> None:
    bad = [name for name, value in state.items() if not bool(torch.isfinite(value).all())]
    if bad:
        raise CheckpointError(f"{where}: NaN or infinite weights in {_some(bad)}; take weights of an earlier step")


def _some(names: list[str]) -> str:
    more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    return ", ".join(names[:MAX_NAMED]) + more


def network_from_state(
    state: Mapping[str, Tensor], patch_selector: str | None = None, where: str = "weights"
) -> nn.Module:
    """Build the network that fits `state` and load it strictly; see `load_network` for the selector.

    Args:
        state: name -> float32 tensor; they become the parameters.
        patch_selector: as in `load_network`.
        where: name of the source for messages.

    Raises:
        CheckpointError: sizes that contradict each other; missing, unknown or mis-shaped weights (named).
    """
    channels, dims, patch_size = _dimensions(state, where)
    has_scorer = any(name.startswith(SCORER_PREFIX) for name in state)
    if patch_selector is None:
        patch_selector = "scorer" if has_scorer else "gradient" if channels == eVONet.bins else "random"
    patch_selector = patch_selector.lower()
    if patch_selector == "scorer" and not has_scorer:
        raise CheckpointError(f"{where} holds no scorer; use PATCH_SELECTOR gradient or random")
    if patch_selector != "scorer":
        state = {name: value for name, value in state.items() if not name.startswith(SCORER_PREFIX)}
    with torch.random.fork_rng(devices=[]):
        network = _build(channels, dims, patch_selector, patch_size)
    _require_match(state, network, where)
    network.load_state_dict(state, strict=True, assign=True)
    return network


def _build(channels: int, dims: tuple[int, int, int], patch_selector: str, patch_size: int = 3) -> nn.Module:
    sizes = dict(zip(("dim_inet", "dim_fnet", "dim"), dims))
    kind = eVONet if channels == eVONet.bins else VONet
    return kind(P=patch_size, patch_selector=patch_selector, **sizes)  # type: ignore[arg-type]


def _dimensions(state: Mapping[str, Tensor], where: str) -> tuple[int, tuple[int, int, int], int]:
    """Input channels, (dim_inet, dim_fnet, dim) and patch side that the shapes of the weights tell."""
    wanted = {"patchify.fnet.conv1.weight": 4, "patchify.fnet.conv2.weight": 4, "patchify.inet.conv2.weight": 4}
    wanted["update.corr.0.weight"] = 2
    missing = [name for name, rank in wanted.items() if name not in state or state[name].dim() != rank]
    if missing:
        raise CheckpointError(f"{where} is no odometry network: {_some(missing)} missing or of wrong rank")
    dim, channels = state["patchify.fnet.conv1.weight"].shape[:2]
    dims = state["patchify.inet.conv2.weight"].shape[0], state["patchify.fnet.conv2.weight"].shape[0], dim
    if channels not in (eVONet.bins, VONet.bins):
        expected = f"{eVONet.bins} (event bins) or {VONet.bins} (colours)"
        raise CheckpointError(f"{where} takes {channels} input channels; expected {expected}")
    features = state["update.corr.0.weight"].shape[1]
    patch_size = round((features / correlation_size(1)) ** 0.5)
    if correlation_size(patch_size) != features or patch_size % 2 == 0:
        expected = f"{correlation_size(1)} times the square of an odd patch side"
        raise CheckpointError(f"{where}: update.corr.0 takes {features} correlation features; expected {expected}")
    return channels, dims, patch_size


def _require_match(state: Mapping[str, Tensor], network: nn.Module, where: str) -> None:
    expected = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    problems = {
        "missing": [name for name in expected if name not in state],
        "unknown": [name for name in state if name not in expected],
        "of wrong shape": [
            f"{name} {tuple(state[name].shape)} instead of {shape}"
            for name, shape in expected.items()
            if name in state and tuple(state[name].shape) != shape
        ],
    }
    found = "; ".join(f"{kind}: {_some(names)}" for kind, names in problems.items() if names)
    if found:
        raise CheckpointError(f"{where} does not fit {type(network).__name__}: {found}")


def _random_network(text: str, patch_selector: str | None) -> nn.Module:
    parts = text[len(RANDOM_PREFIX) :].split(":")
    rgb = parts[-1] == "rgb"
    parts = parts[:-1] if rgb else parts
    try:
        seed = int(parts[0])
        numbers = tuple(int(number) for number in parts[1].split(",")) if len(parts) > 1 else (384, 128, 32)
        dim_inet, dim_fnet, dim = numbers
        valid = len(parts) <= 2 and min(numbers) > 0 and seed >= 0
    except (ValueError, IndexError):
        valid = False
    if not valid:
        raise CheckpointError(f"cannot read {text!r}; expected {RANDOM_USAGE}")
    if patch_selector is None:
        patch_selector = "random" if rgb else "scorer"
    warnings.warn(f"{text}: untrained network, its trajectory means nothing", UserWarning, stacklevel=3)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return _build(VONet.bins if rgb else eVONet.bins, (dim_inet, dim_fnet, dim), patch_selector)


def save_checkpoint(path: str | os.PathLike[str], network: nn.Module, **extras: Any) -> Path:
    """Write `model_state_dict` and `extras` under a temporary name, check that it reads back safely, rename.

    Args:
        path: file to write.
        network: the network; its weights are stored on the CPU.
        extras: further entries such as `steps`, `optimizer_state_dict`; tensors, numbers, strings and containers only.

    Returns:
        The path.

    Raises:
        CheckpointError: NaN or infinite weights.
        OutputError: the file cannot be written, or `extras` holds objects that a safe reader refuses.
    """
    target = Path(path)
    state = {name: value.detach().cpu().clone() for name, value in network.state_dict().items()}
    _require_finite(state, str(target))
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        torch.save({"model_state_dict": state, **extras}, temporary)
        torch.load(temporary, map_location="cpu", weights_only=True)
        temporary.replace(target)
    except (pickle.PickleError, AttributeError, TypeError) as error:
        raise OutputError(f"{target} not written: the extra entries hold more than tensors and plain values") from error
    except (OSError, RuntimeError) as error:
        raise OutputError(f"{target} not written ({_reason(error)}); check the disk and the folder") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
    return target


def load_encoders(network: nn.Module, arrays: Mapping[str, np.ndarray]) -> None:
    """Load the two encoders (`patchify.fnet.*`, `patchify.inet.*`) and leave the rest of the network as it is.

    Args:
        network: `VONet` or `eVONet`.
        arrays: name -> array, exactly the weights of the two encoders.

    Raises:
        CheckpointError: missing, unknown or mis-shaped arrays (named), or values that are not finite.
    """
    state = {name: torch.from_numpy(np.array(value, dtype=np.float32)) for name, value in arrays.items()}
    _require_finite(state, "encoder arrays")
    encoders = nn.ModuleDict({"fnet": network.patchify.fnet, "inet": network.patchify.inet})  # type: ignore[union-attr,dict-item]
    wrapper = nn.ModuleDict({"patchify": encoders})
    _require_match(state, wrapper, "encoder arrays")
    wrapper.load_state_dict(state, strict=True)
