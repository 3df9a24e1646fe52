"""Time integrators: one module and one line in ``CLASSES`` each; what a scene names is imported."""

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
"""A scene's ``time.integrator`` to module and class."""


def integrator_of(integrator: str, radius: float | None) -> Integrator:
    """The integrator of a scene's ``time.integrator``; ``radius`` is for ``alpha2``."""
    module, name = CLASSES[integrator]
    kind: Callable[..., Integrator] = getattr(
        import_module(f"lyra_petsc.stepping.integrators.{module}"), name
    )
    return kind() if radius is None else kind(radius)
