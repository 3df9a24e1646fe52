"""Membrane laws as functions of Green strain: one module and one line in ``LAWS`` each.

The module of a law has kernels of the Green strain (e0, e1, e2) = (E_uu, E_vv, 2 E_uv), with the parameters
of a material in row m of c (n_materials, n): ``energy`` W [J/m²], ``stress`` ∂W/∂e (3 numbers) and
``tangent`` ∂²W/∂e² (c11, c12, c22, c33, c13, c23) [N/m]. Further, ``parameters(shell)`` returns a material's
row of c (shorter rows are filled with zeros), ``stiffest(c)`` the largest tangent at rest (n_materials,)
[N/m], and ``SOFTENS`` tells whether the law softens under compression. Convex laws have a
positive-semidefinite tangent.
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

LAWS = {
    "stvk": "lyra_petsc.terms.membrane_laws.stvk",
    "measured": "lyra_petsc.terms.membrane_laws.measured",
    "curves": "lyra_petsc.terms.membrane_laws.curves",
    "neo-hookean": "lyra_petsc.terms.membrane_laws.neo_hookean",
}


def law_of(name: str) -> ModuleType:
    """Import and return the module of a law."""
    return import_module(LAWS[name])
