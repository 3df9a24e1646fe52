"""Symmetric tensors of triangles in files: six components, in the order of XDMF or in that of VTK.

They are plane tensors in material axes: u along the warp, v across it in the sheet, w normal to it. Files of
states and arrays in Python have XDMF's order uu, uv, uw, vv, vw, ww (its ``Tensor6``), VTK
uu, vv, ww, uv, vw, uw. Older run folders hold uu, vv, uv.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

TENSORS = frozenset({"green_strain", "stress", "curvature_tensor"})
"""Fields that are symmetric tensors."""

COMPONENTS = {6: ("uu", "uv", "uw", "vv", "vw", "ww"), 3: ("uu", "vv", "uv")}
"""Names of the components by their number: of six, and of three in older folders."""

_VTK_ORDER = [0, 3, 5, 1, 4, 2]
VTK_COLUMNS = ((np.s_[0:5:4], np.s_[0:5:4]), (np.s_[1:3], np.s_[3:6:2]), (np.s_[3:6:2], np.s_[1:3]))
"""The same in pairs of columns, VTK's and XDMF's, each pair ascending."""

_IN_PLANE = [0, 3, 1]


def six_components(plane: NDArray[Any]) -> NDArray[Any]:
    """(n, 6) of plane tensors uu, vv, uv (n, 3)."""
    tensors = np.zeros((len(plane), 6))
    tensors[:, _IN_PLANE] = plane
    return tensors


def plane_components(tensors: NDArray[Any]) -> NDArray[Any]:
    """(n, 3) uu, vv, uv of tensors with six components, or as they are with three."""
    return tensors if tensors.shape[1] == 3 else np.ascontiguousarray(tensors[:, _IN_PLANE])


def is_tensor(shape: tuple[int, ...]) -> bool:
    """Whether an array of this shape holds six components a row."""
    return len(shape) == 2 and shape[1] == 6


def in_vtk_order(rows: NDArray[Any]) -> NDArray[Any]:
    """Rows as VTK wants them: tensors of six components in its order, all others as they are."""
    return np.ascontiguousarray(rows[:, _VTK_ORDER]) if is_tensor(rows.shape) else rows
