"""Reading a mesh file's bytes, and words for lists of culprits."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from lyra_petsc.errors import InputError


def read_bytes(path: Path) -> bytes:
    """Content of ``path``.

    Raises
    ------
    InputError
        If it is missing, no plain file, not readable or empty.
    """
    try:
        if path.is_dir():
            raise InputError("is a folder; a mesh file (.geo, .msh or .obj) is needed", file=path)
        if not path.exists():
            raise InputError("no such mesh file", file=path)
        if not path.is_file():
            raise InputError("is no plain file", file=path)
        data = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"cannot be read ({reason})", file=path) from None
    if not data.strip():
        raise InputError("the file is empty", file=path)
    return data


def culprits(indices: Iterable[object], limit: int = 5) -> str:
    """``3, 5, 9, 12, 40 and 7 more``."""
    everything = list(indices)
    shown = ", ".join(str(index) for index in everything[:limit])
    more = f" and {len(everything) - limit} more" if len(everything) > limit else ""
    return shown + more


def printable(name: str) -> str:
    """``name`` without what a terminal or HDF5 would choke on (control and null characters)."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in name)
