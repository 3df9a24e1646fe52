"""``run``: simulate a scene and leave its results in a folder."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.cli.progress import Progress, closing_table
from lyra_petsc.cli.signals import StopRequest
from lyra_petsc.errors import Interrupted, LyraError, OutputError, SolverError
from lyra_petsc.output.claim import Claim
from lyra_petsc.output.folder import choose
from lyra_petsc.output.phases import Phases
from lyra_petsc.output.summary import read_summary, versions, write_summary
from lyra_petsc.parallel import on_root
from lyra_petsc.recorder import Recorder
from lyra_petsc.scene.default import default_scene
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.schema import Scene
from lyra_petsc.simulation import Simulation
from lyra_petsc.solvers.options import unused


def read_scene(comm: MPI.Comm, path: Path, settings: Sequence[str]) -> Scene:
    """The checked scene on all ranks; read on rank 0."""
    scene = on_root(comm, lambda: load_scene(path, settings))
    assert scene is not None
    return scene


def run(
    comm: MPI.Comm,
    path: Path | None,
    settings: Sequence[str],
    *,
    out: Path | None,
    force: bool,
    resume: bool,
) -> None:
    """Simulate a scene; collective.

    Raises
    ------
    InputError
        Bad input; nothing is written.
    SolverError, OutputError
        The run could not go on; what was announced stands.
    Interrupted
        A signal; the last step is in the checkpoint.
    """
    phases = Phases()
    stop = StopRequest(comm)
    if path is None and resume and out is not None:
        path = out / "scene.yaml"
    path = path or default_scene()
    stem = path.stem
    choice = choose(comm, stem, out, force=force, resume=resume)
    scene = read_scene(comm, path, settings)
    with Claim(comm, choice) as claim:  # before the set-up, which may take long
        simulation = Simulation(comm, scene, phases)
        recorder = Recorder(simulation)
        if claim.note:
            simulation.notes.append(claim.note)
        _leave_set_up(stop)
        with phases("output"):
            claim.clear()
            if choice.resume:
                recorder.resume(claim.path)
            else:
                recorder.begin(claim.path)
        simulation.model.release()
        journey = _Journey(comm, simulation, recorder, claim.path, resumed=choice.resume)
        journey.go(stop)
        simulation.destroy()


def _leave_set_up(stop: StopRequest) -> None:
    number = stop.signal_number()
    if number:
        raise Interrupted(
            f"stopped by {signal.Signals(number).name} during the set-up; nothing was written", number
        )


class _Journey:
    """The loop over the steps with its progress, summary and ways of ending."""

    def __init__(
        self, comm: MPI.Comm, simulation: Simulation, recorder: Recorder, folder: Path, *, resumed: bool
    ) -> None:
        self._comm, self._simulation, self._recorder, self._folder = comm, simulation, recorder, folder
        self._totals = {"newton_iterations": 0, "linear_iterations": 0, "rejected": 0}
        self._versions = versions()
        self._told = 0
        self._first_step = simulation.step_number
        self._resumed: list[dict[str, Any]] = []
        if resumed:
            earlier = on_root(comm, lambda: read_summary(folder / "summary.json")) or {}
            self._resumed = [*earlier.get("resumed", []), self._resumption()]

    def go(self, stop: StopRequest) -> None:
        simulation, recorder = self._simulation, self._recorder
        outcome = "done"
        self._summarise("running")
        progress = Progress(
            self._comm,
            simulation.control.end,
            start=simulation.time,
            plain=_petsc_speaks(),
            unit="s" if simulation.model.system.scheme.moves else "",
        )
        try:
            with progress:
                self._tell(progress)
                simulation.stepper.monitor()
                while not simulation.finished:
                    report = simulation.step()
                    for name in self._totals:
                        self._totals[name] += getattr(report, name)
                    with simulation.phases("output"):
                        recorder.record(report)
                    self._tell(progress)
                    budget = simulation.budget
                    energy = budget.kinetic + budget.membrane + budget.bending + budget.potential
                    progress.update(
                        report.step, report.time, report.newton_iterations, report.linear_iterations, energy
                    )
                    self._obey(stop)
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
            recorder.close()
        self._summarise(outcome)
        simulation.stepper.ts.viewFromOptions("-ts_view")
        closing_table(self._comm, simulation.phases.seconds(), self._folder, outcome)
        self._warn_of_unused()

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
            self._recorder.write_checkpoint()
            self._summarise(outcome)
            if self._simulation.failure is None:
                return ()
            self._recorder.write_failure()
        except OutputError as error:
            return (str(error),)
        return (f"look at {self._folder / 'failure.xdmf'} (ParaView) and {self._folder / 'failure.txt'}",)

    def _obey(self, stop: StopRequest) -> None:
        number = stop.signal_number()
        if number:
            self._recorder.write_checkpoint()
            raise Interrupted(
                f"stopped by {signal.Signals(number).name} after step {self._simulation.step_number} "
                f"(t = {self._simulation.time:g} s); the checkpoint is written, --resume goes on",
                number,
            )

    def _tell(self, progress: Progress) -> None:
        for note in self._simulation.notes[self._told :]:
            progress.say(f"note: {note}")
        self._told = len(self._simulation.notes)

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

    def _warn_of_unused(self) -> None:
        simulation = self._simulation
        left = unused(simulation.stepper.our_options)
        if left and self._comm.rank == 0:
            listed = ", ".join(f"-{name}" for name in left)
            print(f"lyra-petsc: warning: PETSc options that nothing used: {listed}", file=sys.stderr)


def _petsc_speaks() -> bool:
    """Whether PETSc prints while the run goes on, which would tear a progress bar apart."""
    names = PETSc.Options().getAll()
    return any(word in name for name in names for word in ("monitor", "converged_reason", "_view", "info"))
