"""The geometric multigrid cycle, ``-pc_type python`` with the ``-pc_python_type`` of ``presets``.

A symmetric V cycle: one backward sweep of Gauss-Seidel before and one forward sweep after the coarser level.
From level ``-pc_mg_w_from`` on (1 is the next coarser than the mesh) three levels are visited twice, as in a
W cycle. One half of the matrix is stored, in single precision, and read twice a cycle. If edges carry
unknowns, vertices of the mesh are swept ``-pc_mg_vertex_sweeps`` times before and after, by default depending
on the bending stiffness (``edge_sweeps``).

Between ranks the sweeps are Jacobi, which diverges if strongly coupled unknowns belong to three or more
ranks. There the diagonal is increased as in the l1 smoothers of Baker, Falgout, Kolev and Yang (SIAM J. Sci.
Comput. 33, 2011), so that the cycle is positive definite on any number of ranks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.linear import failed_factors
from lyra_petsc.linear import gauss_seidel as sweeps
from lyra_petsc.linear.hierarchy import Hierarchy, Level
from lyra_petsc.linear.matrix import AssembledMatrix
from lyra_petsc.phases import SWEEP, TRANSFER

if TYPE_CHECKING:
    from lyra_petsc.linear.edge_sweeps import SweepsWithEdges

Floats = NDArray[np.float32]

MAX_TWICE = 3
"""Largest number of levels visited twice: each doubles the visits of coarser ones, where ranks mostly
wait."""

MAX_COUPLING = 0.9
"""Largest sum of a row's couplings to other ranks, relative to the diagonal blocks, without an increase."""


def _make_sweeps(level: Level) -> sweeps.BlockSweeps | SweepsWithEdges:
    pattern = level.pattern
    if pattern.edge_couplings is None:
        return sweeps.BlockSweeps(pattern)
    from lyra_petsc.linear.edge_sweeps import SweepsWithEdges  # only needed here

    return SweepsWithEdges(pattern, pattern.edge_couplings, level.memory)


