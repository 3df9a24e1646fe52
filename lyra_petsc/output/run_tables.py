"""The tables of a run: history.csv, and others that the scene requests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TypeAlias

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.output.history import (
    HISTORY_COLUMNS,
    OBSTACLE_COLUMNS,
    History,
    check_columns,
    vector_columns,
)
from lyra_petsc.output.layout import HISTORY, OBSTACLES, PROBES, REACTIONS
from lyra_petsc.stepping.simulation import SteppedScene, StepReport
from lyra_petsc.terms.energies import ENERGIES
from lyra_petsc.terms.protocols import WritesTable

Row: TypeAlias = Mapping[str, float | str]


class RunTables:
    """The tables that a scene requests.

    Parameters
    ----------
    simulation : SteppedScene

    Attributes
    ----------
    columns : dict of str to tuple of str
        Columns of each table by file name.
    """

    def __init__(self, simulation: SteppedScene) -> None:
        self._simulation = simulation
        scene, held = simulation.scene, simulation.problem.equations.held
        term_columns = tuple(simulation.energy_balance.column_names)
        self.columns: dict[str, tuple[str, ...]] = {HISTORY: (*HISTORY_COLUMNS, *term_columns)}
        if scene.probes:
            self.columns[PROBES] = vector_columns(list(scene.probes))
        if scene.output.reactions and scene.handles:
            moments = [f"handle{n}_m{axis}" for n in held.with_slopes for axis in "xyz"]
            forces = vector_columns([f"handle{n}" for n in range(len(scene.handles))])
            self.columns[REACTIONS] = (*forces, *moments)
        if scene.obstacles:
            self.columns[OBSTACLES] = OBSTACLE_COLUMNS
        self._of_terms = [t for t in simulation.problem.terms.values() if isinstance(t, WritesTable)]
        for term in self._of_terms:
            self.columns[term.table] = ("step", "time", *term.table_columns)
        self._files: dict[str, History] = {}

    def check(self, folder: Path) -> None:
        """Check that the tables in a folder can be continued (rank 0).

        Raises
        ------
        InputError
            If one has other columns.
        """
        for name, columns in self.columns.items():
            check_columns(folder / name, columns)

    def open(self, folder: Path, resume_after: int | None) -> None:
        """Create the files, or continue them after a step; collective. Notes rows that are lost."""
        comm = self._simulation.problem.points.comm
        self._files = {
            name: History(folder / name, columns, comm, resume_after=resume_after)
            for name, columns in self.columns.items()
        }
        history = self._files[HISTORY]
        if resume_after is not None and history.kept_until != resume_after:
            lost = f"the rows of steps {history.kept_until + 1} to {resume_after} are lost"
            self._simulation.notes.append(f"{history.path}: {lost}")

    def rows(self, report: StepReport) -> dict[str, Sequence[Row]]:
        """The rows of a step for each table; collective."""
        budget, energy_balance = self._simulation.budget, self._simulation.energy_balance
        history: Row = {
            **asdict(report),
            "kinetic_energy": budget.kinetic,
            **dict(zip(ENERGIES, (budget.membrane, budget.bending, budget.potential), strict=True)),
            "external_work": budget.external_work,
            "dissipation": budget.dissipation,
            **energy_balance.columns(),
        }
        rows: dict[str, Sequence[Row]] = {HISTORY: [history]}
        if PROBES in self.columns:
            means = {f"{name}_": mean for name, mean in self._probe_means().items()}
            rows[PROBES] = [_vector_row(report, means)]
        if REACTIONS in self.columns:
            handle_forces = energy_balance.handle_forces(len(self._simulation.scene.handles))
            forces = {f"handle{n}_": force for n, force in enumerate(handle_forces)}
            moments = {f"handle{n}_m": moment for n, moment in energy_balance.handle_moments().items()}
            rows[REACTIONS] = [_vector_row(report, forces | moments)]
        if names := list(self._simulation.scene.obstacles or {}):
            loads = zip(names, energy_balance.obstacle_forces(len(names)), strict=True)
            rows[OBSTACLES] = [
                dict(zip(OBSTACLE_COLUMNS, (report.step, report.time, name, *map(float, load)), strict=True))
                for name, load in loads
            ]
        here = self._simulation.problem.equations.here() if self._of_terms else None
        for term in self._of_terms:
            assert here is not None
            entries = term.table_rows(here.x, here.frozen[term])
            rows[term.table] = [
                dict(zip(self.columns[term.table], (report.step, report.time, *entry), strict=True))
                for entry in entries
            ]
        return rows

    def append(self, rows: Mapping[str, Sequence[Row]]) -> None:
        """Write the rows of a step (rank 0).

        Raises
        ------
        OutputError
            If a file cannot be written.
        """
        for name, lines in rows.items():
            self._files[name].append(*lines)

    def close(self) -> None:
        """Close the files; not collective."""
        for table in self._files.values():
            table.close()

    def _probe_means(self) -> dict[str, Array]:
        """Mean position [m] of each probe's vertices."""
        problem = self._simulation.problem
        local = np.zeros((len(problem.probes), 4))
        for row, vertices in enumerate(problem.probes.values()):
            local[row, :3] = problem.equations.x[vertices].sum(axis=0)
            local[row, 3] = len(vertices)
        total = np.empty_like(local)
        problem.points.comm.Allreduce(local, total, MPI.SUM)
        return {name: total[row, :3] / total[row, 3] for row, name in enumerate(problem.probes)}


def _vector_row(report: StepReport, vectors: Mapping[str, Array]) -> Row:
    """A table row with the components of vectors; a column's name is the vector's and the axis."""
    row: dict[str, float | str] = {"step": report.step, "time": report.time}
    for name, vector in vectors.items():
        row |= {f"{name}{axis}": float(vector[i]) for i, axis in enumerate("xyz")}
    return row
