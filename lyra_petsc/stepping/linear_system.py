"""The matrices of Newton's linear systems: the Jacobian, and what its preconditioner is built from, when.

While the exact Hessian may be indefinite the preconditioner is built from the regularised one, so that it
stays positive definite, and conjugate gradients see negative curvature only where there is some.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.linear import multigrid, presets
from lyra_petsc.linear.hierarchy import Hierarchy, InterpolationRows, Surface, interpolations
from lyra_petsc.linear.matrix import AssembledMatrix, BlockMatrix, Matrix
from lyra_petsc.linear.multigrid import Multigrid
from lyra_petsc.linear.petsc_options import is_set
from lyra_petsc.linear.pivots import is_incomplete, shows_negative_curvature
from lyra_petsc.phases import JACOBIAN_AGAIN, logged
from lyra_petsc.stepping.stage_equations import StageEquations

LEAST_SHIFT, LARGEST_SHIFT = 0.01, 1.0
"""Fractions of the diagonal blocks."""

MORE, LESS = 4.0, 0.9
"""Factors of the shift after indefinite factors, and from step to step."""

INDEFINITE = (
    PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_PC,
    PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED,
)


class DiagonalShift:
    """By how much diagonal blocks are enlarged before a matrix is factored incompletely.

    Incomplete factors of a positive-definite matrix may be indefinite. Those of one with a larger diagonal
    exist, and resemble the matrix less (Manteuffel, Math. Comp. 34, 1980, 473-497): the diagonal is enlarged
    as little as makes the factors of a KSP's preconditioner positive definite.

    Parameters
    ----------
    ksp : PETSc.KSP
    acts : bool
        The preconditioner is built from a matrix of its own.
    """

    def __init__(self, ksp: PETSc.KSP, *, acts: bool) -> None:
        self._ksp, self._acts = ksp, acts
        self._value = LEAST_SHIFT

    @property
    def value(self) -> float:
        """Fraction by which diagonal blocks are to be larger; 0 where nothing is factored incompletely."""
        return self._value if self._acts and is_incomplete(self._ksp.getPC()) else 0.0

    def memory(self) -> dict[str, float]:
        """What a checkpoint must hold to go on alike."""
        return {"shift": self._value}

    def restore(self, memory: Mapping[str, float]) -> None:
        """Go on with a memory."""
        self._value = float(memory.get("shift", self._value))

    def begin(self) -> None:
        """A new step: a little less than in the last one."""
        self._value = max(LEAST_SHIFT, LESS * self._value)

    def raise_(self) -> bool:
        """Take more if the last solve failed by the factors; whether that may help."""
        failed = self._ksp.getConvergedReason() in INDEFINITE
        if not failed or self.value == 0.0 or self._value >= LARGEST_SHIFT:
            return False
        self._value = min(LARGEST_SHIFT, MORE * self._value)
        return True


SET_UP = 8.0
"""Set-up of a preconditioner in linear iterations; incomplete factors take about ten, block Jacobi fewer."""

SAME_STEP = 1.25
"""Factor by which the time step may differ."""


class Reuse:
    """For how many steps a preconditioner serves, where a step is one linear solve (``semi-implicit``).

    Setting it up costs as much as some linear iterations. It is kept until a solve takes more iterations than
    the solves with it took on average, its set-up counted in: from there on the average would grow. After
    that the next step sets it up anew, as it does where the time step or the prescribed unknowns are others.
    That is decided from numbers of iterations, the same on all ranks.

    Parameters
    ----------
    acts : bool
        Else every solve sets up its own.

    Attributes
    ----------
    reused : bool
        The last solve took one of a step before.
    """

    def __init__(self, *, acts: bool) -> None:
        self._acts = acts
        self._for: tuple[float, object] | None = None
        self.reused = False
        self.renew()

    def renew(self) -> None:
        """Let the next solve set up its own preconditioner."""
        self._solves, self._iterations = 0, SET_UP

    def begin(self, equations: StageEquations) -> bool:
        """Whether the next solve can do with the preconditioner that there is."""
        reach, mask = equations.stage.c, equations.prescribed.mask
        if self._for is None or self._for[1] is not mask or not _alike(reach, self._for[0]):
            self.renew()
        self.reused = self._acts and self._solves > 0
        if not self.reused:
            self._for = reach, mask
        return self.reused

    def solved(self, iterations: int) -> None:
        """A solve took so many linear iterations."""
        self._solves += 1
        self._iterations += iterations
        if iterations * self._solves > self._iterations:
            self.renew()


def _alike(step: float, other: float) -> bool:
    return other / SAME_STEP < step < other * SAME_STEP


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
        self._equations.update_pattern()  # stencils may have changed since the last matrix
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
        if discretisation.stencils_change:
            self._interpolations = found
        below = None
        if self._equations.active.coarse and not discretisation.stencils_change:
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
        if not self._equations.update_pattern() and discretisation.rows is self._rows:
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
        keep = keep and (self._equations.integrator.dynamic or not self.factors)
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