class Smoother:
    """Smoothing on a level, and transfer to and from the next coarser one.

    Parameters
    ----------
    level : Level
    vertex_sweeps : int
        Sweeps over the vertices if edges carry unknowns; 0 chooses their number by the stiffness.

    Attributes
    ----------
    n_sweeps : int
        Sweeps before and after the coarser level.
    coarse_sweeps : tuple of int
        Sweeps that suit the next coarser level, and those below.
    b, x : (n_local, 3)
        Right-hand side and solution.
    """

    def __init__(self, level: Level, vertex_sweeps: int) -> None:
        pattern, points = level.pattern, level.points
        self.points, self.n_couplings = points, pattern.n_couplings
        self._rows = pattern.indptr, pattern.ends, pattern.columns
        self._with_ghosts = np.flatnonzero(pattern.ends < pattern.indptr[1:])
        self._turns, self._sweeps = level.turns, _make_sweeps(level)
        self.x, self.b = self._sweeps.x, self._sweeps.b
        self._vertex_sweeps, self.n_sweeps, self.coarse_sweeps = vertex_sweeps, 1, (1, 1)
        assert level.galerkin is not None
        self._coarse = level.galerkin.points
        start, parents, weights = level.galerkin.interpolation
        self._parents = start[: len(self._sweeps.r) + 1], parents, weights.astype(np.float32)
        self._all_parents = start, *self._parents[1:]
        self._transfer_flops = 6.0 * len(parents)
        self._free = np.ones((points.n_local, 3), dtype=np.float32)
        self._increased = np.empty(0, dtype=np.int64)  # rows with an increased diagonal
        self._increase = np.empty((0, 3, 3), dtype=np.float32)
        self._in_residual = np.empty((0, 3), dtype=np.float32)  # x for which the residual has the increase

    def set(self, values: Array, free: Array) -> None:
        """Set the block rows (n_blocks, 3, 3) and the free coordinates (n_owned, 3); collective."""
        values = values.reshape(-1, 9)
        self._sweeps.invert(values)
        if (inertia := self._sweeps.inertia(values)) is not None:
            self._choose_sweeps(inertia)
        self._increase_diagonal(values)
        self._sweeps.store(values)  # may overwrite ``values`` on the finest level
        self._free[: len(free)] = free
        self.points.update_ghosts(self._free)

    def _choose_sweeps(self, own: Array) -> None:
        """Choose more sweeps if bending is stiff compared with inertia, ``own`` (2,) here; collective."""
        from lyra_petsc.linear.edge_sweeps import SWEEPS  # only needed here

        inertia, stiffness = self.points.comm.allreduce(own)
        numbers = (numbers for bound, numbers in SWEEPS if inertia < bound * stiffness)
        n_sweeps, *coarse = next(numbers, (1, 1, 1))
        self.n_sweeps, self.coarse_sweeps = self._vertex_sweeps or n_sweeps, (coarse[0], coarse[1])

    def _increase_diagonal(self, values: Array) -> None:
        """Increase D so that D + Dᵀ − (couplings to other ranks) is positive definite; collective.

        With D = L Lᵀ a coupling C of rows i and j is bounded by n (xᵢᵀ Dᵢ xᵢ + xⱼᵀ Dⱼ xⱼ) / 2 with n =
        ‖Lᵢ⁻¹ C Lⱼ⁻ᵀ‖. If the sum of a row's n exceeds the limit, its diagonal block grows by half the excess.
        """
        if self.points.comm.size == 1:
            return
        packed = np.empty((self.points.n_local, 3))  # six float32 numbers a row, sent in one message
        roots = packed.view(np.float32)
        diagonal = self._sweeps.diagonal(values, self._with_ghosts)
        sweeps.invert_roots(self._with_ghosts, diagonal, roots)
        self.points.update_ghosts(packed)
        sums = np.empty(len(self._with_ghosts))
        sweeps.relative_couplings(self._with_ghosts, *self._rows, values, roots, sums)
        strong = np.flatnonzero(sums > MAX_COUPLING)
        self._increased = rows = self._with_ghosts[strong]
        if len(strong):
            growth = (sums[strong, None] - MAX_COUPLING) / 2.0
            self._sweeps.shrink(rows, 1.0 + growth)
            self._increase = (growth * diagonal[strong]).astype(np.float32).reshape(-1, 3, 3)
        self._in_residual = np.zeros((len(strong), 3), dtype=np.float32)

    def sweep_down(self, coarse: Floats, *, again: bool) -> None:
        """Sweep before the coarser level; ``coarse`` (n_local coarse, 3) = restricted residual; collective.

        Starts from zero, or again from the result of `sweep_up`.
        """
        if again:
            self._subtract_ghosts(np.zeros_like(self.x[self.points.n_owned :]))
        else:
            self.x[:] = 0.0
            self._sweeps.begin(self.b)
            self._in_residual[:] = 0.0
        ghosts = self.x[self.points.n_owned :].copy()
        with SWEEP:
            self._sweeps.backward(self.x)
            PETSc.Log.logFlops(self._sweeps.flops)
        self._subtract_ghosts(ghosts)
        for number in range(1, self.n_sweeps):
            ghosts = self.x[self.points.n_owned :].copy()
            with SWEEP:
                self._sweeps.backward_again(self.x, number)
                PETSc.Log.logFlops(self._sweeps.flops)
            self._subtract_ghosts(ghosts)
        with TRANSFER:
            if self._turns is not None:
                assert not isinstance(self._sweeps, sweeps.BlockSweeps)
                self._turns.mult_transpose_add(self._sweeps.of_edges, self._sweeps.r)
            sweeps.restrict(*self._parents, self._free, self._sweeps.r, coarse)
            PETSc.Log.logFlops(self._transfer_flops)
            self._coarse.add_to_owners(coarse)

    def _subtract_ghosts(self, old: Floats) -> None:
        """Update the ghosts, and the residual from their old values; collective."""
        if self.points.comm.size > 1:
            self.points.update_ghosts(self.x)
            ghosts = self.x[self.points.n_owned :]
            ghosts -= old
            self._sweeps.subtract_ghosts(self.x)
            ghosts += old
        if len(self._increased):
            change = self.x[self._increased] - self._in_residual
            self._sweeps.add(self._increased, np.einsum("nij,nj->ni", self._increase, change))
            self._in_residual = self._in_residual + change

    def sweep_up(self, coarse: Floats) -> None:
        """Add the coarser level's correction and sweep; collective.

        Ghosts are interpolated here as by their owners, without a message: `sweep_down` left them current.
        """
        with TRANSFER:
            self._coarse.update_ghosts(coarse)
            self._add_interpolated(coarse)
            PETSc.Log.logFlops(self._transfer_flops)
        for number in range(self.n_sweeps - 1, 0, -1):
            self._sweep_after(number)
            self.points.update_ghosts(self.x)
        self._sweep_after(0)

    def _sweep_after(self, number: int) -> None:
        rows = self._increased
        if len(rows):
            b, self._in_residual = self.b[rows], self.x[rows]
            self.b[rows] += np.einsum("nij,nj->ni", self._increase, self._in_residual)
        with SWEEP:
            self._sweeps.forward(self.b, self.x, number)
            PETSc.Log.logFlops(self._sweeps.flops)
        if len(rows):
            self.b[rows] = b

    def _add_interpolated(self, coarse: Floats) -> None:
        if self._turns is None:
            sweeps.add_interpolated(*self._all_parents, self._free, coarse, self.x)
        else:
            assert not isinstance(self._sweeps, sweeps.BlockSweeps)
            correction = self._sweeps.increment
            correction[:] = 0.0
            sweeps.add_interpolated(*self._all_parents, self._free, coarse, correction)
            self._turns.mult_add(correction)
            self.x += correction
        if self._sweeps.correct(self.x):
            self.points.update_ghosts(self.x)  # only owners know the corrections of edges


