"""Elastic forces along the straight way of a step: what they add up to, if they are an energy's."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.terms.bending import Bending
from lyra_petsc.terms.membrane import Membrane
from lyra_petsc.terms.term import Elastic

Array = NDArray[np.float64]

EPSILON = 10.0 * float(np.finfo(np.float64).eps)
"""Relative round-off of a sum, as in `residual_roundoff`."""

MOST_PANELS = 16
"""Of the integral along the hinges' way."""

SAMPLES, WIDEST_TURN = 9, 1.0
"""Points of that way, and the turn [rad] between two of them beyond which a hinge may have jumped: one that
passes 180° changes its energy without a force, one whose triangle is turned over in its plane loses it and
has it back within a short way."""


Terms = Mapping[Elastic, Any]
"""Terms, and what each of them froze for the step."""


def gradient(terms: Terms, x: Array) -> Array:
    """Of the terms' energy at x (n_local, 3), [N]."""
    out = np.zeros_like(x)
    for term, frozen in terms.items():
        term.add_gradient(x, frozen, out)
    return out


def energy(terms: Terms, x: Array) -> float:
    """Of this rank's elements [J]."""
    return sum(float(term.energies(x, frozen).sum()) for term, frozen in terms.items())


def force_along(
    comm: MPI.Comm, n: int, terms: Terms, x0: Array, dx: Array, *, enough: float
) -> tuple[float, bool]:
    """∫₀¹ ∇E(x0 + s Δx)·Δx ds [J], and whether hinges had their part taken from energies; collective.

    Exact for the membrane, whose energy is a quartic along a line; refined until it stands for the rest.

    Parameters
    ----------
    n : int
        Owned vertices of this rank.
    terms : mapping of Elastic to what it froze for the step
    x0, dx : (n_local, 3)
        Where the way begins, and the way [m].
    enough : float
        Error [J] that does not matter.
    """
    smooth: Terms = {term: frozen for term, frozen in terms.items() if isinstance(term, Membrane)}
    bent = {term: frozen for term, frozen in terms.items() if term not in smooth}

    def integral(which: Terms, panels: int, points: int) -> float:
        return float(comm.allreduce(_panels(which, n, x0, dx, panels, points)))

    exact = integral(smooth, 1, 2)
    if not comm.allreduce(len(bent)):
        return exact, False
    if comm.allreduce(_widest_turn(bent, x0, dx), op=MPI.MAX) < WIDEST_TURN:
        panels, before = 1, integral(bent, 1, 5)
        while panels < MOST_PANELS:
            panels *= 2
            now = integral(bent, panels, 5)
            if abs(now - before) <= max(enough, EPSILON * abs(now)):
                return exact + now, False
            before = now
    return exact + float(comm.allreduce(energy(bent, x0 + dx) - energy(bent, x0))), True


def _panels(terms: Terms, n: int, x0: Array, dx: Array, panels: int, points: int) -> float:
    """This rank's part of the integral by Gauss's rule on equal panels."""
    if not terms:
        return 0.0
    nodes, weights = np.polynomial.legendre.leggauss(points)  # type: ignore[no-untyped-call]
    value = 0.0
    for panel in range(panels):
        for node, weight in zip(nodes, weights, strict=True):
            s = (panel + 0.5 * (1.0 + node)) / panels
            value += 0.5 * weight * float(np.vdot(gradient(terms, x0 + s * dx)[:n], dx[:n]))
    return value / panels


def _widest_turn(terms: Terms, x0: Array, dx: Array) -> float:
    """Largest change [rad] of a hinge's angle between two of `SAMPLES` points of the way."""
    widest = 0.0
    for term in terms:
        if isinstance(term, Bending):
            before = term.angles(x0)
            for s in np.linspace(0.0, 1.0, SAMPLES)[1:]:
                now = term.angles(x0 + s * dx)
                widest = max(widest, float(np.abs(now - before).max(initial=0.0)))
                before = now
    return widest
