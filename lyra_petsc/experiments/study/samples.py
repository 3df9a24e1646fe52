"""What a run left, at the sample times: positions by slabs, energies and probes as numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.errors import InputError, LyraError
from lyra_petsc.mesh.measures import bounding_diagonal
from lyra_petsc.output.agreement import raise_together
from lyra_petsc.output.read_run import Columns, read_table
from lyra_petsc.output.self_contained import check_folder
from lyra_petsc.output.states import stored_states
from lyra_petsc.output.stored import open_stored
from lyra_petsc.output.stored_mesh import StoredMesh
from lyra_petsc.parallel import on_root

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

FORMS = ("kinetic_energy", "membrane_energy", "bending_energy", "potential_energy")
SAME_TIME = 1e-6
"""Fraction of the time between samples by which a state may miss a sample time."""

ROWS_AT_ONCE = 1 << 16
"""Rows of a file that a rank reads at a time."""


@dataclass
class Surface:
    """The rest shape of a run's mesh, on rank 0.

    Attributes
    ----------
    rest : (V, 3) float64
        [m].
    triangles : (F, 3) int64
    areas : (V,) float64
        Rest area of each vertex [m²]: a third of that of its triangles.
    """

    rest: Array
    triangles: Ints
    areas: Array

    @property
    def size(self) -> float:
        """Diagonal [m] of the bounding box."""
        return bounding_diagonal(self.rest)

    def same_as(self, other: Surface) -> bool:
        """Whether it is the same mesh, vertex by vertex, up to rounding."""
        if self.rest.shape != other.rest.shape or not np.array_equal(self.triangles, other.triangles):
            return False
        return bool(np.abs(self.rest - other.rest).max() <= 1e-9 * max(self.size, other.size))


@dataclass
class Samples:
    """A run at the sample times; the same on all ranks.

    Attributes
    ----------
    folder : Path
    times : tuple of float
        [s].
    files : tuple of (str, str)
        File and dataset of the positions at each time.
    n_vertices : int
    size : float
        Diagonal [m] of the rest shape's bounding box.
    energies : (T, 4) float64
        Kinetic, membrane, bending, potential [J] at each time.
    exchanged : float
        Largest change [J] of any of them since the start, over all steps.
    probes : dict of name → (T, 3) float64
        [m].
    """

    folder: Path
    times: tuple[float, ...]
    files: tuple[tuple[str, str], ...]
    n_vertices: int
    size: float
    energies: Array
    exchanged: float
    probes: dict[str, Array] = field(default_factory=dict)

    def rows(self, comm: MPI.Comm, sample: int, wanted: Ints | None = None) -> Array:
        """Positions (n, 3) [m] of this rank's slab of vertices, or of the vertices ``wanted``; collective.

        Parameters
        ----------
        comm : MPI.Comm
        sample : int
        wanted : (n,) int, optional
            Ascending vertex numbers.

        Raises
        ------
        InputError
            On every rank, if the file cannot be read.
        """
        file, dataset = self.files[sample]
        problem: LyraError | None = None
        rows: Array = np.empty((0, 3))
        try:
            with open_stored(self.folder / file) as opened:
                stored = opened[dataset]
                if wanted is None:
                    start, stop = slab(comm, self.n_vertices)
                    rows = stored[start:stop]
                else:
                    rows = _picked(stored, wanted)
        except InputError as error:
            problem = error
        raise_together(comm, problem)
        return rows


def slab(comm: MPI.Comm, n: int, rank: int | None = None) -> tuple[int, int]:
    """First row and the row after the last of a rank's share of n rows; this one's unless told."""
    rank = comm.rank if rank is None else rank
    return rank * n // comm.size, (rank + 1) * n // comm.size


def scatter(comm: MPI.Comm, rows: NDArray[Any] | None) -> NDArray[Any]:
    """This rank's slab of rows (n, …) that rank 0 has; collective."""
    pieces: list[NDArray[Any]] = []
    if rows is not None:
        pieces = [rows[slice(*slab(comm, len(rows), rank))] for rank in range(comm.size)]
    return np.asarray(comm.scatter(pieces, root=0))


def _picked(stored: Any, wanted: Ints) -> Array:
    """Rows of a dataset, read in pieces so that a rank never holds all of it."""
    out = np.empty((len(wanted), 3))
    for start in range(0, stored.shape[0], ROWS_AT_ONCE):
        first, last = np.searchsorted(wanted, [start, start + ROWS_AT_ONCE])
        if last > first:
            piece = stored[start : start + ROWS_AT_ONCE]
            out[first:last] = piece[wanted[first:last] - start]
    return out


def read_surface(folder: Path) -> Surface:
    """The mesh of a run. For rank 0.

    Raises
    ------
    InputError
        If ``mesh.h5`` is missing or damaged.
    """
    mesh = StoredMesh(folder)
    rest, triangles, uv = mesh.rest, mesh.triangles, mesh.corner_uv
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    thirds = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 6.0
    areas = np.bincount(triangles.ravel(), np.repeat(thirds, 3), len(rest)).astype(np.float64)
    return Surface(rest, triangles, areas)


def read_samples(comm: MPI.Comm, folder: Path, times: Sequence[float], spacing: float) -> Samples:
    """What a run left at the sample times; collective.

    Parameters
    ----------
    folder : Path
    times : sequence of float
        [s].
    spacing : float
        Time between samples [s]; states within 1e-6 of it count.

    Raises
    ------
    InputError
        On every rank, if a state, the mesh or the history is missing.
    """
    found = on_root(comm, lambda: read_here(folder, times, spacing))
    assert found is not None
    return found


def read_here(folder: Path, times: Sequence[float], spacing: float) -> Samples:
    """As ``read_samples``, on one rank and for it alone."""
    states = []
    if folder.is_dir():
        check_folder(folder)
        states = stored_states(folder)
    if not states:
        raise InputError("holds no states of a run", file=folder)
    at = np.array([state.time for state in states])
    files = []
    for time in times:
        nearest = int(np.abs(at - time).argmin())
        if abs(at[nearest] - time) > SAME_TIME * spacing:
            raise InputError(
                f"has no state at t = {time:g} s, which is a sample time (its states run from "
                f"{at.min():g} to {at.max():g} s); run it with output.every = {spacing:g}",
                file=folder,
            )
        number = states[nearest].number
        files.append((states[nearest].file, f"states/{number:06d}/position"))
    surface = read_surface(folder)
    history, at_samples = _table(folder / "history.csv", times)
    energies = np.column_stack([history[name] for name in FORMS])
    probes = {}
    if (folder / "probes.csv").is_file():
        table, chosen = _table(folder / "probes.csv", times)
        names = [name.removesuffix("_x") for name in table if name.endswith("_x")]
        probes = {
            name: np.column_stack([table[f"{name}_{axis}"] for axis in "xyz"])[chosen] for name in names
        }
    exchanged = float(np.abs(energies - energies[0]).max())
    return Samples(
        folder, tuple(times), tuple(files), len(surface.rest), surface.size, energies[at_samples], exchanged,
        probes,
    )  # fmt: skip


def _table(path: Path, times: Sequence[float]) -> tuple[Columns, list[int]]:
    """A table's columns, and the rows nearest to the sample times."""
    columns = read_table(path)
    if not len(columns["time"]):
        raise InputError("has no rows", file=path)
    return columns, [int(np.abs(columns["time"] - time).argmin()) for time in times]
