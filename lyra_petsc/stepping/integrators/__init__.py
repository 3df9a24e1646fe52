"""Time integrators: each has a module, imported only if a scene names it, and a line in ``CLASSES``."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

from lyra_petsc.stepping.integrators.integrator import Integrator

CLASSES = {
    "beuler": ("beuler", "BackwardEuler"),
    "semi-implicit": ("beuler", "SemiImplicit"),
    "midpoint": ("midpoint", "Midpoint"),
    "alpha2": ("alpha2", "GeneralisedAlpha"),
    "bdf2": ("bdf2", "Bdf2"),
    "static": ("static", "Static"),
}
"""Module and class of each value of a scene's ``time.integrator``."""


def integrator_of(integrator: str, radius: float | None) -> Integrator:
    """The integrator of this name; ``radius`` is the spectral radius of ``alpha2``, else None."""
    module, name = CLASSES[integrator]
    kind: Callable[..., Integrator] = getattr(
        import_module(f"lyra_petsc.stepping.integrators.{module}"), name
    )
    return kind() if radius is None else kind(radius)
