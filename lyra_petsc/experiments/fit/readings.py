"""Readings: measurable quantities as functions of the state of a simulation at given times.

Each reading computes its values from sums over all ranks.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import itemgetter
from pathlib import Path

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.errors import InputError, suggest
from lyra_petsc.scene.fit_block import DrapeCoefficient, Measurement, Quantity
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.text import read_text
from lyra_petsc.stepping.energy_balance import EnergyBalance
from lyra_petsc.stepping.problem import Problem

AXES = ("x", "y", "z")

SAME_TIME = 1e-9
"""Fraction of the end time by which the time of a step may differ from that of a measurement."""


Points = Sequence[tuple[str | int, tuple[int, ...]]]
"""Probes by name or vertices by number, each with some axes."""


@dataclass
class Reading:
    """One quantity at one time.

    Attributes
    ----------
    key : str
        Key of the measurement in the scene.
    name : str
        Name of the quantity.
    time : float
        Time [s], or load factor.
    parts : tuple of str
        Names of its m values.
    kind : str
        ``position``, ``overhang``, ``drape`` or ``force``.
    sums : callable (problem, energy balance)
        This rank's part of the sums over all ranks.
    values : callable
        The values (m,) as a function of the sums.
    vertices : sequence of int
        Numbers of the vertices that the measurement names.
    measured, uncertainty : (m,)
        Measured values and standard deviations; empty if nothing was measured.
    """

    key: str
    name: str
    time: float
    parts: tuple[str, ...]
    kind: str
    sums: Callable[[Problem, EnergyBalance | None], Array]
    values: Callable[[Array], Array]
    vertices: Sequence[int] = ()
    measured: Array = field(default_factory=lambda: np.empty(0))
    uncertainty: Array = field(default_factory=lambda: np.empty(0))

    @property
    def labels(self) -> list[str]:
        """Labels of its values, for tables."""
        return [f"{self.name} {part}".strip() for part in self.parts]


def _position_sums(points: Points, problem: Problem, energy_balance: EnergyBalance | None) -> Array:
    """Sums of positions and numbers of this rank's vertices of all points, (4 n,)."""
    x, vertices = problem.equations.x, problem.points.mesh_vertices
    sums = []
    for point, _ in points:
        rows = problem.probes[point] if isinstance(point, str) else np.flatnonzero(vertices == point)
        sums += [*x[rows].sum(axis=0), float(len(rows))]
    return np.array(sums)


def _means(total: Array) -> Array:
    """Mean positions (n, 3) [m]."""
    sums = total.reshape(-1, 4)
    return sums[:, :3] / sums[:, 3:]


def _components(points: Points, total: Array) -> Array:
    """Mean positions [m] of the points, each along its axes, (m,)."""
    return np.concatenate([mean[list(axes)] for mean, (_, axes) in zip(_means(total), points, strict=True)])


def _positions(key: str, name: str, time: float, parts: tuple[str, ...], points: Points) -> Reading:
    """Mean positions [m] of probes, or positions of vertices."""
    sums, values = partial(_position_sums, points), partial(_components, points)
    vertices = [point for point, _ in points if isinstance(point, int)]
    return Reading(key, name, time, parts, "position", sums, values, vertices)


def _hanging_angle(total: Array) -> Array:
    """Angle [°] below the horizontal of the line from one probe to another, (1,)."""
    edge, tip = _means(total)
    chord = tip - edge
    return np.array([math.degrees(math.atan2(-chord[2], math.hypot(chord[0], chord[1])))])


def _projected_area(problem: Problem, energy_balance: EnergyBalance | None) -> Array:
    """Area [m²] of the sheet's projection along z."""
    membrane = problem.membrane
    a, b, c = (problem.equations.x[membrane.stencil[: membrane.n_owned, k]] for k in range(3))
    first, second = b - a, c - a
    return np.array([0.5 * float(np.sum(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]))])


