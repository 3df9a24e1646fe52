"""St. Venant-Kirchhoff, orthotropic: W = ½ (c11 E_uu² + 2 c12 E_uu E_vv + c22 E_vv² + c33 (2 E_uv)²).

Source: the Lyra paper, eq. 2-3; Bonet and Wood, Nonlinear Continuum Mechanics for FEA, ch. 8.
"""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.element import inlined
from lyra_petsc.scene.materials.library import ShellMaterial

SOFTENS = True


@inlined()
def stress(e0, e1, e2, c, m):  # type: ignore[no-untyped-def]
    """Second Piola-Kirchhoff stress (S_uu, S_vv, S_uv) [N/m]."""
    return c[m, 0] * e0 + c[m, 1] * e1, c[m, 1] * e0 + c[m, 2] * e1, c[m, 3] * e2


@inlined()
def energy(e0, e1, e2, c, m):  # type: ignore[no-untyped-def]
    """Energy [J] per rest area [m²]."""
    s0, s1, s2 = c[m, 0] * e0 + c[m, 1] * e1, c[m, 1] * e0 + c[m, 2] * e1, c[m, 3] * e2
    return 0.5 * (e0 * s0 + e1 * s1 + e2 * s2)


@inlined()
def tangent(e0, e1, e2, c, m):  # type: ignore[no-untyped-def]
    """c11, c12, c22, c33, c13, c23 [N/m]."""
    return c[m, 0], c[m, 1], c[m, 2], c[m, 3], 0.0, 0.0


def parameters(shell: ShellMaterial) -> list[float]:
    """c11, c12, c22, c33 [N/m]."""
    return [shell.c11, shell.c12, shell.c22, shell.c33]


def stiffest(c: Array) -> Array:
    """Largest stiffness [N/m], (n_materials,), for parameters c (n_materials, 4)."""
    return np.abs(c).max(axis=1)
