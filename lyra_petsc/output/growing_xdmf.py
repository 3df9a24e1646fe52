"""states.xdmf grows by one state at a time, and is a whole document at every moment.

Behind the end of the document stands an XML processing instruction full of spaces. A state is written into
it, with another end of the document and the opening of another such instruction behind it: so far nothing of
this counts. Then the former end is overwritten with spaces, in one write within one page of the file, and
what was the instruction's is the document's. Who reads meanwhile sees one or the other. Only where the room
is used up is the file copied, with an eighth more.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from lyra_petsc.errors import OutputError
from lyra_petsc.output.agreement import missing_folder, reason
from lyra_petsc.output.xdmf import DOCUMENT_END, DOCUMENT_START

SEAM = (DOCUMENT_END + "<?room ").encode()
"""The end of the document, and the opening of the room behind it."""

ROOM_END = b"?>\n"

PAGE = 4096
"""What a process that is killed writes whole or not at all [bytes]."""

LEAST_ROOM, MOST_ROOM = 1 << 14, 1 << 20
"""Bytes; XML readers keep an instruction in memory, and refuse one of 10 MB."""


class GrowingXdmf:
    """The file; for one rank.

    Parameters
    ----------
    path : Path
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._seam = 0
        self._size = -1

    def replace(self, grids: Iterable[str]) -> None:
        """Write the document of these states.

        Raises
        ------
        OutputError
            If it could not be written; what stood there before stands.
        """
        self._make([DOCUMENT_START.encode(), *(grid.encode() for grid in grids)], copied=0)

    def append(self, grid: str) -> None:
        """Announce one more state.

        Raises
        ------
        OutputError
            If it could not be; what was announced stands.
        FileNotFoundError
            If somebody has removed or changed the file.
        """
        text = grid.encode()
        begin = self._seam + len(SEAM)
        begin += _pad(begin + len(text))
        try:
            status = self.path.stat()
            if status.st_size != self._size:
                raise FileNotFoundError
            if begin + len(text) + len(SEAM) + len(ROOM_END) > self._size:
                self._make([text], copied=self._seam)
                return
            with open(self.path, "r+b", buffering=0) as file:
                os.pwrite(file.fileno(), text + SEAM, begin)
                os.fdatasync(file.fileno())  # never after what makes it count
                os.pwrite(file.fileno(), b" " * len(SEAM), self._seam)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise self._refusal(error) from error
        self._seam = begin + len(text)

    def _make(self, pieces: list[bytes], copied: int) -> None:
        """The first ``copied`` bytes of the file and these pieces, with new room, under its name."""
        part = self.path.with_name(self.path.name + ".part")
        try:
            with open(part, "wb") as new:
                if copied:
                    with open(self.path, "rb") as old:
                        while new.tell() < copied:
                            new.write(old.read(min(copied - new.tell(), MOST_ROOM)))
                new.writelines(pieces)
                new.write(b" " * _pad(new.tell()))
                seam = new.tell()
                new.write(SEAM)
                new.write(b" " * min(max(seam // 8, LEAST_ROOM), MOST_ROOM) + ROOM_END)
                size = new.tell()
                new.flush()
                os.fsync(new.fileno())
            os.replace(part, self.path)
        except OSError as error:
            part.unlink(missing_ok=True)
            raise self._refusal(error) from error
        self._seam, self._size = seam, size

    def _refusal(self, error: OSError) -> OutputError:
        return OutputError(f"{self.path}: cannot be written: {missing_folder(self.path) or reason(error)}")


def _pad(seam: int) -> int:
    """Bytes by which a seam has to move to lie within one page."""
    return -seam % PAGE if seam % PAGE + len(SEAM) > PAGE else 0
