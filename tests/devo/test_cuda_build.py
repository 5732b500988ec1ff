"""What holds without a GPU: the build and its errors, the C interface against its declarations, the choice of twins."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from devo import cuda_library, kernels
from devo.altcorr import corr
from devo.errors import InputError

PACKAGES = ("altcorr", "fastba")
ROOT = Path(__file__).resolve().parents[2]


def run_setup(folder: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "setup.py"), "-q", "build_ext", "--build-lib", str(folder / "lib"),
               "--build-temp", str(folder / "temp"), *arguments]
    return subprocess.run(command, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, timeout=60)


def test_build_without_a_compiler_fails_in_one_line(tmp_path: Path) -> None:
    done = run_setup(tmp_path, DEVO_CUDA="1", CUDA_HOME=str(tmp_path))
    assert done.returncode != 0
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("error: DEVO_CUDA=1, but there is no nvcc in CUDA_HOME=")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("value", ["", "0"])
def test_nothing_is_built_unless_asked_for(tmp_path: Path, value: str) -> None:
    done = run_setup(tmp_path, DEVO_CUDA=value, CUDA_HOME=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.rglob("*.so"))


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [("", {"sm_75", "sm_90", "compute_90"}), ("86", {"sm_86", "compute_86"}),
     ("75;80", {"sm_75", "sm_80", "compute_80"})],
)
def test_build_calls_nvcc_for_the_wanted_gpus(tmp_path: Path, wanted: str, expected: set[str]) -> None:
    """With a stand-in for nvcc that knows three GPUs and writes down its arguments."""
    nvcc = tmp_path / "bin" / "nvcc"
    nvcc.parent.mkdir()
    nvcc.write_text(
        f"#!/bin/sh\nif [ $1 = --list-gpu-arch ]; then echo compute_75; echo compute_87; echo compute_90; exit; fi\n"
        f"echo $@ >> {tmp_path}/calls\nfor out; do :; done\necho built > $out\n"
    )
    nvcc.chmod(0o755)
    done = run_setup(tmp_path, DEVO_CUDA="1", CUDA_HOME=str(tmp_path), DEVO_CUDA_ARCH=wanted)
    assert done.returncode == 0, done.stderr
    calls = (tmp_path / "calls").read_text().splitlines()
    assert [set(re.findall(r",code=(\w+)", call)) for call in calls] == [expected, expected]
    for package in PACKAGES:
        assert (tmp_path / "lib" / "devo" / package / cuda_library.built_library(package).name).is_file()


def test_failing_compiler_is_reported(tmp_path: Path) -> None:
    nvcc = tmp_path / "bin" / "nvcc"
    nvcc.parent.mkdir()
    nvcc.write_text("#!/bin/sh\nexit 3\n")
    nvcc.chmod(0o755)
    done = run_setup(tmp_path, DEVO_CUDA="1", CUDA_HOME=str(tmp_path), DEVO_CUDA_ARCH="90")
    assert done.returncode != 0 and "error: nvcc failed with exit code 3" in done.stderr.splitlines()[-1]


@pytest.mark.parametrize("package", PACKAGES)
def test_declared_arguments_are_those_of_the_source(package: str) -> None:
    source = (ROOT / "devo" / package / "kernels.cu").read_text(encoding="utf-8")
    found = {}
    for name, arguments in re.findall(r'extern "C" int (\w+)\(([^)]*)\)', source):
        kinds = ["p" if "*" in one else {"int64_t": "i", "double": "d"}[one.split()[0]] for one in arguments.split(",")]
        assert kinds[:2] == ["i", "p"]  # device and stream
        found[name] = "".join(kinds[2:])
    assert len(found) == 4
    tree = ast.parse((ROOT / "devo" / package / "extension.py").read_text(encoding="utf-8"))
    declared = next(node.value for node in tree.body
                    if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "SIGNATURES")
    assert eval(compile(ast.Expression(declared), "SIGNATURES", "eval")) == found


@pytest.fixture()
def nothing_built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(cuda_library, "built_library", lambda package: tmp_path / f"{package}.so")
    for name in kernels.EXTENSIONS.values():
        monkeypatch.delitem(sys.modules, name, raising=False)
    kernels._extension.cache_clear()
    yield tmp_path
    kernels._extension.cache_clear()


class OnCuda:
    is_cuda = True


@pytest.mark.parametrize("package", PACKAGES)
def test_without_a_library_the_twin_runs(nothing_built: Path, monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    monkeypatch.setenv("DEVO_KERNELS", "auto")
    assert kernels.cuda_kernel(package, OnCuda()) is None  # type: ignore[arg-type]
    monkeypatch.setenv("DEVO_KERNELS", "cuda")
    with pytest.raises(InputError, match=f"the extension devo.{package}.extension is not built"):
        kernels.cuda_kernel(package, OnCuda())  # type: ignore[arg-type]


@pytest.mark.parametrize("package", PACKAGES)
def test_a_broken_library_counts_as_none(nothing_built: Path, monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    (nothing_built / f"{package}.so").write_bytes(b"no library")
    monkeypatch.setenv("DEVO_KERNELS", "auto")
    assert kernels.cuda_kernel(package, OnCuda()) is None  # type: ignore[arg-type]
    with pytest.raises(ImportError, match="build it again"):
        cuda_library.CudaLibrary(package, {})


def test_on_the_cpu_the_twin_runs_whatever_is_built(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEVO_KERNELS", "auto")
    index = torch.zeros(1, dtype=torch.int64)
    operands = torch.ones(1, 1, 2, 1, 1), torch.ones(1, 1, 2, 3, 3), torch.ones(1, 1, 2, 1, 1), index, index
    assert corr(*operands, 1).eq(2).all()
    monkeypatch.setenv("DEVO_KERNELS", "cuda")
    with pytest.raises(InputError, match="not on a CUDA device"):
        corr(*operands, 1)
