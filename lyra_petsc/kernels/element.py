"""Decorators of element kernels: cached, contraction of products and sums permitted, division by zero gives
inf.

Not the whole of ``fastmath``: NaN must survive, since a collapsed element is recognised by it.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from lyra_petsc.kernels.cache import cached, inner

kernel: Any = partial(cached, error_model="numpy", fastmath={"contract", "nsz", "arcp"})

subkernel: Any = partial(inner, **kernel.keywords)
"""For functions that only kernels call."""

leaf: Any = partial(subkernel, _nrt=False)
"""For those that create no arrays, either: without reference counting of their arguments.
Numba counts references in a whole function or not at all, and atomic counting takes several times as long as
a few sums."""

inlined: Any = partial(leaf, forceinline=True)
"""Like ``leaf``, for small functions, which LLVM copies to where they are called.

Functions that these call must not create arrays either. Numba's ``inline="always"`` copies functions before
it infers types: kernels run as fast, but take longer to compile. It remains for functions called with many
different literals, since others would be compiled for each literal.
"""