def _drape_coefficient(block: DrapeCoefficient, total: Array) -> Array:
    """Area of the projection beyond the support, over that of the ring, (1,)."""
    support, whole = (math.pi * r * r for r in (block.support, block.radius))
    return np.array([(abs(total[0]) - support) / (whole - support)])


def _handle_force(handle: int, problem: Problem, energy_balance: EnergyBalance | None) -> Array:
    """This rank's share of the force [N] of a handle on the sheet; every rank has the total force."""
    assert energy_balance is not None
    force = energy_balance.handle_forces(len(problem.scene.handles))[handle]
    return force / problem.points.comm.size


@dataclass(frozen=True)
class Instant:
    """All readings at one time."""

    time: float
    readings: tuple[Reading, ...]

    def values(self, problem: Problem, energy_balance: EnergyBalance | None) -> Array:
        """The values of all readings; collective."""
        sums = [reading.sums(problem, energy_balance) for reading in self.readings]
        total = np.concatenate(sums)
        problem.points.comm.Allreduce(MPI.IN_PLACE, total, MPI.SUM)
        ends = np.cumsum([len(part) for part in sums])[:-1]
        parts = np.split(total, ends)
        return np.concatenate([r.values(part) for r, part in zip(self.readings, parts, strict=True)])


def instants(readings: Sequence[Reading]) -> list[Instant]:
    """The readings grouped by ascending time."""
    times = sorted({reading.time for reading in readings})
    return [Instant(time, tuple(r for r in readings if r.time == time)) for time in times]


# -- from a scene ------------------------------------------------------------------------------------


def readings_of(scene: Scene, measurements: Sequence[Measurement]) -> list[Reading]:
    """The readings of the measurements of a scene; reads their tables. On one rank.

    Raises
    ------
    InputError
        For unknown probes, handles, times or columns.
    """
    readings: list[Reading] = []
    for number, measurement in enumerate(measurements):
        key = f"fit.measurements[{number}]"
        if measurement in measurements[:number]:
            raise InputError(
                f"is fit.measurements[{measurements.index(measurement)}] again; leave one of them out",
                file=scene.source,
                key=key,
            )
        try:
            readings += _readings(scene, measurement, key)
        except InputError as error:
            if error.key is None:
                raise InputError(str(error), key=key) from None
            raise
    _refuse_times(scene, readings)
    return readings


def _refuse_times(scene: Scene, readings: Sequence[Reading]) -> None:
    end = scene.time.end
    for reading in readings:
        if not SAME_TIME * end < reading.time <= end * (1.0 + SAME_TIME):
            kind = "load factor" if scene.time.static else "time"
            raise InputError(
                f"measures at {kind} {reading.time:g}, but the scene ends at {end:g}; times are > 0",
                file=scene.source,
                key=reading.key,
            )


def readings_without_values(scene: Scene, quantity: Quantity) -> list[Reading]:
    """The readings of a quantity without measured values, at one time or those of its table. On one rank.

    Raises
    ------
    InputError
        As `readings_of`.
    """
    if quantity.points is not None:
        readings = _points(scene, _Table(quantity.points), "quantity", quantity.at, 1.0)
    else:
        readings = [_make_reading(scene, quantity, "quantity", quantity.at or scene.time.end)]
    _refuse_times(scene, readings)
    return readings


def _readings(scene: Scene, measurement: Measurement, key: str) -> list[Reading]:
    if measurement.points is not None:
        table = _Table(measurement.points)
        return _points(scene, table, f"{key}.points", measurement.at, measurement.uncertainty)
    if measurement.table is None:
        reading = _make_reading(scene, measurement, key, measurement.at or scene.time.end)
        assert measurement.value is not None
        assert measurement.uncertainty is not None
        if len(measurement.value) != len(reading.parts):
            raise InputError(
                f"must hold {len(reading.parts)} numbers ({', '.join(reading.parts)}), "
                f"not {len(measurement.value)}",
                file=scene.source,
                key=f"{key}.value",
            )
        reading.measured = np.array(measurement.value)
        reading.uncertainty = np.full(len(reading.parts), measurement.uncertainty)
        return [reading]
    table = _Table(measurement.table)
    one = _make_reading(scene, measurement, key, scene.time.end)
    table.refuse_others("time", "uncertainty", *(AXES if measurement.axes else one.parts))
    times, *columns = (table.numbers(name) for name in ("time", *one.parts))
    sigmas = np.full(len(times), measurement.uncertainty)
    if measurement.uncertainty is None or "uncertainty" in table.names:
        sigmas = table.uncertainties()
    readings = []
    for time, sigma, *values in zip(times.tolist(), sigmas, *columns, strict=True):
        reading = _make_reading(scene, measurement, key, time)
        reading.measured, reading.uncertainty = np.array(values), np.full(len(values), sigma)
        readings.append(reading)
    return readings