class Coarsest:
    """The coarsest level, solved by a KSP with the options prefix ``mg_coarse_``."""

    def __init__(self, level: Level) -> None:
        self.points, self.n_couplings = level.points, level.pattern.n_couplings
        self.matrix = AssembledMatrix(level.points, level.pattern, "aij", prefix="mg_coarse_")
        self.x, self.b = (np.zeros((level.points.n_local, 3), dtype=np.float32) for _ in range(2))
        self._solution, self._rhs = self.matrix.mat.createVecs()
        self._ksp = PETSc.KSP().create(level.points.comm)
        self._ksp.setOptionsPrefix("mg_coarse_")
        self._ksp.setType(PETSc.KSP.Type.PREONLY)
        self._ksp.setFromOptions()

    def set(self, values: Array, free: Array) -> None:
        """Set new block rows (n_blocks, 3, 3); collective."""
        failed_factors.replace_failed(self._ksp)
        self.matrix.set(values)
        self._ksp.setOperators(self.matrix.mat)

    def solve(self) -> None:
        """Solve for x; collective."""
        n = self.points.n_owned
        self._rhs.getArray()[:] = self.b[:n].ravel()
        self._ksp.solve(self._rhs, self._solution)
        self.x[:n] = self._solution.getArray().reshape(-1, 3)

    def view(self, viewer: PETSc.Viewer) -> None:
        """Show the solver; collective."""
        self._ksp.view(viewer)

    def destroy(self) -> None:
        """Free the PETSc objects; collective."""
        for item in (self._ksp, self.matrix, self._solution, self._rhs):
            item.destroy()


