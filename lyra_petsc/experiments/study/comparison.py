"""Errors of a run against a reference at the sample times, on one rank.

Between meshes of the same sheets rest shapes are compared, sheet by sheet: each point goes to the nearest
triangle of its sheet and gets the barycentric weights of the nearest place in it. On flat sheets that is
linear interpolation in material coordinates; where a curved outline or surface is cut into different
triangles the points are projected onto the nearest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.experiments.exact_motions import ExactMotion
from lyra_petsc.experiments.study.plan import MEAN_SQUARE, Quantity
from lyra_petsc.mesh.measures import bounding_diagonal
from lyra_petsc.output.read_run import ENERGIES, Columns, read_table
from lyra_petsc.output.states import stored_states
from lyra_petsc.output.stored import StoredMesh, check_folder, read_stored

SAME_TIME = 1e-6
"""Fraction of the time between samples by which a state may miss a sample time."""


class AnyMesh(Protocol):
    """A mesh with its rest shape (V, 3) [m] and triangles (F, 3): built, or read from a run's folder."""

    @property
    def rest(self) -> Array:
        """(V, 3) [m]"""

    @property
    def triangles(self) -> Ints:
        """(F, 3)"""


def same_mesh(one: AnyMesh, other: AnyMesh) -> bool:
    """Whether it is the same mesh, vertex by vertex, up to rounding."""
    if one.rest.shape != other.rest.shape or not np.array_equal(one.triangles, other.triangles):
        return False
    size = max(map(bounding_diagonal, (one.rest, other.rest)))
    return bool(np.abs(one.rest - other.rest).max() <= 1e-9 * size)


def vertex_areas(mesh: StoredMesh) -> Array:
    """Rest area of each vertex (V,) [m²]: a third of that of its triangles."""
    uv = mesh.corner_uv
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    thirds = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 6.0
    return np.bincount(mesh.triangles.ravel(), np.repeat(thirds, 3), len(mesh.rest)).astype(np.float64)


@dataclass
class Samples:
    """A run at the sample times.

    Attributes
    ----------
    mesh : StoredMesh
    times : tuple of float
        [s].
    places : tuple of (Path, str)
        File and dataset of the positions at each time.
    energies : (T, 4) float64
        Kinetic, membrane, bending, potential [J] at each time.
    exchanged : float
        Largest change [J] of any of them since the start, over all steps.
    probes : dict of name → (T, 3) float64
        [m].
    sheets : sequence of int
        Vertices of each mesh source; needed between different meshes.
    """

    mesh: StoredMesh
    times: tuple[float, ...]
    places: tuple[tuple[Path, str], ...]
    energies: Array
    exchanged: float
    probes: dict[str, Array]
    sheets: Sequence[int] = ()

    @cached_property
    def size(self) -> float:
        """Diagonal [m] of the rest shape's bounding box."""
        return bounding_diagonal(self.mesh.rest)

    def positions(self, sample: int) -> Array:
        """(V, 3) [m]

        Raises
        ------
        InputError
            If the file cannot be read.
        """
        return read_stored(*self.places[sample], self.mesh.rest.shape, "f")


def read_samples(folder: Path, times: Sequence[float], spacing: float, sheets: Sequence[int] = ()) -> Samples:
    """What a run left at the sample times.

    Parameters
    ----------
    folder : Path
    times : sequence of float
        [s].
    spacing : float
        Time between samples [s]; states within 1e-6 of it count.
    sheets : sequence of int
        Vertices of each mesh source, if it may be compared with another mesh.

    Raises
    ------
    InputError
        If a state, the mesh or the history is missing.
    """
    if folder.is_dir():
        check_folder(folder)
    states = stored_states(folder) if folder.is_dir() else []
    if not states:
        raise InputError("holds no states of a run", file=folder)
    at = np.array([state.time for state in states])
    places = []
    for time in times:
        nearest = int(np.abs(at - time).argmin())
        if abs(at[nearest] - time) > SAME_TIME * spacing:
            raise InputError(
                f"has no state at t = {time:g} s, which is a sample time (its states run from "
                f"{at.min():g} to {at.max():g} s); run it with output.every = {spacing:g}",
                file=folder,
            )
        state = states[nearest]
        places.append((folder / state.file, f"states/{state.number:06d}/position"))
    mesh = StoredMesh(folder)
    vertex_areas(mesh)  # reads all that comparisons need
    history, at_samples = _table(folder / "history.csv", times)
    energies = np.column_stack([history[name] for name in ENERGIES])
    probes = {}
    if (folder / "probes.csv").is_file():
        table, chosen = _table(folder / "probes.csv", times)
        for name in (name.removesuffix("_x") for name in table if name.endswith("_x")):
            probes[name] = np.column_stack([table[f"{name}_{axis}"] for axis in "xyz"])[chosen]
    exchanged = float(np.abs(energies - energies[0]).max())
    return Samples(mesh, tuple(times), tuple(places), energies[at_samples], exchanged, probes, sheets)


