"""A function of an array that is often called repeatedly with the same values."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array

Result = TypeVar("Result", bound="NDArray[Any] | tuple[NDArray[Any], ...]")


def unwritable(*arrays: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """The arrays, made read-only.

    Kernels are compiled separately for read-only arrays, so that arrays used in place of remembered results
    must be read-only, too.
    """
    for array in arrays:
        array.flags.writeable = False
    return arrays


class Remembered(Generic[Result]):
    """``function`` of an array, computed again only if the values differ from those of the last call.

    Its results, an array or several, are made read-only, since they are returned repeatedly.
    """

    def __init__(self, function: Callable[[Array], Result]) -> None:
        self._function = function
        self._last: tuple[Array, Result] | None = None

    def forget(self) -> None:
        """Compute again at the next call, because the function has changed."""
        self._last = None

    def __call__(self, x: Array) -> Result:
        if self._last is None or not np.array_equal(x, self._last[0]):
            result = self._function(x)
            unwritable(*((result,) if isinstance(result, np.ndarray) else result))
            self._last = x.copy(), result
        return self._last[1]