class VCycle:
    """Context of a PC of type ``python``, created by PETSc; ``attach`` gives it the levels."""

    def __init__(self) -> None:
        self._levels: list[Smoother | Coarsest] = []
        self._renew: Callable[[], Iterator[tuple[Array, Array]]] | None = None
        self._twice_from = self._vertex_sweeps = 0

    def setFromOptions(self, pc: PETSc.PC) -> None:
        """Read ``-pc_mg_w_from`` and ``-pc_mg_vertex_sweeps``."""
        options = PETSc.Options(pc.getOptionsPrefix())
        self._twice_from = options.getInt("pc_mg_w_from", 0)
        self._vertex_sweeps = max(0, options.getInt("pc_mg_vertex_sweeps", 0))

    def attach(self, hierarchy: Hierarchy, renew: Callable[[], Iterator[tuple[Array, Array]]]) -> None:
        """Set the levels, and the function that computes their current block rows; collective."""
        *finer, coarsest = hierarchy.levels
        self._levels = [*(Smoother(level, self._vertex_sweeps) for level in finer), Coarsest(coarsest)]
        self._renew = renew

    def setUp(self, pc: PETSc.PC) -> None:
        """Compute the levels' block rows, after the matrix has changed; collective.

        Raises
        ------
        InputError
            If this is part of another preconditioner, and has no levels.
        """
        if self._renew is None:
            prefix = pc.getOptionsPrefix() or ""
            raise InputError("works as the main preconditioner only", key=f"-{prefix}pc_python_type")
        finest = self._levels[0]
        for number, (level, rows) in enumerate(zip(self._levels, self._renew(), strict=True)):
            level.set(*rows)
            if number > 0 and isinstance(level, Smoother) and isinstance(finest, Smoother):
                level.n_sweeps = finest.coarse_sweeps[min(number, 2) - 1]

    def apply(self, pc: PETSc.PC, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """x = result of one cycle for b; collective."""
        finest, n = self._levels[0], b.getLocalSize() // 3
        finest.b[:n] = b.getArray(readonly=True).reshape(-1, 3)
        self._visit(0)
        result = finest.x[:n]
        if math.isfinite(float(np.vdot(result, result))):
            x.getArray()[:] = result.ravel()
        else:
            # sweeps of an indefinite matrix may diverge; with this result PETSc reports an indefinite PC
            x.getArray()[:] = -b.getArray(readonly=True)

    def _visit(self, number: int, *, again: bool = False) -> None:
        """Compute x of a level for its b, from zero or, if ``again``, from the present x; collective."""
        level, coarser = self._levels[number], number + 1
        if isinstance(level, Coarsest):
            level.solve()
            return
        coarse_level = self._levels[coarser]
        level.sweep_down(coarse_level.b, again=again)
        self._visit(coarser)
        if 0 < self._twice_from <= coarser < min(self._twice_from + MAX_TWICE, len(self._levels) - 1):
            self._visit(coarser, again=True)
        level.sweep_up(coarse_level.x)

    def view(self, pc: PETSc.PC, viewer: PETSc.Viewer) -> None:
        """For ``-ksp_view`` and ``-snes_view``."""
        if not self._levels:
            viewer.printfASCII("  no levels yet\n")
            return
        comm = self._levels[0].points.comm
        couplings = [comm.allreduce(level.n_couplings) for level in self._levels]
        twice = range(self._twice_from, min(self._twice_from + MAX_TWICE, len(self._levels) - 1))
        visited = [number for number in twice if self._twice_from > 0]
        kind = f"W (visits below {', '.join(map(str, visited))} twice)" if visited else "V"
        between = "" if comm.size == 1 else ", between ranks Jacobi with an increased diagonal"
        lines = [
            f"type is MULTIPLICATIVE, levels={len(couplings)} cycles={kind}, 0 is the finest",
            "Using Galerkin computed coarse grid matrices, in double precision",
            f"operator complexity = {sum(couplings) / couplings[0]:.4g}",
        ]
        for number, (level, n) in enumerate(zip(self._levels, couplings, strict=True)):
            unknowns = 3 * level.points.n_global
            lines.append(f"level {number}: rows={unknowns}, cols={unknowns}, bs=3, nonzeros={9 * n}")
            if isinstance(level, Smoother):
                lines += [
                    "  down: one backward sweep of block Gauss-Seidel, up: one forward sweep" + between,
                    *([f"  {level.n_sweeps} of each"] if level.n_sweeps > 1 else []),
                    "  one half of the matrix in single precision",
                ]
        for line in lines:
            viewer.printfASCII(f"  {line}\n")
        viewer.printfASCII("  coarse grid solver, in double precision:\n")
        viewer.pushASCIITab()
        coarsest = self._levels[-1]
        assert isinstance(coarsest, Coarsest)
        coarsest.view(viewer)
        viewer.popASCIITab()

    def destroy(self, pc: PETSc.PC) -> None:
        """Free the PETSc objects; collective."""
        self.detach()

    def detach(self) -> None:
        """Free the levels; collective."""
        for level in self._levels:
            if isinstance(level, Coarsest):
                level.destroy()
        self._levels, self._renew = [], None
