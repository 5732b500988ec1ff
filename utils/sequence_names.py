"""What the names of published sequences say: calibrations and crops are found by parts of them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path


def find_in_path(path: Path, parts: Iterable[str]) -> str | None:
    """Return the first of `parts` that the name of the folder contains, else that one of its parents contains.

    Upper and lower case are not told apart. Inner folders come first, so that the name of a collection does not
    decide about a sequence in it; names of links come before those of what they lead to.
    """
    parts = list(parts)
    named = Path(os.path.abspath(path))  # noqa: PTH100 - normalises `..` without following links
    for name in (*reversed(named.parts), *reversed(path.resolve().parts)):
        for part in parts:
            if part.lower() in name.lower():
                return part
    return None
