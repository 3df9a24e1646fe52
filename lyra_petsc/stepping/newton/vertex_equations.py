"""A Jacobian for vertices only, for the coarse levels of multigrid where edges have unknowns, too.

Elimination of the edges' unknowns would couple distant vertices. The Jacobian of the same sheet with hinges
is used instead: the eliminated one lies between 0.23 and 1.67 times it, on any mesh. The smoother on all
unknowns reduces the error of the difference.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.stepping.forces import StageForces
from lyra_petsc.stepping.time_step import Evaluation
from lyra_petsc.terms.bending.director_rotations import DirectorRotations
from lyra_petsc.terms.bending.midedge import MidEdge
from lyra_petsc.terms.term import Coupling, Elastic, Viscous


class VertexEquations:
    """Block rows of a Jacobian for vertices; rows of edges are empty.

    Parameters
    ----------
    forces : StageForces
        Of a scene with terms in ``active.coarse``.
    evaluated : callable
        The stage evaluated last.
    lagged : bool
        Whether loads that depend on velocities are those at the start of a step.

    Attributes
    ----------
    pattern : BlockPattern
    turns : DirectorRotations
        The edges' unknowns as functions of the vertices.
    """

    def __init__(self, forces: StageForces, evaluated: Callable[[], Evaluation], *, lagged: bool) -> None:
        self._forces, self._evaluated, layout, active = forces, evaluated, forces.layout, forces.active
        self._bent = next(term for term in active.elastic if isinstance(term, MidEdge))
        self._elastic: list[Elastic] = [active.coarse.get(term, term) for term in active.elastic]
        self._viscous: list[Viscous] = [] if lagged else active.viscous
        couplings: dict[str, Coupling] = {}
        for term in (*self._elastic, *self._viscous):
            couplings |= term.couplings
        self._rows = BlockRows(BlockPattern(couplings, layout.n_owned, layout.n_local, layout.n_vertices))
        self.pattern = self._rows.pattern
        self.turns = DirectorRotations(self._bent, layout.n_owned)
        self._held_number = -1

    def _hold(self, held: Mask) -> None:
        """Set the data that depend on the prescribed unknowns ``held`` (n_local, 3)."""
        term = self._bent
        assert term.edges is not None
        self._constrained = self._rows.constrained_entries(held)
        self._clamped = np.nonzero(held.ravel()[term.edges] & (term.stencil < self.pattern.n_owned))
        self.turns.exclude(held)

    def values(self, held: Mask, memory: Array) -> Array:
        """Block rows (n_blocks, 3, 3) at the stage last evaluated, stored in ``memory``.

        Prescribed unknowns ``held`` (n_local, 3) are decoupled.
        """
        at, rows = self._evaluated(), self._rows
        x, step, stage = at.x, at.step, at.step.stage
        if (number := step.prescribed.number) != self._held_number:
            self._held_number = number
            self._hold(held)
        self.turns.update(x)
        values = memory[: 9 * self.pattern.n_blocks].reshape(-1, 3, 3)
        rows.set_diagonal(stage.sigma * self._forces.mass, values)
        for term in self._elastic:
            weight: Array | float = stage.c
            if self._forces.damps and term.registration.damped:
                weight = weight + term.elements.data["damping"]
            rows.add_stiffness(term, x, at.frozen.get(term), 1.0, weight, values)
        for wind in self._viscous:
            wind.add_hessian(at.v, at.frozen[wind], self.pattern.offsets, values)
        if held.any():
            self._add_clamps(x, stage.c, values)
            rows.constrain(values, held, self._constrained)
        return values

    def _add_clamps(self, x: Array, c: float, values: Array) -> None:
        """Add the bending stiffness of triangles at prescribed directors.

        It acts on the third corner, at its height over the edge. There are no hinges at the border, and
        without this stiffness a clamped sheet would rotate freely about its clamp.
        """
        term, data = self._bent, self._bent.elements.data
        triangle, corner = self._clamped
        opposite, tail, head = (x[term.stencil[triangle, (corner + k) % 3]] for k in range(3))
        edge = head - tail
        normal = np.cross(edge, opposite - tail)
        square = np.sum(normal * normal, axis=1)
        factor = data["stiffness"][triangle, np.array([0, 3, 5])[corner]] * c
        if self._forces.damps:
            factor *= 1.0 + data["damping"][triangle] / c
        # n nᵀ / height²
        factor *= np.divide(
            np.sum(edge * edge, axis=1), square**2, out=np.zeros_like(square), where=square > 0.0
        )
        blocks = factor[:, None, None] * normal[:, :, None] * normal[:, None, :]
        np.add.at(values, self.pattern.indptr[term.stencil[triangle, corner]], blocks)
