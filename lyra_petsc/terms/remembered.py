"""A function of an array that is often asked twice at the same place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array

Result = TypeVar("Result", bound="Array | tuple[Array, ...]")


def unwritable(*arrays: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """These arrays, which cannot be written to from here on.

    Kernels are compiled for arrays of either kind: what stands for remembered results is to be as they are.
    """
    for array in arrays:
        array.flags.writeable = False
    return arrays


class Remembered(Generic[Result]):
    """``function`` of an array, computed where it was not computed last.

    Its results, an array or several, cannot be written to: they are given out again.
    """

    def __init__(self, function: Callable[[Array], Result]) -> None:
        self._function = function
        self._last: tuple[Array, Result] | None = None

    def forget(self) -> None:
        """Let the function be another from here on."""
        self._last = None

    def __call__(self, at: Array) -> Result:
        if self._last is None or not np.array_equal(at, self._last[0]):
            result = self._function(at)
            unwritable(*((result,) if isinstance(result, np.ndarray) else result))
            self._last = at.copy(), result
        return self._last[1]
