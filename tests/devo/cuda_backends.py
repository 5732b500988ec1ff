"""Where the CUDA kernels are tested: on a GPU, and everywhere in a CPU emulation of the same source."""

from __future__ import annotations

import contextlib
import importlib
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from devo import cuda_library, fastba
from devo.altcorr import correlation, patches
from devo.kernels import EXTENSIONS, kernel_mode

PACKAGES = ("altcorr", "fastba")
ROOT = Path(__file__).resolve().parents[2]


@dataclass
class Kernels:
    """Where the kernels run, and a way to call a public function with the twin and with the kernels."""

    device: torch.device
    modules: dict[str, ModuleType]
    monkeypatch: pytest.MonkeyPatch

    def twin(self, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        self.monkeypatch.setenv("DEVO_KERNELS", "torch")
        return function(*arguments, **options)

    def ours(self, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        self.monkeypatch.setenv("DEVO_KERNELS", "cuda")
        return function(*arguments, **options)


@pytest.fixture(scope="session")
def emulated_libraries(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    compiler, folder = shutil.which("g++"), tmp_path_factory.mktemp("kernels")
    if compiler is None:
        pytest.skip("g++ is missing, which compiles the kernels for the CPU")
    built = {}
    for package in PACKAGES:
        built[package] = folder / f"{package}.so"
        header, source = ROOT / "tests" / "devo" / "emulated_cuda.h", ROOT / "devo" / package / "kernels.cu"
        # the checks of a fortified libc take switches between the stacks of threads for errors
        command = [compiler, "-x", "c++", "-std=c++17", "-O1", "-w", "-U_FORTIFY_SOURCE", "-shared", "-fPIC",
                   "-include", str(header), str(source), "-o", str(built[package])]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode and "_Float16" in done.stderr:
            pytest.skip("this g++ is too old for half precision")
        assert done.returncode == 0, done.stderr
    return built


@pytest.fixture(scope="session")
def emulated_modules(emulated_libraries: dict[str, Path]) -> Iterator[dict[str, ModuleType]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cuda_library, "built_library", emulated_libraries.__getitem__)
        for name in EXTENSIONS.values():
            patch.delitem(sys.modules, name, raising=False)
        modules = {package: importlib.import_module(name) for package, name in EXTENSIONS.items()}
        for name in EXTENSIONS.values():
            sys.modules.pop(name)
    return modules


@pytest.fixture(params=["emulated", pytest.param("cuda", marks=pytest.mark.gpu)])
def kernels(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Kernels:
    if request.param == "cuda":
        if not torch.cuda.is_available():
            pytest.skip("no CUDA device")
        try:
            modules = {package: importlib.import_module(name) for package, name in EXTENSIONS.items()}
        except ImportError as error:
            pytest.skip(str(error))
        return Kernels(torch.device("cuda", 0), modules, monkeypatch)
    modules = request.getfixturevalue("emulated_modules")

    def choose(name: str, *tensors: Tensor) -> ModuleType | None:
        return modules[name] if kernel_mode() == "cuda" else None

    monkeypatch.setattr(cuda_library, "current_stream", lambda device: contextlib.nullcontext(0))
    for module in (correlation, patches, fastba):
        monkeypatch.setattr(module, "cuda_kernel", choose)
    return Kernels(torch.device("cpu"), modules, monkeypatch)


def assert_close(ours: Tensor, twin: Tensor, tolerance: float) -> None:
    """Same shape, dtype, device and NaNs; differences relative to the largest value."""
    assert (ours.shape, ours.dtype, ours.device) == (twin.shape, twin.dtype, twin.device)
    assert torch.equal(ours.isnan(), twin.isnan())
    ours, twin = ours.double().nan_to_num(), twin.double().nan_to_num()
    largest = max(1.0, float(twin.abs().max())) if twin.numel() else 1.0
    assert not twin.numel() or float((ours - twin).abs().max()) <= tolerance * largest
