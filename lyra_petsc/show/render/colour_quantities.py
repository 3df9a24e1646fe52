"""Quantities that can colour a sheet; a new one is one function and one line in ``DERIVED``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError, suggest
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.output.tensors import TENSORS, plane_components

COVERED_VALUES = 98.0
"""Percentage of a state's values below the upper limit of its colours, and above the lower limit."""
COVERED_STATES = 80.0
"""Percentage of the states whose limits the common range includes, so that few states do not set it."""

PERCENTILES = np.linspace(0.0, 100.0, 401)
"""Percentiles of a state's values from which ranges are computed."""


@dataclass(frozen=True)
class ColourRange:
    """A range of colours that the user has chosen.

    Attributes
    ----------
    low, high : float
        Values or, if ``percent``, percentiles of all values of the run.
    percent : bool
    """

    low: float
    high: float
    percent: bool = False

    @classmethod
    def parse(cls, text: str) -> ColourRange:
        """The range given by a text such as ``0,5`` or ``2%,98%``.

        Raises
        ------
        InputError
        """
        words = [word.strip() for word in text.split(",")]
        percent = all(word.endswith("%") for word in words)
        try:
            ends = [float(word.removesuffix("%") if percent else word) for word in words]
        except ValueError:
            ends = []
        if len(ends) != 2 or not -np.inf < ends[0] < ends[1] < np.inf:
            message = f"must be two numbers, the lower first, as in 0,5 or 2%,98%, not {text!r}"
            raise InputError(message, key="--range")
        if percent and not 0.0 <= ends[0] < ends[1] <= 100.0:
            raise InputError(f"must be from 0% to 100%, not {text!r}", key="--range")
        return cls(ends[0], ends[1], percent)


@dataclass(frozen=True)
class ColourQuantity:
    """A number on every vertex or triangle of every state.

    Attributes
    ----------
    label : str
        Name and unit, shown at the colour bar.
    values : callable
        Returns the values, (V,) or (F,), of a state by its number.
    on_triangles : bool
        Whether there is a value for each triangle; else for each vertex.
    signed : bool
        Whether zero belongs in the middle of the colours.
    averages : bool
        Whether mean values are meaningful; those of ranks are not.
    """

    label: str
    values: Callable[[int], Array]
    on_triangles: bool = False
    signed: bool = False
    averages: bool = True

    def percentiles(self, state: int) -> Array:
        """(401,) the ``PERCENTILES`` of a state's values; NaN if no value is finite."""
        values = self.values(state)
        finite = values[np.isfinite(values)]
        return np.percentile(finite, PERCENTILES) if len(finite) else np.full(len(PERCENTILES), np.nan)

    def limits(self, percentiles: Array, chosen: ColourRange | None = None) -> tuple[float, float]:
        """Values at both ends of the colours.

        Parameters
        ----------
        percentiles : (n, 401)
            The `percentiles` of some states.
        chosen : ColourRange, optional
            By default, the range covers 98 % of the values on each side, in 80 % of the states.
        """
        if chosen is not None and not chosen.percent:
            return chosen.low, chosen.high
        percentiles = percentiles[np.isfinite(percentiles).all(axis=1)]
        if len(percentiles) == 0:
            return colour_limits(np.inf, -np.inf)
        if chosen is not None:
            low, high = np.percentile(percentiles, [chosen.low, chosen.high])
        else:
            lowest, highest = np.searchsorted(PERCENTILES, [100.0 - COVERED_VALUES, COVERED_VALUES])
            low = np.percentile(percentiles[:, lowest], 100.0 - COVERED_STATES, method="lower")
            high = np.percentile(percentiles[:, highest], COVERED_STATES, method="higher")
        if self.signed:
            high = max(abs(low), abs(high))
            low = -high
        elif abs(low) < 1e-4 * (high - low):
            low = 0.0
        return colour_limits(float(low), float(high))

    def on_vertices(self, run: StoredRun) -> ColourQuantity:
        """The same quantity on vertices: means over the triangles of a vertex, weighted by rest area.

        Values of constant strain triangles alternate around the field that they approximate; the means
        follow the field. Quantities without meaningful means are returned unchanged.
        """
        if not self.on_triangles or not self.averages:
            return self
        triangles, rest = run.triangles, run.rest
        corners = rest[triangles]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        ends, weights = triangles.ravel(), np.repeat(areas, 3)
        whole = np.bincount(ends, weights, len(rest))
        of_triangles = self.values

        def values(state: int) -> Array:
            summed = np.bincount(ends, weights * np.repeat(of_triangles(state), 3), len(rest))
            return np.divide(summed, whole, out=np.zeros_like(summed), where=whole > 0.0)

        return replace(self, values=values, on_triangles=False)


