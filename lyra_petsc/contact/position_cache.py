"""A function of positions that is often called repeatedly with the same ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, unwritable

Result = TypeVar("Result", bound="NDArray[Any] | tuple[NDArray[Any], ...]")


class PositionCache(Generic[Result]):
    """``function`` of positions, with the result for the last ones kept.

    The key is the value of the positions, and the ``number`` of the frames that the function may take, too.
    Results, an array or several, are made read-only, since they are returned repeatedly.
    """

    def __init__(self, function: Callable[..., Result]) -> None:
        self._function = function
        self._last: tuple[Array, list[int], Result] | None = None

    def forget(self) -> None:
        """Compute again at the next call: the function has changed, or the memory is needed."""
        self._last = None

    def __call__(self, x: Array, *frames: Any) -> Result:
        numbers = [own.number for own in frames]
        if self._last is None or numbers != self._last[1] or not np.array_equal(x, self._last[0]):
            result = self._function(x, *frames)
            unwritable(*((result,) if isinstance(result, np.ndarray) else result))
            self._last = x.copy(), numbers, result
        return self._last[2]
