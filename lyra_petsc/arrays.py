"""Type aliases of arrays, and arrays that are only read."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


def read_only(values: Array) -> Array:
    """A view of ``values`` that cannot be written to.

    Kernels are compiled for read-only arrays and for others apart: callers whose arrays may be either give
    this view of them.
    """
    view = values.view()
    view.flags.writeable = False
    return view


def unwritable(*arrays: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """The arrays, made read-only.

    Kernels are compiled separately for read-only arrays, so that arrays used in place of results that are
    kept must be read-only, too.
    """
    for array in arrays:
        array.flags.writeable = False
    return arrays
