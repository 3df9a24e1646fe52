"""Writes the files of a run: states, checkpoints, history and other tables. Every method is collective."""

from __future__ import annotations

import os
import time as clock
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.output.checkpoint import Checkpoint, CheckpointWriter, TermArrays, read_checkpoint
from lyra_petsc.output.fields import Field, chosen_fields
from lyra_petsc.output.file_operations import reason, replace_text, writing
from lyra_petsc.output.hdf5 import read_slab
from lyra_petsc.output.history import (
    HISTORY_COLUMNS,
    OBSTACLE_COLUMNS,
    History,
    check_columns,
    vector_columns,
)
from lyra_petsc.output.mesh_file import check_same_mesh, write_mesh
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.run_folder import CHECKPOINT
from lyra_petsc.output.states import FailureState, StateWriter, remove_failure, write_failure
from lyra_petsc.output.stored import open_stored, read_stored
from lyra_petsc.output.xdmf import group_name
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.dump import Change, dump_scene, obstacle_motions, scene_changes
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping import term_states
from lyra_petsc.stepping.simulation import SteppedScene, StepReport
from lyra_petsc.terms.handles.motion import Motion

MAX_LISTED_CHANGES = 12
"""Maximum number of a resumed scene's changes that are listed one by one."""

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
        self._disk = ThreadPoolExecutor(max_workers=1)
        self._synced: Future[None] | None = None  # of rank 0
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
        on_root(problem.points.comm, lambda: replace_text(folder / "scene.yaml", dump_scene(scene)))
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
        check_same_mesh(folder, problem.mesh, _used_groups(scene), self._comm)
        checkpoint = read_checkpoint(folder, self._vertices, self._edges, self._term_arrays())
        on_root(self._comm, lambda: self._check_continuable(folder, checkpoint))
        try:
            self._restore(checkpoint)
        except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(
                f"does not hold what this program writes ({reason(error)}): run without --resume",
                file=checkpoint.file,
            ) from error
        on_root(self._comm, lambda: self._refuse_crossings(checkpoint))
        if checkpoint.note:
            simulation.notes.append(checkpoint.note)
        self._note_changes(folder / "scene.yaml")
        if problem.start is not None:
            problem.start = self._first_positions(folder, otherwise=problem.start)
        self._open(folder, simulation.step_number)
        history, last = self._tables["history.csv"], simulation.step_number
        if (kept := history.kept_until) != last:
            simulation.notes.append(f"{history.path}: the rows of steps {kept + 1} to {last} are lost")
        on_root(self._comm, lambda: replace_text(folder / "scene.yaml", dump_scene(scene)))
        self._last_state = checkpoint.scalars["last_state"]

    def _first_positions(self, folder: Path, *, otherwise: Array) -> Array:
        """Positions [m] of this rank's vertices in state 0, or ``otherwise`` if state 0 cannot be read."""
        file, name, order = folder / "states-0000.h5", f"{group_name(0)}/position", self._vertices

        def readable() -> bool:
            with suppress(InputError):
                read_stored(file, name, (order.n_global, 3), kinds="f")
                return True
            return False

        if not on_root(self._comm, readable):
            return otherwise
        return order.from_slab(read_slab(file, name, order))

    def _restore(self, checkpoint: Checkpoint) -> None:
        """Restore the simulation from a checkpoint."""
        simulation, scalars = self._simulation, checkpoint.scalars
        system, layout = simulation.problem.system, simulation.problem.points
        arrays = {
            name: layout.join(values, checkpoint.edges.get(name))
            for name, values in checkpoint.arrays.items()
        }
        for number, start in enumerate(scalars["late_starts"]):
            system.reference.restore(float(start), arrays[f"start_{number}"])
        system.state.set(arrays["position"], arrays["velocity"])
        terms = simulation.problem.terms
        elements = {
            name: self._changing_elements(terms[name].stencil.shape[1], rows)
            for name, rows in checkpoint.elements.items()
        }
        simulation.resume(arrays, scalars, checkpoint.edges, elements)

    def _term_arrays(self) -> TermArrays:
        """The arrays of the scene's terms in checkpoints."""
        system, terms = self._simulation.problem.system, self._simulation.problem.terms
        widths = {name: rows.shape[1] for name, rows in term_states.element_arrays(system).items()}
        elements = {name: (terms[name].stencil.shape[1], n) for name, n in widths.items()}
        vertices, edges = term_states.vertex_arrays(system), term_states.edge_arrays(system)
        return TermArrays(vertices.keys(), edges.keys(), elements)

    def _changing_elements(self, n: int, rows: Array) -> tuple[Ints, Array]:
        """Changing elements from a checkpoint's rows (E, n + m).

        Returns
        -------
        vertices : (E, n) int64
            Global numbers of each element's vertices.
        data : (E, m) float64
            The other columns.
        """
        layout = self._simulation.problem.points
        numbers = rows[:, :n].astype(np.int64)
        own = layout.start + np.arange(layout.n_vertices)
        return self._vertices.look_up(own, numbers.ravel()).reshape(numbers.shape), rows[:, n:]

    def _check_continuable(self, folder: Path, checkpoint: Checkpoint) -> None:
        """Check that the scene can continue from the checkpoint (rank 0)."""
        now = self._simulation.scene.time.scheme
        before = checkpoint.scalars["scheme"]
        if "static" in (now, before) and now != before:
            raise InputError(
                "a motion does not go on as a static analysis, nor the other way round: run without --resume",
                file=checkpoint.file,
                key="time.analysis",
            )
        for name, columns in self._table_columns().items():
            check_columns(folder / name, columns)

    def _refuse_crossings(self, checkpoint: Checkpoint) -> None:
        """Refuse a scene that is changed so that sheets cross each other or obstacles now (rank 0)."""
        simulation = self._simulation
        scene, mesh = simulation.scene, simulation.problem.mesh
        if scene.contact is None or mesh is None:
            return
        from lyra_petsc.contact.overlaps import refuse_crossings  # with kernels
        from lyra_petsc.mesh.obstacles import build_obstacles

        with open_stored(checkpoint.file) as file:
            positions = file["vertices/position"][()]
        obstacles = build_obstacles(scene, mesh.obstacles, Motion)
        refuse_crossings(scene, mesh, positions, obstacles, simulation.time, f"at {simulation.time_text()}")

    def _note_changes(self, before: Path) -> None:
        """Add notes for the user on the keys in which the scene differs from the one in the folder."""
        scene, notes = self._simulation.scene, self._simulation.notes
        try:
            self.changes = on_root(self._comm, lambda: scene_changes(before, scene))
        except InputError as error:
            notes.append(f"{error}; what has changed since the run was begun is not known")
            return
        if any(change.key.startswith(("obstacles", "motions")) for change in self.changes):
            with suppress(InputError):  # scenes of other versions are compared as text only
                earlier = on_root(
                    self._comm, lambda: obstacle_motions(load_scene(before, meshes_needed=False))
                )
                now = obstacle_motions(scene)
                self.earlier_motions = {n: each for n, each in earlier.items() if n in now and each != now[n]}
        for change in self.changes[:MAX_LISTED_CHANGES]:
            if change.key == "time.end":
                notes.append(str(change))
            elif change.key == "time.integrator":
                notes.append(
                    f"changed since the run was begun: {change} (begins without memory of earlier steps)"
                )
            else:
                notes.append(f"changed since the run was begun: {change}")
        if len(self.changes) > MAX_LISTED_CHANGES:
            notes.append(f"and {len(self.changes) - MAX_LISTED_CHANGES} more changes, listed in summary.json")

    def _table_columns(self) -> dict[str, tuple[str, ...]]:
        """Columns of each table that the scene requests, by file name."""
        scene, system = self._simulation.scene, self._simulation.problem.system
        term_columns = tuple(self._simulation.energy_balance.column_names)
        tables: dict[str, tuple[str, ...]] = {"history.csv": (*HISTORY_COLUMNS, *term_columns)}
        if scene.probes:
            tables["probes.csv"] = vector_columns(list(scene.probes))
        if scene.output.reactions and scene.handles:
            moments = [f"handle{n}_m{axis}" for n in system.held.with_slopes for axis in "xyz"]
            forces = vector_columns([f"handle{n}" for n in range(len(scene.handles))])
            tables["reactions.csv"] = (*forces, *moments)
        if scene.obstacles:
            tables["obstacles.csv"] = OBSTACLE_COLUMNS
        return tables

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
        self._checkpoints = CheckpointWriter(folder, self._vertices, self._edges)
        self._tables = {
            name: History(folder / name, columns, self._comm, resume_after=resume_after)
            for name, columns in self._table_columns().items()
        }

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
        budget = self._simulation.budget
        history: dict[str, float | str] = {
            **asdict(report),
            "kinetic_energy": budget.kinetic,
            "membrane_energy": budget.membrane,
            "bending_energy": budget.bending,
            "potential_energy": budget.potential,
            "external_work": budget.external_work,
            "dissipation": budget.dissipation,
            **self._simulation.energy_balance.columns(),
        }
        rows, energy_balance = {"history.csv": [history]}, self._simulation.energy_balance
        if "probes.csv" in self._tables:
            means = {f"{name}_": mean for name, mean in self._probe_means().items()}
            rows["probes.csv"] = [self._vector_row(report, means)]
        if "reactions.csv" in self._tables:
            handle_forces = energy_balance.handle_forces(len(self._simulation.scene.handles))
            forces = {f"handle{n}_": force for n, force in enumerate(handle_forces)}
            moments = {f"handle{n}_m": moment for n, moment in energy_balance.handle_moments().items()}
            rows["reactions.csv"] = [self._vector_row(report, forces | moments)]
        if names := list(self._simulation.scene.obstacles or {}):
            loads = zip(names, energy_balance.obstacle_forces(len(names)), strict=True)
            rows["obstacles.csv"] = [_obstacle_row(report, *each) for each in loads]

        def work() -> bool:
            for name, lines in rows.items():
                self._tables[name].append(*lines)
            return self._checkpoint_is_due()

        return bool(on_root(self._comm, work))

    @staticmethod
    def _vector_row(report: StepReport, vectors: dict[str, Array]) -> dict[str, float | str]:
        """A table row with the components of vectors; a column's name is the vector's and the axis."""
        row: dict[str, float | str] = {"step": report.step, "time": report.time}
        for name, vector in vectors.items():
            row |= {f"{name}{axis}": float(vector[i]) for i, axis in enumerate("xyz")}
        return row

    def _probe_means(self) -> dict[str, Array]:
        """Mean position [m] of each probe's vertices."""
        problem = self._simulation.problem
        local = np.zeros((len(problem.probes), 4))
        for row, vertices in enumerate(problem.probes.values()):
            local[row, :3] = problem.system.x[vertices].sum(axis=0)
            local[row, 3] = len(vertices)
        total = np.empty_like(local)
        problem.points.comm.Allreduce(local, total, MPI.SUM)
        return {name: total[row, :3] / total[row, 3] for row, name in enumerate(problem.probes)}

    # -- states --------------------------------------------------------------------------------------

    def write_state(self) -> None:
        """Write and announce the present state, unless it is written already, and its checkpoint."""
        simulation = self._simulation
        if simulation.step_number == self._last_state:
            self.write_checkpoint()
            return
        problem = simulation.problem
        began = clock.monotonic()
        self._states.write(
            simulation.step_number,
            simulation.time,
            problem.system.x[: problem.points.n_vertices],
            {field.name: (field.on, field.compute(problem)) for field in self._fields},
        )
        self._last_state = simulation.step_number
        self.write_checkpoint(began)

    def write_checkpoint(self, began: float | None = None) -> None:
        """Write a checkpoint of the present state; its duration counts from ``began`` on, if given."""
        simulation = self._simulation
        system, layout = simulation.problem.system, simulation.problem.points
        n, (saved, scalars) = layout.n_owned, simulation.saved_state()
        rows = {"position": system.x[:n], "velocity": system.v[:n], **saved}
        for number, start in enumerate(sorted(system.reference.late)):
            rows[f"start_{number}"] = system.reference.late[start]
        arrays = {name: layout.split(values)[0] for name, values in rows.items()}
        arrays |= term_states.vertex_arrays(system)
        edges = {name: layout.split(values)[1] for name, values in rows.items()} if self._edges else {}
        edges |= term_states.edge_arrays(system)
        scalars["last_state"] = self._last_state
        began = clock.monotonic() if began is None else began
        elements = term_states.element_arrays(system)
        self._wait_for_disk()  # the previous checkpoint is safe before this one takes its place
        self._checkpoints.write(arrays, scalars, edges, elements)
        if self._comm.rank == 0:
            self._synced = self._disk.submit(_sync, self._folder / CHECKPOINT)
        self._last_checkpoint = clock.monotonic()
        self._steps_since_checkpoint = 0
        self._checkpoint_seconds = self._last_checkpoint - began

    def write_failure(self) -> None:
        """Write the files on a failed step: its cause, the state before it and the failing iterate."""
        simulation, failure = self._simulation, self._simulation.failure
        assert failure is not None
        system, n = simulation.problem.system, simulation.problem.points.n_vertices
        stuck = failure.failed_solve.of_vertices(n)
        before = {"velocity": system.v[:n]}  # the equations of the failed step do not hold it
        failing = {"velocity": stuck.velocity, "residual": stuck.residual}
        # positions that are not finite could not be drawn
        position = np.where(np.isfinite(stuck.position), stuck.position, system.x[:n])
        write_failure(
            self._folder,
            self._vertices,
            simulation.problem.whole.n_triangles,
            simulation.step_number,
            (FailureState(failure.time, system.x[:n], before), FailureState(stuck.time, position, failing)),
            failure.text,
        )

    def flush(self) -> None:
        """Wait until the last checkpoint is on disk, and announce all states.

        Raises
        ------
        OutputError
            If a file could not be written; states announced before are kept.
        """
        self._wait_for_disk()
        self._states.finish()

    def _wait_for_disk(self) -> None:
        def work() -> None:
            synced, self._synced = self._synced, None
            if synced is not None:
                synced.result()

        on_root(self._comm, work)

    def close(self) -> None:
        """Close the tables; not collective."""
        self._disk.shutdown()
        for table in self._tables.values():
            table.close()


def _sync(path: Path) -> None:
    """Write a file from the memory of the operating system to disk."""
    with writing(path), open(path, "rb") as file:
        os.fsync(file.fileno())


def _obstacle_row(report: StepReport, name: str, load: Array) -> dict[str, float | str]:
    """A row of obstacles.csv; ``load`` (8,) as in `EnergyBalance.obstacle_forces`."""
    values: list[float | str] = [report.step, report.time, name, *map(float, load)]
    return dict(zip(OBSTACLE_COLUMNS, values, strict=True))


def _used_groups(scene: Scene) -> set[str]:
    """Names of the mesh's groups that a scene uses."""
    selectors = [*scene.handles, *scene.loads, *scene.probes.values()]
    names = {block.group for block in scene.material} | {selector.group for selector in selectors}
    return {name for name in names if name is not None}
