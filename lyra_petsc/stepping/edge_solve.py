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


def is_needed(equations: StageEquations) -> bool:
    """Whether the edges' unknowns need a solve of their own at the end of the step."""
    return (
        bool(equations.points.n_edges_global)
        and equations.integrator.dynamic
        and not equations.step.ends_at_stage
    )


def initial_moments(equations: StageEquations) -> float:
    """Norm [N] of the moments on free edges at the start of a run, handles set."""
    time, layout = equations.step.start, equations.points
    equations.change(prescribed=equations.prescriptions.of_step(time, time, equations.x))
    force = equations.forces.sum(equations.active.sheet, equations.x, equations.step.frozen)
    moments = np.where(equations.step.prescribed.free, force, 0.0)[layout.n_vertices :]
    return float(np.sqrt(layout.global_sum(float(np.vdot(moments, moments)))[0]))


@dataclass(frozen=True)
class EdgeSolve:
    """What a solve for the edges' unknowns interrupts.

    Attributes
    ----------
    step : TimeStep
    evaluation : Evaluation
        Of its stage.
    """

    step: TimeStep
    evaluation: Evaluation

    @classmethod
    def begin(cls, equations: StageEquations, x_before: Array) -> EdgeSolve:
        """Set up the equations at the end of the step just accepted, from x_before (n_owned, 3).

        Before the first step they are those at these positions, after `initial_moments`.
        """
        step, n = equations.step, len(equations.mass)
        interrupted, dt = cls(step, equations.evaluated), step.dt or 1.0
        equations.predicted_stress.forget()
        held = equations.prescriptions.with_vertices(step.prescribed, equations.x[:n])
        equations.change(
            stage=Stage(1.0 / dt, dt, dt),
            v_h=np.zeros((n, 3)),
            x_h=equations.points.extended(x_before),
            prescribed=held.reaching(x_before, dt),
            linear=False,
            in_contact=False,  # vertices do not move
            of_edges=True,
        )
        equations.change(frozen=equations.active.with_targets(step.frozen, equations.targets_at(step.end)))
        return interrupted

    def end(self, equations: StageEquations, solution: Evaluation | None) -> None:
        """Set the edges' unknowns from the stage that solves their equations, unless None, and return to the
        step.
        """
        equations.return_to(self.step)
        equations.predicted_stress.forget()
        if solution is not None:
            equations.state.set_edges(solution.x)
        equations.revisit(self.evaluation)
