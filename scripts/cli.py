"""What every command line of this project shares, see `utils.cli` (commands in `evals/` use it from there)."""

from __future__ import annotations

from utils.cli import INTERRUPTED, AliasParser, run_cli

__all__ = ["INTERRUPTED", "AliasParser", "run_cli"]
