"""A flat sheet's bending, linear: the program's own element Hessians and assembled rows, out of plane.

A flat sheet at rest has no coupling between its plane and the direction across it, so that one unknown
per vertex, its height, is left. Everything here is gathered on every rank, in mesh order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.assembly.blocks import BlockRows, Fill
from lyra_petsc.terms.term import Elastic
from lyra_petsc.verification.bench import Trial

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
    model = trial.simulation.model
    term = model.bending
    n = term.n_owned
    out = np.empty((n, 4, 4, 3, 3))
    term.hessians(model.system.x, 0, n, 0.0, out)
    stencil = mesh_numbers(trial)[term.stencil[:n]]
    mine = (term.elements.index[:n], stencil, np.ascontiguousarray(out[:, :, :, 2, 2]))
    pieces = model.points.comm.allgather(mine)
    index, stencils, blocks = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    order = np.argsort(index)
    return HingeBlocks(stencils[order], blocks[order])


def mesh_numbers(trial: Trial) -> Ints:
    """Number in the mesh of every local vertex (n_local,); collective."""
    points = trial.simulation.model.points
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
        solver = PETSc.KSP().create(PETSc.COMM_SELF)
        solver.setOperators(matrix)
        solver.setType(PETSc.KSP.Type.PREONLY)
        solver.getPC().setType(PETSc.PC.Type.LU)
        solver.solve(right, left)
        height = np.zeros(len(self.held))
        height[free] = left.getArray()
        for made in (solver, matrix, right, left):
            made.destroy()
        return height


def stiffness(trial: Trial) -> Stiffness:
    """Bending and clamps of the start shape, assembled by the program; collective."""
    model = trial.simulation.model
    system, pattern, points = model.system, model.pattern, model.points
    rows = BlockRows(pattern)
    values = rows.zeros()
    for name in BENDING_TERMS:
        term = model.terms.get(name)
        if isinstance(term, Elastic):
            term.prepare(0.0, 1.0, 1.0)
            rows.add(term.offsets_of_elements(pattern.offsets), _filled_by(term, system.x), 1.0, values)
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


def _filled_by(term: Elastic, x: Array) -> Fill:
    return lambda lo, hi, out: term.hessians(x, lo, hi, 0.0, out)
