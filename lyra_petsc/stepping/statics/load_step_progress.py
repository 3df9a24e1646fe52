"""The proximal steps of a load step, and which of them brought the sheet nearer to its equilibrium.

A proximal step makes progress if the out-of-balance force falls. In a snap it grows for many steps, while
the potential energy falls: where one is given, its fall counts too.
"""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.newton.newton_trace import Iteration
from lyra_petsc.stepping.stepper import Attempt

PROGRESS = 0.9
"""Progress is a force below this fraction of the least one so far."""

MIN_FALL = 0.01
"""Fall of the potential energy below its least value that counts as progress, over its range so far."""


class LoadStepProgress:
    """The proximal steps of a load step, their out-of-balance forces and potential energies.

    Parameters
    ----------
    before, factor : float
        Load factors at the start and the end of the load step.
    start : (n_owned, 3)
        Positions [m] at its start.

    Attributes
    ----------
    history : list of Iteration
        The out-of-balance force [N] before the first solve and after each.
    solves, newton, linear : int
        Numbers of proximal steps and of their Newton and linear iterations.
    resumed : int
        Number of leaps that were resumed where they ended.
    last_force : float
        Out-of-balance force [N] one proximal step before.
    solved_once : bool
        Whether any proximal step has converged.
    """

    def __init__(self, before: float, factor: float, start: Array) -> None:
        self.before, self.factor, self.start = before, factor, start
        self.solves = self.newton = self.linear = self.resumed = 0
        self.last_force, self.solved_once = np.inf, False
        self.history: list[Iteration] = []
        self._potentials: list[float] = []
        self._restarted_at = 0

    def count(self, attempt: Attempt) -> None:
        """Count a proximal step and its iterations."""
        self.solves += 1
        self.newton += attempt.newton_iterations
        self.linear += attempt.linear_iterations

    def record_force(self, force: float, linear_iterations: int | None) -> None:
        """Note the out-of-balance force [N] after a solve, or before the first (no iterations)."""
        taken = None if linear_iterations is None else 1.0
        self.history.append(Iteration(force, linear_iterations or 0, 0, taken))

    def record_potential(self, energy: float) -> None:
        """Note the potential energy [J] after a solve; if it is given once, then for all."""
        self._potentials.append(energy)

    def restart(self) -> None:
        """Count progress from the next force on, as forces before are from other friction or handles."""
        self._restarted_at = len(self.history)

    @property
    def last_by_force(self) -> int:
        """Number of the last solve after which the force was notably less than after all before."""
        last, smallest = 0, np.inf
        for number, entry in enumerate(self.history[self._restarted_at :]):
            if entry.residual < PROGRESS * smallest:
                last, smallest = number, entry.residual
        return self._restarted_at + last

    @property
    def least_force(self) -> float:
        """The out-of-balance force [N] after that solve."""
        return self.history[self.last_by_force].residual

    @property
    def last(self) -> int:
        """Number of the last solve that made progress."""
        last, least, highest = 0, np.inf, -np.inf
        for number, energy in enumerate(self._potentials, start=1):
            highest = max(highest, energy)
            if energy < least - MIN_FALL * (highest - least):
                last, least = number, energy
        return max(self.last_by_force, last)