def round_numbers(low: float, high: float) -> Array:
    """(n,) about five round numbers from ``low`` to ``high``, in equal steps."""
    from matplotlib.ticker import MaxNLocator

    numbers = np.asarray(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))
    tolerance = 1e-6 * (high - low)
    return numbers[(numbers >= low - tolerance) & (numbers <= high + tolerance)]


def colour_limits(low: float, high: float) -> tuple[float, float]:
    """The range from ``low`` to ``high``, or a small range if it is empty."""
    if low < high:
        return low, high
    middle = low if np.isfinite(low) else 0.0
    return middle, middle + max(1e-12, 1e-6 * abs(middle))


def quantity(run: StoredRun, name: str) -> ColourQuantity:
    """The quantity with a name.

    Raises
    ------
    InputError
        If the name is unknown, or the states lack the field that the quantity is computed from.
    """
    if name in DERIVED:
        return DERIVED[name](run, name)
    if name not in run.fields:
        known = [*DERIVED, *run.fields]
        raise InputError(
            f"no field {name!r}, {suggest(name, known)}; a scene's output.fields names further ones",
            file=run.folder,
            key="--field",
        )
    principal = name in TENSORS
    reduce = (lambda rows: _largest_principal(plane_components(rows))) if principal else _magnitude
    label = _label(f"largest principal {name}" if principal else name, run.field_units(name))
    on_triangles = run.field_on(name) == "triangle"
    values: Callable[[int], Array] = lambda i: reduce(np.asarray(run.field(name)[i]))  # noqa: E731
    return ColourQuantity(label, values, on_triangles, name in _SIGNED, name not in _NOT_AVERAGED)


_SIGNED = {"curvature", "plastic_curvature"}
_NOT_AVERAGED = {"rank"}


def _speed(run: StoredRun, name: str) -> ColourQuantity:
    if "velocity" not in run.fields:
        raise InputError(
            f"{name} needs the velocities, which this run did not write; add velocity to the scene's "
            "output.fields, or show displacement or strain",
            file=run.folder,
            key="--field",
        )
    return ColourQuantity(_label("speed", "m/s"), lambda i: _magnitude(run.velocities[i]))


def _displacement(run: StoredRun, name: str) -> ColourQuantity:
    start = run.positions[0]
    return ColourQuantity(_label(name, "m"), lambda i: _magnitude(run.positions[i] - start))


def _strain(run: StoredRun, name: str) -> ColourQuantity:
    triangles, inverse = run.triangles, np.linalg.inv(_edges(material_coordinates(run)))

    def values(state: int) -> Array:
        # deformation gradient (F, 3, 2), which maps material edges to current ones
        gradient = _edges(run.positions[state][triangles]) @ inverse
        metric = np.swapaxes(gradient, 1, 2) @ gradient
        strain = 0.5 * (metric[:, [0, 1, 0], [0, 1, 1]] - np.array([1.0, 1.0, 0.0]))
        return 100.0 * _largest_principal(strain)

    return ColourQuantity(_label("largest principal strain", "%"), values, on_triangles=True)


DERIVED: dict[str, Callable[[StoredRun, str], ColourQuantity]] = {
    "speed": _speed,
    "displacement": _displacement,
    "strain": _strain,
}
"""Quantities that are computed from positions and velocities; further ones are the run's fields."""


def quantity_names(run: StoredRun) -> list[str]:
    """Names of the quantities by which a run's states can be coloured."""
    derived = [name for name in DERIVED if name != "speed" or "velocity" in run.fields]
    return derived + [name for name in run.fields if name not in {"velocity", *derived}]


def material_coordinates(run: StoredRun) -> Array:
    """(F, 3, 2) material coordinates of the triangles' corners [m]: ``vt``, or the flattened rest shape."""
    return run.mesh.corner_uv


def _edges(corners: Array) -> Array:
    """(F, d, 2) two edges of each triangle as columns; ``corners`` is (F, 3, d)."""
    return np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)


def _largest_principal(symmetric: Array) -> Array:
    """(F,) larger in-plane eigenvalue of tensors uu, vv, uv (F, 3)."""
    uu, vv, uv = symmetric.T
    return (uu + vv) / 2.0 + np.hypot((uu - vv) / 2.0, uv)


def _magnitude(values: Array) -> Array:
    values = np.asarray(values, dtype=np.float64)
    return values if values.ndim == 1 else np.linalg.norm(values.reshape(len(values), -1), axis=1)


def _label(name: str, unit: str) -> str:
    title = name.replace("_", " ")
    return title if unit == "1" else f"{title} [{unit}]"