def _table(path: Path, times: Sequence[float]) -> tuple[Columns, list[int]]:
    """A table's columns, and the rows nearest to the sample times."""
    columns = read_table(path)
    if not len(columns["time"]):
        raise InputError("has no rows", file=path)
    return columns, [int(np.abs(columns["time"] - time).argmin()) for time in times]


CANDIDATES = 12
"""Triangles with the nearest centroids among which the nearest triangle is looked for."""


def located(
    points: AnyMesh, point_sheets: Sequence[int], other: AnyMesh, other_sheets: Sequence[int]
) -> tuple[Ints, Array]:
    """Where in another mesh the vertices of ``points`` lie: corners (n, 3) and their weights (n, 3).

    Parameters
    ----------
    points, other : mesh
    point_sheets, other_sheets : sequence of int
        Vertices of each sheet, which are numbered consecutively.
    """
    found = []
    ends, others = np.cumsum([0, *point_sheets]), np.cumsum([0, *other_sheets])
    first = other.triangles[:, 0]
    for sheet in range(len(point_sheets)):
        inside = (first >= others[sheet]) & (first < others[sheet + 1])
        mine = points.rest[ends[sheet] : ends[sheet + 1]]
        found.append(_nearest(mine, other.rest, other.triangles[inside]))
    corners, weights = zip(*found, strict=True)
    return np.concatenate(corners), np.concatenate(weights)


def _nearest(places: Array, vertices: Array, triangles: Ints) -> tuple[Ints, Array]:
    from scipy.spatial import cKDTree

    corners = vertices[triangles]
    count = min(CANDIDATES, len(triangles))
    _, found = cKDTree(corners.mean(axis=1)).query(places, k=count)
    near = np.asarray(found).ravel()
    points = np.repeat(places, count, axis=0)
    weights = barycentric(points, corners[near])
    distance = np.linalg.norm(np.einsum("nc,nci->ni", weights, corners[near]) - points, axis=1)
    best = distance.reshape(-1, count).argmin(axis=1) + count * np.arange(len(places))
    return triangles[near[best]], weights[best]


