"""Errors of a run against a reference at the sample times.

Each rank compares a slab of vertices, so that no rank holds a whole state. Between different meshes of the
same sheets each vertex gets the barycentric coordinates of the closest point of its sheet in the other mesh's
rest shape. On flat sheets this is linear interpolation in material coordinates; where two meshes approximate
a curved outline or surface differently, vertices are projected onto the closest triangle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.experiments.exact_motions import ExactMotion
from lyra_petsc.experiments.study.plan import MEAN_SQUARE, StudyQuantity
from lyra_petsc.mesh.measures import bounding_diagonal
from lyra_petsc.output.file_operations import on_every_rank
from lyra_petsc.output.read_run import ENERGIES, Columns, read_table, stored_states
from lyra_petsc.output.stored import StoredMesh, open_stored
from lyra_petsc.parallel import on_root

ROWS_AT_ONCE = 1 << 16
"""Rows of a file that a rank reads at once."""


@dataclass
class RestSurface:
    """The rest shape of a run's mesh, on rank 0.

    Attributes
    ----------
    rest : (V, 3) float64
        [m].
    triangles : (F, 3) int64
    areas : (V,) float64
        Rest area of each vertex [m²]: a third of the area of its triangles.
    """

    rest: Array
    triangles: Ints
    areas: Array

    @property
    def size(self) -> float:
        """Diagonal [m] of the bounding box."""
        return bounding_diagonal(self.rest)

    def same_as(self, other: RestSurface) -> bool:
        """Whether it is the same mesh, vertex by vertex, up to rounding."""
        if self.rest.shape != other.rest.shape or not np.array_equal(self.triangles, other.triangles):
            return False
        return bool(np.abs(self.rest - other.rest).max() <= 1e-9 * max(self.size, other.size))


@dataclass
class Samples:
    """Data of a run at the sample times; the same on all ranks.

    Attributes
    ----------
    folder : Path
    times : tuple of float
        [s].
    files : tuple of (str, str)
        File and dataset of the positions at each time.
    n_vertices : int
    size : float
        Diagonal [m] of the bounding box of the rest shape.
    energies : (T, 4) float64
        Kinetic, membrane, bending and potential energy [J] at each time.
    exchanged : float
        Largest change [J] of any of these energies since the start, over all steps.
    probes : dict of name → (T, 3) float64
        Positions of probes [m].
    sheets : sequence of int
        Number of vertices of each mesh source; needed for runs on different meshes.
    """

    folder: Path
    times: tuple[float, ...]
    files: tuple[tuple[str, str], ...]
    n_vertices: int
    size: float
    energies: Array
    exchanged: float
    probes: dict[str, Array]
    sheets: Sequence[int] = ()

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

        def read() -> Array:
            with open_stored(self.folder / file) as opened:
                stored = opened[dataset]
                if wanted is not None:
                    return _read_rows(stored, wanted)
                return stored[slice(*slab(comm, self.n_vertices))]

        return on_every_rank(comm, read)


def slab(comm: MPI.Comm, n: int, rank: int | None = None) -> tuple[int, int]:
    """First row and the row after the last of a rank's share of n rows; by default of this rank."""
    rank = comm.rank if rank is None else rank
    return rank * n // comm.size, (rank + 1) * n // comm.size


def scatter(comm: MPI.Comm, rows: NDArray[Any] | None) -> NDArray[Any]:
    """Distribute rows (n, …) of rank 0; returns this rank's slab; collective."""
    pieces: list[NDArray[Any]] = []
    if rows is not None:
        pieces = [rows[slice(*slab(comm, len(rows), rank))] for rank in range(comm.size)]
    return np.asarray(comm.scatter(pieces, root=0))


def _read_rows(stored: Any, wanted: Ints) -> Array:
    """Some rows of a dataset, read in pieces so that a rank never holds all of it."""
    out = np.empty((len(wanted), 3))
    for start in range(0, stored.shape[0], ROWS_AT_ONCE):
        first, last = np.searchsorted(wanted, [start, start + ROWS_AT_ONCE])
        if last > first:
            piece = stored[start : start + ROWS_AT_ONCE]
            out[first:last] = piece[wanted[first:last] - start]
    return out


