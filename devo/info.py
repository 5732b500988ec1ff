"""`python -m devo.info`: what is installed, which device and kernels would be used, which weights ship."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys

import torch

from devo import __version__
from devo.checkpoint import builtin_weights, default_weights
from devo.device import fast_dtype, resolve_device
from devo.kernels import active_kernels, kernel_mode

_PACKAGES = ("numpy", "scipy", "opencv-python-headless", "h5py", "hdf5plugin", "open3d", "evo", "matplotlib", "rosbags")


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def describe() -> dict[str, str]:
    """Facts about this installation as name and text, in display order."""
    device = resolve_device("auto")
    kernels = ", ".join(f"{name}: {kind}" for name, kind in active_kernels().items())
    weights = ", ".join(builtin_weights()) or "none"
    rows = {
        "devo": __version__,
        "python": f"{sys.version.split()[0]} on {platform.system()} {platform.machine()}",
        "torch": f"{torch.__version__}, {torch.get_num_threads()} of {os.cpu_count()} threads",
        "device": str(device) + (f" ({torch.cuda.get_device_name(device)})" if device.type == "cuda" else ""),
        "mixed precision": str(fast_dtype(device, True)).removeprefix("torch."),
        "kernels": f"{kernels} (DEVO_KERNELS={kernel_mode()})",
        "built-in weights": f"{weights} (default: {default_weights() or 'none'})",
    }
    return rows | {package: _version(package) for package in _PACKAGES}


if __name__ == "__main__":
    for name, value in describe().items():
        print(f"{name:>22}  {value}")
