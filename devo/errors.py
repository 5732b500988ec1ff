"""The exceptions of this project: one root, few branches.

A message says what was found, what was expected and what to try. Command lines print it on one
line and leave with `exit_code`.
"""

from __future__ import annotations


class DevoError(Exception):
    """Root of every error this project raises on purpose; a command that meets it ends with exit code 1."""

    exit_code: int = 1


class InputError(DevoError):
    """The caller's arguments or files are unusable (exit code 2)."""

    exit_code = 2


class CheckpointError(InputError):
    """A weights file is missing, truncated, unsafe or of another shape than expected (exit code 2)."""


class TrackingError(DevoError):
    """The odometry cannot go on or has no result to give (exit code 1)."""


class OutputError(DevoError):
    """A result could not be written, for example because the disk is full (exit code 1)."""