def read_surface(folder: Path) -> RestSurface:
    """Read the rest shape of a run. For rank 0.

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
    return RestSurface(rest, triangles, areas)


def read_samples(
    comm: MPI.Comm, folder: Path, times: Sequence[float], spacing: float, sheets: Sequence[int] = ()
) -> Samples:
    """Read the data of a run at the sample times; collective.

    Parameters
    ----------
    folder : Path
    times : sequence of float
        Sample times [s].
    spacing : float
        Time between samples [s]; times of states may differ by 1e-6 of it.
    sheets : sequence of int
        Number of vertices of each mesh source; needed for comparison with another mesh.

    Raises
    ------
    InputError
        On every rank, if a state, the mesh or the history is missing.
    """
    return on_root(comm, lambda: read_local(folder, times, spacing, sheets))


def read_local(folder: Path, times: Sequence[float], spacing: float, sheets: Sequence[int] = ()) -> Samples:
    """As ``read_samples``, on one rank only."""
    states = stored_states(folder)
    at = np.array([state.time for state in states])
    files = []
    for time in times:
        nearest = int(np.abs(at - time).argmin())
        # fraction of the time between samples by which the time of a state may differ from a sample time
        if abs(at[nearest] - time) > 1e-6 * spacing:
            raise InputError(
                f"has no state at t = {time:g} s, which is a sample time (its states run from "
                f"{at.min():g} to {at.max():g} s); run it with output.every = {spacing:g}",
                file=folder,
            )
        number = states[nearest].number
        files.append((states[nearest].file, f"states/{number:06d}/position"))
    surface = read_surface(folder)
    history, at_samples = _table(folder / "history.csv", times)
    energies = np.column_stack([history[name] for name in ENERGIES])
    probes = {}
    if (folder / "probes.csv").is_file():
        table, chosen = _table(folder / "probes.csv", times)
        for name in (name.removesuffix("_x") for name in table if name.endswith("_x")):
            probes[name] = np.column_stack([table[f"{name}_{axis}"] for axis in "xyz"])[chosen]
    exchanged = float(np.abs(energies - energies[0]).max())
    return Samples(
        folder, tuple(times), tuple(files), len(surface.rest), surface.size, energies[at_samples], exchanged,
        probes, sheets,
    )  # fmt: skip


def _table(path: Path, times: Sequence[float]) -> tuple[Columns, list[int]]:
    """The columns of a table, and the rows nearest to the sample times."""
    columns = read_table(path)
    if not len(columns["time"]):
        raise InputError("has no rows", file=path)
    return columns, [int(np.abs(columns["time"] - time).argmin()) for time in times]


@dataclass
class Interpolation:
    """Interpolation from another mesh at this rank's slab of points.

    Attributes
    ----------
    wanted : (m,) int64
        Vertices of the other mesh that this rank reads, ascending.
    corner : (n, 3) int64
        Corners of the triangle of each point, as indices into ``wanted``.
    weight : (n, 3) float64
        Barycentric coordinates.
    """

    wanted: Ints
    corner: Ints
    weight: Array

    def rows(self, comm: MPI.Comm, samples: Samples, sample: int) -> Array:
        """Positions (n, 3) [m] of the other mesh's surface at this rank's points; collective."""
        found = samples.rows(comm, sample, self.wanted)
        return np.einsum("nc,nci->ni", self.weight, found[self.corner])


def make_interpolation(
    comm: MPI.Comm,
    points: RestSurface | None,
    point_sheets: Sequence[int],
    other: RestSurface | None,
    other_sheets: Sequence[int],
) -> Interpolation:
    """Make the interpolation from ``other`` to the vertices of ``points``; collective, computed on rank 0.

    Parameters
    ----------
    points, other : RestSurface
        Needed on rank 0 only.
    point_sheets, other_sheets : sequence of int
        Number of vertices of each sheet; the vertices of a sheet are numbered consecutively.
    """

    def locate() -> tuple[Ints, Array]:
        assert points is not None
        assert other is not None
        corner = np.empty((len(points.rest), 3), dtype=np.int64)
        weight = np.empty((len(points.rest), 3))
        ends, others = np.cumsum([0, *point_sheets]), np.cumsum([0, *other_sheets])
        for sheet in range(len(point_sheets)):
            mine = slice(ends[sheet], ends[sheet + 1])
            first = other.triangles[:, 0]
            triangles = other.triangles[(first >= others[sheet]) & (first < others[sheet + 1])]
            corner[mine], weight[mine] = _nearest_triangles(points.rest[mine], other.rest, triangles)
        return corner, weight

    corner, weight = (scatter(comm, rows) for rows in on_root(comm, locate, share=False) or (None, None))
    wanted, inverse = np.unique(corner, return_inverse=True)
    return Interpolation(wanted, inverse.reshape(corner.shape).astype(np.int64), weight)


def _nearest_triangles(points: Array, vertices: Array, triangles: Ints) -> tuple[Ints, Array]:
    from scipy.spatial import cKDTree

    corners = vertices[triangles]
    # number of triangles with the nearest centroids among which the closest triangle is searched
    count = min(12, len(triangles))
    _, found = cKDTree(corners.mean(axis=1)).query(points, k=count)
    near = np.asarray(found).ravel()
    repeated = np.repeat(points, count, axis=0)
    weights = barycentric(repeated, corners[near])
    distance = np.linalg.norm(np.einsum("nc,nci->ni", weights, corners[near]) - repeated, axis=1)
    best = distance.reshape(-1, count).argmin(axis=1) + count * np.arange(len(points))
    return triangles[near[best]], weights[best]


def barycentric(points: Array, corners: Array) -> Array:
    """Barycentric coordinates (n, 3) of the closest points of triangles (n, 3, 3) to points (n, 3)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    u, v, w = b - a, c - a, points - a
    uu, uv, vv = _dot(u, u), _dot(u, v), _dot(v, v)
    wu, wv = _dot(w, u), _dot(w, v)
    area = uu * vv - uv * uv
    s, t = (vv * wu - uv * wv) / area, (uu * wv - uv * wu) / area
    weights: Array = np.stack([1.0 - s - t, s, t], axis=1)
    outside = (weights < 0.0).any(axis=1)
    if outside.any():
        weights[outside] = _nearest_on_sides(points[outside], corners[outside])
    return weights


