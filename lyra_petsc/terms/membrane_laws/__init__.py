"""Laws of the membrane by Green strain: one module and one line in ``LAWS`` each.

A law's module offers kernels of the Green strain (e0, e1, e2) = (E_uu, E_vv, 2 E_uv) with the parameters in
row m of c (n_laws, n): ``energy`` W [J/m²], ``stress`` ∂W/∂e (3 numbers) and ``tangent`` ∂²W/∂e² (c11, c12,
c22, c33, c13, c23) [N/m]; and on arrays ``parameters(shell)``, a row of c for a material (shorter ones are
filled with zeros), and ``stiffest(c)``, the largest size of the tangent at rest (n_laws,). ``SOFTENS`` says
whether it does under compression. Convex laws have a positive-semidefinite tangent.
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
    """The module of a law, imported now."""
    return import_module(LAWS[name])
