"""Readings: measurable quantities as functions of the state of a simulation at given times.

Each reading computes its values from sums over all ranks.
"""

from __future__ import annotations

import csv
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.errors import InputError, suggest
from lyra_petsc.scene.fit_block import DrapeCoefficient, Measurement, Overhang, Quantity
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.text import read_text
from lyra_petsc.stepping.energy_balance import EnergyBalance
from lyra_petsc.stepping.problem import Problem

AXES = ("x", "y", "z")
MAX_ROWS = 100_000

SAME_TIME = 1e-9
"""Fraction of the end time by which the time of a step may differ from that of a measurement."""


@dataclass
class Reading(ABC):
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
    measured, uncertainty : (m,)
        Measured values and standard deviations; empty if nothing was measured.
    """

    key: str
    name: str
    time: float
    parts: tuple[str, ...]
    measured: Array = field(default_factory=lambda: np.empty(0))
    uncertainty: Array = field(default_factory=lambda: np.empty(0))

    @abstractmethod
    def sums(self, problem: Problem, energy_balance: EnergyBalance | None) -> Array:
        """This rank's part of the sums over all ranks."""

    @abstractmethod
    def values(self, total: Array) -> Array:
        """The values (m,) as a function of the sums."""

    @property
    def vertices(self) -> list[int]:
        """Numbers of the vertices that the measurement names."""
        return []

    @property
    def labels(self) -> list[str]:
        """Labels of its values, for tables."""
        return [f"{self.name} {part}".strip() for part in self.parts]


@dataclass
class Positions(Reading):
    """Mean positions of probes (by name) or positions of vertices (by number), each with some axes."""

    wanted: list[tuple[str | int, tuple[int, ...]]] = field(default_factory=list)

    def _rows(self, problem: Problem) -> list[Ints]:
        original = problem.points.mesh_vertices
        order = np.argsort(original)
        found = []
        for what, _ in self.wanted:
            if isinstance(what, str):
                found.append(problem.probes[what])
                continue
            at = np.searchsorted(original, what, sorter=order)
            here = at < len(original) and original[order[at]] == what
            found.append(order[at : at + 1] if here else np.empty(0, dtype=np.int64))
        return found

    def sums(self, problem: Problem, energy_balance: EnergyBalance | None) -> Array:
        x, rows = problem.equations.x, self._rows(problem)
        parts = [np.append(x[mine].sum(axis=0), float(len(mine))) for mine in rows]
        return np.concatenate(parts)

    def means(self, total: Array) -> Array:
        """Mean positions (n, 3) [m]."""
        sums = total.reshape(-1, 4)
        return sums[:, :3] / sums[:, 3:]

    def values(self, total: Array) -> Array:
        means = self.means(total)
        return np.concatenate([mean[list(axes)] for mean, (_, axes) in zip(means, self.wanted, strict=True)])

    @property
    def vertices(self) -> list[int]:
        return [what for what, _ in self.wanted if isinstance(what, int)]


@dataclass
class HangingAngle(Positions):
    """Angle [°] below the horizontal of the line from one probe to another."""

    def values(self, total: Array) -> Array:
        edge, tip = self.means(total)
        chord = tip - edge
        return np.array([math.degrees(math.atan2(-chord[2], math.hypot(chord[0], chord[1])))])


@dataclass
class Shadow(Reading):
    """Drape coefficient: area of the sheet's projection along z beyond the support, over that of the ring."""

    block: DrapeCoefficient | None = None

    def sums(self, problem: Problem, energy_balance: EnergyBalance | None) -> Array:
        membrane = problem.membrane
        a, b, c = (problem.equations.x[membrane.stencil[: membrane.n_owned, k]] for k in range(3))
        first, second = b - a, c - a
        return np.array([0.5 * float(np.sum(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]))])

    def values(self, total: Array) -> Array:
        assert self.block is not None
        support, whole = (math.pi * r * r for r in (self.block.support, self.block.radius))
        return np.array([(abs(total[0]) - support) / (whole - support)])


