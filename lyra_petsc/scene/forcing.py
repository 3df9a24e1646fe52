"""Scene blocks that move the sheets: wind, handles and their motions, loads, initial state."""

from __future__ import annotations

import math
from collections import Counter
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, field_validator, model_validator
from typing_extensions import Self

from lyra_petsc.scene.block import Block
from lyra_petsc.scene.rules import absent, given, one_of, when
from lyra_petsc.scene.sheet import Rotation
from lyra_petsc.scene.values import (
    LARGEST_INDEX,
    VECTOR,
    Flag,
    Index,
    JsonSchema,
    Name,
    NonNegative,
    Number,
    Positive,
    Scale,
    Seed,
    Until,
    Vec3,
    Vector,
    problem,
    shown,
    vector,
    whole,
)

Direction = Literal["x", "y", "z"]
AXES: tuple[Direction, ...] = ("x", "y", "z")
_AXES = {"type": "array", "items": {"enum": list(AXES)}, "minItems": 1}


class Wind(Block):
    """Uniform wind.

    Attributes
    ----------
    velocity : (3,) [m/s]
        Of the air; zeros are still air.
    density : float [kg/m³]
        Of the air.
    drag : float [kg/(m² s)]
        Tangential drag coefficient.
    """

    velocity: Vector
    density: NonNegative
    drag: NonNegative = 0.0


def _vertex_list(value: Any) -> Any:
    if not isinstance(value, (list, tuple)) or not value:
        raise problem(f"must be a list of vertex numbers, not {shown(value)}")
    return list(value)


_VERTICES = {"type": "array", "items": whole(0, LARGEST_INDEX), "minItems": 1, "uniqueItems": True}
_BOX = {"type": "array", "items": VECTOR, "minItems": 2, "maxItems": 2}


class _Vertices(Block):
    """The three ways to name vertices.

    Attributes
    ----------
    group : str or None
        A group of the mesh, or a sheet's name.
    nodes : list of int or None
        Vertex numbers, from 0, in file order.
    box : two (3,) [m] or None
        Lower and upper corner; start positions, faces included.
    """

    group: Name | None = None
    nodes: Annotated[list[Index], BeforeValidator(_vertex_list), JsonSchema(_VERTICES)] | None = None
    box: Annotated[tuple[Vec3, Vec3], JsonSchema(_BOX)] | None = None

    @field_validator("nodes")
    @classmethod
    def _each_once(cls, nodes: list[int] | None) -> list[int] | None:
        if nodes is not None and len(set(nodes)) != len(nodes):
            twice = Counter(nodes).most_common(1)[0][0]
            raise problem(f"lists vertex {twice} twice")
        return nodes

    @field_validator("box", mode="before")
    @classmethod
    def _corners(cls, value: Any) -> Any:
        if not isinstance(value, (list, tuple)) or len(value) != 2:
            raise problem(f"must be two corners [[x, y, z], [x, y, z]], not {shown(value)}")
        low, high = vector(value[0]), vector(value[1])
        if any(a > b for a, b in zip(low, high, strict=True)):
            raise problem("must have its lower corner first")
        return low, high

    def _selected(self) -> list[str]:
        return self.given("group", "nodes", "box")


class Selector(_Vertices):
    """Vertices by exactly one of group, nodes, box."""

    rules = (one_of("group", "nodes", "box"),)

    @model_validator(mode="after")
    def _one_selection(self) -> Self:
        if len(self._selected()) != 1:
            raise problem("must have exactly one of group, nodes, box")
        return self


