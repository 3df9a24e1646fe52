"""A choice of vertices, which several blocks of the scene share."""

from __future__ import annotations

from collections import Counter
from typing import Annotated, Any

from pydantic import field_validator

from lyra_petsc.scene.block import Block
from lyra_petsc.scene.values import Index, Name, Vec3, list_of, problem, shown, vector


class VertexChoice(Block):
    """Vertices by group, nodes or box.

    Attributes
    ----------
    group : str or None
        A group of the mesh, or the name of a sheet.
    nodes : list of int or None
        Numbers of vertices from 0, in file order.
    box : two (3,) [m] or None
        Lower and upper corner of a box; it selects by start positions and includes its faces.
    """

    group: Name | None = None
    nodes: Annotated[list[Index], list_of(" of vertex numbers", minimum=1)] | None = None
    box: tuple[Vec3, Vec3] | None = None

    @field_validator("nodes")
    @classmethod
    def _check_unique(cls, nodes: list[int] | None) -> list[int] | None:
        if nodes is not None and len(set(nodes)) != len(nodes):
            twice = Counter(nodes).most_common(1)[0][0]
            raise problem(f"lists vertex {twice} twice")
        return nodes

    @field_validator("box", mode="before")
    @classmethod
    def _check_box(cls, value: Any) -> Any:
        if not isinstance(value, (list, tuple)) or len(value) != 2:
            raise problem(f"must be two corners [[x, y, z], [x, y, z]], not {shown(value)}")
        low, high = vector(value[0]), vector(value[1])
        if any(a > b for a, b in zip(low, high, strict=True)):
            raise problem("must have its lower corner first")
        return low, high
