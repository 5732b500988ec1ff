"""Lines for people on stderr."""

from __future__ import annotations

import sys

from tqdm import tqdm


def say(text: str) -> None:
    """One line on stderr that does not tear a progress bar."""
    tqdm.write(text, file=sys.stderr)