def _make_reading(scene: Scene, quantity: Quantity, key: str, time: float) -> Reading:
    axes = tuple(AXES.index(axis) for axis in quantity.axes or AXES)
    names = tuple(AXES[axis] for axis in axes)
    if quantity.probe is not None:
        _check_probe(scene, quantity.probe, f"{key}.probe")
        return _positions(key, quantity.probe, time, names, [(quantity.probe, axes)])
    if quantity.overhang is not None:
        edge, tip = quantity.overhang.edge, quantity.overhang.tip
        _check_probe(scene, edge, f"{key}.overhang.edge")
        _check_probe(scene, tip, f"{key}.overhang.tip")
        sums = partial(_position_sums, [(edge, ()), (tip, ())])
        return Reading(key, "overhang", time, ("degrees",), "overhang", sums, _hanging_angle)
    if quantity.drape is not None:
        values = partial(_drape_coefficient, quantity.drape)
        return Reading(key, "drape", time, ("coefficient",), "drape", _projected_area, values)
    assert quantity.force is not None
    if not quantity.force < len(scene.handles):
        raise InputError(
            f"measures handle {quantity.force}, but the scene has {len(scene.handles)} handles, "
            "counted from 0",
            file=scene.source,
            key=f"{key}.force",
        )
    sums, name = partial(_handle_force, quantity.force), f"handle {quantity.force}"
    return Reading(key, name, time, names, "force", sums, itemgetter(list(axes)))


def _check_probe(scene: Scene, name: str, key: str) -> None:
    if name not in scene.probes:
        hint = suggest(name, list(scene.probes)) if scene.probes else "the scene has no probes"
        raise InputError(f"unknown probe {name!r}, {hint}", file=scene.source, key=key)


