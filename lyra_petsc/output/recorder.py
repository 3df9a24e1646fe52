"""The files of a run: states, checkpoints, history and other tables; every method is collective."""

from __future__ import annotations

import time as clock
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.output.agreement import reason, replace_text
from lyra_petsc.output.checkpoint import Checkpoint, checkpoint_file, read_checkpoint
from lyra_petsc.output.fields import Field, chosen
from lyra_petsc.output.hdf5 import Background, NewFile, read_slab, write_collective
from lyra_petsc.output.history import (
    HISTORY_COLUMNS,
    OBSTACLE_COLUMNS,
    History,
    check_columns,
    vector_columns,
)
from lyra_petsc.output.mesh_file import check_same_mesh, write_mesh
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.states import StateInTime, StateWriter, remove_failure, write_failure
from lyra_petsc.output.stored import read_stored
from lyra_petsc.output.tensors import plane_components
from lyra_petsc.output.xdmf import group_name
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.dump import Change, dump_scene, scene_changes
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping import term_memory
from lyra_petsc.stepping.simulation import SteppedScene, StepReport

MOST_CHANGES = 12
"""Changes of a resumed scene that are listed one by one."""

CHEAP = 100.0
"""Time since the last checkpoint, over the time that took (with a state, if one was due), from which on
another is written."""


