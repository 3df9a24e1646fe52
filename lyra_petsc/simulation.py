"""A scene in motion: steps with retries, no files."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.handles.motion import Window
from lyra_petsc.model import Model, build_model
from lyra_petsc.output.phases import Phases
from lyra_petsc.scene.schema import Scene
from lyra_petsc.solvers.options import fill_gaps, petsc_number
from lyra_petsc.stepping.control import StepControl
from lyra_petsc.stepping.stepper import Attempt, Stepper
from lyra_petsc.stepping.work import Budget, Ledger

Array = NDArray[np.float64]

SMALLEST_FRACTION = 2.0**-12
"""Δt below which no retry is made, over the nominal one (``-ts_adapt_dt_min`` overrides it)."""


@dataclass
class StepReport:
    """One accepted step."""

    step: int
    time: float
    dt: float
    newton_iterations: int
    linear_iterations: int
    rejected: int
    residual: float
    wall_seconds: float


def _positive(name: str, seconds: float) -> float:
    """A time [s] from PETSc's options, or from the scene and then positive anyway."""
    if not 0.0 < seconds < math.inf:
        raise InputError(f"must be a finite number of seconds > 0, not {seconds:g}", key=name)
    return seconds


class Simulation:
    """Set up a scene and step through it; every method is collective.

    Parameters
    ----------
    comm : MPI.Comm
    scene : Scene
    phases : Phases, optional
        Where wall time is charged.

    Attributes
    ----------
    model : Model
    time : float
        [s]
    step_number : int
    notes : list of str
        What the user should know: mesh repairs, changed linear solver, …

    Raises
    ------
    InputError
        On all ranks, if the scene cannot be simulated.
    """

    def __init__(self, comm: MPI.Comm, scene: Scene, phases: Phases | None = None) -> None:
        self.comm, self.scene = comm, scene
        self.phases = phases or Phases()
        fill_gaps(scene.petsc)
        self.model: Model = build_model(comm, scene, self.phases)
        self.notes = list(self.model.outline.notes)
        outline, system = self.model.outline, self.model.system
        with self.phases("solve"):
            self.stepper = Stepper(
                scene, system, self.model.pattern, outline.spacing, system.roundoff(outline.reach)
            )
        ts = self.stepper.ts
        step = _positive("-ts_dt", ts.getTimeStep())
        step = _positive("-ts_adapt_dt_max", min(step, petsc_number("ts_adapt_dt_max", step)))
        smallest = _positive("-ts_adapt_dt_min", petsc_number("ts_adapt_dt_min", SMALLEST_FRACTION * step))
        _positive("-ts_max_time", ts.getMaxTime())
        self.max_steps = ts.getMaxSteps()
        self.control = StepControl(step, ts.getMaxTime(), scene.output.every, self._events(), smallest)
        self.time, self.step_number = 0.0, 0
        self.stepper.start(0.0, 0)
        self.ledger = Ledger(system)

    def _events(self) -> list[float]:
        windows = [Window.of(handle) for handle in self.scene.handles]
        windows += [Window(load.start, load.until) for load in self.scene.loads]
        return [t for window in windows for t in window.events()]

    @property
    def budget(self) -> Budget:
        """Energies and works up to the present state."""
        return self.ledger.budget

    @property
    def finished(self) -> bool:
        """Whether the end of the scene, or ``-ts_max_steps``, is reached."""
        return self.control.is_end(self.time) or self.step_number >= self.max_steps

    def step(self) -> StepReport:
        """One accepted step, retried with a smaller Δt where needed.

        Raises
        ------
        SolverError
            If even the smallest Δt fails; the state is that before the step.
        """
        started = clock.perf_counter()
        system, n = self.model.system, self.model.points.n_owned
        x_before, v_before = system.x[:n].copy(), system.v[:n].copy()
        newton = linear = rejected = 0
        while True:
            end = self.control.next_end(self.time)
            with self.phases("solve"):
                attempt = self.stepper.attempt(self.time, end)
            newton += attempt.newton_iterations
            linear += attempt.linear_iterations
            if attempt.converged:
                break
            rejected += 1
            self._recover(attempt, end)
        self.control.succeeded()
        dt, self.time = end - self.time, end
        self.step_number += 1
        with self.phases("output"):
            self.ledger.record(x_before, v_before)
        system.begin(self.time)
        self.stepper.monitor()
        seconds = clock.perf_counter() - started
        return StepReport(
            self.step_number, self.time, dt, newton, linear, rejected, attempt.residual, seconds
        )

    def _recover(self, attempt: Attempt, end: float) -> None:
        if self.stepper.linear_solver_failed:
            previous = self.stepper.preset
            following = self.stepper.next_preset()
            if following is not None:
                self.notes.append(
                    f"step {self.step_number + 1}: linear solver '{previous}' broke down, "
                    f"going on with '{following}'"
                )
                return
        if not self.control.failed():
            raise SolverError(
                f"step {self.step_number + 1} (t = {self.time:g} s) did not converge even with Δt = "
                f"{end - self.time:.3g} s: {attempt.words}; last residual {attempt.residual:.3g} N; "
                f"the state at t = {self.time:g} s is kept; {attempt.advice}",
                collective=True,
            )

    def memory(self) -> dict[str, Any]:
        """What a checkpoint must hold beside positions and velocities to go on as if never stopped."""
        return {
            "time": self.time,
            "step": self.step_number,
            "budget": asdict(self.budget),
            "factor": self.control.factor,
            "good": self.control.good,
            "blend": self.stepper.blend,
            "preset": self.stepper.preset,
            "late_starts": sorted(self.model.system.late_starts),
        }

    def resume(self, memory: Mapping[str, Any]) -> None:
        """Go on from a state already put into ``model.system`` (x and v of owned points)."""
        system = self.model.system
        system.points.update_ghosts(system.x)
        system.points.update_ghosts(system.v)
        self.time, self.step_number = float(memory["time"]), int(memory["step"])
        for name, value in memory["budget"].items():
            setattr(self.budget, name, float(value))
        self.ledger.measure()
        self.control.factor, self.control.good = float(memory["factor"]), int(memory["good"])
        while memory["preset"] in self.stepper.presets[1:]:
            self.stepper.next_preset()
        self.stepper.blend = float(memory["blend"])
        self.stepper.start(self.time, self.step_number)

    def destroy(self) -> None:
        """Free all PETSc and MPI objects; collective."""
        self.stepper.destroy()
        self.model.points.destroy()
