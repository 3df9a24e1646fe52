"""Errors of a run against a reference at the sample times, computed on one rank.

Between different meshes of the same sheets each vertex gets the barycentric coordinates of the closest point
of its sheet in the other mesh's rest shape. On flat sheets this is linear interpolation in material
coordinates; where two meshes approximate a curved outline or surface differently, vertices are projected onto
the closest triangle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.experiments.exact_motions import ExactMotion
from lyra_petsc.experiments.study.plan import MEAN_SQUARE, StudyQuantity
from lyra_petsc.mesh.measures import bounding_diagonal
from lyra_petsc.output.read_run import ENERGIES, Columns, StoredRun, read_table
from lyra_petsc.output.stored import StoredMesh


@dataclass
class RestSurface:
    """The rest shape of a run's mesh.

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
    """Data of a run or an exact motion at the sample times.

    Attributes
    ----------
    times : sequence of float
        [s].
    positions : callable
        Positions (V, 3) [m] by the number of a sample.
    surface : RestSurface
    energies : (T, 4) float64
        Kinetic, membrane, bending and potential energy [J] at each time.
    exchanged : float
        Largest change [J] of any of these energies since the start, over all steps.
    probes : dict of name → (T, 3) float64
        Positions of probes [m].
    sheets : sequence of int
        Number of vertices of each mesh source; needed for runs on different meshes.
    """

    times: Sequence[float]
    positions: Callable[[int], Array]
    surface: RestSurface
    energies: Array
    exchanged: float
    probes: dict[str, Array]
    sheets: Sequence[int] = ()


def read_surface(folder: Path) -> RestSurface:
    """Read the rest shape of a run.

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


def read_samples(folder: Path, times: Sequence[float], spacing: float, sheets: Sequence[int] = ()) -> Samples:
    """Read the data of a run at the sample times.

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
        If a state, the mesh or the history is missing.
    """
    run = StoredRun(folder)
    states = [run.at(time) for time in times]
    for time, state in zip(times, states, strict=True):
        if abs(run.times[state] - time) > 1e-6 * spacing:
            raise InputError(
                f"has no state at t = {time:g} s, which is a sample time (its states run from "
                f"{run.times.min():g} to {run.times.max():g} s); run it with output.every = {spacing:g}",
                file=folder,
            )
    history, rows = _table(folder / "history.csv", times)
    energies = np.column_stack([history[name] for name in ENERGIES])
    probes = {}
    if (folder / "probes.csv").is_file():
        table, at_samples = _table(folder / "probes.csv", times)
        for name in (name.removesuffix("_x") for name in table if name.endswith("_x")):
            probes[name] = np.column_stack([table[f"{name}_{axis}"] for axis in "xyz"])[at_samples]
    exchanged = float(np.abs(energies - energies[0]).max())
    surface = read_surface(folder)
    return Samples(
        times, lambda i: run.positions[states[i]], surface, energies[rows], exchanged, probes, sheets
    )


def _table(path: Path, times: Sequence[float]) -> tuple[Columns, list[int]]:
    """The columns of a table, and the rows nearest to the sample times."""
    columns = read_table(path)
    if not len(columns["time"]):
        raise InputError("has no rows", file=path)
    return columns, [int(np.abs(columns["time"] - time).argmin()) for time in times]


def samples_of_motion(motion: ExactMotion, run: Samples) -> Samples:
    """An exact motion at the vertices, probes and sample times of a run."""
    start = run.positions(0)
    forms = [motion.energies(t) for t in run.times]
    energies = np.array([[form.kinetic, form.membrane, 0.0, form.potential] for form in forms])
    return replace(
        run,
        positions=lambda i: motion.positions(start, run.times[i]),
        energies=energies,
        exchanged=float(np.abs(energies - energies[0]).max()),
        probes={
            name: np.concatenate([motion.positions(path[:1], t) for t in run.times])
            for name, path in run.probes.items()
        },
    )


def interpolation(
    points: RestSurface, point_sheets: Sequence[int], other: RestSurface, other_sheets: Sequence[int]
) -> tuple[Ints, Array]:
    """Corners (V, 3) in ``other`` and their weights (V, 3) for the vertices of ``points``.

    The sheets are numbers of vertices; the vertices of a sheet are numbered consecutively.
    """
    corner, weight = np.empty((len(points.rest), 3), dtype=np.int64), np.empty((len(points.rest), 3))
    ends, others = np.cumsum([0, *point_sheets]), np.cumsum([0, *other_sheets])
    first = other.triangles[:, 0]
    for sheet in range(len(point_sheets)):
        mine = slice(ends[sheet], ends[sheet + 1])
        triangles = other.triangles[(first >= others[sheet]) & (first < others[sheet + 1])]
        corner[mine], weight[mine] = _nearest_triangles(points.rest[mine], other.rest, triangles)
    return corner, weight


def _nearest_triangles(points: Array, vertices: Array, triangles: Ints) -> tuple[Ints, Array]:
    from scipy.spatial import cKDTree

    corners = vertices[triangles]
    # number of triangles with the nearest centroids among which the closest triangle is searched
    count = min(12, len(triangles))
    _, nearest = cKDTree(corners.mean(axis=1)).query(points, k=count)
    near = np.asarray(nearest).ravel()
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
"""Relative errors at each sample after the start, by the name of the quantity; empty where unknown."""


def error_history(run: Samples, reference: Samples, quantities: Sequence[StudyQuantity]) -> History:
    """Errors of a run against a reference at each sample, by quantity.

    On different meshes the finer solution is interpolated at the rest positions of the coarser mesh's
    vertices.
    """
    errors: History = {}
    if any(quantity.name.startswith("position") for quantity in quantities):
        errors |= _position_errors(run, reference)
    if reference.exchanged > 0.0:  # the error of the total over the largest energy exchanged
        totals = run.energies.sum(axis=1), reference.energies.sum(axis=1)
        errors["energy"] = np.abs(totals[0] - totals[1]) / reference.exchanged
    for quantity in quantities:
        name = quantity.probe
        if name in run.probes and name in reference.probes:
            error = run.probes[name] - reference.probes[name]
            errors[quantity.name] = np.asarray(np.linalg.norm(error, axis=1) / reference.surface.size)
    return {quantity.name: errors.get(quantity.name, np.empty(0)) for quantity in quantities}


def overall(history: History) -> Errors:
    """The error over all samples: root mean square of L2 norms, maximum of other quantities."""

    def one(name: str, errors: Array) -> float:
        if not len(errors):
            return math.nan
        return math.sqrt(float(np.mean(errors**2))) if name == MEAN_SQUARE else float(errors.max())

    return {name: one(name, errors) for name, errors in history.items()}


def _position_errors(run: Samples, reference: Samples) -> History:
    """Largest and area-weighted L2 error at each sample after the start."""
    coarse, fine = run, reference
    if len(run.surface.rest) > len(reference.surface.rest):
        coarse, fine = reference, run
    areas = coarse.surface.areas / coarse.surface.areas.sum()
    same = coarse.surface.same_as(fine.surface)
    if not same:
        corner, weight = interpolation(coarse.surface, coarse.sheets, fine.surface, fine.sheets)
    largest, squares = [], []
    for i in range(1, len(run.times)):
        x = fine.positions(i)
        x = x if same else np.einsum("nc,nci->ni", weight, x[corner])
        distance = np.linalg.norm(coarse.positions(i) - x, axis=1)
        largest.append(distance.max())
        squares.append(areas @ distance**2)
    size = reference.surface.size
    return {"position_max": np.array(largest) / size, MEAN_SQUARE: np.sqrt(squares) / size}
