"""Which implementation of a kernel runs: the CUDA extension or its pure-torch twin.

`DEVO_KERNELS` decides: `torch` always takes the twin, `cuda` insists on the extension, `auto` (default) takes
the extension for CUDA tensors where it is built and the twin everywhere else. Nothing is compiled here; an
extension is a module that loads an already built library (see `devo.cuda_library`) when it is first asked for.
"""

from __future__ import annotations

import functools
import importlib
import os
from types import ModuleType

import torch

from devo.errors import InputError

MODES = ("auto", "torch", "cuda")
EXTENSIONS = {"altcorr": "devo.altcorr.extension", "fastba": "devo.fastba.extension"}


def kernel_mode() -> str:
    """Read `DEVO_KERNELS` (`auto`, `torch` or `cuda`).

    Raises:
        InputError: the variable holds something else.
    """
    mode = os.environ.get("DEVO_KERNELS", "auto").strip().lower() or "auto"
    if mode not in MODES:
        raise InputError(f"DEVO_KERNELS={mode!r} is unknown; expected one of {', '.join(MODES)}")
    return mode


@functools.cache
def _extension(name: str) -> ModuleType | None:
    try:
        return importlib.import_module(EXTENSIONS[name])
    except ImportError:
        return None


def cuda_kernel(name: str, *tensors: torch.Tensor) -> ModuleType | None:
    """Return the CUDA extension that should handle `tensors`, or `None` for the torch twin.

    Args:
        name: `altcorr` or `fastba`.
        tensors: the operands; the extension is only considered when all of them live on a CUDA device.

    Raises:
        InputError: `DEVO_KERNELS=cuda`, but the extension is not built or an operand is not on a CUDA device.
    """
    mode = kernel_mode()
    if mode == "torch":
        return None
    on_cuda = all(tensor.is_cuda for tensor in tensors)
    extension = _extension(name) if on_cuda else None
    if mode == "cuda" and extension is None:
        missing = f"the extension {EXTENSIONS[name]} is not built"
        found = missing if on_cuda else "the tensors are not on a CUDA device"
        raise InputError(f"DEVO_KERNELS=cuda, but {found}; use DEVO_KERNELS=auto or torch for the torch twin")
    return extension


def active_kernels() -> dict[str, str]:
    """Describe for each kernel what runs now, for example `{"altcorr": "torch", "fastba": "torch"}`."""
    wanted = kernel_mode()
    usable = wanted != "torch" and torch.cuda.is_available()
    return {name: "cuda" if usable and _extension(name) else "torch" for name in EXTENSIONS}
