"""Writes the files of a run: states, checkpoints, history and other tables. Every method is collective."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from lyra_petsc.output.checkpoint import read_checkpoint, write_checkpoint
from lyra_petsc.output.continuation import (
    checkpoint_of,
    first_positions,
    note_changes,
    restore,
    term_arrays,
    used_groups,
)
from lyra_petsc.output.fields import Field, chosen_fields
from lyra_petsc.output.file_operations import replace_text
from lyra_petsc.output.layout import SCENE_FILE
from lyra_petsc.output.mesh_file import check_same_mesh, write_mesh
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.run_tables import RunTables
from lyra_petsc.output.states import FailureState, StateWriter, remove_failure, write_failure
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.dump import Change, dump_scene
from lyra_petsc.stepping.simulation import SteppedScene, StepReport

MIN_COST_RATIO = 100.0
"""A checkpoint is also written if the time since the last one is this many times the last one's duration.

The duration includes the writing of a state, if one was written together with the checkpoint."""


class Recorder:
    """Writes the files that a scene requests.

    Construction only checks the requests; ``begin`` or ``resume`` opens the files.

    Parameters
    ----------
    simulation : SteppedScene

    Attributes
    ----------
    changes : list of Change
        After ``resume``: differences between the scene and the one that the run was begun with.
    earlier_motions : dict of str to dict
        After ``resume``: by name, how the run moved obstacles until then, if it does so otherwise now.

    Raises
    ------
    InputError
        For a field that cannot be computed in the scene.
    """

    def __init__(self, simulation: SteppedScene) -> None:
        self._simulation = simulation
        problem = simulation.problem
        self._fields: list[Field] = chosen_fields(problem)
        points = problem.points
        self._vertices = FileOrder(points.comm, points.mesh_vertices, points.n_vertices_global)
        self._edges: FileOrder | None = None
        if points.n_edges_global:
            self._edges = FileOrder(points.comm, points.edges, points.n_edges_global)
        self._triangles: FileOrder | None = None
        if any(field.on == "triangle" for field in self._fields):
            elements = problem.membrane.elements
            own = elements.index[: elements.n_owned].astype(np.int64)
            self._triangles = FileOrder(points.comm, own, problem.whole.n_triangles)
        self._comm = points.comm
        self._tables = RunTables(simulation)
        self._disk = ThreadPoolExecutor(max_workers=1)
        self._completion: Future[None] | None = None  # of rank 0
        self._last_checkpoint = clock.monotonic()
        self._steps_since_checkpoint = 0
        self._last_state = -1
        self._checkpoint_seconds = 0.0
        self.changes: list[Change] = []
        self.earlier_motions: dict[str, Any] = {}

    # -- opening -------------------------------------------------------------------------------------

    def begin(self, folder: Path) -> None:
        """Write the mesh, the completed scene, and the initial state, table rows and checkpoint."""
        simulation = self._simulation
        problem = simulation.problem
        scene = problem.scene
        write_mesh(folder, problem.mesh, problem.points.comm)
        on_root(problem.points.comm, lambda: replace_text(folder / SCENE_FILE, dump_scene(scene)))
        self._open(folder, None)
        self._write_row(StepReport(0, 0.0, 0.0, 0, 0, 0, 0.0, 0.0))
        self.write_state()
        self.flush()

    def resume(self, folder: Path) -> None:
        """Restore the simulation from the newest checkpoint and remove later states and rows.

        Raises
        ------
        InputError
            If the run in the folder cannot continue with this scene; the folder is left unchanged.
        """
        simulation = self._simulation
        problem, scene = simulation.problem, simulation.scene
        check_same_mesh(folder, problem.mesh, used_groups(scene), self._comm)
        checkpoint = read_checkpoint(folder, self._vertices, self._edges, term_arrays(simulation))
        restore(simulation, checkpoint, self._vertices)
        on_root(self._comm, lambda: self._tables.check(folder))
        if checkpoint.note:
            simulation.notes.append(checkpoint.note)
        self.changes, self.earlier_motions = note_changes(simulation, folder / SCENE_FILE)
        if problem.start is not None:
            problem.start = first_positions(folder, self._vertices, otherwise=problem.start)
        self._open(folder, simulation.step_number)
        on_root(self._comm, lambda: replace_text(folder / SCENE_FILE, dump_scene(scene)))
        self._last_state = checkpoint.scalars["last_state"]

    def _open(self, folder: Path, resume_after: int | None) -> None:
        self._folder = folder
        on_root(self._comm, lambda: remove_failure(folder))
        self._states = StateWriter(
            folder,
            self._vertices,
            self._triangles,
            n_triangles=self._simulation.problem.whole.n_triangles,
            resume_after=resume_after,
            vtkhdf=self._simulation.scene.output.vtkhdf,
            time_unit="1" if self._simulation.scene.time.static else "s",
        )
        self._tables.open(folder, resume_after)

    # -- a step --------------------------------------------------------------------------------------

    def record(self, report: StepReport) -> None:
        """Write the rows, state and checkpoint due after an accepted step; files may be completed later."""
        self._steps_since_checkpoint += 1
        due = self._write_row(report)
        control = self._simulation.control
        if control.writes_at(report.time) or self._simulation.finished:
            self.write_state()
        elif due:
            self.write_checkpoint()

    def _checkpoint_is_due(self) -> bool:
        """Whether a checkpoint is due, by steps or by wall time (rank 0).

        It is also due if its cost is negligible compared with the time since the last one, so that a step
        of minutes is not lost if the launcher kills the run a second after its signal.
        """
        checkpoint = self._simulation.scene.output.checkpoint
        if checkpoint.steps is not None and self._steps_since_checkpoint >= checkpoint.steps:
            return True
        elapsed = clock.monotonic() - self._last_checkpoint
        return elapsed >= checkpoint.seconds or elapsed >= MIN_COST_RATIO * self._checkpoint_seconds

    def _write_row(self, report: StepReport) -> bool:
        """Write the step's rows to all tables; returns whether a checkpoint is due by rank 0's clock."""
        rows = self._tables.rows(report)

        def work() -> bool:
            self._tables.append(rows)
            return self._checkpoint_is_due()

        return bool(on_root(self._comm, work))

    # -- states --------------------------------------------------------------------------------------

    def write_state(self) -> None:
        """Write the present state, unless it is written already, and its checkpoint."""
        simulation = self._simulation
        if simulation.step_number == self._last_state:
            self.write_checkpoint()
            return
        problem = simulation.problem
        began = clock.monotonic()
        self._wait_for_disk()
        announce = self._states.write(
            simulation.step_number,
            simulation.time,
            problem.equations.x[: problem.points.n_vertices],
            {field.name: (field.on, field.compute(problem)) for field in self._fields},
        )
        self._last_state = simulation.step_number
        self._write_checkpoint(began, announce)

    def write_checkpoint(self) -> None:
        """Write a checkpoint of the present state."""
        began = clock.monotonic()
        self._wait_for_disk()
        self._write_checkpoint(began)

    def _write_checkpoint(self, began: float, *announce: Callable[[], None]) -> None:
        """Write a checkpoint, whose duration counts from ``began`` on.

        A thread of rank 0 completes it while the run goes on: it brings the state to disk, announces it by
        ``announce``, and then does so with the checkpoint, which hence never follows a state that is lost.
        """
        held = checkpoint_of(self._simulation)
        held.scalars["last_state"] = self._last_state
        publish = write_checkpoint(
            self._folder,
            self._vertices,
            held.arrays,
            held.scalars,
            self._edges,
            held.edges,
            held.elements,
        )

        def complete() -> None:
            for work in (*announce, publish):
                work()

        if self._comm.rank == 0:
            self._completion = self._disk.submit(complete)
        self._last_checkpoint = clock.monotonic()
        self._steps_since_checkpoint = 0
        self._checkpoint_seconds = self._last_checkpoint - began

    def write_failure(self) -> None:
        """Write the files on a failed step: its cause, the state before it and the failing iterate."""
        simulation, failure = self._simulation, self._simulation.failure
        assert failure is not None
        equations, n = simulation.problem.equations, simulation.problem.points.n_vertices
        stuck = failure.failed_solve.of_vertices(n)
        before = {"velocity": equations.v[:n]}  # the equations of the failed step do not hold it
        failing = {"velocity": stuck.velocity, "residual": stuck.residual}
        # positions that are not finite could not be drawn
        position = np.where(np.isfinite(stuck.position), stuck.position, equations.x[:n])
        write_failure(
            self._folder,
            self._vertices,
            simulation.problem.whole.n_triangles,
            simulation.step_number,
            (
                FailureState(failure.time, equations.x[:n], before),
                FailureState(stuck.time, position, failing),
            ),
            failure.text,
        )

    def flush(self) -> None:
        """Wait until the last state and checkpoint are on disk and announced.

        Raises
        ------
        OutputError
            If a file could not be written; states announced before are kept.
        """
        self._wait_for_disk()
        self._states.finish()

    def _wait_for_disk(self) -> None:
        def work() -> None:
            completion, self._completion = self._completion, None
            if completion is not None:
                completion.result()

        on_root(self._comm, work)

    def close(self) -> None:
        """Close the tables; not collective."""
        self._disk.shutdown()
        self._tables.close()
