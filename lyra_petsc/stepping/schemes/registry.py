"""The schemes by name: one module and one line each; only the one that a scene names is imported."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

from lyra_petsc.stepping.schemes.scheme import Scheme

SCHEMES = {
    "beuler": ("beuler", "BackwardEuler"),
    "semi-implicit": ("beuler", "SemiImplicit"),
    "midpoint": ("midpoint", "Midpoint"),
    "alpha2": ("alpha2", "GeneralisedAlpha"),
    "bdf2": ("bdf2", "Bdf2"),
    "static": ("static", "Static"),
}
"""A scene's ``time.integrator`` to module and class."""


def scheme_of(integrator: str, radius: float | None) -> Scheme:
    """The scheme of a scene's ``time.integrator``; ``radius`` is for ``alpha2``."""
    module, name = SCHEMES[integrator]
    kind: Callable[..., Scheme] = getattr(import_module(f"lyra_petsc.stepping.schemes.{module}"), name)
    return kind() if radius is None else kind(radius)
