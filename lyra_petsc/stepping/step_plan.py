"""The step control that a scene and PETSc's options ask for, and the bounds of a run's length."""

from __future__ import annotations

from collections.abc import Iterable

from petsc4py import PETSc

from lyra_petsc.errors import InputError
from lyra_petsc.linear.petsc_options import is_set, petsc_number
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.step_control import LoadControl, StepControl, ToleranceControl
from lyra_petsc.stepping.ts_options import STEP_OPTIONS, step_option

SMALLEST_FRACTION = 2.0**-12
"""Smallest Δt of a retry over the nominal Δt (``-ts_adapt_dt_min`` overrides it)."""

LARGEST_FRACTION = 0.1
"""Largest Δt of an adaptive run over its length (``-ts_adapt_dt_max`` overrides it)."""

SMALLEST_ADAPTED = 1e-6
"""Smallest Δt of an adaptive run over the largest (``-ts_adapt_dt_min`` overrides it)."""

MAX_STEPS, MAX_STATES = 1e8, 1e6
"""Upper bounds of a run's numbers of steps and of states."""


def planned_control(scene: Scene, ts: PETSc.TS, stops: Iterable[float]) -> StepControl:
    """Control of fixed steps, of steps by a tolerance, or of load increments, with steps that end at
    ``stops`` [s].

    Raises
    ------
    InputError
        For times that are not positive, and more than `MAX_STEPS` steps or `MAX_STATES` states.
    """
    time, every = scene.time, scene.output.every
    step = _seconds(step_option(), ts.getTimeStep())
    end = _seconds("ts_max_time", ts.getMaxTime())
    # the end of the run is recognised within a fraction of Δt, so Δt must not exceed the run's length
    largest = LARGEST_FRACTION * end if time.adaptive else min(step, end)
    largest = _positive("ts_adapt_dt_max", min(largest, petsc_number("ts_adapt_dt_max", largest)))
    smallest = _seconds(
        "ts_adapt_dt_min", (SMALLEST_ADAPTED if time.adaptive else SMALLEST_FRACTION) * largest
    )
    if time.analysis == "static":
        return LoadControl(largest, end, stops, smallest, petsc_number("ts_adapt_dt_max", end))
    if time.adaptive:
        control: StepControl = ToleranceControl(step, largest, end, every, stops, smallest)
    else:
        control = StepControl(largest, end, every, stops, smallest)
    _check_length(scene, control)
    return control


def _check_length(scene: Scene, control: StepControl) -> None:
    """Refuse runs of more than `MAX_STEPS` steps or `MAX_STATES` states."""
    every, steps = scene.output.every, control.end / control.step
    if steps > MAX_STEPS:
        names = [f"-{name}" for name in ("ts_adapt_dt_max", *STEP_OPTIONS, "ts_max_time") if is_set(name)]
        excess = f"{control.step:g} s makes {steps:.3g} steps", MAX_STEPS, [*names, "time.step"][0]
    elif (states := steps if every is None else control.end / every) > MAX_STATES:
        step = control.step if every is None else every
        excess = f"{step:g} s makes {states:.3g} states", MAX_STATES, "output.every"
    else:
        return
    count, maximum, key = excess
    raise InputError(
        f"{count} in {control.end:g} s; at most {maximum:g} are made: give more",
        file=None if key.startswith("-") else scene.source,
        key=key,
    )


def _seconds(option: str, default: float) -> float:
    """The seconds of an option, or the default."""
    return _positive(option, petsc_number(option, default))


def _positive(option: str, seconds: float) -> float:
    """``seconds`` of an option; refuses what is not positive and finite."""
    if not 0.0 < seconds < float("inf"):
        raise InputError(f"must be a finite number of seconds > 0, not {seconds:g}", key=f"-{option}")
    return seconds
