"""Build script: a pure Python package by default, with CUDA kernels where `DEVO_CUDA=1` asks for them.

`DEVO_CUDA=1 pip install -e . --no-build-isolation` or `DEVO_CUDA=1 python setup.py build_ext --inplace` compile the
kernels of `devo.altcorr` and `devo.fastba` with nvcc, found in `CUDA_HOME` or else on the path, into libraries with a
C interface. `DEVO_CUDA_ARCH` chooses the GPUs, for example `90` or `75;86;90`; by default all usual ones that this nvcc
knows. Every operation has a torch twin, so nothing is missing without the kernels.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.errors import CompileError

PACKAGES = ("altcorr", "fastba")
USUAL_ARCHITECTURES = ("70", "75", "80", "86", "89", "90", "100", "120")


def find_nvcc() -> str:
    """Path of the CUDA compiler."""
    home = os.environ.get("CUDA_HOME", "")
    found = shutil.which("nvcc", path=str(Path(home) / "bin") if home else None)
    if found is None:
        place = f"in CUDA_HOME={home}" if home else "on the path"
        raise CompileError(f"DEVO_CUDA=1, but there is no nvcc {place}; install the CUDA toolkit, set CUDA_HOME, or "
                           "unset DEVO_CUDA to do without CUDA kernels")
    return found


def targets(nvcc: str) -> list[str]:
    """Options of nvcc: machine code for every architecture, and PTX of the newest for later GPUs."""
    wanted = os.environ.get("DEVO_CUDA_ARCH", "").replace(",", " ").replace(";", " ").split()
    if not wanted:
        listed = subprocess.run([nvcc, "--list-gpu-arch"], capture_output=True, text=True, check=True).stdout.split()
        wanted = [number for number in USUAL_ARCHITECTURES if f"compute_{number}" in listed]
    newest = wanted[-1]
    codes = [f"-gencode=arch=compute_{number},code=sm_{number}" for number in wanted]
    return [*codes, f"-gencode=arch=compute_{newest},code=compute_{newest}"]


class BuildKernels(build_ext):
    """Compiles each source into one shared library next to it, whose name has no tag of a Python version."""

    def get_ext_filename(self, fullname: str) -> str:
        """Relative path of a library."""
        return str(Path(*fullname.split("."))) + ".so"

    def build_extension(self, ext: Extension) -> None:
        """Call nvcc."""
        nvcc, out = find_nvcc(), Path(self.get_ext_fullpath(ext.name))
        out.parent.mkdir(parents=True, exist_ok=True)
        command = [nvcc, "-O3", "-std=c++17", "-shared", "-Xcompiler", "-fPIC", "--threads", "0", *targets(nvcc),
                   *ext.sources, "-o", str(out)]
        try:
            subprocess.run(command, check=True)
        except subprocess.CalledProcessError as error:
            raise CompileError(f"nvcc failed with exit code {error.returncode}: {' '.join(command)}") from error


def kernels() -> list[Extension]:
    """The libraries to build, none unless `DEVO_CUDA` asks for them."""
    if os.environ.get("DEVO_CUDA", "").strip().lower() in ("", "0", "false", "no", "off"):
        return []
    return [Extension(f"devo.{package}.libdevo_{package}", [f"devo/{package}/kernels.cu"],
                      depends=["devo/kernel_tools.cuh"]) for package in PACKAGES]


setup(ext_modules=kernels(), cmdclass={"build_ext": BuildKernels})
