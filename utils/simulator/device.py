"""Check a device that a user asked for."""

from __future__ import annotations

import torch

from devo.errors import InputError


def checked_device(name: str) -> torch.device:
    """The named device.

    Raises:
        InputError: no such kind of device, or it is not there.
    """
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise InputError(f"device {name!r} is unknown, expected cpu, cuda or cuda:N") from error
    available = device.type == "cpu" or (device.type == "cuda" and (device.index or 0) < torch.cuda.device_count())
    if not available:
        raise InputError(f"device {name!r} is not available here; try --device cpu")
    return device