class _Table:
    """A table with a heading and columns separated by commas, semicolons or tabs; # starts a comment.

    Raises
    ------
    InputError
        If heading or rows are missing, or a row has a wrong number of columns.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        lines = [line.split("#")[0] for line in read_text(path, largest=2**26).splitlines()]
        kept = [(number, line) for number, line in enumerate(lines, start=1) if line.strip()]
        if len(kept) < 2:
            raise InputError("must hold a line with the names of columns, and lines of numbers", file=path)
        largest = 100_000
        if len(kept) - 1 > largest:
            raise InputError(f"holds {len(kept) - 1} lines; thin it out to at most {largest}", file=path)
        heading = kept[0][1]
        sign = next((sign for sign in ";\t" if sign in heading), ",")
        try:  # each line by itself: quotes do not reach beyond it
            rows = [next(csv.reader([line], delimiter=sign)) for _, line in kept]
        except csv.Error as error:
            raise InputError(f"is no table: {error}", file=path) from None
        self.names = [name.strip().lower() for name in rows[0]]
        twice = [name for name in self.names if self.names.count(name) > 1]
        if twice:
            raise InputError(f"has two columns {twice[0]!r}; leave one out", file=path)
        self.lines = [number for number, _ in kept[1:]]
        self.rows = [[cell.strip() for cell in row] for row in rows[1:]]
        for line, row in zip(self.lines, self.rows, strict=True):
            if len(row) != len(self.names):
                raise InputError(
                    f"line {line} has {len(row)} columns, the heading {len(self.names)}", file=path
                )
        first: dict[tuple[str, ...], int] = {}
        for line, row in zip(self.lines, self.rows, strict=True):
            if first.setdefault(tuple(row), line) != line:
                raise InputError(f"line {line} is line {first[tuple(row)]} again; leave it out", file=path)

    def refuse_others(self, *known: str) -> None:
        """Refuse columns with other names.

        Raises
        ------
        InputError
        """
        for name in self.names:
            if name not in known:
                raise InputError(f"unknown column {name!r}, {suggest(name, known)}", file=self.path)

    def texts(self, name: str) -> list[str]:
        """A column of texts.

        Raises
        ------
        InputError
            If it is missing.
        """
        if name not in self.names:
            raise InputError(
                f"has no column {name!r}; its columns are {', '.join(self.names)}", file=self.path
            )
        column = self.names.index(name)
        return [row[column] for row in self.rows]

    def numbers(self, name: str) -> Array:
        """A column of numbers.

        Raises
        ------
        InputError
            If it is missing, or contains other texts.
        """
        texts = self.texts(name)
        numbers = np.array([_number(text) for text in texts])
        self.refuse(~np.isfinite(numbers), lambda row: f"{name} must be a number, not {texts[row]!r}")
        return numbers

    def uncertainties(self) -> Array:
        """The column ``uncertainty``, which must be positive."""
        sigmas = self.numbers("uncertainty")
        self.refuse(~(sigmas > 0.0), lambda row: f"uncertainty must be > 0, not {sigmas[row]:g}")
        return sigmas

    def refuse(self, wrong: Mask, why: Callable[[int], str]) -> None:
        """Refuse the first of the rows in a mask, if there is one.

        Raises
        ------
        InputError
        """
        for row in np.flatnonzero(wrong).tolist():
            raise InputError(f"line {self.lines[row]}: {why(row)}", file=self.path)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _points(
    scene: Scene, table: _Table, key: str, at: float | None, uncertainty: float | None
) -> list[Reading]:
    """Positions of vertices or probes, at one time or several."""
    names = [axis for axis in AXES if axis in table.names]
    if not names:
        raise InputError("has none of the columns x, y, z", file=table.path)
    columns = np.column_stack([table.numbers(name) for name in names])
    points: list[str | int] = []
    if "vertex" in table.names and "probe" in table.names:
        raise InputError("has columns 'vertex' and 'probe'; leave one out", file=table.path)
    if "vertex" in table.names:
        numbers = table.numbers("vertex")
        whole = np.rint(numbers)
        table.refuse(numbers != whole, lambda row: f"vertex must be a whole number, not {numbers[row]:g}")
        points += whole.astype(int).tolist()
    elif "probe" in table.names:
        for name in table.texts("probe"):
            _check_probe(scene, name, key)
            points.append(name)
    else:
        raise InputError(
            f"has neither a column 'vertex' nor 'probe'; its columns are {', '.join(table.names)}",
            file=table.path,
        )
    table.refuse_others("vertex", "probe", "time", "uncertainty", *AXES)
    if "uncertainty" in table.names:
        sigmas = table.uncertainties()
    elif uncertainty is not None:
        sigmas = np.full(len(points), uncertainty)
    else:
        raise InputError("has no column 'uncertainty'; add it, or give uncertainty", file=table.path, key=key)
    times = np.full(len(points), at or scene.time.end)
    if "time" in table.names:
        if at is not None:
            raise InputError("has a column time; leave at out", file=table.path, key=key)
        times = table.numbers("time")
    readings: list[Reading] = []
    axes = tuple(AXES.index(name) for name in names)
    for time in sorted(set(times.tolist())):
        rows = np.flatnonzero(times == time)
        parts = tuple(f"{points[row]} {name}" for row in rows for name in names)
        reading = _positions(key, table.path.stem, time, parts, [(points[row], axes) for row in rows])
        reading.measured, reading.uncertainty = columns[rows].ravel(), np.repeat(sigmas[rows], len(names))
        readings.append(reading)
    return readings
