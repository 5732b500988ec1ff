"""Reading of pickled weight files without running any code they contain.

Old training checkpoints hold optimiser and scheduler objects next to the weights, which torch's `weights_only` reader
refuses. The reader here replaces every class and function outside of a short list by an inert stand-in, so that
the tensors can be taken out and nothing else comes to life.
"""

from __future__ import annotations

import collections
import pickle
import struct
import tarfile
import zipfile
from pathlib import Path
from types import ModuleType
from typing import IO, Any

import torch

from devo.errors import CheckpointError

# what a damaged or foreign file can make the unpickler raise
READ_ERRORS = (
    pickle.UnpicklingError,
    zipfile.BadZipFile,
    tarfile.TarError,
    struct.error,
    RuntimeError,
    EOFError,
    OSError,
    ValueError,
    TypeError,
    AttributeError,
    LookupError,
    ImportError,
    AssertionError,
    ArithmeticError,
    MemoryError,
)

_ALLOWED = {
    ("collections", "OrderedDict"): collections.OrderedDict,
    ("torch._utils", "_rebuild_tensor"): torch._utils._rebuild_tensor,
    ("torch._utils", "_rebuild_tensor_v2"): torch._utils._rebuild_tensor_v2,
    ("torch._utils", "_rebuild_parameter"): torch._utils._rebuild_parameter,
    ("torch", "Size"): torch.Size,
    ("torch", "device"): torch.device,
}


class Inert:
    """Stands in for anything a file asks for that is not plain data; takes every call and every state, does nothing."""

    def __new__(cls, *_: Any, **__: Any) -> Inert:  # noqa: D102
        return super().__new__(cls)

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __call__(self, *_: Any, **__: Any) -> Inert:  # noqa: D102
        return self

    def __setstate__(self, _: Any) -> None:
        pass

    def __setitem__(self, _: Any, __: Any) -> None:
        pass

    def append(self, _: Any) -> None:
        """Ignore an element."""

    def extend(self, _: Any) -> None:
        """Ignore elements."""

    def add(self, _: Any) -> None:
        """Ignore an element."""


class _InertUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """Return an allowed tensor function, a torch dtype, or the inert stand-in; imports nothing."""
        if (module, name) in _ALLOWED:
            return _ALLOWED[module, name]
        if module == "torch" and isinstance(getattr(torch, name, None), torch.dtype):
            return getattr(torch, name)
        return Inert


class _InertPickle(ModuleType):
    """What `torch.load` needs of a pickle module."""

    Unpickler = _InertUnpickler

    @staticmethod
    def load(file: IO[bytes], **options: Any) -> Any:
        return _InertUnpickler(file, **options).load()


def read_inert(path: Path) -> Any:
    """Read a torch file (zip or legacy layout) into CPU tensors, plain containers and `Inert` objects.

    Raises:
        CheckpointError: a TorchScript program instead of weights.
        READ_ERRORS: the file is damaged.
    """
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            if any(name.endswith("constants.pkl") for name in archive.namelist()):
                raise CheckpointError(f"{path} is a TorchScript program; expected a file of weights")
    return torch.load(path, map_location="cpu", pickle_module=_InertPickle("inert_pickle"), weights_only=False)