@dataclass
class HandleForce(Reading):
    """Force [N] of a handle on the sheet."""

    handle: int = 0
    axes: tuple[int, ...] = (0, 1, 2)

    def sums(self, problem: Problem, energy_balance: EnergyBalance | None) -> Array:
        assert energy_balance is not None
        count = len(problem.scene.handles)
        force = energy_balance.handle_forces(count)[self.handle]
        # every rank has the total force
        return force / problem.points.comm.size

    def values(self, total: Array) -> Array:
        return np.asarray(total)[list(self.axes)]


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
        found = [reading.values(part) for reading, part in zip(self.readings, parts, strict=True)]
        return np.concatenate(found)


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
    found: list[Reading] = []
    for number, measurement in enumerate(measurements):
        key = f"fit.measurements[{number}]"
        if measurement in measurements[:number]:
            raise InputError(
                f"is fit.measurements[{measurements.index(measurement)}] again; leave one of them out",
                file=scene.source,
                key=key,
            )
        try:
            found += _readings(scene, measurement, key)
        except InputError as error:
            if error.key is None:
                raise InputError(str(error), key=key) from None
            raise
    _refuse_times(scene, found)
    return found


def _refuse_times(scene: Scene, readings: Sequence[Reading]) -> None:
    end = scene.time.end
    for reading in readings:
        if not SAME_TIME * end < reading.time <= end * (1.0 + SAME_TIME):
            what = "load factor" if scene.time.analysis == "static" else "time"
            raise InputError(
                f"measures at {what} {reading.time:g}, but the scene ends at {end:g}; times are > 0",
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
        found = _points(scene, _Table(quantity.points), "quantity", quantity.at, 1.0)
    else:
        found = [_make_reading(scene, quantity, "quantity", quantity.at or scene.time.end)]
    _refuse_times(scene, found)
    return found


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
    found = []
    for time, sigma, *values in zip(times.tolist(), sigmas, *columns, strict=True):
        found.append(_make_reading(scene, measurement, key, time))
        found[-1].measured, found[-1].uncertainty = np.array(values), np.full(len(values), sigma)
    return found


def _make_reading(scene: Scene, quantity: Quantity, key: str, time: float) -> Reading:
    axes = tuple(AXES.index(axis) for axis in quantity.axes or AXES)
    names = tuple(AXES[axis] for axis in axes)
    if quantity.probe is not None:
        _check_probe(scene, quantity.probe, f"{key}.probe")
        return Positions(key, quantity.probe, time, names, wanted=[(quantity.probe, axes)])
    if quantity.overhang is not None:
        overhang: Overhang = quantity.overhang
        _check_probe(scene, overhang.edge, f"{key}.overhang.edge")
        _check_probe(scene, overhang.tip, f"{key}.overhang.tip")
        wanted: list[tuple[str | int, tuple[int, ...]]] = [(overhang.edge, ()), (overhang.tip, ())]
        return HangingAngle(key, "overhang", time, ("degrees",), wanted=wanted)
    if quantity.drape is not None:
        return Shadow(key, "drape", time, ("coefficient",), block=quantity.drape)
    assert quantity.force is not None
    if not quantity.force < len(scene.handles):
        raise InputError(
            f"measures handle {quantity.force}, but the scene has {len(scene.handles)} handles, "
            "counted from 0",
            file=scene.source,
            key=f"{key}.force",
        )
    return HandleForce(key, f"handle {quantity.force}", time, names, handle=quantity.force, axes=axes)


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
        if len(kept) - 1 > MAX_ROWS:
            raise InputError(f"holds {len(kept) - 1} lines; thin it out to at most {MAX_ROWS}", file=path)
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
        found = np.array([_number(text) for text in texts])
        self.refuse(~np.isfinite(found), lambda row: f"{name} must be a number, not {texts[row]!r}")
        return found

    def uncertainties(self) -> Array:
        """The column ``uncertainty``, which must be positive."""
        found = self.numbers("uncertainty")
        self.refuse(~(found > 0.0), lambda row: f"uncertainty must be > 0, not {found[row]:g}")
        return found

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
    found: list[Reading] = []
    axes = tuple(AXES.index(name) for name in names)
    for time in sorted(set(times.tolist())):
        rows = np.flatnonzero(times == time)
        parts = tuple(f"{points[row]} {name}" for row in rows for name in names)
        place = Positions(key, table.path.stem, time, parts, wanted=[(points[row], axes) for row in rows])
        place.measured, place.uncertainty = columns[rows].ravel(), np.repeat(sigmas[rows], len(names))
        found.append(place)
    return found
