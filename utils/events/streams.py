"""Choose one of several event streams in a file: topics of a bag, groups of an HDF5 file, outputs of a recorder."""

from __future__ import annotations

from devo.errors import InputError


def choose_stream(names: list[str], wanted: str | None, source: str) -> str:
    """Return the one name that equals `wanted` or contains it; without a wish, the only name.

    Args:
        names: what the file has, at least one.
        wanted: whole name or a part of it, such as "left"; None takes the only one.
        source: what to call the file in messages.

    Raises:
        InputError: none or several names fit.
    """
    fitting = names if wanted is None else [name for name in names if name == wanted]
    if wanted is not None and not fitting:
        fitting = [name for name in names if wanted in name]
    if len(fitting) == 1:
        return fitting[0]
    listing = ", ".join(sorted(names))
    if wanted is None:
        raise InputError(f"{source}: holds several event streams ({listing}); choose one with stream=\"...\" "
                         "(--stream on the command line), a part of the name is enough")
    problem = "no event stream is called" if not fitting else "more than one event stream fits"
    raise InputError(f"{source}: {problem} {wanted!r}; there are {listing}")
