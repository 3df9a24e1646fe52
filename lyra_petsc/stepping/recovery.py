"""Recovery of a step that failed or is rejected: the strategies, in the order in which they are tried.

The first strategy for the step's trouble that applies changes how the step is repeated, from the state at its
start. If none is left, the run ends with that state.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, NoReturn

from petsc4py import PETSc

from lyra_petsc.errors import SolverError
from lyra_petsc.linear.petsc_options import is_set
from lyra_petsc.stepping.failure.failure_report import FailedAttempt, explain_failure
from lyra_petsc.stepping.integrators.beuler import BackwardEuler, LaggedBackwardEuler
from lyra_petsc.stepping.statics.friction_balance import LANDING_PARTS
from lyra_petsc.stepping.step_control import HALVINGS
from lyra_petsc.stepping.stepper import Attempt

if TYPE_CHECKING:
    from lyra_petsc.stepping.simulation import SteppedScene

START_HALVINGS = 2
"""Halvings after which backward Euler takes a step of a damped sheet at the start or after a jump."""

IMPACT_DT = 0.2
"""Δt over the nominal one below which backward Euler takes steps that fail in contact."""


class Trouble(Enum):
    """Why an attempt at a step is not accepted."""

    TOUCHING = "something touches or nears a limit in a step without contact in its equations"
    UNSOLVED = "no solution is found"
    CROSSING = "parts would cross"
    UNRESOLVED = "contact begins or ends too fast"
    INACCURATE = "its error is too large"
    GAIN = "it gains energy"


@dataclass(frozen=True)
class RejectedStep:
    """An attempt at a step that is not accepted.

    Attributes
    ----------
    dt : float
        Length of the step [s], or increment of the load factor.
    gains : int
        How many attempts at the step have been rejected because they gained energy.
    jumps : bool
        Whether the sheet is damped and the step begins at a start or a jump of the forces.
    earlier : list of FailedAttempt
        The failed attempts at this step, this one included.
    """

    trouble: Trouble
    attempt: Attempt
    dt: float
    gains: int
    jumps: bool
    earlier: list[FailedAttempt]


@dataclass(frozen=True)
class Strategy:
    """A way to repeat a step.

    Attributes
    ----------
    name, condition : str
        What is done and when, for the docs.
    troubles : tuple of Trouble
    applies : callable
        Whether it may help; the same on all ranks; collective.
    act : callable
        Changes how the step is repeated.
    """

    name: str
    condition: str
    troubles: tuple[Trouble, ...]
    applies: Callable[[SteppedScene, RejectedStep], bool]
    act: Callable[[SteppedScene, RejectedStep], None]


def recover(run: SteppedScene, step: RejectedStep) -> None:
    """Change how a rejected step is repeated, by the first strategy that applies; collective.

    Raises
    ------
    SolverError
        If none is left; `SteppedScene.failure` says why if the step has no solution.
    """
    for strategy in STRATEGIES:
        if step.trouble in strategy.troubles and strategy.applies(run, step):
            strategy.act(run, step)
            return
    _give_up(run, step)


def _give_up(run: SteppedScene, step: RejectedStep) -> NoReturn:
    if step.trouble is Trouble.GAIN:
        assert run.guard is not None
        raise SolverError(
            f"{_at(run)}: {run.scene.time.scheme} {run.guard.message}, even with Δt = {step.dt:.3g} s; "
            f"the state at {run.time_text()} is kept; try {run.guard.remedy}",
            collective=True,
        )
    assert step.attempt.failed_solve is not None
    failure = explain_failure(
        run.problem,
        run.scene,
        run.stepper.solver,
        step.attempt.failed_solve,
        step.earlier,
        refused=step.attempt.refused,
        step=run.step_number + 1,
        time=run.time,
        iterations_key=_iterations_key(),
    )
    run.fail(failure)


def _at(run: SteppedScene) -> str:
    return f"step {run.step_number + 1} ({run.time_text()})"


def _iterations_key() -> str:
    """Name of the option or key that limits Newton's iterations."""
    return "-snes_max_it" if is_set("snes_max_it") else "solver.max_iterations"


# -- other integrators ---------------------------------------------------------------------------------


def _always(run: SteppedScene, step: RejectedStep) -> bool:
    return True


def _take_contact_integrator(run: SteppedScene, step: RejectedStep) -> None:
    run.problem.equations.integrators.take(run.problem.equations.integrators.in_contact)


def _is_substitute(run: SteppedScene) -> bool:
    """Whether backward Euler takes the place of the scene's integrators."""
    equations = run.problem.equations
    return equations.integrator not in (equations.integrators.usual, equations.integrators.in_contact)


def _backward_euler_may_help(run: SteppedScene, step: RejectedStep) -> bool:
    """The midpoint rule, which conserves angular momentum, is not replaced because of a gain."""
    equations = run.problem.equations
    kept = step.trouble is Trouble.GAIN and equations.integrator.moves_uniformly
    return (
        equations.integrators.usual.dynamic
        and equations.integrators.usual.name != "beuler"
        and not (kept or _is_substitute(run))
    )


def _follows_impact(run: SteppedScene, step: RejectedStep) -> bool:
    """Whether something touches and the step is short: of adaptive steps, near their minimum in contact."""
    if not (_backward_euler_may_help(run, step) and run.problem.equations.has_active_pairs):
        return False
    if run.accuracy is not None:
        return step.dt <= 2.0 * run.accuracy.minimum_dt()
    return step.dt <= IMPACT_DT * run.control.step


def _follows_jump(run: SteppedScene, step: RejectedStep) -> bool:
    return _backward_euler_may_help(run, step) and step.jumps and step.gains >= START_HALVINGS