def barycentric(places: Array, corners: Array) -> Array:
    """Weights (n, 3) of the nearest place in each triangle; ``corners`` is (n, 3, 3), ``places`` (n, 3)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    u, v, w = b - a, c - a, places - a
    uu, uv, vv = _dot(u, u), _dot(u, v), _dot(v, v)
    wu, wv = _dot(w, u), _dot(w, v)
    area = uu * vv - uv * uv
    s, t = (vv * wu - uv * wv) / area, (uu * wv - uv * wu) / area
    weights: Array = np.stack([1.0 - s - t, s, t], axis=1)
    outside = (weights < 0.0).any(axis=1)
    if outside.any():
        weights[outside] = _on_sides(places[outside], corners[outside])
    return weights


def _on_sides(places: Array, corners: Array) -> Array:
    """Weights of the nearest place on the three sides."""
    sides, ways = np.roll(corners, -1, axis=1) - corners, places[:, None] - corners
    along = np.clip(_dot(ways, sides) / _dot(sides, sides), 0.0, 1.0)
    side = np.linalg.norm(along[:, :, None] * sides - ways, axis=2).argmin(axis=1)
    rows, weights = np.arange(len(side)), np.zeros((len(side), 3))
    weights[rows, side], weights[rows, (side + 1) % 3] = 1.0 - along[rows, side], along[rows, side]
    return weights


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("...i,...i->...", a, b))


Errors = dict[str, float]
"""By the name of the quantity; relative, see ``quantities``. NaN where nothing can be told."""

History = dict[str, Array]
"""Errors at each sample after the start, by the name of the quantity."""


def against_motion(samples: Samples, motion: ExactMotion, quantities: Sequence[Quantity]) -> Errors:
    """Errors of a run against an exact motion."""
    start, times = samples.positions(0), samples.times
    forms = [motion.energies(t) for t in times]
    exact = np.array([[form.kinetic, form.membrane, 0.0, form.potential] for form in forms])
    probes = {
        name: np.concatenate([motion.positions(path[:1], t) for t in times])
        for name, path in samples.probes.items()
    }
    whole = replace(samples, energies=exact, exchanged=float(np.abs(exact - exact[0]).max()), probes=probes)

    def positions() -> History:
        return _positions(samples, lambda i: motion.positions(start, times[i]), samples.size)

    return overall(_errors(samples, whole, quantities, positions))


def against_run(mine: Samples, other: Samples, quantities: Sequence[Quantity]) -> Errors:
    """Errors of a run against another, over all samples."""
    return overall(history_against_run(mine, other, quantities))


def history_against_run(mine: Samples, other: Samples, quantities: Sequence[Quantity]) -> History:
    """Errors of a run against another at each sample.

    On different meshes the finer solution is interpolated at the rest places of the coarser one's
    vertices.
    """

    def positions() -> History:
        coarse, fine = (other, mine) if len(mine.mesh.rest) > len(other.mesh.rest) else (mine, other)
        if same_mesh(coarse.mesh, fine.mesh):
            return _positions(coarse, fine.positions, other.size)
        corners, weights = located(coarse.mesh, coarse.sheets, fine.mesh, fine.sheets)

        def interpolated(sample: int) -> Array:
            return np.einsum("nc,nci->ni", weights, fine.positions(sample)[corners])

        return _positions(coarse, interpolated, other.size)

    return _errors(mine, other, quantities, positions)


def _errors(
    mine: Samples, other: Samples, quantities: Sequence[Quantity], positions: Callable[[], History]
) -> History:
    """The quantities in their order; empty where nothing can be told."""
    found: History = {}
    if any(quantity.name.startswith("position") for quantity in quantities):
        found |= positions()
    if other.exchanged > 0.0:  # the error of the total over the largest energy exchanged
        totals = mine.energies.sum(axis=1), other.energies.sum(axis=1)
        found["energy"] = np.abs(totals[0] - totals[1]) / other.exchanged
    for quantity in quantities:
        name = quantity.probe
        if name in mine.probes and name in other.probes:
            way = mine.probes[name] - other.probes[name]
            found[quantity.name] = np.asarray(np.linalg.norm(way, axis=1) / other.size)
    return {quantity.name: found.get(quantity.name, np.empty(0)) for quantity in quantities}


def overall(history: History) -> Errors:
    """The error over all samples: the root mean square of the L2 norms, of all others the largest."""
    found = dict.fromkeys(history, math.nan)
    for name, errors in history.items():
        if len(errors):
            mean = name == MEAN_SQUARE
            found[name] = math.sqrt(float(np.mean(errors**2))) if mean else float(errors.max())
    return found


def _positions(samples: Samples, there: Callable[[int], Array], size: float) -> History:
    """Largest and area-weighted L2 distance over space, at each sample after the start, over ``size`` [m]."""
    areas = vertex_areas(samples.mesh)
    distances = [
        np.linalg.norm(samples.positions(i) - there(i), axis=1) for i in range(1, len(samples.times))
    ]
    largest = np.array([distance.max(initial=0.0) for distance in distances])
    squares = np.array([areas @ distance**2 for distance in distances]) / areas.sum()
    return {"position_max": largest / size, MEAN_SQUARE: np.sqrt(squares) / size}
