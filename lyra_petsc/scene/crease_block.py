"""The block of creases: edges with rest angles and a stiffness of their own."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator

from lyra_petsc.scene.block import Block
from lyra_petsc.scene.time_curve import NumberInTime, NumberPoints, plain_values
from lyra_petsc.scene.values import Name, NonNegative, require


def _below_half_turn(value: float | NumberPoints) -> float | NumberPoints:
    for angle in plain_values(value):
        require(abs(angle) < 180.0, f"must be between -180 and 180 degrees, not {angle:g}")
    return value


class Crease(Block):
    """Edges that are folded, with a stiffness of their own instead of the sheet's.

    Attributes
    ----------
    group : str
        A group of curves: its edges between two triangles. Of another group those with both ends in it.
    angle : float or curve [°]
        Rest angle from flat, positive where both sides turn towards the normals. In a static analysis the
        load factor replaces the time of a curve, and a number is reached in proportion to it, from the angle
        at the start.
    stiffness : float [N·m/m/rad]
        Moment per rest length of the edges over the angle from the rest angle.
    """

    group: Name
    angle: Annotated[NumberInTime, AfterValidator(_below_half_turn)]
    stiffness: NonNegative
