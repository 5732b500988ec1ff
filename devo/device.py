"""Which device and which number format a run uses, decided once and said out loud."""

from __future__ import annotations

import contextlib

import torch

from devo.errors import InputError


def resolve_device(name: str | torch.device = "auto") -> torch.device:
    """Turn `auto`, `cpu`, `cuda` or `cuda:i` into a device; `auto` takes CUDA where it exists.

    Raises:
        InputError: an unknown name, or CUDA was asked for and is not there (never a silent fallback).
    """
    if isinstance(name, torch.device):
        return name
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise InputError(f"device {name!r} is unknown; expected auto, cpu, cuda or cuda:0") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InputError(f"device {name!r} was asked for, but torch {torch.__version__} finds no CUDA device; "
                         "use --device cpu or auto")
    return device


def fast_dtype(device: torch.device, mixed_precision: bool) -> torch.dtype:
    """The number format of networks and feature buffers on `device`.

    With `mixed_precision`: float16 on CUDA, bfloat16 on CPUs that multiply it in hardware (AMX or AVX512-BF16),
    float32 on every other CPU, where emulated bfloat16 would only be slower. Without it: float32.
    """
    if not mixed_precision:
        return torch.float32
    if device.type == "cuda":
        return torch.float16
    has_hardware = torch.cpu._is_amx_tile_supported() or torch.cpu._is_avx512_bf16_supported()
    return torch.bfloat16 if has_hardware else torch.float32


def autocast(device: torch.device, dtype: torch.dtype) -> contextlib.AbstractContextManager[None]:
    """Autocast to `dtype` on `device`; a no-op for float32."""
    return torch.autocast(device.type, dtype=dtype, enabled=dtype != torch.float32)


def random_home(generator: torch.Generator | None) -> torch.device:
    """Where random numbers are drawn: with the generator, by default on the CPU, whatever device uses them.

    So the same seed chooses the same patches on every device.
    """
    return torch.device("cpu") if generator is None else generator.device
