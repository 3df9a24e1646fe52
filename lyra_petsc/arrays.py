"""Type aliases of arrays, and arrays that are only read."""

from __future__ import annotations

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
