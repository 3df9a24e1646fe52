"""A run from its folder to its summary: every step simulated and recorded, nothing shown."""

from __future__ import annotations

import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.errors import Interrupted, LyraError, OutputError, SolverError
from lyra_petsc.output.claim import Claim
from lyra_petsc.output.folder import RunFolder
from lyra_petsc.output.h5py_loader import import_ahead
from lyra_petsc.output.phases import Phases
from lyra_petsc.output.summary import read_summary, versions, write_summary
from lyra_petsc.parallel import on_root
from lyra_petsc.recorder import Recorder
from lyra_petsc.scene.schema import Scene
from lyra_petsc.simulation import Simulation, StepReport
from lyra_petsc.solvers.options import unused

StopAsked = Callable[[], int]
"""The signal by which any rank was asked to stop, else 0; collective."""


class Watcher:
    """What is told of a run while it goes on, on all ranks alike; this one ignores it."""

    def begin(self, simulation: Simulation, folder: Path) -> None:
        """The initial state, or that of the checkpoint, is on disk in ``folder``."""

    def note(self, text: str) -> None:
        """Something that the user should know."""

    def step(self, simulation: Simulation, report: StepReport) -> None:
        """A step was accepted and recorded."""

    def close(self) -> None:
        """No step follows, whatever the reason."""

    def done(self, simulation: Simulation, folder: Path) -> None:
        """The run came to its end, and everything is on disk."""


def carry_out(
    comm: MPI.Comm,
    scene: Scene,
    choice: RunFolder,
    watcher: Watcher,
    stop: StopAsked,
    phases: Phases | None = None,
) -> Path:
    """Simulate a scene, or go on with it, in the folder chosen; collective. Returns that folder.

    Raises
    ------
    InputError
        Bad input; nothing is written.
    SolverError, OutputError
        The run could not go on; what was announced stands.
    Interrupted
        It was asked to stop; the last step is in the checkpoint.
    """
    with Claim(comm, choice) as claim:  # before the set-up, which may take long
        import_ahead()
        simulation = Simulation(comm, scene, phases)
        try:
            recorder = Recorder(simulation)
            if claim.note:
                simulation.notes.append(claim.note)
            _leave_set_up(stop)
            with simulation.phases("output"):
                claim.clear()
                if choice.resume:
                    recorder.resume(claim.path)
                else:
                    recorder.begin(claim.path)
            simulation.model.release()
            _Journey(simulation, recorder, claim.path, watcher, resumed=choice.resume).go(stop)
        except BaseException:
            if comm.size == 1:  # else some ranks may not come here, and destruction is collective
                with suppress(Exception):  # the first thing that went wrong is what counts
                    simulation.destroy()
            raise
        simulation.destroy()
        return claim.path


def _leave_set_up(stop: StopAsked) -> None:
    number = stop()
    if number:
        raise Interrupted(
            f"stopped by {signal.Signals(number).name} during the set-up; nothing was written", number
        )


class _Journey:
    """The loop over the steps with its summary and ways of ending."""

    def __init__(
        self, simulation: Simulation, recorder: Recorder, folder: Path, watcher: Watcher, *, resumed: bool
    ) -> None:
        self._simulation, self._recorder, self._folder = simulation, recorder, folder
        self._watcher, self._comm = watcher, simulation.comm
        self._totals = {"newton_iterations": 0, "linear_iterations": 0, "rejected": 0}
        self._versions = versions()
        self._told = 0
        self._first_step = simulation.step_number
        self._resumed: list[dict[str, Any]] = []
        if resumed:
            earlier = on_root(self._comm, lambda: read_summary(folder / "summary.json")) or {}
            self._resumed = [*earlier.get("resumed", []), self._resumption()]

    def go(self, stop: StopAsked) -> None:
        simulation, recorder, watcher = self._simulation, self._recorder, self._watcher
        self._summarise("running")
        try:
            watcher.begin(simulation, self._folder)
            self._tell()
            simulation.stepper.monitor()
            while not simulation.finished:
                report = simulation.step()
                for name in self._totals:
                    self._totals[name] += getattr(report, name)
                with simulation.phases("output"):
                    recorder.record(report)
                self._tell()
                watcher.step(simulation, report)
                self._obey(stop)
            with simulation.phases("output"):
                recorder.settle()
        except SolverError as error:
            if error.collective:
                error.details += self._keep(str(error))
            raise
        except LyraError as error:
            # the first thing that went wrong is what counts: on a full disk this fails as well
            with suppress(OutputError):
                self._summarise(str(error))
            if isinstance(error, OutputError):
                error.details += self._remedy()
            raise
        finally:
            watcher.close()
            recorder.close()
        self._summarise("done")
        watcher.done(simulation, self._folder)

    def _tell(self) -> None:
        for note in self._simulation.notes[self._told :]:
            self._watcher.note(note)
        self._told = len(self._simulation.notes)

    def _resumption(self) -> dict[str, Any]:
        """Where this run takes over, and what is different from then on."""
        changes = [{"key": c.key, "old": c.old, "new": c.new} for c in self._recorder.changes]
        simulation = self._simulation
        return {
            "step": simulation.step_number,
            "time": simulation.time,
            "ranks": self._comm.size,
            "changes": changes,
        }

    def _remedy(self) -> tuple[str, ...]:
        """What to do when a file cannot be written."""
        if not self._folder.is_dir():
            return (f"the folder {self._folder} is gone; nothing can be resumed",)
        return ("what was announced before stands; once it can be written again, --resume goes on",)

    def _keep(self, outcome: str) -> tuple[str, ...]:
        """Write the last good state and the step that failed; where it can be looked at."""
        try:
            self._recorder.write_state()
            self._recorder.settle()
            self._summarise(outcome)
            if self._simulation.failure is None:
                return ()
            self._recorder.write_failure()
        except OutputError as error:
            return (str(error),)
        return (f"look at {self._folder / 'failure.xdmf'} (ParaView) and {self._folder / 'failure.txt'}",)

    def _obey(self, stop: StopAsked) -> None:
        number = stop()
        if number:
            self._recorder.write_checkpoint()
            self._recorder.settle()
            raise Interrupted(
                f"stopped by {signal.Signals(number).name} after step {self._simulation.step_number} "
                f"(t = {self._simulation.time:g} s); the checkpoint is written, --resume goes on",
                number,
            )

    def _summarise(self, outcome: str) -> None:
        simulation = self._simulation
        model = simulation.model
        content: dict[str, Any] = {
            "title": simulation.scene.title,
            "outcome": outcome,
            "versions": self._versions,
            "ranks": self._comm.size,
            "sizes": {
                "vertices": model.outline.n_vertices,
                "triangles": model.outline.n_triangles,
                "unknowns": 3 * model.outline.n_vertices,
            },
            "terms": model.outline.terms,
            "partitioner": model.partitioner,
            "linear_solver": simulation.stepper.preset,
            "petsc_options": PETSc.Options().getAll(),
            "unused_petsc_options": unused(simulation.stepper.our_options) if outcome == "done" else [],
            "integrator": simulation.scene.time.scheme,
            "time": simulation.time,
            "estimated_error": simulation.estimated_error if simulation.local_error else None,
            "steps": simulation.step_number,
            "steps_of_this_run": simulation.step_number - self._first_step,
            **self._totals,
            "resumed": self._resumed,
            "wall_seconds": simulation.phases.seconds(),
            "notes": simulation.notes,
            **({"failure": simulation.failure.content()} if simulation.failure else {}),
        }
        write_summary(self._folder / "summary.json", content, self._comm)