def _nearest_on_sides(points: Array, corners: Array) -> Array:
    """Barycentric coordinates of the closest points on the three sides."""
    sides, offsets = np.roll(corners, -1, axis=1) - corners, points[:, None] - corners
    along = np.clip(_dot(offsets, sides) / _dot(sides, sides), 0.0, 1.0)
    side = np.linalg.norm(along[:, :, None] * sides - offsets, axis=2).argmin(axis=1)
    rows, weights = np.arange(len(side)), np.zeros((len(side), 3))
    weights[rows, side], weights[rows, (side + 1) % 3] = 1.0 - along[rows, side], along[rows, side]
    return weights


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("...i,...i->...", a, b))


Errors = dict[str, float]
"""Relative errors by the name of the quantity; NaN where an error is unknown."""

History = dict[str, Array]
"""Relative errors at each sample after the start, by the name of the quantity."""

Rows = Callable[[int], Array]
"""Positions (n, 3) [m] of this rank's points at a sample."""


def motion_errors(
    comm: MPI.Comm, samples: Samples, motion: ExactMotion, quantities: Sequence[StudyQuantity]
) -> Errors:
    """Errors of a run against an exact motion; collective."""
    start, times = samples.rows(comm, 0), samples.times
    forms = [motion.energies(t) for t in times]
    exact = np.array([[form.kinetic, form.membrane, 0.0, form.potential] for form in forms])
    probes = {
        name: np.concatenate([motion.positions(path[:1], t) for t in times])
        for name, path in samples.probes.items()
    }
    whole = replace(samples, energies=exact, exchanged=float(np.abs(exact - exact[0]).max()), probes=probes)

    def positions() -> History:
        surface = on_root(comm, lambda: read_surface(samples.folder), share=False)
        return _distances(comm, samples, lambda i: motion.positions(start, times[i]), surface, samples.size)

    return overall(_errors(samples, whole, quantities, positions))


