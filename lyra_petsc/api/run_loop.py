"""The loop of a run: set-up, all steps, results on disk, and a summary however the run ends."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.errors import InputError, Interrupted, LyraError, OutputError, SolverError
from lyra_petsc.linear.petsc_options import unused
from lyra_petsc.output.recorder import Recorder
from lyra_petsc.output.run_folder import FolderChoice, RunDirectory
from lyra_petsc.output.summary import library_versions, read_summary, write_summary
from lyra_petsc.parallel import on_root
from lyra_petsc.phases import Phases
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.simulation import SteppedScene, StepReport

SignalCheck = Callable[[], int]
"""Returns the signal that requested any rank to stop, else 0; collective."""


class ProgressCallbacks:
    """Methods called on all ranks during a run; to be overridden."""

    def begin(self, simulation: SteppedScene, folder: Path) -> None:
        """The initial state, or that of the checkpoint, is on disk in ``folder``."""

    def note(self, text: str) -> None:
        """A message for the user."""

    def step(self, simulation: SteppedScene, report: StepReport) -> None:
        """A step was accepted and recorded."""

    def close(self) -> None:
        """The last step is over, for whatever reason."""

    def done(self, simulation: SteppedScene, folder: Path) -> None:
        """The run has reached its end, and all its files are written."""


def simulate(
    comm: MPI.Comm,
    scene: Scene,
    choice: FolderChoice,
    callbacks: ProgressCallbacks,
    stop: SignalCheck,
    phases: Phases | None = None,
) -> Path:
    """Simulate a scene from its start or from a checkpoint; collective. Returns the folder of the results.

    Raises
    ------
    InputError
        Bad input; nothing is written.
    SolverError, OutputError
        The run could not continue; all states written before can be read.
    Interrupted
        A signal requested it to stop; the last step is in the checkpoint.
    """
    with RunDirectory(comm, choice) as directory:  # locked before the set-up, which may take long
        simulation = SteppedScene(comm, scene, phases)
        try:
            recorder = Recorder(simulation)
            if directory.note:
                simulation.notes.append(directory.note)
            if number := stop():
                raise Interrupted(" during the set-up; nothing was written", number)
            with simulation.phases("output"):
                directory.clean()
                if choice.resume:
                    recorder.resume(directory.path)
                else:
                    recorder.begin(directory.path)
            simulation.problem.release()
            _RunLoop(simulation, recorder, directory.path, callbacks, resumed=choice.resume).run(stop)
        except BaseException:
            if comm.size == 1:  # destruction is collective, and other ranks may not have failed
                with suppress(Exception):  # report the first error
                    simulation.destroy()
            raise
        simulation.destroy()
        return directory.path


class _RunLoop:
    """Takes all steps, and writes the summary however the run ends."""

    def __init__(
        self,
        simulation: SteppedScene,
        recorder: Recorder,
        folder: Path,
        callbacks: ProgressCallbacks,
        *,
        resumed: bool,
    ) -> None:
        self._simulation, self._recorder, self._folder = simulation, recorder, folder
        self._callbacks, self._comm = callbacks, simulation.comm
        self._versions = library_versions()
        self._notes_shown = simulation.run_notes.earlier
        self._first_step = simulation.step_number
        self._resumed: list[dict[str, Any]] = []
        if resumed:
            earlier = self._earlier_summary()
            changes = [{"key": c.key, "old": c.old, "new": c.new} for c in recorder.changes]
            start = {"step": simulation.step_number, "time": simulation.time, "ranks": self._comm.size}
            motions = {"earlier_motions": recorder.earlier_motions} if recorder.earlier_motions else {}
            self._resumed = [*earlier.get("resumed", []), start | {"changes": changes} | motions]

    def _earlier_summary(self) -> dict[str, Any]:
        """The summary of the run that is resumed, empty if it cannot be read."""
        try:
            return on_root(self._comm, lambda: read_summary(self._folder / "summary.json")) or {}
        except InputError as error:
            self._simulation.notes.append(f"{error}; its entries on earlier resumptions are lost")
            return {}

    def run(self, stop: SignalCheck) -> None:
        simulation, recorder, callbacks = self._simulation, self._recorder, self._callbacks
        self._summarise("running")
        try:
            callbacks.begin(simulation, self._folder)
            self._show_notes()
            simulation.stepper.monitor()
            while not simulation.finished:
                report = simulation.step()
                with simulation.phases("output"):
                    recorder.record(report)
                self._show_notes()
                callbacks.step(simulation, report)
                if number := stop():
                    recorder.write_checkpoint()
                    recorder.flush()
                    when = f" after step {simulation.step_number} (t = {simulation.time:g} s)"
                    raise Interrupted(f"{when}; the checkpoint is written, --resume goes on", number)
            with simulation.phases("output"):
                recorder.flush()
            if simulation.note_of_repeats:
                callbacks.note(simulation.note_of_repeats)
        except SolverError as error:
            if error.collective:
                error.details += self._write_failure(str(error))
            raise
        except LyraError as error:
            with suppress(OutputError):  # fails as well on a full disk
                self._summarise(str(error))
            if isinstance(error, OutputError) and not self._folder.is_dir():
                error.details += (f"the folder {self._folder} is gone; nothing can be resumed",)
            elif isinstance(error, OutputError):
                hint = "what was announced before stands; once it can be written again, --resume goes on"
                error.details += (hint,)
            raise
        finally:
            callbacks.close()
            recorder.close()
        self._summarise("done" if simulation.at_end else "stopped")
        callbacks.done(simulation, self._folder)

    def _show_notes(self) -> None:
        for note in self._simulation.notes[self._notes_shown :]:
            self._callbacks.note(note)
        self._notes_shown = len(self._simulation.notes)

    def _write_failure(self, outcome: str) -> tuple[str, ...]:
        """Write the last accepted state and the failed step; returns lines that name their files."""
        try:
            self._recorder.write_state()
            self._recorder.flush()
            self._summarise(outcome)
            if self._simulation.failure is None:
                return ()
            self._recorder.write_failure()
        except OutputError as error:
            return (str(error),)
        return (f"look at {self._folder / 'failure.xdmf'} (ParaView) and {self._folder / 'failure.txt'}",)

    def _summarise(self, outcome: str) -> None:
        simulation = self._simulation
        problem = simulation.problem
        content: dict[str, Any] = {
            "title": simulation.scene.title,
            "outcome": outcome,
            "versions": self._versions,
            "ranks": self._comm.size,
            "sizes": {
                "vertices": problem.whole.n_vertices,
                "triangles": problem.whole.n_triangles,
                "unknowns": problem.points.n_unknowns,
            },
            "terms": problem.whole.terms,
            **problem.whole.summary,
            "partitioner": problem.partitioner,
            "linear_solver": simulation.stepper.preset,
            "petsc_options": PETSc.Options().getAll(),
            "unused_petsc_options": unused(simulation.stepper.our_options)
            if outcome in ("done", "stopped")
            else [],
            "integrator": simulation.scene.time.scheme,
            "time": simulation.time,
            "estimated_error": simulation.accuracy.estimated if simulation.accuracy else None,
            "energy_balance": simulation.guard.content() if simulation.guard else None,
            "steps": simulation.step_number,
            "steps_of_this_run": simulation.step_number - self._first_step,
            **simulation.totals,
            **simulation.stability,
            "resumed": self._resumed,
            "wall_seconds": simulation.phases.seconds(),
            "notes": [*simulation.notes, *filter(None, [simulation.note_of_repeats])],
            **({"failure": simulation.failure.content()} if simulation.failure else {}),
        }
        write_summary(self._folder / "summary.json", content, self._comm)
