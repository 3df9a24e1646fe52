"""Small files replaced atomically: a reader finds the old or the new content, never a part of it."""

from __future__ import annotations

import os
from pathlib import Path

from lyra_petsc.errors import OutputError
from lyra_petsc.output.agreement import reason


def replace_text(path: str | os.PathLike[str], text: str) -> None:
    """Put ``text`` into a file in one instant. Call on one rank.

    Raises
    ------
    OutputError
        If it could not be written; what stood there before stands.
    """
    replace_bytes(path, text.encode("utf-8"))


def replace_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """As `replace_text`, for content that is no text."""
    path = Path(path)
    part = path.with_name(path.name + ".part")
    try:
        with open(part, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise OutputError(f"{path}: cannot be written: {reason(error)}") from error
