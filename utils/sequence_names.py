"""What the names of published sequences say: calibrations and crops are found by parts of them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path


def find_in_path(path: Path, parts: Iterable[str]) -> str | None:
    """Return the first of `parts` that the name of the folder contains, else that one of its parents contains.

    Upper and lower case are not told apart. Inner folders come first, so that the name of a collection does not
    decide about a sequence in it.
    """
    parts = list(parts)
    for name in reversed(path.resolve().parts):
        for part in parts:
            if part.lower() in name.lower():
                return part
    return None
