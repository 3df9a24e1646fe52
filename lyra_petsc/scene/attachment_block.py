"""Attachments of a scene: springs between points of its sheets."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, WithJsonSchema

from lyra_petsc.scene.block import Block
from lyra_petsc.scene.values import Positive, Vector, number, require, shown
from lyra_petsc.scene.vertex_choice import VertexChoice


def _length(value: Any) -> float | str:
    if isinstance(value, str):
        require(value == "start", f"must be a length in m, or start, not {shown(value)}")
        return value
    length = number(value)
    require(length >= 0.0, f"must be >= 0, not {length:g}")
    return length


class AttachmentEnd(VertexChoice):
    """Points of the sheets: those of a group, nodes or box, or the one nearest to a place.

    Attributes
    ----------
    group : str or None
        A group of the mesh, or the name of a sheet. In ``to`` a group of triangles stands for all points of
        its surface.
    point : (3,) [m] or None
        The point of the sheets nearest to this place at the start, a vertex or inside a triangle; with a
        ``group`` of triangles that of this surface.
    """

    point: Vector | None = None

    def check(self) -> None:
        """Refuse several choices."""
        if self.point is None:
            self.require_one("group", "nodes", "box", "point")
        for key in ("nodes", "box"):
            self.require_with(key, self.point is None, "does not go with point; leave one of them out")


class Attachment(Block):
    """Springs that hold points of sheets together: buttons, pockets, ends of cables.

    Attributes
    ----------
    start, to : AttachmentEnd
        Each point of ``from`` is attached to the nearest point of ``to`` at the start.
    stiffness : float [N/m]
        Stiffness of the spring of each point.
    length : float [m] or "start"
        Distance at which the springs are free of force; ``start``: their distances at the start.
    breaks_at : float [N] or None
        A spring whose force is larger at the end of a step is gone for good; its energy becomes heat. A
        static analysis stays at such a load factor until nothing breaks any more.
    """

    start: AttachmentEnd = Field(alias="from")
    to: AttachmentEnd
    stiffness: Positive
    length: Annotated[
        float | Literal["start"],
        BeforeValidator(_length),
        WithJsonSchema({"anyOf": [{"const": "start"}, {"type": "number", "minimum": 0}]}),
    ] = 0.0
    breaks_at: Positive | None = None
