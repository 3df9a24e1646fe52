"""The matrices of Newton's linear systems: the Jacobian, and the matrix its preconditioner is built from.

While the exact Hessian may be indefinite, the preconditioner is built from the regularised one. It then stays
positive definite, and conjugate gradients meet negative curvature only if the Hessian has it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.linear import multigrid, presets
from lyra_petsc.linear.hierarchy import Hierarchy, InterpolationRows, Surface, interpolations
from lyra_petsc.linear.matrix import AssembledMatrix, BlockMatrix, Matrix
from lyra_petsc.linear.multigrid import Multigrid
from lyra_petsc.linear.petsc_options import is_set
from lyra_petsc.linear.pivots import is_incomplete, shows_negative_curvature
from lyra_petsc.phases import JACOBIAN_AGAIN, logged
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.time_step import Evaluation

MIN_SHIFT, MAX_SHIFT = 0.01, 1.0
"""Fractions of the diagonal blocks."""

GROWTH, DECAY = 4.0, 0.9
"""Factors on the shift after indefinite factors, and from step to step."""

INDEFINITE = (
    PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_PC,
    PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED,
)


class DiagonalShift:
    """The fraction by which diagonal blocks are enlarged before a matrix is factored incompletely.

    Incomplete factors of a positive-definite matrix may be indefinite. With a larger diagonal they are
    definite, but approximate the matrix less well (Manteuffel, Math. Comp. 34, 1980, 473-497). The shift is
    kept as small as definite factors allow.

    Parameters
    ----------
    ksp : PETSc.KSP
    enabled : bool
        Whether the preconditioner is built from a matrix of its own.
    """

    def __init__(self, ksp: PETSc.KSP, *, enabled: bool) -> None:
        self._ksp, self._enabled = ksp, enabled
        self._value = MIN_SHIFT

    @property
    def value(self) -> float:
        """Fraction by which diagonal blocks are to be larger; 0 where nothing is factored incompletely."""
        return self._value if self._enabled and is_incomplete(self._ksp.getPC()) else 0.0

    def saved_state(self) -> dict[str, float]:
        """Entries of a checkpoint, for `restore`."""
        return {"shift": self._value}

    def restore(self, saved: Mapping[str, float]) -> None:
        """Restore a `saved_state`."""
        self._value = saved["shift"]

    def decrease(self) -> None:
        """Try a slightly smaller shift in a new step."""
        self._value = max(MIN_SHIFT, DECAY * self._value)

    def increase(self) -> bool:
        """Increase the shift if the last solve failed because of the factors; whether that may help."""
        failed = self._ksp.getConvergedReason() in INDEFINITE
        if not failed or self.value == 0.0 or self._value >= MAX_SHIFT:
            return False
        self._value = min(MAX_SHIFT, GROWTH * self._value)
        return True


SET_UP = 8.0
"""Cost of a preconditioner's set-up in linear iterations: about ten for incomplete factors, fewer for block
Jacobi."""

SAME_STEP = 1.25
"""Factor by which the time step may differ from that of the set-up."""


class Reuse:
    """Decides when to reuse a preconditioner in steps of one linear solve (``semi-implicit``).

    It is reused until a solve takes more iterations than the solves with it on average, its set-up counted
    as `SET_UP` iterations: from there on the average would grow. The next step then sets up a new one, as
    after a change of the time step or of the prescribed unknowns. The decision depends on numbers of
    iterations, which are the same on all ranks.

    Parameters
    ----------
    enabled : bool
        Whether to reuse at all; else every solve sets up its own.

    Attributes
    ----------
    reused : bool
        Whether the last solve used the preconditioner of an earlier step.
    """

    def __init__(self, *, enabled: bool) -> None:
        self._enabled = enabled
        self._for: tuple[float, int] | None = None
        self.reused = False
        self.discard()

    def discard(self) -> None:
        """Make the next solve set up its own preconditioner."""
        self._solves, self._iterations = 0, SET_UP

    def begin_solve(self, equations: StageEquations) -> bool:
        """Whether the next solve reuses the present preconditioner."""
        reach, held = equations.step.stage.c, equations.step.prescribed.number
        if self._for is None or self._for[1] != held or not _similar(reach, self._for[0]):
            self.discard()
        self.reused = self._enabled and self._solves > 0
        if not self.reused:
            self._for = reach, held
        return self.reused

    def end_solve(self, iterations: int) -> None:
        """Note the number of linear iterations of a solve."""
        self._solves += 1
        self._iterations += iterations
        if iterations * self._solves > self._iterations:
            self.discard()


def _similar(step: float, other: float) -> bool:
    return other / SAME_STEP < step < other * SAME_STEP


class LinearSystem:
    """Operator and preconditioning matrix of one KSP, updated as stencils change; collective.

    Parameters
    ----------
    equations : StageEquations
    surface : Surface
        The surface of which multigrid's coarse meshes are made.
    preset : str
        Name of the linear solver whose options are set.
    hessian : str
        The scene's ``solver.hessian``.
    iterates : bool
        Whether a step is more than one linear solve.

    Attributes
    ----------
    operator, preconditioner : Matrix
        The two may be the same object.
    cycles : bool
        Whether the preconditioner is a cycle of the program's multigrid.
    factors : bool
        Whether the preconditioner is a complete factorisation.
    kept_preconditioner, uses_operator : bool
        Whether the preconditioner was kept from the last iteration, and whether the operator is its matrix.
    reuse : Reuse
    """

    def __init__(
        self, equations: StageEquations, surface: Surface, preset: str, hessian: str, *, iterates: bool
    ) -> None:
        self._equations, self._surface, self._preset = equations, surface, preset
        self._iterates = iterates
        direct = PETSc.Options().getString("ksp_type", "cg") == PETSc.KSP.Type.PREONLY
        # Eisenstat's trick multiplies by the operator, and needs its entries
        self._one_matrix = PETSc.Options().getString("pc_type", "") == PETSc.PC.Type.EISENSTAT
        # else the preconditioner is built from the operator's own values
        self._regularised = iterates and hessian != "regularised" and not direct and not self._one_matrix
        self._shifts = not direct
        self.factors = PETSc.Options().getString("pc_type", "") in ("cholesky", "lu")
        if equations.active.summing and (direct or self._one_matrix):
            raise InputError(
                "needs all entries of the matrix, but those of an enclosed volume are only in products; "
                "take -ksp_type cg -pc_type cholesky",
                key="-ksp_type" if direct else "-pc_type",
            )
        self.cycles = multigrid.is_requested()
        # multigrid set up for earlier positions takes many more iterations
        asked = is_set("snes_lag_preconditioner")
        new = iterates or self.factors or direct or self._one_matrix or self.cycles or asked
        self.reuse = Reuse(enabled=not new)
        self._interpolations: list[InterpolationRows] | None = None
        self._multigrid: Multigrid | None = None
        self._ksp: PETSc.KSP | None = None
        self.begin_solve()
        self._create()

    def _create(self) -> None:
        discretisation = self._equations.discretisation
        self._equations.update_pattern()  # stencils may have changed since the last matrix
        self._is_empty = True  # whether the preconditioner's new matrix has no values yet
        self._rows = discretisation.rows
        layout, pattern = discretisation.layout, discretisation.rows.pattern
        kind = presets.matrix_type(self._preset)
        self.operator: Matrix
        self.preconditioner: Matrix
        dense = bool(self._equations.active.summing)  # which only products apply
        if (is_set("mat_type") and not dense) or self._one_matrix:
            self.operator = AssembledMatrix(layout, pattern, kind)
        else:
            self.operator = BlockMatrix(layout, pattern, self._block_summary)
        self.preconditioner = self.operator
        if self.cycles:
            spare = self._regularised or isinstance(self.operator, AssembledMatrix)
            hierarchy = self._hierarchy(spare=spare)
            if spare:
                summary = self._block_summary
                entries = None if hierarchy.rows is None else hierarchy.entries
                self.preconditioner = BlockMatrix(layout, pattern, summary, hierarchy.rows, entries)
            assert isinstance(self.preconditioner, BlockMatrix)
            self._multigrid = Multigrid(
                self.preconditioner, hierarchy, held=lambda: self._equations.step.prescribed.mask
            )
        elif (
            self._regularised or isinstance(self.operator, BlockMatrix) or self._preset in presets.INCOMPLETE
        ):
            diagonal = PETSc.Options().getString("pc_type", "") in presets.READS_DIAGONAL
            self.preconditioner = AssembledMatrix(
                layout, pattern, "baij" if diagonal else kind, diagonal=diagonal
            )

    def _block_summary(self) -> list[str]:
        """Lines of text on the blocks that near pairs add to the matrix."""
        equations, discretisation = self._equations, self._equations.discretisation
        if equations.contact is None:
            return []
        numbers = [rows.pattern.n_couplings for rows in (discretisation.fixed, discretisation.rows)]
        fixed, every = equations.points.global_sum(*numbers).astype(np.int64)
        pairs = equations.contact.report(equations.evaluated.x, equations.step.frozen).pairs()
        return [f"blocks: {fixed} of the mesh, {every - fixed} of pairs that act ({pairs})"]

    def _hierarchy(self, *, spare: bool) -> Hierarchy:
        discretisation = self._equations.discretisation
        rows = self._interpolations
        if rows is None:
            rows = interpolations(discretisation.layout, self._surface, multigrid.max_levels())
        if discretisation.stencils_change:
            self._interpolations = rows
        vertex_matrix = None
        if self._equations.active.coarse and not discretisation.stencils_change:
            from lyra_petsc.stepping.newton.vertex_equations import (
                VertexEquations,  # needed with edge unknowns only
            )

            equations = self._equations
            vertex_matrix = VertexEquations(
                equations.forces, lambda: equations.evaluated, lagged=equations.integrator.lagged_loads
            )
        return Hierarchy(discretisation.layout, discretisation.rows.pattern, rows, vertex_matrix, spare=spare)

    def attach(self, ksp: PETSc.KSP) -> None:
        """Attach to a KSP whose options are set."""
        self._ksp = ksp
        self.shift = DiagonalShift(ksp, enabled=self._shifts and self.preconditioner is not self.operator)
        if self._multigrid is not None:
            self._multigrid.attach(ksp)

    def update_pattern(self) -> bool:
        """Create new matrices if stencils have changed the pattern; whether they did."""
        discretisation = self._equations.discretisation
        if not self._equations.update_pattern() and discretisation.rows is self._rows:
            return False
        self._free(permanently=False)
        self._create()
        assert self._ksp is not None
        if self._multigrid is not None:
            self._multigrid.attach(self._ksp)
        if self._ksp.getPC().getType() == PETSc.PC.Type.TELESCOPE:
            self._ksp.getPC().reset()  # it would copy the new matrix into one with the old pattern
        self._ksp.setOperators(self.operator.mat, self.preconditioner.mat)
        self.begin_solve()
        self.reuse.discard()
        return True

    # -- values --------------------------------------------------------------------------------------

    def begin_solve(self) -> None:
        """Prepare for a new solve, in which nothing of the last one can be kept."""
        self.kept_preconditioner = self.uses_operator = False

    def assemble(self, at: Evaluation, convexity: float, *, keep: bool, convex: bool) -> Array | None:
        """Assemble the Jacobian and the preconditioning matrix at the `linearised` stage.

        Parameters
        ----------
        convexity : float
            Weight of the regularised Hessian.
        keep : bool
            Whether the preconditioner of the last iteration can be kept.
        convex : bool
            Whether the Hessian was positive definite in the last solve.

        Returns
        -------
        (n_owned, 3) or None
            As `StageForces.jacobian`.
        """
        force = self.assemble_operator(at, convexity)
        if self.preconditioner is not self.operator and not self.reuse.begin_solve(self._equations):
            self._set_preconditioner(at, keep=keep, convex=convex)
        self._equations.state.forget()  # the linear solve needs the memory
        return force

    def _set_preconditioner(self, at: Evaluation, *, keep: bool, convex: bool) -> None:
        if not self._regularised:
            self.preconditioner.set(self.operator.rows, self.shift.value)
            return
        assert self._ksp is not None
        # an equilibrium's Newton steps are large, and factors cost less than one more
        keep = keep and not self._is_empty and (self._equations.integrator.dynamic or not self.factors)
        self._is_empty = False
        self.kept_preconditioner = keep
        self.uses_operator = convex and not keep and shows_negative_curvature(self._ksp.getPC())
        if self.uses_operator:
            # while the Jacobian is positive definite there is no better preconditioner
            self.preconditioner.set(self.operator.rows, self.shift.value)
        elif not keep:
            self._set_regularised(at)

    def assemble_operator(self, at: Evaluation, convexity: float) -> Array | None:
        """Assemble the Jacobian at the `linearised` stage with this weight of the regularised Hessian."""
        force = self._jacobian(at, convexity, self.operator.rows)
        if isinstance(self.operator, BlockMatrix):
            dense = self._equations.forces.dense_part(at)
            self.operator.add_dense(dense and dense.restricted(at.step.prescribed.free))
        self.operator.set(self.operator.rows)
        return force

    def _jacobian(self, at: Evaluation, convexity: float, rows: Array) -> Array | None:
        predicted = self._equations.predicted_stress.positions
        return self._equations.forces.jacobian(at, convexity, rows, predicted)

    def _set_regularised(self, at: Evaluation) -> None:
        self._jacobian(at, 1.0, self.preconditioner.rows)
        self.preconditioner.set(self.preconditioner.rows, self.shift.value)

    def save_rows(self, at: Evaluation) -> None:
        """Save the block rows assembled ``at`` a stage, for `assemble_with`."""
        self._saved_rows = [self.operator.rows.copy()]
        if self.preconditioner is not self.operator and self._regularised and not self.uses_operator:
            if self.kept_preconditioner:
                self._jacobian(at, 1.0, self.preconditioner.rows)
            self._saved_rows.append(self.preconditioner.rows.copy())

    def assemble_with(self, add: Callable[[Array], None]) -> None:
        """Set the matrices to the saved block rows and what ``add`` adds to them, prescribed unknowns
        decoupled.
        """
        prescribed = self._equations.step.prescribed
        constrained = self._equations.forces.constrained(prescribed)
        for matrix, rows in zip((self.operator, self.preconditioner), self._saved_rows, strict=False):
            matrix.rows[:] = rows
            add(matrix.rows)
            if len(constrained.changed):
                self._rows.constrain(matrix.rows, prescribed.mask, constrained)
        self.operator.set(self.operator.rows)
        if self.preconditioner is not self.operator:
            own = self.preconditioner if len(self._saved_rows) > 1 else self.operator
            self.preconditioner.set(own.rows, self.shift.value)

    def improve_preconditioner(self, at: Evaluation) -> bool:
        """Build a better preconditioner after the linear solve has failed; whether there is one."""
        if self.preconditioner is self.operator or not (
            self.kept_preconditioner or self.uses_operator or self.shift.increase()
        ):
            return False
        self._rebuild_preconditioner(at)
        return True

    @logged(JACOBIAN_AGAIN)
    def _rebuild_preconditioner(self, at: Evaluation) -> None:
        if self._regularised:
            self._set_regularised(at)
        else:
            self.preconditioner.set(self.operator.rows, self.shift.value)
        self.kept_preconditioner = self.uses_operator = False

    @logged(JACOBIAN_AGAIN)
    def reassemble_operator(self, at: Evaluation, convexity: float) -> None:
        """As `assemble_operator`, logged as a repeated assembly."""
        self.assemble_operator(at, convexity)

    def _free(self, *, permanently: bool) -> None:
        self._equations.damping.release_values()
        if self._multigrid is not None:
            self._multigrid.destroy(for_good=permanently)
            self._multigrid = None
        self.operator.destroy()
        if self.preconditioner is not self.operator:
            self.preconditioner.destroy()

    def destroy(self) -> None:
        """Free the matrices; collective."""
        self._free(permanently=True)
