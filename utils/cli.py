"""What every command line of this project shares: aliases, one-line errors, exit codes.

A script begins with two lines that put the repository root on `sys.path`, imports only this module and
`argparse`-cheap things at module level (so that `--help` is instant), and ends with
`sys.exit(run_cli(main))`. Heavy imports belong into `main`, after the arguments are parsed.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from devo.errors import DevoError

INTERRUPTED = 130
"""Exit code after Ctrl-C (128 + SIGINT), as shells expect it."""


class _HelpFormatter(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter):
    """Keep line breaks of descriptions and show only defaults that say something."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.default is None or isinstance(action.default, bool) or not action.option_strings:
            return action.help
        return super()._get_help_string(action)


class AliasParser(argparse.ArgumentParser):
    """An `ArgumentParser` in which every `--long_flag` may also be written `--long-flag` and the other way round.

    Works for options of groups and of sub-commands alike, shows only the declared spelling in the help, does not
    guess abbreviations, and reports a wrong command line on a single line of stderr with exit code 2.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("formatter_class", _HelpFormatter)
        kwargs.setdefault("allow_abbrev", False)
        super().__init__(*args, **kwargs)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse as `argparse` does, after the flags were brought to their declared spelling."""
        words = sys.argv[1:] if args is None else list(args)
        declared = {_hyphenated(name): name for name in self._option_string_actions if name.startswith("--")}
        end = words.index("--") if "--" in words else len(words)
        spelled = [self._declared_spelling(word, declared) for word in words[:end]]
        return super().parse_known_args(spelled + words[end:], namespace)

    def _declared_spelling(self, word: str, declared: dict[str, str]) -> str:
        if not word.startswith("--"):
            return word
        name, equals, value = word.partition("=")
        if name in self._option_string_actions:
            return word
        return declared.get(_hyphenated(name), name) + equals + value

    def error(self, message: str) -> NoReturn:
        """Say on one line what is wrong with the arguments and leave with exit code 2."""
        self.exit(2, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def run_cli(main: Callable[[Sequence[str] | None], int | None], argv: Sequence[str] | None = None) -> int:
    """Run `main(argv)` and return its exit code; a `DevoError` becomes one line on stderr and its `exit_code`.

    Ctrl-C gives 130 and a line that says so; a reader that closed the pipe ends the command quietly. Everything
    else is a defect of the program and keeps its traceback.
    """
    name = os.path.basename(sys.argv[0])  # noqa: PTH119 - the name only, and pathlib is slow to import
    try:
        return main(argv) or 0
    except DevoError as error:
        sys.stderr.write(f"{name}: error: {' '.join(str(error).split())}\n")
        return error.exit_code
    except KeyboardInterrupt:
        sys.stderr.write(f"{name}: interrupted; files that were completed before are kept\n")
        return INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _hyphenated(name: str) -> str:
    return "--" + name[2:].replace("_", "-")