class Recorder:
    """Writes what a scene asks for.

    Construction checks and plans, and touches no file; ``begin`` or ``resume`` opens them.

    Parameters
    ----------
    simulation : SteppedScene

    Attributes
    ----------
    changes : list of Change
        What the scene says otherwise than the one that the run was begun with, after ``resume``.

    Raises
    ------
    InputError
        For a field that the scene cannot have.
    """

    def __init__(self, simulation: SteppedScene) -> None:
        self._simulation = simulation
        problem = simulation.problem
        self._fields: list[Field] = chosen(problem)
        points = problem.points
        self._vertices = FileOrder(points.comm, points.mesh_vertices, points.n_vertices_global)
        self._edges: FileOrder | None = None
        if points.n_edges_global:
            self._edges = FileOrder(points.comm, points.edges, points.n_edges_global)
        self._triangles: FileOrder | None = None
        if any(field.on == "triangle" for field in self._fields):
            elements = problem.membrane.elements
            own = elements.index[: elements.n_owned].astype(np.int64)
            self._triangles = FileOrder(points.comm, own, problem.outline.n_triangles)
        self._comm = points.comm
        self._background = Background(points.comm)
        self._last_checkpoint = clock.monotonic()
        self._steps_since = 0
        self._last_state = -1
        self._checkpoint_seconds = 0.0
        self.changes: list[Change] = []

    # -- opening -------------------------------------------------------------------------------------

    def begin(self, folder: Path) -> None:
        """Write the mesh, the scene as understood, the initial state, row and checkpoint."""
        simulation = self._simulation
        problem = simulation.problem
        scene = problem.scene
        write_mesh(folder, problem.mesh, problem.points.comm)
        on_root(problem.points.comm, lambda: replace_text(folder / "scene.yaml", dump_scene(scene)))
        self._open(folder, None)
        self._write_row(StepReport(0, 0.0, 0.0, 0, 0, 0, 0.0, 0.0))
        self.write_state()
        self.settle()

    def resume(self, folder: Path) -> None:
        """Put the newest checkpoint into the simulation and cut the files behind it.

        Raises
        ------
        InputError
            If the run in the folder cannot go on with this scene; the folder is untouched.
        """
        simulation = self._simulation
        problem, scene = simulation.problem, simulation.scene
        check_same_mesh(folder, problem.mesh, _groups(scene), self._comm)
        checkpoint = read_checkpoint(folder, self._vertices, self._edges)
        on_root(self._comm, lambda: self._check_kind(folder, checkpoint))
        try:
            self._put(checkpoint)
        except (LookupError, TypeError, ValueError) as error:
            raise InputError(
                f"checkpoint is damaged, or was written by another version ({reason(error)}): "
                "run without --resume",
                file=checkpoint.file,
            ) from error
        if checkpoint.note:
            simulation.notes.append(checkpoint.note)
        self._note_changes(folder / "scene.yaml")
        if problem.start is not None:
            problem.start = self._first_positions(folder, otherwise=problem.start)
        self._open(folder, simulation.step_number)
        history, last = self._opened["history.csv"], simulation.step_number
        if (kept := history.kept_until) != last:
            simulation.notes.append(f"{history.path}: the rows of steps {kept + 1} to {last} are lost")
        on_root(self._comm, lambda: replace_text(folder / "scene.yaml", dump_scene(scene)))
        self._last_state = int(checkpoint.scalars["last_state"])

    def _first_positions(self, folder: Path, *, otherwise: Array) -> Array:
        """Positions [m] of this rank's vertices in state 0; the scene's start where that cannot be read."""
        file, name, order = folder / "states-0000.h5", f"{group_name(0)}/position", self._vertices

        def readable() -> bool:
            with suppress(InputError):
                read_stored(file, name, (order.n_global, 3), kinds="f")
                return True
            return False

        if not on_root(self._comm, readable):
            return otherwise
        return order.from_slab(read_slab(file, name, order))

    def _put(self, checkpoint: Checkpoint) -> None:
        """Put a checkpoint into the simulation."""
        simulation, memory = self._simulation, checkpoint.scalars
        system, layout = simulation.problem.system, simulation.problem.points
        arrays = {
            name: layout.join(values, checkpoint.edges.get(name))
            for name, values in checkpoint.arrays.items()
        }
        for number, start in enumerate(memory["late_starts"]):
            system.reference.restore(float(start), arrays[f"start_{number}"])
        system.state.set(arrays["position"], arrays["velocity"])
        terms = simulation.problem.terms
        elements = {
            name: self._elements(terms[name].registration.element_vertices, rows)
            for name, rows in checkpoint.elements.items()
            if name in terms
        }
        simulation.resume(memory, arrays, checkpoint.edges, elements)
        int(memory["last_state"])

    def _elements(self, n: int, rows: Array) -> tuple[Ints, Array]:
        """Vertices (E, n) of elements of a checkpoint, by global numbers, and what it holds of them."""
        layout = self._simulation.problem.points
        numbers = rows[:, :n].astype(np.int64)
        known = bool(((numbers >= 0) & (numbers < layout.n_vertices_global)).all())
        if not self._comm.allreduce(known, MPI.LAND):
            raise ValueError("elements are of vertices that there are not")
        own = layout.start + np.arange(layout.n_vertices)
        return self._vertices.look_up(own, numbers.ravel()).reshape(numbers.shape), rows[:, n:]

    def _check_kind(self, folder: Path, checkpoint: Checkpoint) -> None:
        """Refuse a scene that cannot continue from the checkpoint (rank 0)."""
        now = self._simulation.scene.time.scheme
        before = checkpoint.scalars.get("scheme", now)
        if "static" in (now, before) and now != before:
            raise InputError(
                "a motion does not go on as a static analysis, nor the other way round: run without --resume",
                file=checkpoint.file,
                key="time.analysis",
            )
        for name, columns in self._tables().items():
            check_columns(folder / name, columns)

    def _note_changes(self, before: Path) -> None:
        """Note in which keys the scene differs from the one in the folder."""
        scene, notes = self._simulation.scene, self._simulation.notes
        try:
            self.changes = on_root(self._comm, lambda: scene_changes(before, scene))
        except InputError as error:
            notes.append(f"{error}; what has changed since the run was begun is not known")
            return
        for change in self.changes[:MOST_CHANGES]:
            if change.key == "time.end":
                notes.append(str(change))
            elif change.key == "time.integrator":
                notes.append(
                    f"changed since the run was begun: {change} (begins without memory of earlier steps)"
                )
            else:
                notes.append(f"changed since the run was begun: {change}")
        if len(self.changes) > MOST_CHANGES:
            notes.append(f"and {len(self.changes) - MOST_CHANGES} more changes, listed in summary.json")

    def _tables(self) -> dict[str, tuple[str, ...]]:
        """Names and columns of the tables that the scene asks for."""
        scene, system = self._simulation.scene, self._simulation.problem.system
        more = tuple(self._simulation.ledger.column_names)
        tables: dict[str, tuple[str, ...]] = {"history.csv": (*HISTORY_COLUMNS, *more)}
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
            n_triangles=self._simulation.problem.outline.n_triangles,
            resume_after=resume_after,
            vtkhdf=self._simulation.scene.output.vtkhdf,
            background=self._background,
        )
        self._opened = {
            name: History(folder / name, columns, self._comm, resume_after=resume_after)
            for name, columns in self._tables().items()
        }

    # -- a step --------------------------------------------------------------------------------------

    def record(self, report: StepReport) -> None:
        """Write all that the step just accepted requires, partly in the background of the next steps."""
        self._steps_since += 1
        due = self._write_row(report)
        control = self._simulation.control
        if control.writes_at(report.time) or self._simulation.finished:
            self.write_state()
        elif due:
            self.write_checkpoint()

    def _due(self) -> bool:
        """Whether a checkpoint is due, by steps or by wall time (rank 0).

        Also where it costs next to nothing beside the steps since the last one: a step of minutes is
        then not lost to a launcher that leaves a second to finish.
        """
        asked = self._simulation.scene.output.checkpoint
        if asked.steps is not None and self._steps_since >= asked.steps:
            return True
        elapsed = clock.monotonic() - self._last_checkpoint
        return elapsed >= asked.seconds or elapsed >= CHEAP * self._checkpoint_seconds

    def _write_row(self, report: StepReport) -> bool:
        """A row of each table; whether a checkpoint is due, by rank 0's clock."""
        budget = self._simulation.budget
        history: dict[str, float | str] = {
            **asdict(report),
            "kinetic_energy": budget.kinetic,
            "membrane_energy": budget.membrane,
            "bending_energy": budget.bending,
            "potential_energy": budget.potential,
            "external_work": budget.external_work,
            "dissipation": budget.dissipation,
            **self._simulation.ledger.columns(),
        }
        rows, ledger = {"history.csv": [history]}, self._simulation.ledger
        if "probes.csv" in self._opened:
            means = {f"{name}_": mean for name, mean in self._probe_means().items()}
            rows["probes.csv"] = [self._vectors(report, means)]
        if "reactions.csv" in self._opened:
            pulls = ledger.handle_forces(len(self._simulation.scene.handles))
            forces = {f"handle{n}_": force for n, force in enumerate(pulls)}
            moments = {f"handle{n}_m": moment for n, moment in ledger.handle_moments().items()}
            rows["reactions.csv"] = [self._vectors(report, forces | moments)]
        if names := list(self._simulation.scene.obstacles or {}):
            pushes = zip(names, ledger.obstacle_forces(len(names)), strict=True)
            rows["obstacles.csv"] = [_push(report, *each) for each in pushes]

        def work() -> bool:
            for name, lines in rows.items():
                self._opened[name].append(*lines)
            return self._due()

        return bool(on_root(self._comm, work))

    @staticmethod
    def _vectors(report: StepReport, vectors: dict[str, Array]) -> dict[str, float | str]:
        """A row with the components of vectors, each named by the vector and the axis."""
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
        """Write the present state, to be announced, unless it is written already, and a checkpoint of it."""
        simulation = self._simulation
        if simulation.step_number == self._last_state:
            self.write_checkpoint()
            return
        problem = simulation.problem
        values = {field: field.compute(problem) for field in self._fields}
        for field in values:
            if field.name in self._states.in_plane:
                values[field] = plane_components(values[field])
        with self._checkpoint(last_state=simulation.step_number) as checkpoint:
            self._states.write(
                simulation.step_number,
                simulation.time,
                problem.system.x[: problem.points.n_vertices],
                {field.name: (field.on, value) for field, value in values.items()},
                beside=[checkpoint],  # what is announced is not written again after a kill
            )
        self._last_state = simulation.step_number

    def write_checkpoint(self) -> None:
        """Replace the checkpoint by the present state."""
        with self._checkpoint(self._last_state) as checkpoint:
            write_collective([checkpoint], self._comm, self._background)

    @contextmanager
    def _checkpoint(self, last_state: int) -> Iterator[NewFile]:
        """A checkpoint of the present state, to be written within the context."""
        simulation = self._simulation
        system, layout = simulation.problem.system, simulation.problem.points
        n = layout.n_owned
        rows = {"position": system.x[:n], "velocity": system.v[:n], **simulation.arrays()}
        for number, start in enumerate(sorted(system.reference.late)):
            rows[f"start_{number}"] = system.reference.late[start]
        arrays = {name: layout.split(values)[0] for name, values in rows.items()}
        arrays |= term_memory.vertex_arrays(system)
        edges = {name: layout.split(values)[1] for name, values in rows.items()} if self._edges else {}
        edges |= term_memory.edge_arrays(system)
        scalars = simulation.memory() | {
            "last_state": last_state,
            "scheme": simulation.scene.time.scheme,
        }
        began = clock.monotonic()
        elements = term_memory.element_arrays(system)
        yield checkpoint_file(self._folder, self._vertices, arrays, scalars, self._edges, edges, elements)
        self._last_checkpoint = clock.monotonic()
        self._steps_since = 0
        self._checkpoint_seconds = self._last_checkpoint - began

    def write_failure(self) -> None:
        """Write why the last step could not be taken: the state before it and the failing iterate."""
        simulation, failure = self._simulation, self._simulation.failure
        assert failure is not None
        system, n = simulation.problem.system, simulation.problem.points.n_vertices
        stuck = failure.failed_solve.of_vertices(n)
        before = {"velocity": system.v[:n]}  # the equations of the failed step do not hold it
        failing = {"velocity": stuck.velocity, "residual": stuck.residual}
        # a number that is not finite has no place in space
        position = np.where(np.isfinite(stuck.position), stuck.position, system.x[:n])
        write_failure(
            self._folder,
            self._vertices,
            simulation.problem.outline.n_triangles,
            simulation.step_number,
            (StateInTime(failure.time, system.x[:n], before), StateInTime(stuck.time, position, failing)),
            failure.text,
        )

    def settle(self) -> None:
        """Return when all that was written is on the disk and announced.

        Raises
        ------
        OutputError
            If it could not be; what was announced before stands.
        """
        self._background.settle()
        self._states.finish()

    def close(self) -> None:
        """Close the tables; for one rank. Errors of what is still being written are raised by `settle`."""
        self._background.close()
        for table in self._opened.values():
            table.close()


def _push(report: StepReport, name: str, push: Array) -> dict[str, float | str]:
    """A row of obstacles.csv, of a force and a torque (6,)."""
    values: list[float | str] = [report.step, report.time, name, *map(float, push)]
    return dict(zip(OBSTACLE_COLUMNS, values, strict=True))


def _groups(scene: Scene) -> set[str]:
    """Names of the mesh's groups that a scene uses."""
    selectors = [*scene.handles, *scene.loads, *scene.probes.values()]
    names = {block.group for block in scene.material} | {selector.group for selector in selectors}
    return {name for name in names if name is not None}
