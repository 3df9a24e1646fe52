"""Solves of a Newton iteration's linear system with further stiffness in its block rows."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.newton.linear_system import LinearSystem
from lyra_petsc.stepping.time_step import Evaluation


class RepeatedSolves:
    """The linear system at velocities v (n_owned, 3); all methods are collective.

    Parameters
    ----------
    ksp : PETSc.KSP
    linear : LinearSystem
    at : callable
        Returns the evaluation of the equations at Newton's iterate.
    renew, ease : callable
        Assembles the system again where the pattern has changed; changes the system after a failed solve, and
        returns whether another may succeed.

    Attributes
    ----------
    iterations : int
        Linear iterations so far.
    """

    def __init__(
        self,
        ksp: PETSc.KSP,
        linear: LinearSystem,
        at: Callable[[], Evaluation],
        renew: Callable[[], None],
        ease: Callable[[], bool],
    ) -> None:
        self._ksp, self._linear, self._at = ksp, linear, at
        self._renew, self._ease = renew, ease
        self.iterations = 0

    def renew(self) -> None:
        """Assemble the system again if the pattern of the present pairs demands it, for `solve`."""
        self._renew()
        self._linear.save_rows(self._at())

    def ease(self) -> bool:
        """Change the system after a failed solve, and return whether another may succeed."""
        eased = self._ease()
        if eased:
            self._linear.save_rows(self._at())
        return eased

    def product(self, z: PETSc.Vec) -> Array:
        """The matrix times z, (n_owned, 3)."""
        out = z.duplicate()
        self._linear.operator.mat.mult(z, out)
        values: Array = np.array(out.getArray(readonly=True)).reshape(-1, 3)
        out.destroy()
        return values

    def solve(self, add: Callable[[Array], None], right: PETSc.Vec, z: PETSc.Vec, tolerance: float) -> bool:
        """Solve for z after ``add`` has added to the block rows (n_blocks, 3, 3), to a residual of at most
        ``tolerance`` [N]; whether it succeeded with a direction of descent.
        """
        ksp = self._ksp
        self._linear.assemble_with(add)
        ksp.setOperators(self._linear.operator.mat, self._linear.preconditioner.mat)
        kept = ksp.getTolerances()
        ksp.setTolerances(rtol=1e-14, atol=tolerance)
        ksp.solve(right, z)
        ksp.setTolerances(*kept)
        self.iterations += ksp.getIterationNumber()
        return ksp.getConvergedReason() > 0 and bool(right.dot(z) > 0.0)
