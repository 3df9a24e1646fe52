"""A flat sheet's bending, linear: the program's own element Hessians and assembled rows, out of plane.

A flat sheet at rest has no coupling between its plane and the direction across it, so that one unknown
per vertex, its height, is left. Everything here is gathered on every rank, in mesh order.

The stiffness of an endless strip or sheet comes from the hinges of one of its periodic cells: the height
is a quadratic with the mean curvatures plus a periodic part; the energy, least over the periodic part and
whatever curvature is left free, gives the effective stiffness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.experiments.bench import Trial, direct_solver
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.terms.bending import Bending
from lyra_petsc.terms.term import Elastic, UpcomingStep

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

BENDING_TERMS = ("bending", "clamp")


@dataclass(frozen=True)
class HingeBlocks:
    """Quadratic form of every hinge in the heights of its vertices.

    Attributes
    ----------
    stencil : (E, 4) int64
        Vertices of each hinge, numbered as the mesh.
    blocks : (E, 4, 4) float64
        [N/m]; the energy is ½ zᵀ block z.
    """

    stencil: Ints
    blocks: Array


def hinge_blocks(trial: Trial) -> HingeBlocks:
    """The bending term's Hessians at the start shape, each hinge once; collective."""
    problem = trial.simulation.problem
    term = next(term for term in problem.terms.values() if isinstance(term, Bending))
    n = term.n_owned
    slopes = _slopes(problem.system.x[term.stencil[:n], :2])
    blocks = 2.0 * term.elements.data["k"][:n, None, None] * slopes[:, :, None] * slopes[:, None, :]
    mine = (term.elements.index[:n], mesh_numbers(trial)[term.stencil[:n]], blocks)
    pieces = problem.points.comm.allgather(mine)
    index, stencils, blocks = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    order = np.argsort(index)
    return HingeBlocks(stencils[order], blocks[order])


def _slopes(corners: Array) -> Array:
    """∂θ/∂z (E, 4) [1/m] of flat hinges with corners (E, 4, 2) [m] as in ``terms.hinge``.

    At the opposite vertices it is −1 over their heights, at the ends of the edge what keeps a tilt free of
    angle.
    """
    edge = corners[:, 1] - corners[:, 0]
    length = np.linalg.norm(edge, axis=1)
    slopes = np.zeros((len(corners), 4))
    for opposite in (2, 3):
        side = corners[:, opposite] - corners[:, 0]
        inverse = length / np.abs(edge[:, 0] * side[:, 1] - edge[:, 1] * side[:, 0])
        along = (side * edge).sum(axis=1) / length**2
        slopes[:, opposite] = -inverse
        slopes[:, 0] += (1.0 - along) * inverse
        slopes[:, 1] += along * inverse
    return slopes


def mesh_numbers(trial: Trial) -> Ints:
    """Number in the mesh of every local vertex (n_local,); collective."""
    points = trial.simulation.problem.points
    of_global: Ints = np.concatenate(points.comm.allgather(points.original))
    return of_global[points.global_number]


@dataclass(frozen=True)
class Stiffness:
    """The assembled bending stiffness of a flat sheet in the heights of its vertices.

    Attributes
    ----------
    rows, columns : (n,) int64
        Vertices, numbered as the mesh.
    values : (n,) float64
        [N/m]
    held : (V,) bool
        Whether handles prescribe the height.
    """

    rows: Ints
    columns: Ints
    values: Array
    held: NDArray[np.bool_]

    def dense(self) -> Array:
        """The matrix of the free heights (n_free, n_free)."""
        size = len(self.held)
        full = np.zeros((size, size))
        full[self.rows, self.columns] = self.values
        free: Array = full[np.ix_(~self.held, ~self.held)]
        return free

    def solve(self, force: Array) -> Array:
        """Heights [m] (V,) under forces [N] (V,), by a direct solve on every rank."""
        free = np.flatnonzero(~self.held)
        number = np.full(len(self.held), -1, dtype=np.int64)
        number[free] = np.arange(len(free))
        inside = (number[self.rows] >= 0) & (number[self.columns] >= 0)
        rows, columns = number[self.rows[inside]], number[self.columns[inside]]
        order = np.lexsort((columns, rows))
        start = np.searchsorted(rows[order], np.arange(len(free) + 1))
        matrix = PETSc.Mat().createAIJ(
            (len(free), len(free)),
            csr=(
                start.astype(PETSc.IntType),
                columns[order].astype(PETSc.IntType),
                self.values[inside][order],
            ),
            comm=PETSc.COMM_SELF,
        )
        right, left = matrix.createVecs()
        right.setArray(force[free])
        solver = direct_solver(MPI.COMM_SELF, matrix, "verify_sheet_")
        solver.solve(right, left)
        height = np.zeros(len(self.held))
        height[free] = left.getArray()
        for made in (solver, matrix, right, left):
            made.destroy()
        return height


