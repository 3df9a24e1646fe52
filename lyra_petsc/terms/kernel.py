"""How element kernels are compiled: cached, contractions allowed, division by zero gives inf.

Not the whole of ``fastmath``: NaN must survive, since it is how a collapsed element is noticed.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from lyra_petsc.kernel_cache import cached

Index = np.uintp
"""Kernels look entries up by it: no number is negative then, which numba would count from the end."""

kernel: Any = partial(cached, error_model="numpy", fastmath={"contract", "nsz", "arcp"})
