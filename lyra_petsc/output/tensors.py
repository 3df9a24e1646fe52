"""Symmetric tensors of triangles in files: six components, in XDMF's or VTK's order.

They are plane tensors in material axes: u along the warp, v across it in the sheet, w normal to the sheet.
States and arrays in Python have the order of XDMF's ``Tensor6``, uu, uv, uw, vv, vw, ww; VTK's order is
uu, vv, ww, uv, vw, uw.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

TENSORS = frozenset({"green_strain", "stress", "curvature_tensor"})
"""Fields that are symmetric tensors."""

COMPONENTS = ("uu", "uv", "uw", "vv", "vw", "ww")
"""Names of the components."""

VTK_COLUMNS = ((np.s_[0:5:4], np.s_[0:5:4]), (np.s_[1:3], np.s_[3:6:2]), (np.s_[3:6:2], np.s_[1:3]))
"""Pairs of ascending slices of columns in VTK's and XDMF's order."""

_IN_PLANE = [0, 3, 1]


def six_components(plane: NDArray[Any]) -> NDArray[Any]:
    """(n, 6) components of plane tensors given as uu, vv, uv (n, 3)."""
    tensors = np.zeros((len(plane), 6))
    tensors[:, _IN_PLANE] = plane
    return tensors


def plane_components(tensors: NDArray[Any]) -> NDArray[Any]:
    """(n, 3) components uu, vv, uv of plane tensors with six components."""
    return np.ascontiguousarray(tensors[:, _IN_PLANE])


def is_tensor(shape: tuple[int, ...]) -> bool:
    """Whether an array of this shape holds tensors of six components."""
    return len(shape) == 2 and shape[1] == 6