def run_errors(comm: MPI.Comm, mine: Samples, other: Samples, quantities: Sequence[StudyQuantity]) -> Errors:
    """Errors of a run against another, over all samples; collective."""
    return overall(history_against_run(comm, mine, other, quantities))


def history_against_run(
    comm: MPI.Comm, mine: Samples, other: Samples, quantities: Sequence[StudyQuantity]
) -> History:
    """Errors of a run against another at each sample; collective.

    On different meshes the finer solution is interpolated at the rest positions of the coarser mesh's
    vertices.
    """
    return _errors(mine, other, quantities, lambda: _errors_between(comm, mine, other))


def _errors(
    mine: Samples, other: Samples, quantities: Sequence[StudyQuantity], positions: Callable[[], History]
) -> History:
    """Errors of the quantities in their order; empty where they are unknown."""
    found: History = {}
    if any(quantity.name.startswith("position") for quantity in quantities):
        found |= positions()
    if other.exchanged > 0.0:  # the error of the total over the largest energy exchanged
        totals = mine.energies.sum(axis=1), other.energies.sum(axis=1)
        found["energy"] = np.abs(totals[0] - totals[1]) / other.exchanged
    for quantity in quantities:
        name = quantity.probe
        if name in mine.probes and name in other.probes:
            error = mine.probes[name] - other.probes[name]
            found[quantity.name] = np.asarray(np.linalg.norm(error, axis=1) / other.size)
    return {quantity.name: found.get(quantity.name, np.empty(0)) for quantity in quantities}


def overall(history: History) -> Errors:
    """The error over all samples: root mean square of L2 norms, maximum of other quantities."""
    found = dict.fromkeys(history, math.nan)
    for name, errors in history.items():
        if len(errors):
            mean = name == MEAN_SQUARE
            found[name] = math.sqrt(float(np.mean(errors**2))) if mean else float(errors.max())
    return found


def _errors_between(comm: MPI.Comm, run: Samples, reference: Samples) -> History:
    coarse, fine = (reference, run) if run.n_vertices > reference.n_vertices else (run, reference)
    found = on_root(comm, lambda: [read_surface(each.folder) for each in (coarse, fine)], share=False)
    points, other = found or (None, None)
    same = comm.bcast(points is not None and other is not None and points.same_as(other), root=0)
    rows: Rows = partial(fine.rows, comm)
    if not same:
        rows = partial(make_interpolation(comm, points, coarse.sheets, other, fine.sheets).rows, comm, fine)
    return _distances(comm, coarse, rows, points, reference.size)


def _distances(
    comm: MPI.Comm, samples: Samples, exact: Rows, surface: RestSurface | None, size: float
) -> History:
    """Largest and area-weighted L2 error at each sample after the start; ``surface`` is on rank 0."""
    areas = scatter(comm, None if surface is None else surface.areas)
    whole = comm.allreduce(float(areas.sum()))
    count = len(samples.times) - 1
    largest, squares = np.empty(count), np.empty(count)
    for i in range(count):
        distance = np.linalg.norm(samples.rows(comm, i + 1) - exact(i + 1), axis=1)
        largest[i] = comm.allreduce(float(distance.max(initial=0.0)), MPI.MAX)
        squares[i] = comm.allreduce(float(areas @ distance**2)) / whole
    return {"position_max": largest / size, MEAN_SQUARE: np.sqrt(squares) / size}
