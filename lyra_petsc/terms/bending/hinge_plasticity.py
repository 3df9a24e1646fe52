"""Plastic bending of hinges: what a hinge does beyond its yield angle.

A material with the hardening h has hinges of the stiffness h k (``hinge``) beside which act elements of the
stiffness (1 − h) k with a bounded moment, those of ``coulomb``: elastic up to the yield angle θ_y, and
sliding beyond. Together they have the stiffness k, and h k after yield, in a loop of kinematic hardening.
θ_y is the curvature κ_y times half the sum of the two heights on the edge: a hinge whose edge lies across the
bending has the moment B κ_y [N m/m] there.

Source: J. C. Simo, T. J. R. Hughes, Computational Inelasticity, Springer 1998, ch. 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import Any, Self

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.bending.hinge import Bending, whole_hinges
from lyra_petsc.terms.coulomb import FrictionLimits
from lyra_petsc.terms.protocols import Place, TermState, Yields
from lyra_petsc.terms.rest import RestShape


class PlasticAngles(Yields):
    """Angles that slide beyond a yield angle: the state of hinges and clamps that bend plastically.

    Parameters
    ----------
    elements : Elements
        With data ``k`` (E,) [N·m] of the energy k θ² before yield, ``rest_angle`` and ``yield_angle`` (E,)
        [rad], ``slid_share`` (E,) fraction of the stiffness that yields.

    Attributes
    ----------
    bent : (E,)
        Angles [rad] to which the elements have slid.
    """

    elements: Elements

    def _start(self, elements: Elements) -> None:
        """Set limits and state; called by subclasses."""
        k, yield_angle = elements.data["k"], elements.data["yield_angle"]
        self.limits = FrictionLimits(2.0 * k * yield_angle, yield_angle)
        self.bent: Array = elements.data["rest_angle"].copy()

    def angles_at(self, x: Array, frozen: Any) -> Array:
        """Angles (E,) [rad] at positions x (n_local, 3)."""
        raise NotImplementedError

    def law_at(self, angles: Array, convexity: float | None) -> tuple[Array, Array]:
        """The result of `Bending.law` at ``angles`` (E,)."""
        u = angles - self.bent
        k, c = self.limits.parabola(u) if convexity is None else self.limits.tangent(u, convexity)
        return k, angles - c

    def at_limits(self, *, yields: bool) -> Self:
        other = copy(self)
        other.limits = self.limits.moved(yields=yields)
        return other

    def initialise(self, x: Array) -> None:
        """The angles of the start, as far as they are beyond the yield angle."""
        raise NotImplementedError

    @property
    def plastic_angles(self) -> Array:
        """Angles (E,) [rad], less those of rest, that remain where no moments act."""
        return self.elements.data["slid_share"] * (self.bent - self.elements.data["rest_angle"])

    def accept(self, x: Array, frozen: Any) -> None:
        self.bent = self.bent + self.limits.slid(self.angles_at(x, frozen) - self.bent)

    def heat(self, x: Array, frozen: Any) -> float:
        before, bent = float(self.energies(x, frozen).sum()), self.bent
        self.accept(x, frozen)
        after = float(self.energies(x, frozen).sum())
        self.bent = bent
        return before - after

    def state(self) -> dict[str, TermState]:
        return {"bent": TermState(Place.ELEMENT, self.bent[:, None])}

    def restore(self, values: Mapping[str, Array], x: Array) -> None:
        self.bent = values["bent"][:, 0].copy()


class HingePlasticity(PlasticAngles, Bending):
    """The hinges that may yield; parameters as of `Bending` and `PlasticAngles`."""

    def __init__(self, elements: Elements) -> None:
        super().__init__(elements)
        self._start(elements)

    def angles_at(self, x: Array, frozen: Any) -> Array:
        return self.angles(x, frozen)

    def law(self, angles: Array, convexity: float | None = None) -> tuple[Array, Array]:
        return self.law_at(angles, convexity)

    def initialise(self, x: Array) -> None:
        self.accept(x, None)


def elements(rest: RestShape) -> Elements:
    """The hinges whose material yields (rank 0)."""
    hinges, triangle = whole_hinges(rest)
    return yielding(hinges, triangle, rest, hinges.data["rest_height"])


def yielding(hinges: Elements, triangle: Ints, rest: RestShape, height: Array) -> Elements:
    """Those ``hinges`` whose material, that of ``triangle`` (E,), yields, with the stiffness that is lost.

    ``height`` (E,) [m] is the sum of the two heights on the edge of each.
    """
    curvature = rest.per_triangle("yield_curvature")[triangle]
    rows = np.flatnonzero(np.isfinite(curvature))
    data = {name: values[rows] for name, values in hinges.data.items()}
    data["slid_share"] = 1.0 - rest.per_triangle("elastic_share")[triangle[rows]]
    data["k"] = data["k"] * data["slid_share"]
    data["yield_angle"] = 0.5 * curvature[rows] * height[rows]
    return Elements(hinges.stencil[rows], data)


def make(elements: Elements, scene: Scene, mass: Array) -> HingePlasticity:
    """The term on one rank."""
    return HingePlasticity(elements)
