"""Open3D, imported late: it takes a second, and needs system libraries that a bare machine lacks."""

from __future__ import annotations

import importlib
from typing import Any

from devo.errors import InputError


def import_open3d(remedy: str) -> Any:
    """Return the Open3D module.

    Args:
        remedy: what to try where it cannot be imported, a clause.

    Raises:
        InputError: it cannot be imported.
    """
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        raise InputError(f"Open3D cannot be imported ({error}); {remedy}") from error
