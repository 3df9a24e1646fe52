"""The matrices of Newton's linear systems: the Jacobian, and what its preconditioner is built from.

While the exact Hessian may be indefinite the preconditioner is built from the regularised one, so that it
stays positive definite, and conjugate gradients see negative curvature only where there is some.
"""

from __future__ import annotations

from collections.abc import Callable

from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.linear import multigrid, presets
from lyra_petsc.linear.hierarchy import Hierarchy, InterpolationRows, Surface, interpolations
from lyra_petsc.linear.matrix import AssembledMatrix, BlockMatrix, Matrix
from lyra_petsc.linear.multigrid import Multigrid
from lyra_petsc.linear.petsc_options import is_set
from lyra_petsc.linear.pivots import shows_negative_curvature
from lyra_petsc.phases import JACOBIAN_AGAIN, logged
from lyra_petsc.stepping.diagonal_shift import DiagonalShift
from lyra_petsc.stepping.reuse import Reuse
from lyra_petsc.stepping.stage_equations import StageEquations


class LinearSystem:
    """Operator and preconditioning matrix of one KSP, which follow the discretisation; collective.

    Parameters
    ----------
    equations : StageEquations
    surface : Surface
        That multigrid's coarse meshes are made of.
    preset : str
        The linear solver whose options are set.
    hessian : str
        The scene's ``solver.hessian``.
    iterates : bool
        A step is more than one linear solve.

    Attributes
    ----------
    operator, preconditioner : Matrix
        May be the same.
    cycles : bool
        The latter is a cycle of multigrid.
    factors : bool
        It is exact factors of a matrix.
    reuse : Reuse
        For how many steps the preconditioner serves.
    """

    def __init__(
        self, equations: StageEquations, surface: Surface, preset: str, hessian: str, *, iterates: bool
    ) -> None:
        self._equations, self._surface, self._preset = equations, surface, preset
        self._iterates = iterates
        direct = PETSc.Options().getString("ksp_type", "cg") == PETSc.KSP.Type.PREONLY
        # this one is a way to multiply by the operator, and needs its entries
        self._one_matrix = PETSc.Options().getString("pc_type", "") == PETSc.PC.Type.EISENSTAT
        # else the preconditioner is built from the operator's own values
        self._regularised = iterates and hessian != "regularised" and not direct and not self._one_matrix
        self._shifts = not direct
        self.factors = PETSc.Options().getString("pc_type", "") in ("cholesky", "lu")
        self.cycles = multigrid.is_asked_for()
        # cycles on a mesh that has moved on take many more iterations
        asked = is_set("snes_lag_preconditioner")
        new = iterates or self.factors or direct or self._one_matrix or self.cycles or asked
        self.reuse = Reuse(acts=not new)
        self._interpolations: list[InterpolationRows] | None = None
        self._multigrid: Multigrid | None = None
        self._ksp: PETSc.KSP | None = None
        self.begin()
        self._create()

    def _create(self) -> None:
        discretisation = self._equations.discretisation
        self._equations.renew_pattern()  # stencils may have changed since the last matrix
        self._rows = discretisation.rows
        layout, pattern = discretisation.layout, discretisation.rows.pattern
        kind = presets.matrix_type(self._preset)
        self.operator: Matrix
        self.preconditioner: Matrix
        if is_set("mat_type") or self._one_matrix:
            self.operator = AssembledMatrix(layout, pattern, kind)
        else:
            self.operator = BlockMatrix(layout, pattern, self._equations.block_summary)
        self.preconditioner = self.operator
        if self.cycles:
            spare = self._regularised or isinstance(self.operator, AssembledMatrix)
            hierarchy = self._levels(spare=spare)
            if spare:
                summary = self._equations.block_summary
                entries = None if hierarchy.rows is None else hierarchy.entries
                self.preconditioner = BlockMatrix(layout, pattern, summary, hierarchy.rows, entries)
            assert isinstance(self.preconditioner, BlockMatrix)
            self._multigrid = Multigrid(
                self.preconditioner, hierarchy, held=lambda: self._equations.prescribed.mask
            )
        elif (
            self._regularised or isinstance(self.operator, BlockMatrix) or self._preset in presets.INCOMPLETE
        ):
            diagonal = PETSc.Options().getString("pc_type", "") in presets.READS_DIAGONAL
            self.preconditioner = AssembledMatrix(
                layout, pattern, "baij" if diagonal else kind, diagonal=diagonal
            )

    def _levels(self, *, spare: bool) -> Hierarchy:
        discretisation = self._equations.discretisation
        found = self._interpolations
        if found is None:
            found = interpolations(discretisation.layout, self._surface, multigrid.most_levels())
        if discretisation.changes:
            self._interpolations = found
        below = None
        if self._equations.active.coarse and not discretisation.changes:
            from lyra_petsc.stepping.vertex_equations import VertexEquations  # of use for nothing else

            below = VertexEquations(self._equations)
        return Hierarchy(discretisation.layout, discretisation.rows.pattern, found, below, spare=spare)

    def attach(self, ksp: PETSc.KSP) -> None:
        """Serve a KSP whose options are read."""
        self._ksp = ksp
        self.shift = DiagonalShift(ksp, acts=self._shifts and self.preconditioner is not self.operator)
        if self._multigrid is not None:
            self._multigrid.attach(ksp)

    def renew(self) -> bool:
        """Follow changed stencils; whether the matrices are others."""
        discretisation = self._equations.discretisation
        if not self._equations.renew_pattern() and discretisation.rows is self._rows:
            return False
        self._free(for_good=False)
        self._create()
        assert self._ksp is not None
        if self._multigrid is not None:
            self._multigrid.attach(self._ksp)
        self._ksp.setOperators(self.operator.mat, self.preconditioner.mat)
        self.begin()
        self.reuse.renew()
        return True

    # -- values --------------------------------------------------------------------------------------

    def begin(self) -> None:
        """A new step: nothing of the one before can be kept."""
        self.kept = self.same = False

    def set(self, v: Array, blend: float, *, keep: bool, convex: bool) -> None:
        """Assemble the Jacobian at velocities v (n_owned, 3), and what its preconditioner is built from.

        Parameters
        ----------
        blend : float
            Fraction of regularisation.
        keep : bool
            What was set up an iteration ago still serves.
        convex : bool
            The Hessian was positive definite when it was last seen.
        """
        self.set_operator(v, blend)
        if self.preconditioner is not self.operator and not self.reuse.begin(self._equations):
            self._set_preconditioner(v, keep=keep, convex=convex)
        self._equations.forget_directors()

    def _set_preconditioner(self, v: Array, *, keep: bool, convex: bool) -> None:
        if not self._regularised:
            self.preconditioner.set(self.operator.rows, self.shift.value)
            return
        assert self._ksp is not None
        # an equilibrium's Newton steps are large, and factors cost less than one more
        keep = keep and (self._equations.integrator.moves or not self.factors)
        self.kept = keep
        self.same = convex and not keep and shows_negative_curvature(self._ksp.getPC())
        if self.same:
            # as long as it is positive definite there is no better preconditioner
            self.preconditioner.set(self.operator.rows, self.shift.value)
        elif not keep:
            self._set_regularised(v)

    def set_operator(self, v: Array, blend: float) -> None:
        """Assemble the Jacobian at velocities v (n_owned, 3) with this fraction of regularisation."""
        self._equations.jacobian(v, blend, self.operator.rows)
        self.operator.set(self.operator.rows)

    def _set_regularised(self, v: Array) -> None:
        self._equations.jacobian(v, 1.0, self.preconditioner.rows)
        self.preconditioner.set(self.preconditioner.rows, self.shift.value)

    def keep(self, v: Array) -> None:
        """Keep what was assembled at v (n_owned, 3), for `with_more`."""
        self._assembled = [self.operator.rows.copy()]
        if self.preconditioner is not self.operator and self._regularised and not self.same:
            if self.kept:
                self._equations.jacobian(v, 1.0, self.preconditioner.rows)
            self._assembled.append(self.preconditioner.rows.copy())

    def with_more(self, add: Callable[[Array], None]) -> None:
        """Let the matrices be those kept, and what ``add`` adds to their block rows."""
        for matrix, rows in zip((self.operator, self.preconditioner), self._assembled, strict=False):
            matrix.rows[:] = rows
            add(matrix.rows)
        self.operator.set(self.operator.rows)
        if self.preconditioner is not self.operator:
            own = self.preconditioner if len(self._assembled) > 1 else self.operator
            self.preconditioner.set(own.rows, self.shift.value)

    def better_preconditioner(self, v: Array) -> bool:
        """Build another preconditioner at v after the linear solve failed; whether there is one."""
        if self.preconditioner is self.operator or not (self.kept or self.same or self.shift.raise_()):
            return False
        self._precondition_again(v)
        return True

    @logged(JACOBIAN_AGAIN)
    def _precondition_again(self, v: Array) -> None:
        if self._regularised:
            self._set_regularised(v)
        else:
            self.preconditioner.set(self.operator.rows, self.shift.value)
        self.kept = self.same = False

    @logged(JACOBIAN_AGAIN)
    def set_operator_again(self, v: Array, blend: float) -> None:
        """As ``set_operator``, with more regularisation."""
        self.set_operator(v, blend)

    def _free(self, *, for_good: bool) -> None:
        self._equations.forget_rows()
        if self._multigrid is not None:
            self._multigrid.destroy(for_good=for_good)
            self._multigrid = None
        self.operator.destroy()
        if self.preconditioner is not self.operator:
            self.preconditioner.destroy()

    def destroy(self) -> None:
        """Free the matrices; collective."""
        self._free(for_good=True)
