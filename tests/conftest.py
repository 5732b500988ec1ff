"""Shared pytest fixtures: reference arrays, real recordings, deterministic threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

REPOSITORY = Path(__file__).resolve().parents[1]
SHARED = REPOSITORY.parent / "shared"


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    # tensors in tests are small: a second thread gains nothing and waits for a core on a busy machine
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the checkout under test."""
    return REPOSITORY


@pytest.fixture(scope="session")
def fixture_folder() -> Path:
    """Folder of the reference arrays; `DEVO_FIXTURES` points to other seeds of the same files."""
    return Path(os.environ.get("DEVO_FIXTURES", REPOSITORY / "tests" / "data"))


@pytest.fixture(scope="session")
def fixture_npz(fixture_folder: Path) -> Callable[[str], dict[str, np.ndarray]]:
    """Load one reference file by name, for example `fixture_npz("lie_groups")["SE3_a"]`."""

    def load(name: str) -> dict[str, np.ndarray]:
        with np.load(fixture_folder / f"{name}.npz", allow_pickle=False) as archive:
            return dict(archive)

    return load


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the small real recordings; tests that need it are skipped where it is missing."""
    folder = SHARED / "data"
    if not folder.is_dir():
        pytest.skip(f"real recordings not found at {folder}")
    return folder
