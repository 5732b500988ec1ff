"""Metadata as comment lines: `key: value`, ASCII, short enough for every reader, without loss.

A character outside printable ASCII and the backslash are written as Python escapes. What does not fit on one line
goes on in lines that begin with `+ `. Comments of other programs, which have no such form, are collected under
the key `comment` and written back as they were.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

FOREIGN = "comment"
"""Metadata key that holds the comment lines of other programs, joined by line feeds."""

_KEY = re.compile(r"[A-Za-z0-9_.\\-]+")
_ESCAPE = re.compile(r"\\(?:x([0-9a-f]{2})|u([0-9a-f]{4})|U([0-9a-f]{8})|([nrt\\]))")
_CONTROL = {"n": "\n", "r": "\r", "t": "\t", "\\": "\\"}
_CONTINUES = "+ "
_LINE_LENGTH = 200  # readers in wide use stop at 1024 characters, editors much earlier


def metadata_to_comments(metadata: Mapping[str, str]) -> list[str]:
    """Comment lines (without the comment sign of the format) that `metadata_from_comments` turns back."""
    lines: list[str] = []
    for key, value in metadata.items():
        if key == FOREIGN:
            lines += value.encode("ascii", "backslashreplace").decode().splitlines()
            continue
        text = f"{_escape(key, spaces=True)}: {_escape(value)}"
        lines.append(text[:_LINE_LENGTH])
        lines += [_CONTINUES + text[at : at + _LINE_LENGTH] for at in range(_LINE_LENGTH, len(text), _LINE_LENGTH)]
    return lines


def metadata_from_comments(lines: Iterable[str]) -> dict[str, str]:
    """Metadata of a file from its comment lines; foreign lines are collected under `FOREIGN`."""
    joined: list[str] = []
    for line in lines:
        if line.startswith(_CONTINUES) and joined:
            joined[-1] += line[len(_CONTINUES) :]
        else:
            joined.append(line)
    metadata: dict[str, str] = {}
    foreign: list[str] = []
    for line in joined:
        key, colon, value = line.partition(": ")
        if colon and _KEY.fullmatch(key) and key not in metadata:
            metadata[_unescape(key)] = _unescape(value)
        else:
            foreign.append(line)
    if foreign:
        metadata[FOREIGN] = "\n".join(foreign)
    return metadata


def _escape(text: str, spaces: bool = False) -> str:
    escaped = text.encode("unicode_escape").decode("ascii")
    if not spaces:
        return escaped
    return "".join(c if c.isalnum() or c in "_.\\-" else f"\\x{ord(c):02x}" for c in escaped)


def _unescape(text: str) -> str:
    def character(match: re.Match[str]) -> str:
        code = match[1] or match[2] or match[3]
        return _CONTROL[match[4]] if code is None else chr(int(code, 16))

    return _ESCAPE.sub(character, text)
