"""Changes of a simulation by a program between two steps; collective.

They act from the next step on, and the energy that they bring counts as external work.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.stepping.problem import refuse_contact, refuse_overrun
from lyra_petsc.terms.registry import Registration, Role
from lyra_petsc.terms.term import Load, UpcomingStep

if TYPE_CHECKING:
    from lyra_petsc.stepping.simulation import SteppedScene


class ProgramForces(Load):
    """Forces (n, 3) [N] on this rank's vertices, which a program sets."""

    registration = Registration("program forces", lambda scene, shells: False, Role.LOAD)

    def __init__(self, forces: Array) -> None:
        super().__init__(Elements(np.empty((0, 1), dtype=np.int32), {}))
        self.forces = forces

    def set(self, run: SteppedScene, forces: Array) -> None:
        """Let other forces (n, 3) [N] act from now on."""
        self.forces = forces.copy()
        run.expect_jump(run.time)

    def add_force(self, step: UpcomingStep, out: Array) -> None:
        out[: len(self.forces)] += self.forces


def add_forces(run: SteppedScene, values: Array) -> ProgramForces:
    """Let forces (n, 3) [N] of the program act."""
    forces = ProgramForces(values.copy())
    run.problem.equations.active.add_load(forces)
    return forces


def set_state(run: SteppedScene, x: Array, v: Array) -> None:
    """Set positions [m] and velocities [m/s] of the vertices, (n_vertices, 3); those that handles hold keep
    theirs.

    Raises
    ------
    InputError
        Sheets would touch, or a limit would be exceeded; nothing is changed.
    """
    equations, n = run.problem.equations, run.problem.points.n_owned
    before = equations.x[:n].copy(), equations.v[:n].copy()
    free = equations.step.prescribed.free[: len(x)]
    after = before[0].copy(), before[1].copy()
    for rows, values in zip(after, (x, v), strict=True):
        rows[: len(values)][free] = values[free]
    _take(run, *after)
    try:
        refuse_overrun(equations, run.scene, f"at {run.time_text()}")
        refuse_contact(equations, run.scene, f"at {run.time_text()}")
    except BaseException:
        _take(run, *before)
        raise
    run.energy_balance.enter_outside_change()
    run.expect_jump(run.time)


def _take(run: SteppedScene, x: Array, v: Array) -> None:
    """Take positions and velocities (n_owned, 3) as those of the present state."""
    equations = run.problem.equations
    moves = run.problem.points.global_max(not np.array_equal(x, equations.x[: len(x)]))[0]
    equations.state.set(x, v)
    if moves:
        for term in equations.active.with_edges:
            term.initialise(equations.x)
    equations.hold_targets(run.time)
    run.stepper.start(run.time, run.step_number)
    if moves and equations.active.with_edges:
        run.stepper.balance_edge_moments(run.roundoff)
