"""Contact for people: loads on obstacles, numbers of pairs, and the parts that are nearest or stop a step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.contact.barrier import ContactBarrier
from lyra_petsc.contact.collisions import RefusedDisplacement
from lyra_petsc.contact.friction import CoulombFriction
from lyra_petsc.mesh.points import Layout, describe_worst
from lyra_petsc.terms.step_end import ContactImpulses
from lyra_petsc.terms.term import Term

TOUCHING = 2e-9
"""Gap over the skin of contact below which the gap counts as closed."""

TIGHT = 0.1
"""Gap over the skin below which the gap counts as nearly closed."""


@dataclass(frozen=True)
class NearPair:
    """Two parts of sheets, or a part of a sheet and an obstacle.

    Attributes
    ----------
    parts : tuple of tuples of int
        Vertices of each part of a sheet, by their numbers in the mesh: one of a vertex, two of an edge, three
        of a triangle.
    obstacle : str
        Name of the obstacle; empty between sheets.
    position : tuple of 3 floats
        Middle of the first part [m].
    gap, kept : float
        Distance minus the distance to keep, and the distance to keep [m].
    blocks : bool
        Whether the pair stops a step, or its gap is nearly closed.
    """

    parts: tuple[tuple[int, ...], ...]
    obstacle: str
    position: tuple[float, ...]
    gap: float
    kept: float
    blocks: bool

    @property
    def text(self) -> str:
        """Description of the pair and its position."""
        named = [_named(part) for part in self.parts]
        if self.obstacle:
            named.append(f"the obstacle {self.obstacle!r}")
        x, y, z = self.position
        return f"{' and '.join(named)}, around ({x:.4g}, {y:.4g}, {z:.4g}) m,"


class ContactReport:
    """Contact at positions in a step; every method but `obstacle_loads` is collective.

    Parameters
    ----------
    layout : Layout
    barrier : ContactBarrier
    friction : CoulombFriction or None
    x : (n_local, 3)
        Positions [m].
    frozen : mapping of Term
        Data of the terms in the step.
    """

    def __init__(
        self,
        layout: Layout,
        barrier: ContactBarrier,
        friction: CoulombFriction | None,
        x: Array,
        frozen: Mapping[Term, Any],
    ) -> None:
        self._layout, self._barrier, self._friction = layout, barrier, friction
        self._x, self._frozen, self._obstacles = x, frozen, frozen[barrier]
        self._skin = barrier.search.skin

    def obstacle_loads(self, impulses: ContactImpulses) -> Array:
        """Force [N] of this rank's pairs on each obstacle and symmetry plane in the last step, torque [N m]
        about the origin, and the sums over contacts of the magnitudes of normal force and friction [N],
        (obstacles, 8); not summed over ranks.
        """
        loads = self._barrier.obstacle_forces(self._x, self._obstacles)
        if self._friction is not None:
            loads += self._friction.obstacle_loads
        np.add.at(loads, impulses.obstacle, impulses.loads)
        return loads

    def normal_forces(self) -> Array:
        """Sum [N] of the normal forces at each owned vertex, (n_vertices,)."""
        out = np.zeros_like(self._x)
        out[:, 0] = self._barrier.normal_forces(self._x, self._obstacles)
        self._layout.add_to_owners(out)
        return out[: self._layout.n_vertices, 0].copy()

    def pairs(self) -> str:
        """Numbers of near pairs, and of those that act, as text."""
        terms = [term for term in (self._barrier, self._friction) if term is not None]
        acts = [
            np.count_nonzero(term.active_elements(self._x, self._frozen[term])[: term.n_owned])
            for term in terms
        ]
        known = [term.n_owned for term in terms]
        numbers = self._layout.global_sum(*acts, *known).astype(np.int64).tolist()
        parts = zip(terms, numbers, numbers[len(terms) :], strict=False)
        return ", ".join(f"{term.name} {n} of {of}" for term, n, of in parts)

    def iterate(self, step_fraction: float) -> str:
        """The line of ``-contact_monitor``, where ``step_fraction`` of the last Newton step was allowed.

        It has the number of contacts, the smallest gap [m], the stiffness [N/m] of the stiffest contact, and
        that fraction. With friction also the numbers of sticking and sliding pairs, and the sums of the
        normal forces [N] that friction takes (those at the start of the step) and of those at the iterate.
        """
        barrier, friction, x, obstacles = self._barrier, self._friction, self._x, self._obstacles
        here, stiffest = barrier.history(x, obstacles), barrier.largest_stiffness(x, obstacles)
        sums = [here["contacts"]]
        if friction is not None:
            sums += friction.count_sticking(x, self._frozen[friction])
            sums.append(float(barrier.find_contacts(x, obstacles.end).force.sum()))
        sums = self._layout.global_sum(*sums).tolist()
        extremes = np.array([stiffest, -here["smallest_gap"]])
        self._layout.comm.Allreduce(MPI.IN_PLACE, extremes, MPI.MAX)
        line = f"CONTACT {sums[0]:.0f} contacts, "
        if sums[0] > 0.0:
            line += f"smallest gap {-extremes[1]:.6e} m, stiffest {extremes[0]:.6e} N/m, "
        line += f"step limit {step_fraction:.4g}"
        if friction is not None:
            stick, slide, of_equations, now = sums[1:]
            line += f"; friction: {stick:.0f} stick, {slide:.0f} slide, "
            line += f"normal forces {of_equations:.6e} N, now {now:.6e} N"
        return line

    # -- pairs -------------------------------------------------------------------------------------

    def nearest(self, refused: RefusedDisplacement | None = None) -> NearPair | None:
        """The pair with the smallest gap, None where none is near; or the one that collides first on a
        displacement that was ``refused``.
        """
        if refused is None:
            return self._worst(self._x, self._nearness())
        steps = self._barrier.largest_steps(*refused)
        return self._worst(refused.x, 1.0 - steps[: self._barrier.n_owned], blocks=True)

    def nearest_obstacle(self) -> NearPair | None:
        """The nearest touching pair with an obstacle."""
        gaps = self._barrier.gaps(self._x, self._obstacles)
        touches = (gaps < 2.0 * self._skin) & (self._barrier.pairs.obstacle[: len(gaps)] >= 0)
        return self._worst(self._x, np.where(touches, self._nearness(), 0.0))

    def _nearness(self) -> Array:
        gaps = self._barrier.gaps(self._x, self._obstacles)
        return np.asarray(1.0 / np.maximum(gaps, TOUCHING * self._skin))

    def _worst(self, x: Array, badness: Array, *, blocks: bool = False) -> NearPair | None:
        """The pair with the largest positive badness (n_owned,) at positions x (n_local, 3), or None."""
        layout, barrier, skin = self._layout, self._barrier, self._skin
        if not layout.global_max(float(badness.max(initial=0.0)))[0] > 0.0:
            return None
        numbers = layout.mesh_vertex_of_local()
        first = numbers[barrier.stencil[: len(badness)]].min(axis=1)

        def describe(row: int) -> NearPair:
            pair, gap = barrier.pair(row), float(barrier.gaps(x, self._obstacles)[row])
            middle = tuple(float(value) for value in x[list(pair.parts[0])].mean(axis=0))
            gap = gap if gap > TOUCHING * skin else min(gap, 0.0)
            parts = tuple(tuple(int(numbers[point]) for point in part) for part in pair.parts)
            return NearPair(parts, pair.obstacle, middle, gap, pair.thickness, blocks or gap <= TIGHT * skin)

        return describe_worst(layout.comm, badness, first, describe)


def _named(part: tuple[int, ...]) -> str:
    if len(part) == 1:
        return f"vertex {part[0]}"
    numbers = sorted(part)
    return (
        f"edge {numbers[0]}-{numbers[1]}" if len(part) == 2 else f"the triangle {'-'.join(map(str, numbers))}"
    )