class Handle(Selector):
    """Vertices whose motion is prescribed, or pulled by springs.

    Attributes
    ----------
    axes : tuple of "x", "y", "z"
        Directions that are held.
    clamp : bool
        Keep the slope of held boundary edges.
    motion : str or None
        Name in ``motions``; without: held in place.
    interpolation : str
        Of the motion in time, between keyframes.
    start, until : float [s]
        Held for from ≤ t ≤ until (without: to the end).
    fade : float [s]
        After ``until`` the hold fades as (1 − (t − until)/fade)⁴.
    stiffness : float [N/m] or None
        Per vertex and axis: a spring instead of a constraint.
    """

    axes: Annotated[tuple[Direction, ...], JsonSchema(_AXES)] = AXES
    clamp: Flag = False
    motion: Name | None = None
    interpolation: Literal["hermite", "linear"] = "hermite"
    start: Number = Field(default=0.0, alias="from")
    until: Until = math.inf
    fade: NonNegative = 0.0
    stiffness: Positive | None = None

    @property
    def axis_numbers(self) -> tuple[int, ...]:
        """``axes`` as 0, 1, 2, ascending."""
        return tuple(AXES.index(axis) for axis in self.axes)

    @field_validator("axes", mode="before")
    @classmethod
    def _axes(cls, value: Any) -> Any:
        if not isinstance(value, (list, tuple)) or not value or any(axis not in AXES for axis in value):
            raise problem(f"must be a list of x, y, z, not {shown(value)}")
        return tuple(axis for axis in AXES if axis in value)

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        _check_times(self.start, self.until)
        return self


def _check_times(start: float, until: float) -> None:
    if not start < until:
        raise problem(f"must be later than from = {start:g}, not {until:g}", "until")


class Keyframe(Block):
    """Where a motion has carried the held vertices at one time: scaled, rotated, translated.

    Attributes
    ----------
    time : float [s]
        Later than the keyframe before.
    scale : float or (3,)
        Factor about the origin, or one for each axis; not 0.
    rotate : Rotation or None
        Rotation after the scaling.
    translate : (3,) [m]
        Displacement after the rotation.
    velocity : (3,) [m/s] or None
        Of the translation; without: by central differences, zero at both ends.
    """

    time: Number
    scale: Scale = 1.0
    rotate: Rotation | None = None
    translate: Vector = (0.0, 0.0, 0.0)
    velocity: Vector | None = None


class Load(_Vertices):
    """A force, a pressure or a traction.

    Attributes
    ----------
    group : str or None
        A group of the mesh, or a sheet's name; for pressure and traction a surface group, or nothing (every
        triangle).
    force : (3,) [N] or None
        Total, shared by the selected vertices.
    pressure : float [Pa] or None
        Along the current normal.
    traction : (3,) [N/m²] or None
        Per rest area, direction fixed in space.
    start, until : float [s]
        Acts for from ≤ t ≤ until (without: to the end).
    """

    rules = (
        one_of("force", "pressure", "traction"),
        when(given("force"), one_of("group", "nodes", "box"), absent("nodes", "box")),
    )

    force: Vector | None = None
    pressure: Number | None = None
    traction: Vector | None = None
    start: Number = Field(default=0.0, alias="from")
    until: Until = math.inf

    @model_validator(mode="after")
    def _one_load(self) -> Self:
        kinds = self.given("force", "pressure", "traction")
        if len(kinds) != 1:
            raise problem("must have exactly one of force, pressure, traction")
        selected = self._selected()
        if self.force is not None and len(selected) != 1:
            raise problem("needs exactly one of group, nodes, box to act on", "force")
        if self.force is None and set(selected) - {"group"}:
            raise problem(f"cannot select triangles for {kinds[0]}; use group", selected[-1])
        _check_times(self.start, self.until)
        return self


class Initial(Block):
    """State at t = 0, beside the start positions.

    Attributes
    ----------
    velocity : (3,) [m/s]
        Of all vertices.
    angular_velocity : (3,) [rad/s]
        About the centre of mass.
    noise : float [m]
        Standard deviation of a normally distributed displacement of every vertex that no
        handle holds, along the vertex normal of the start shape.
    seed : int
        Of the noise.
    """

    velocity: Vector = (0.0, 0.0, 0.0)
    angular_velocity: Vector = (0.0, 0.0, 0.0)
    noise: NonNegative = 0.0
    seed: Seed = 0
