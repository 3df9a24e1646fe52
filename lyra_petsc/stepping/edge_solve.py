"""The solve for the edges' unknowns at the end of a step whose stage is not its end; collective.

Unknowns of edges have no mass and are in equilibrium at the stage. At the end of the step a second solve
finds their equilibrium: a stage of backward Euler with the vertices' present positions prescribed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.integrators.integrator import Stage
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.time_step import Evaluation, TimeStep


def is_needed(system: StageEquations) -> bool:
    """Whether the edges' unknowns need a solve of their own at the end of the step."""
    return bool(system.points.n_edges_global) and system.integrator.dynamic and not system.step.ends_at_stage


def initial_moments(system: StageEquations) -> float:
    """Norm [N] of the moments on free edges at the start of a run, handles set."""
    time, layout = system.step.start, system.points
    system.change(prescribed=system.prescriptions.of_step(time, time, system.x))
    force = system.gradient_of(system.active.sheet, system.x)
    moments = np.where(system.step.prescribed.free, force, 0.0)[layout.n_vertices :]
    return float(np.sqrt(layout.global_sum(float(np.vdot(moments, moments)))[0]))


@dataclass(frozen=True)
class EdgeSolve:
    """What a solve for the edges' unknowns interrupts.

    Attributes
    ----------
    step : TimeStep
    velocity : (n_owned, 3)
        Velocities [m/s] of its stage.
    """

    step: TimeStep
    velocity: Array

    @classmethod
    def begin(cls, system: StageEquations, x_before: Array) -> EdgeSolve:
        """Set up the equations at the end of the step just accepted, from x_before (n_owned, 3).

        Before the first step they are those at these positions, after `initial_moments`.
        """
        step, n = system.step, len(system.mass)
        interrupted, dt = cls(step, system.stage_velocity), step.dt or 1.0
        system.predicted_stress.forget()
        held = system.prescriptions.with_vertices(step.prescribed, system.x[:n])
        system.change(
            stage=Stage(1.0 / dt, dt, dt),
            v_h=np.zeros((n, 3)),
            x_h=system.points.extended(x_before),
            frozen=system.active.with_targets(step.frozen, system.targets_at(step.end)),
            prescribed=held.reaching(x_before, dt),
            linear=False,
            of_edges=True,
        )
        return interrupted

    def end(self, system: StageEquations, solution: Evaluation | None) -> None:
        """Set the edges' unknowns from the stage that solves their equations, unless None, and return to the
        step.
        """
        system.return_to(self.step)
        system.predicted_stress.forget()
        if solution is not None:
            system.state.set_edges(solution.x)
        system.evaluate(self.velocity)
