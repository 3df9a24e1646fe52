"""Evaluations of the stage at the vectors with which PETSc calls back."""

from __future__ import annotations

from petsc4py import PETSc

from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.time_step import Evaluation

Key = tuple[int, int, int]


class Iterates:
    """The last two points of one SNES: its iterate and a trial point; collective.

    A vector is known again by its object state, which changes with its values, as long as the step is the
    same.

    Parameters
    ----------
    equations : StageEquations
    """

    def __init__(self, equations: StageEquations) -> None:
        self._equations = equations
        self._known: dict[Key, Evaluation] = {}

    def forget(self) -> None:
        """Begin another solve, whose vectors may have the addresses of those of the last."""
        self._known = {}

    def _key(self, u: PETSc.Vec) -> Key:
        return int(u.handle), int(u.stateGet()), self._equations.step.number

    def at(self, u: PETSc.Vec) -> Evaluation:
        """The evaluation of the equations at velocities u."""
        evaluation = self._known.get(self._key(u))
        if evaluation is not None:
            return self._equations.revisit(evaluation)
        evaluation = self._equations.linearised(u.getArray(readonly=True).reshape(-1, 3))
        self.add(u, evaluation)
        return evaluation

    def reach(self, u: PETSc.Vec) -> None:
        """The SNES has copied the point of its last residual to its iterate u."""
        if self._known and self._key(u) not in self._known:
            self.add(u, self._known[next(reversed(self._known))])

    def add(self, u: PETSc.Vec, evaluation: Evaluation) -> None:
        """Take the evaluation at velocities u."""
        last = dict([*self._known.items()][-1:])
        self._known = last | {self._key(u): evaluation}
