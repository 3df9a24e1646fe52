"""Stability of an equilibrium: the inertia of the exact Hessian on the free unknowns, and the unstable mode.

The Hessian is that of all energies, plus the symmetric part of the stiffness of loads that follow the shape.
Unknowns of edges need no special treatment: if their block is positive definite, the negative pivots are
those of the Schur complement on the vertices.

Elements that have yielded in the last step have the stiffness of yielding further, as in the energy that was
minimised. Those at their limit that have not have that of unloading; if motions have a negative stiffness
where they let these yield further, the stability is not known. A positive one is Hill's sufficient condition
for stability, with his linear comparison solid.

Sources: R. Hill, Journal of the Mechanics and Physics of Solids 6 (1958) 236-249; H. Petryk, ibid. 39 (1991)
691-711 (minima of incremental energies).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.linear.inertia import Inertia, Pivots
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.statics.following_loads import FollowingLoads
from lyra_petsc.stepping.statics.rigid_motions import rigid_motions
from lyra_petsc.terms.membrane import Membrane
from lyra_petsc.terms.protocols import Yields
from lyra_petsc.terms.term import Load, Viscous

MAX_VERTICES = 200_000
"""Number of vertices above which no factors are computed."""

LOADS = 1e-9
"""Relative accuracy of the stiffness of loads, which is one of finite differences."""

GIVES_WAY = "it holds where what has yielded unloads, and gives way where that yields further"

MIN_BENDING = 0.5
"""A mode with less than this fraction on vertices with bending stiffness is a wrinkle."""


@dataclass(frozen=True)
class Stability:
    """Stability of an equilibrium by the pivots of its Hessian.

    Attributes
    ----------
    stable : bool or None
        Whether all motions but rigid ones have a positive stiffness; None: not known.
    negative, neutral, rigid : int or None
        As `Pivots`.
    reason : str
        Why the stability is not known.
    """

    stable: bool | None = None
    negative: int | None = None
    neutral: int | None = None
    rigid: int | None = None
    reason: str = ""

    @classmethod
    def of(cls, pivots: Pivots) -> Stability:
        """By the pivots: unknown if no stiffness is negative, but round-off hides that of some motions."""
        count, reason = pivots.neutral, ""
        if count and not pivots.negative:
            motions = "1 motion" if count == 1 else f"{count} motions"
            reason = f"nothing resists {motions} beyond round-off (neutral pivots)"
        stable = None if reason else pivots.negative == 0
        return cls(stable, pivots.negative, pivots.neutral, pivots.rigid, reason)

    @property
    def content(self) -> dict[str, Any]:
        """Entries of summary.json."""
        return {
            "stable": self.stable,
            "negative_pivots": self.negative,
            "neutral_pivots": self.neutral,
            "rigid_motions": self.rigid,
        } | ({"stability_unknown": self.reason} if self.reason else {})


def add_exact_hessian(equations: StageEquations, values: Array, *, yielding: bool = False) -> FollowingLoads:
    """Add the exact Hessian [N/m] of all energies at the state to block rows (n_blocks, 3, 3).

    The symmetric part of the stiffness of loads that follow the shape, which are returned, is added, too.
    Prescribed unknowns are not decoupled. Elements at their limits unload, or yield further.
    """
    rows, active, here = equations.discretisation.rows, equations.active, equations.here()
    for term in active.elastic:
        law = term.at_limits(yields=yielding) if isinstance(term, Yields) else term
        rows.add_stiffness(law, here.x, here.frozen[term], 0.0, 1.0, values)

    def force_of(term: Load | Viscous, x: Array, out: Array) -> None:
        """Add the force [N] of a load, or of the wind on a sheet at rest, at positions x."""
        step = equations.targets_at(equations.step.end, x)
        if isinstance(term, Load):
            term.add_force_on_vertices(step, out)
        else:
            against = np.zeros_like(out)
            term.add_gradient(np.zeros_like(x), term.freeze(step), against)
            out -= against

    following = [*active.following, *active.viscous]
    loads = FollowingLoads(following, equations.x, force_of)
    loads.add_hessian(1.0, rows.pattern, values)
    return loads


class Examination:
    """Examination of the present equilibrium; a context that holds the factors of its Hessian; collective.

    Parameters
    ----------
    equations : StageEquations
    size : float
        Diagonal of the mesh's bounding box [m].
    """

    def __init__(self, equations: StageEquations, size: float) -> None:
        self._equations, self._size, self._reason, points = equations, size, "", equations.points
        self._inertia: Inertia | None = None
        if not PETSc.Sys.hasExternalPackage("mumps"):
            self._reason = "this PETSc has no MUMPS, whose factors give the inertia"
        elif points.n_vertices_global > MAX_VERTICES:
            self._reason = (
                f"{points.n_vertices_global} vertices are more than the {MAX_VERTICES} "
                "that factors are made for"
            )
        else:
            self._inertia = self._assemble()

    def _assemble(self, *, yielding: bool = False) -> Inertia:
        equations, points, size = self._equations, self._equations.points, self._size
        n = points.n_owned
        equations.update_pattern()
        values = equations.discretisation.rows.zeros()
        loads = add_exact_hessian(equations, values, yielding=yielding)
        held, unbalanced = equations.step.prescribed.mask, equations.out_of_balance()
        sheet = next(term for term in equations.active.elastic if isinstance(term, Membrane))
        rigid = rigid_motions(points, sheet.stencil, equations.x, held, size)
        square = points.global_sum(float(np.vdot(unbalanced, unbalanced)))[0]
        force = float(np.sqrt(square)) + LOADS * equations.forces.largest_force()
        # forces f at vertices turned by an angle θ do the work ½ θ² f · x, at most
        doubt = force * float(np.sqrt(points.n_vertices_global)) / size
        skew = np.array([np.where(held[:n], 0.0, -loads.skew_force(motion, n)) for motion in rigid])
        pattern, dense = equations.discretisation.rows.pattern, equations.forces.dense_part(equations.here())
        if dense is not None:
            dense = replace(dense, weights=dense.weights / equations.step.stage.c)
        return Inertia(points, pattern, values, held, rigid, skew, doubt, dense)

    @cached_property
    def stability(self) -> Stability:
        """Stability of the equilibrium; collective."""
        if self._inertia is None:
            return Stability(reason=self._reason)
        pivots = self._inertia.pivots()
        if pivots is None:
            return Stability(reason="there is no memory for the factors")
        stability = Stability.of(pivots)
        if stability.stable and any(isinstance(term, Yields) for term in self._equations.active.elastic):
            return self._where_it_yields(stability)
        return stability

    def _where_it_yields(self, stability: Stability) -> Stability:
        """Whether an equilibrium that is stable if it unloads remains so if it yields further; collective."""
        comparison = self._assemble(yielding=True)
        pivots = comparison.pivots()
        comparison.destroy()
        if pivots is None or not pivots.negative:
            return stability
        return replace(stability, stable=None, reason=GIVES_WAY)

    def solve(self, force: Array) -> Array | None:
        """Displacement (n_owned, 3) [m] for a force (n_owned, 3) [N] by the exact Hessian; collective.

        None if there are no factors.
        """
        return None if self._inertia is None else self._inertia.solve(force)

    def lowest_mode(self) -> Array | None:
        """An unstable mode (n_owned, 3) of length one, or None; after ``stability``; collective."""
        assert self._inertia is not None
        return self._inertia.lowest_mode()

    def is_wrinkle(self, mode: Array) -> bool:
        """Whether a mode is mostly on vertices without bending stiffness."""
        equations = self._equations
        stiff = np.zeros(equations.points.n_local, dtype=bool)
        for term in equations.active.elastic:
            if term.registration.bends:
                stiff[term.stencil] = True
        n = equations.points.n_vertices
        square = (mode[:n] ** 2).sum(axis=1)
        on_stiff, total = equations.points.global_sum(float(square[stiff[:n]].sum()), float(square.sum()))
        return bool(on_stiff < MIN_BENDING * total)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        """Free the factors; collective."""
        if self._inertia is not None:
            self._inertia.destroy()
            self._inertia = None
