"""Numbers of a .msh section, read alike from text and from binary."""

from __future__ import annotations

import warnings
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Width = Literal["int", "size"]


class MshError(ValueError):
    """A section that does not hold what the format says; the message is for the user."""


class Values(Protocol):
    """A section read from front to back."""

    def rows(self, n: int, integers: int, reals: int = 0, width: Width = "int") -> tuple[Ints, Floats]:
        """``n`` rows of ``integers`` whole numbers followed by ``reals`` numbers.

        Returns (n, integers) int64 and (n, reals) float64. ``width`` is the size of the whole numbers in
        a binary file: C ``int`` or ``size_t``.

        Raises
        ------
        MshError
            If fewer numbers are left, or something else stands there.
        """
        ...

    def window(self, n: int) -> Ints:
        """The next whole numbers, at most ``n``, without reading on (text only)."""
        ...


class TextValues:
    """Values of an ASCII section."""

    def __init__(self, body: bytes) -> None:
        with warnings.catch_warnings():
            # numpy warns, and stops, at the first thing that is no number
            warnings.simplefilter("error")
            try:
                self._values = np.fromstring(body.decode("latin-1"), dtype=np.float64, sep=" ")
            except (DeprecationWarning, ValueError):
                raise MshError("holds something that is no number") from None
        self._at = 0

    def rows(self, n: int, integers: int, reals: int = 0, width: Width = "int") -> tuple[Ints, Floats]:
        each = integers + reals
        if n < 0 or n * each > len(self._values) - self._at:
            raise MshError(f"is cut short: {n} rows announced, too few numbers left")
        table = self._values[self._at : self._at + n * each].reshape(n, each)
        self._at += n * each
        return _whole(table[:, :integers]), np.array(table[:, integers:])

    def window(self, n: int) -> Ints:
        return _whole(self._values[self._at : self._at + n])


class BinaryValues:
    """Values of a binary section; ``order`` is ``<`` or ``>``."""

    def __init__(self, body: bytes, order: str) -> None:
        self._body = body
        self._order = order
        self._at = 0

    def rows(self, n: int, integers: int, reals: int = 0, width: Width = "int") -> tuple[Ints, Floats]:
        whole = f"{self._order}{'i4' if width == 'int' else 'u8'}"
        row = np.dtype([("whole", whole, (integers,)), ("real", f"{self._order}f8", (reals,))])
        if n < 0 or n * row.itemsize > len(self._body) - self._at:
            raise MshError(f"is cut short: {n} rows announced, too few bytes left")
        table = np.frombuffer(self._body, dtype=row, count=n, offset=self._at)
        self._at += n * row.itemsize
        largest = int(table["whole"].max()) if n and integers else 0
        if largest >= 2**62:
            raise MshError(f"holds the number {largest} where a count or a tag belongs")
        return table["whole"].astype(np.int64), table["real"].astype(np.float64)

    def window(self, n: int) -> Ints:
        raise NotImplementedError("binary element blocks have a header")


def one(values: Values, width: Width = "int") -> int:
    """The next whole number."""
    return int(values.rows(1, 1, width=width)[0][0, 0])


def several(values: Values, n: int, width: Width = "int") -> list[int]:
    """The next ``n`` whole numbers."""
    found: list[int] = values.rows(n, 1, width=width)[0][:, 0].tolist()
    return found


def _whole(table: Floats) -> Ints:
    # beyond 2^53 a float no longer holds a whole number exactly; no real tag is that large
    if not (
        np.isfinite(table).all() and (np.abs(table) < 2.0**53).all() and (table == np.floor(table)).all()
    ):
        raise MshError("holds something else where a count or a tag belongs")
    return table.astype(np.int64)