def stiffness(trial: Trial) -> Stiffness:
    """Bending and clamps of the start shape, assembled by the program; collective."""
    problem = trial.simulation.problem
    system, pattern, points = problem.system, problem.pattern, problem.points
    rows = BlockRows(pattern)
    values = rows.zeros()
    for name in BENDING_TERMS:
        term = problem.terms.get(name)
        if isinstance(term, Elastic):
            frozen = term.freeze(UpcomingStep(0.0, 1.0, 1.0, system.x, system.reference.at))
            rows.add_stiffness(term, system.x, frozen, 0.0, 1.0, values)
    values, pattern = pattern.in_blocks(values), pattern.whole
    numbers = mesh_numbers(trial)
    row, column = np.repeat(np.arange(points.n_owned), np.diff(pattern.indptr)), pattern.columns
    height = np.ascontiguousarray(values[:, 2, 2])
    upper = (row < column) & (column < points.n_owned)
    pieces = points.comm.allgather(
        (
            numbers[np.concatenate([row, column[upper]])],
            numbers[np.concatenate([column, row[upper]])],
            np.concatenate([height, height[upper]]),
        )
    )
    all_rows, columns, all_values = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    held = trial.gather(system.held.mask(0.0, 1.0, points.n_owned)[:, 2].astype(np.float64)) > 0.5
    return Stiffness(all_rows, columns, all_values, held)


OFF_THE_LINES = 0.0917
"""Where a cell begins, as a part of it: no hinge lies on its border."""


def strip_stiffness(hinges: HingeBlocks, points: Array, start: float, period: float, width: float) -> float:
    """B_effective [N·m] of a strip along x with free edges: moment per width over curvature.

    Lateral curvature, twist and the heights of the vertices relax.

    Parameters
    ----------
    hinges : HingeBlocks
    points : (V, 2) float64
        Vertices at rest [m].
    start, period : float [m]
        The cell begins at ``start``, far enough from the ends of the strip that none of its hinges is
        missing, and repeats after ``period``.
    width : float [m]
    """
    x, y = points.T
    shapes = np.stack([0.5 * x**2, x * y], axis=1)
    lattice = np.array([[period], [0.0]])
    energy = _relaxed(hinges, points, shapes, np.linalg.pinv(lattice), np.array([start / period]))
    bent = energy[0, 0] - energy[0, 1] ** 2 / energy[1, 1]
    return float(bent / (period * width))


def sheet_stiffness(
    hinges: HingeBlocks, points: Array, start: Sequence[float], lattice: Array, relaxed: bool = True
) -> Array:
    """D (3, 3) [N·m] of an endless sheet: energy per area ½ κᵀ D κ with κ = (κ11, κ22, 2 κ12).

    Parameters
    ----------
    hinges : HingeBlocks
    points : (V, 2) float64
        Vertices at rest [m].
    start : (2,)
        Where the cell begins, in lattice coordinates.
    lattice : (2, 2) float64
        The two periods [m], as columns.
    relaxed : bool
        False leaves the vertices on the quadratic.
    """
    x, y = points.T
    shapes = np.stack([0.5 * x**2, 0.5 * y**2, 0.5 * x * y], axis=1)
    energy = _relaxed(hinges, points, shapes, np.linalg.inv(lattice), np.asarray(start), relaxed)
    area: float = abs(float(np.linalg.det(lattice)))
    return energy / area


def _relaxed(
    hinges: HingeBlocks, points: Array, shapes: Array, to_cell: Array, start: Array, relaxed: bool = True
) -> Array:
    """Quadratic form (m, m) of a cell's energy in the amplitudes of ``shapes`` (V, m).

    ``to_cell`` (d, 2) maps positions to lattice coordinates.
    """
    cell = points @ to_cell.T - start - OFF_THE_LINES
    middle = 0.5 * (cell[hinges.stencil[:, 0]] + cell[hinges.stencil[:, 1]])
    inside = ((middle >= 0.0) & (middle < 1.0)).all(axis=1)
    stencil, blocks = hinges.stencil[inside], hinges.blocks[inside]
    # vertices that differ by a period have the same periodic part
    lattice = np.linalg.pinv(to_cell)
    folded = points - (np.floor(cell) @ lattice.T)
    _, kind = np.unique(np.round(folded, 9), axis=0, return_inverse=True)
    kind = kind.reshape(-1)
    n = int(kind.max()) + 1
    size = shapes.shape[1]
    form = np.zeros((size + n, size + n))
    for vertices, block in zip(stencil, blocks, strict=True):
        heights = np.zeros((4, size + n))
        heights[:, :size] = shapes[vertices]
        np.add.at(heights, (np.arange(4), size + kind[vertices]), 1.0)
        form += heights.T @ block @ heights
    if not relaxed:
        return form[:size, :size]
    coupling, periodic = form[:size, size:], form[size:, size:]
    energy: Array = form[:size, :size] - coupling @ np.linalg.pinv(periodic, rcond=1e-9) @ coupling.T
    return energy
