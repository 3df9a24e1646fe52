"""Seams of a scene: which edges are sewn together, when, and how stiff they are."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, WithJsonSchema

from lyra_petsc.scene.block import Block
from lyra_petsc.scene.values import Flag, Name, NonNegative, Number, Vector, number, problem, require, shown


def _two_names(value: Any) -> Any:
    if not isinstance(value, (list, tuple)) or len(value) != 2:
        raise problem(
            f"must be two groups of boundary edges like [front/side, back/side], not {shown(value)}"
        )
    return tuple(value)


def _word_or_number(*words: str) -> BeforeValidator:
    """Validator of one of these words, or a number."""

    def check(value: Any) -> float | str:
        if isinstance(value, str):
            require(value in words, f"must be {', '.join(words)} or a number, not {shown(value)}")
            return value
        return number(value)

    return BeforeValidator(check)


class Closing(Block):
    """The time in which a seam is pulled together; the load factor in a static analysis.

    Attributes
    ----------
    start, until : float [s]
        The distance of the two sides goes from that at the start to zero from ``from`` to ``until``.
    """

    start: NonNegative = Field(default=0.0, alias="from")
    until: Number

    def check(self) -> None:
        """Refuse a time that ends before it begins."""
        require(
            self.start < self.until, f"must be later than from = {self.start:g}, not {self.until:g}", "until"
        )


class Seam(Block):
    """Two groups of boundary edges that are sewn together.

    Attributes
    ----------
    between : two str
        Groups of boundary edges, each of which is one curve: ``sheet/group`` for sheets with names. Points at
        the same part of the curves' rest lengths belong together, in the direction in which they are nearer
        to each other at the start; panels may have different numbers of edges. Where three sheets meet, a
        group is in several seams.
    reverse : bool
        Sew in the other direction.
    start : (3,) [m] or None
        For closed curves: the vertices nearest to this point at the start are where both curves begin.
    close : Closing or None
        Time in which threads pull the seam together; without it the seam is closed from the beginning. Where
        the vertices of both sides coincide at the start, the seam is rigid, and no other seam has edges of
        theirs, they become one.
    stiffness : "rigid" or float [N/m²]
        Force per length of the seam and distance of its sides; ``rigid``: 1000 times the membrane stiffness
        over the edge length, so that the sides are less than 1e-4 of an edge apart at strains up to 10 %.
    angle : "free", "rest" or float [°]
        Bending across the seam: none; towards the angle between its sides in the start shape; or towards an
        angle from flat, positive where both sides turn towards the normals of the first one. In a seam that
        closes, bending begins when the sides are as near as their triangles are high.
    bending : float [N·m] or None
        Bending stiffness across the seam; by default that of the softer one of its sides. Without it, sides
        whose vertices become one bend at the seam as within a sheet, by its bending model. Else each edge
        of the side with more vertices and the triangle on the other side of it are a hinge.
    """

    between: Annotated[tuple[Name, Name], BeforeValidator(_two_names)]
    reverse: Flag = False
    start: Vector | None = None
    close: Closing | None = None
    stiffness: Annotated[
        float | Literal["rigid"],
        _word_or_number("rigid"),
        WithJsonSchema({"anyOf": [{"const": "rigid"}, {"type": "number", "exclusiveMinimum": 0}]}),
    ] = "rigid"
    angle: Annotated[
        float | Literal["free", "rest"],
        _word_or_number("free", "rest"),
        WithJsonSchema(
            {"anyOf": [{"enum": ["free", "rest"]}, {"type": "number", "minimum": -180, "maximum": 180}]}
        ),
    ] = "free"
    bending: NonNegative | None = None

    @property
    def rigid(self) -> bool:
        """Whether the sides stay together under any force."""
        return self.stiffness == "rigid"

    @property
    def bends_as_sheet(self) -> bool:
        """Whether joined sides bend at the seam as within a sheet."""
        return self.angle != "free" and self.bending is None

    @property
    def label(self) -> str:
        """Name of the seam in output."""
        return " - ".join(self.between)

    def check(self) -> None:
        """Refuse a group that is sewn to itself, values out of range, and bending of a free seam."""
        require(self.between[0] != self.between[1], "must be two groups, not one and the same", "between")
        if not isinstance(self.stiffness, str):
            require(self.stiffness > 0.0, f"must be > 0, not {self.stiffness:g}", "stiffness")
        if not isinstance(self.angle, str):
            half_turn = f"must be free, rest or between -180 and 180 degrees, not {self.angle:g}"
            require(abs(self.angle) < 180.0, half_turn, "angle")
        useless = self.bending is not None and self.angle == "free"
        require(
            not useless, "needs angle: rest, or degrees; with angle: free the seam bends freely", "bending"
        )
