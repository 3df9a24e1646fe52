"""The block ``fit``: parameters of a scene to be identified, and the measurements. A run ignores it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, WithJsonSchema

from lyra_petsc.scene.block import Block
from lyra_petsc.scene.values import (
    Direction,
    Index,
    Name,
    NonNegative,
    Number,
    Positive,
    axes,
    block_of,
    file_beside,
    list_of,
    number,
    problem,
    require,
    shown,
)


def _bounds(value: Any) -> tuple[float, float]:
    if not isinstance(value, (list, tuple)) or len(value) != 2:
        raise problem(f"must be two numbers, [lowest, highest], not {shown(value)}")
    low, high = number(value[0]), number(value[1])
    if not low < high:
        raise problem(f"must have the lowest number first, not [{low:g}, {high:g}]")
    return low, high


def _numbers(value: Any) -> tuple[float, ...]:
    if isinstance(value, (list, tuple)):
        if not value:
            raise problem("must hold at least one number")
        return tuple(number(entry) for entry in value)
    return (number(value),)


Table = Annotated[Path, file_beside("table", ".csv", ".txt")]


def _unique_axes(value: Any) -> tuple[str, ...]:
    chosen = axes(value)
    if len(set(chosen)) < len(chosen):
        raise problem(f"must hold each of x, y, z once, not {shown(value)}")
    return chosen


_Axes = Annotated[tuple[Direction, ...], BeforeValidator(_unique_axes)]


class Parameter(Block):
    """A number of the scene to be identified.

    Attributes
    ----------
    start : float
        Initial guess, in the unit of the key.
    bounds : two floats
        Lower and upper bound.
    """

    start: Number
    bounds: Annotated[tuple[float, float], BeforeValidator(_bounds)]

    def check(self) -> None:
        """Refuse a start outside of the bounds."""
        low, high = self.bounds
        text = f"must lie within the bounds {low:g} to {high:g}, not {self.start:g}"
        require(low <= self.start <= high, text, "start")


class Overhang(Block):
    """Angle below the horizontal from the edge to the tip of a hanging strip (ASTM D1388: 41.5°).

    Attributes
    ----------
    edge : str
        Probe at the edge, where the overhang begins.
    tip : str
        Probe at the end of the strip.
    """

    edge: Name
    tip: Name


class DrapeCoefficient(Block):
    """Drape coefficient of BS 5058: projected area beyond the support over that of the flat sheet, along z.

    Attributes
    ----------
    radius : float [m]
        Radius of the flat sheet.
    support : float [m]
        Radius of the disc that supports it.
    """

    radius: Positive
    support: NonNegative

    def check(self) -> None:
        """Refuse a support that is not smaller than the sheet."""
        text = f"must be less than radius = {self.radius:g}, not {self.support:g}"
        require(self.support < self.radius, text, "support")


class Quantity(Block):
    """A measurable quantity: one of ``probe``, ``points``, ``overhang``, ``drape``, ``force``.

    Attributes
    ----------
    probe : str or None
        Mean position [m] of a probe of the scene.
    points : str or None
        Positions [m] of many vertices, from a table with a column ``vertex`` (numbers from 0) or ``probe``
        (names) and columns x, y, z or some of them; columns ``time`` and ``uncertainty`` give these for each
        row.
    overhang : Overhang or None
        Angle [°] of an overhang.
    drape : DrapeCoefficient or None
        Drape coefficient, 0 to 1.
    force : int or None
        Force [N] of a handle on the sheet; the handle is given by its number from 0.
    axes : tuple of "x", "y", "z" or None
        Components of a probe or a force, in the order of the values; without this key all.
    at : float [s] or None
        Time, or in a static analysis load factor; without this key the end.
    """

    probe: Name | None = None
    points: Table | None = None
    overhang: Overhang | None = None
    drape: DrapeCoefficient | None = None
    force: Index | None = None
    axes: _Axes | None = None
    at: Positive | None = None

    def check(self) -> None:
        """Refuse several quantities, and axes of one that has none."""
        self.require_one("probe", "points", "overhang", "drape", "force")
        self.require_with("axes", self.present("probe", "force"), "are of a probe or a force; leave axes out")


class Measurement(Quantity):
    """A measured quantity with its value and uncertainty.

    Attributes
    ----------
    value : float or list of float or None
        Measured value, or values in the order of ``axes``, in the unit of the quantity.
    table : str or None
        Instead of ``value``, a table of values over time: columns ``time``, and x, y, z, ``degrees`` or
        ``coefficient``.
    uncertainty : float or None
        Standard deviation of each value, in its unit; a column ``uncertainty`` of the table replaces it.
    """

    value: Annotated[tuple[float, ...], BeforeValidator(_numbers), WithJsonSchema({})] | None = None
    table: Table | None = None
    uncertainty: Positive | None = None

    def check(self) -> None:
        """Refuse values that are missing, or given twice."""
        super().check()
        values = self.present("value", "table")
        self.require_with(
            "points", not values, "come with their values in the table; leave out value and table"
        )
        if self.points is None:
            self.require_one("value", "table")
        self.require_with("table", self.at is None, "has a column time; leave at out")
        if self.value is not None:
            require(self.uncertainty is not None, "missing (standard deviation)", "uncertainty")


class Fit(Block):
    """Numbers of the scene that the command ``fit`` identifies from measurements.

    Attributes
    ----------
    parameters : dict of Parameter
        The numbers, named by their keys in the scene, as ``material.bending``.
    measurements : list of Measurement
        The measured quantities.
    """

    parameters: Annotated[dict[Name, Parameter], block_of("keys of the scene", minimum=1)]
    measurements: Annotated[list[Measurement], list_of(" of measurements", minimum=1)]
