"""The blocks of loads that are enclosed volumes: gas, and liquid."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, BeforeValidator

from lyra_petsc.scene.block import Block
from lyra_petsc.scene.time_curve import NumberInTime, NumberPoints, plain_values
from lyra_petsc.scene.values import Number, Positive, Text, require


def _one_or_many(value: Any) -> Any:
    return tuple(value) if isinstance(value, (list, tuple)) else (value,)


def _positive(value: float | NumberPoints) -> float | NumberPoints:
    for amount in plain_values(value):
        require(amount > 0.0, f"must be > 0, not {amount:g}")
    return value


def _volume(value: float | NumberPoints) -> float | NumberPoints:
    amounts = [float(amount) for amount in plain_values(value)]
    require(min(amounts) >= 0.0 and max(amounts) > 0.0, "must be > 0, in a curve >= 0")
    return value


class Chamber(Block):
    """A volume that a closed surface encloses.

    Attributes
    ----------
    group : str, list of str or None
        Surface groups, or sheets, that together are the closed surface; by default the whole mesh. A wall
        between two chambers is in the lists of both. Normals may point either way.
    name : str
        Name in volumes.csv; by default the groups, joined by +.
    """

    group: Annotated[tuple[Text, ...] | None, BeforeValidator(_one_or_many)] = None
    name: Text = ""

    def check(self) -> None:
        """Refuse no group, and one that is named twice."""
        groups = self.group
        require(groups is None or len(set(groups)) == len(groups) > 0, "must name each group once", "group")

    @property
    def label(self) -> str:
        """The name, or that by default."""
        return self.name or "+".join(self.group or (type(self).__name__.lower(),))


class Gas(Chamber):
    """Gas in a closed volume V: (p + ambient) V^exponent = amount^exponent (pressure + ambient) V0^exponent.

    Attributes
    ----------
    pressure : float [Pa]
        Gauge pressure, relative to ``ambient``, of the amount 1 in the volume V0 of the start.
    exponent : float
        1.4 for fast changes of air (adiabatic), 1 for slow ones (isothermal).
    ambient : float [Pa]
        Absolute pressure outside.
    amount : float or curve
        Amount of gas, relative to that of ``pressure`` in V0. In a static analysis the load factor replaces
        the time of a curve; if there is none, gas is let in as the load factor grows, such that the gauge
        pressure in V0 would grow in proportion to it.
    """

    unsupported: ClassVar[dict[str, str]] = {
        "volume": "the volume is that of the surface at the start, and a gas is given by its pressure there; "
        "an incompressible filling is liquid: {volume: 0.1}",
        "gamma": "is called exponent",
    }

    pressure: Number
    exponent: Positive = 1.4
    ambient: Positive = 101325.0
    amount: Annotated[NumberInTime, AfterValidator(_positive)] = 1.0

    def check(self) -> None:
        """Refuse less than a vacuum."""
        super().check()
        require(self.pressure > -self.ambient, f"must be > -ambient, -{self.ambient:g} Pa", "pressure")


class Liquid(Chamber):
    """Liquid that fills a closed volume; it is compressible as water is.

    Attributes
    ----------
    volume : float or curve [m³] or None
        Its volume without pressure; by default that of the surface at the start. In a static analysis the
        load factor replaces the time of a curve, and a number is reached in proportion to it.
    """

    unsupported: ClassVar[dict[str, str]] = {
        "pressure": "follows from the volume; gas: {pressure: 200} is given by its pressure at the start"
    }

    volume: Annotated[NumberInTime, AfterValidator(_volume)] | None = None

    @property
    def amount(self) -> float | NumberPoints | None:
        """The volume."""
        return self.volume
