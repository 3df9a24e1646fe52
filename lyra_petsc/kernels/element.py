"""How element kernels are compiled: cached, contractions allowed, division by zero gives inf.

Not the whole of ``fastmath``: NaN must survive, since it is how a collapsed element is noticed.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from lyra_petsc.kernels.cache import cached

kernel: Any = partial(cached, error_model="numpy", fastmath={"contract", "nsz", "arcp"})

leaf: Any = partial(kernel, _nrt=False)
"""Kernels for others to call that make no arrays, and do not count references to those they are given: numba
does so in a whole function, and atomic counting takes several times as long as a few sums.
"""
