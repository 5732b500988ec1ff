"""Loading of the built CUDA kernels: shared libraries with a plain C interface, called through ctypes.

`DEVO_CUDA=1 pip install -e . --no-build-isolation` (or `DEVO_CUDA=1 python setup.py build_ext --inplace`) builds them
next to their sources. They depend on neither the version of Python nor that of torch.
"""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import torch
from torch import Tensor

from devo.errors import DevoError, InputError

ARGUMENTS = {"p": ctypes.c_void_p, "i": ctypes.c_int64, "d": ctypes.c_double}
"""Letters of a signature: pointer, 64-bit integer, double. The device number and the stream come before them."""


def built_library(package: str) -> Path:
    """Where the build puts the library of `altcorr` or `fastba`."""
    return Path(__file__).parent / package / f"libdevo_{package}.so"


class CudaLibrary:
    """The functions of one built library.

    Args:
        package: `altcorr` or `fastba`.
        signatures: letters (see `ARGUMENTS`) by name of the function.

    Raises:
        ImportError: the library is not built, cannot be loaded or lacks a function.
    """

    def __init__(self, package: str, signatures: Mapping[str, str]) -> None:
        path = built_library(package)
        if not path.is_file():
            raise ImportError(f"{path} is not built; run DEVO_CUDA=1 python setup.py build_ext --inplace")
        try:
            library = ctypes.CDLL(str(path))
            self.functions = {name: self._declared(library[name], letters) for name, letters in signatures.items()}
        except (OSError, AttributeError) as error:
            raise ImportError(f"{path} cannot be used, build it again: {error}") from error

    @staticmethod
    def _declared(function: Callable[..., int], letters: str) -> Callable[..., int]:
        kinds = [ARGUMENTS["i"], ARGUMENTS["p"], *(ARGUMENTS[letter] for letter in letters)]
        function.argtypes, function.restype = kinds, ctypes.c_int  # type: ignore[attr-defined]
        return function

    def launch(self, name: str, device: torch.device, *arguments: Tensor | int | float | None) -> None:
        """Start a kernel on the current stream of `device`; tensors are passed as addresses, `None` as null.

        Raises:
            InputError: a tensor is on another device.
            DevoError: CUDA refused the launch.
        """
        values: list[int | float | None] = []
        for argument in arguments:
            if isinstance(argument, Tensor):
                if argument.device != device:
                    raise InputError(f"{name} got tensors on {argument.device} and {device}; expected one device")
                values.append(argument.data_ptr())
            else:
                values.append(argument)
        with current_stream(device) as stream:
            error = self.functions[name](device.index or 0, stream, *values)
        if error:
            raise DevoError(f"CUDA kernel {name} failed with error {error} of the CUDA runtime; DEVO_KERNELS=torch "
                            "avoids the built kernels")


@contextlib.contextmanager
def current_stream(device: torch.device) -> Iterator[int]:
    """Handle of the current stream of a CUDA device, which is the current device meanwhile."""
    with torch.cuda.device(device):
        yield torch.cuda.current_stream(device).cuda_stream