def _take_backward_euler(run: SteppedScene, step: RejectedStep) -> None:
    equations = run.problem.equations
    equations.integrators.take(
        LaggedBackwardEuler() if equations.integrators.usual.lagged_loads else BackwardEuler()
    )
    if step.trouble is Trouble.UNRESOLVED:
        return
    why = "finds no collision-free step"
    if step.trouble is Trouble.GAIN:
        assert run.guard is not None
        why = run.guard.message
    touches = equations.has_active_pairs and not _follows_jump(run, step)
    run.run_notes.once(
        "impact" if touches else "energy",
        f"{_at(run)}: {equations.integrators.usual.name} {why}{' in contact' if touches else ''}; "
        "such steps are repeated by backward Euler",
    )


# -- the next linear solver ----------------------------------------------------------------------------


def _other_solver_is_left(run: SteppedScene, step: RejectedStep) -> bool:
    return run.stepper.solver.linear_failed and len(run.stepper.presets) > 1


def _take_next_solver(run: SteppedScene, step: RejectedStep) -> None:
    previous, slow = run.stepper.preset, run.stepper.solver.convergence.too_slow
    following = run.stepper.next_preset()
    why = "took too many iterations" if slow else "broke down"
    run.run_notes.texts.append(
        f"step {run.step_number + 1}: linear solver '{previous}' {why}, going on with '{following}'"
    )


# -- smaller steps -------------------------------------------------------------------------------------


def _lands(run: SteppedScene, step: RejectedStep) -> bool:
    return run.equilibrium is not None and run.equilibrium.lands


def _limit_increment(run: SteppedScene, step: RejectedStep) -> None:
    run.control.limit(run.control.end / LANDING_PARTS)


def _may_halve(run: SteppedScene, step: RejectedStep) -> bool:
    return not (run.in_vain or run.stepper.solver.stopped_by) and run.control.can_halve()


def _halve(run: SteppedScene, step: RejectedStep) -> None:
    if step.trouble is Trouble.CROSSING and _is_substitute(run):
        _take_contact_integrator(run, step)
    run.control.halve()
    why, solve = step.attempt.message or "no solution was found", step.attempt.failed_solve
    if solve and solve.snes_reason == PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT:
        why += f" ({_iterations_key()} {run.stepper.solver.snes.getTolerances()[3]})"
    run.run_notes.count_repeat(why, run.control.factor * run.control.step)


def _take_planned(run: SteppedScene, step: RejectedStep) -> None:
    """The step control has planned the step when it judged the error."""


def _may_halve_gain(run: SteppedScene, step: RejectedStep) -> bool:
    return step.gains < HALVINGS and run.control.can_shorten(step.dt)


def _halve_gain(run: SteppedScene, step: RejectedStep) -> None:
    assert run.guard is not None
    if _is_substitute(run):
        _take_contact_integrator(run, step)
    run.control.shorten(step.dt, first=step.gains == 0)
    if run.guard.gains.repeated == 1:
        run.run_notes.texts.append(
            f"{_at(run)}: {run.scene.time.scheme} {run.guard.message} with Δt = {step.dt:.3g} s; such steps "
            "are repeated with half of it (energy_balance in summary.json has their number); "
            f"try {run.guard.remedy}"
        )


UNSOLVED = (Trouble.UNSOLVED, Trouble.CROSSING)

STRATEGIES = (
    Strategy(
        "the integrator for contact: `bdf2` with its history, under `semi-implicit` backward Euler",
        "always",
        (Trouble.TOUCHING,),
        _always,
        _take_contact_integrator,
    ),
    Strategy(
        "backward Euler: no formula for smooth motions is valid over an impact",
        "always",
        (Trouble.UNRESOLVED,),
        _always,
        _take_backward_euler,
    ),
    Strategy(
        "backward Euler",
        f"something touches, and Δt is below {IMPACT_DT:g} of `time.step`, or adaptive and near its least",
        (Trouble.CROSSING, Trouble.GAIN),
        _follows_impact,
        _take_backward_euler,
    ),
    Strategy(
        "backward Euler: `alpha2` overshoots from the acceleration of a start if damping is stiff",
        f"a damped sheet starts or forces jump, after {START_HALVINGS} halvings; not `midpoint`",
        (Trouble.GAIN,),
        _follows_jump,
        _take_backward_euler,
    ),
    Strategy(
        "the next linear solver",
        "the linear solver broke down or took too many iterations, and another is left",
        UNSOLVED,
        _other_solver_is_left,
        _take_next_solver,
    ),
    Strategy(
        f"the increment at 1/{LANDING_PARTS} of the run",
        "with friction, much landed in a larger one",
        (Trouble.UNSOLVED,),
        _lands,
        _limit_increment,
    ),
    Strategy(
        "half the Δt, or increment",
        "it is not below `-ts_adapt_dt_min`, and no option stopped Newton's method",
        UNSOLVED,
        _may_halve,
        _halve,
    ),
    Strategy(
        "the Δt that the error demands",
        "always",
        (Trouble.INACCURATE,),
        _always,
        _take_planned,
    ),
    Strategy(
        "half the Δt",
        f"fewer than {HALVINGS} halvings of `time.step`",
        (Trouble.GAIN,),
        _may_halve_gain,
        _halve_gain,
    ),
    Strategy(
        "backward Euler",
        "the integrator is not `midpoint`",
        (Trouble.GAIN,),
        _backward_euler_may_help,
        _take_backward_euler,
    ),
)
"""The first that applies is taken; if none does, the run ends with exit code 3."""
