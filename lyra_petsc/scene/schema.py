"""The scene: every key, its unit, its range and its default.

Attribute names are the keys of the scene file, except ``from``, which Python calls
``start``. SI units throughout. Blocks are frozen; ``None`` means the key is absent and its
term is off.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, PrivateAttr, model_validator
from typing_extensions import Self

from lyra_petsc.nearest import nearest
from lyra_petsc.scene.block import Block
from lyra_petsc.scene.control import Output, Solver, Time
from lyra_petsc.scene.forcing import Handle, Initial, Keyframe, Load, Selector, Wind
from lyra_petsc.scene.petsc_block import PETSC_BLOCK, PetscValue, petsc_options
from lyra_petsc.scene.render import Camera, Render
from lyra_petsc.scene.rules import given, when
from lyra_petsc.scene.sheet import Grid, Material, Membrane, MeshSource, Rotation, Transform
from lyra_petsc.scene.values import JsonSchema, Name, Text, Vec3, Vector, problem, shown

__all__ = [
    "Camera",
    "Grid",
    "Handle",
    "Initial",
    "Keyframe",
    "Load",
    "Material",
    "Membrane",
    "MeshSource",
    "Output",
    "Render",
    "Rotation",
    "Scene",
    "Selector",
    "Solver",
    "Time",
    "Transform",
    "Vec3",
    "Wind",
]


SMALLEST_STEP = 2.0**-52
"""Step over the end of the run below which the time, a 64-bit number, would stand still."""


def _too_small(step: float, end: float) -> str:
    return (
        f"is too small, {step:g}: times near {end:g} s are not told apart below {end * SMALLEST_STEP:.2g} s; "
        "take a longer one or an earlier time.end"
    )


_AT_REST = {"anyOf": [{"type": "null"}, {"items": {"const": 0}}]}


def _one_or_many(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        if not value:
            raise problem("must hold at least one entry")
        return list(value)
    return [value]


def _many(value: Any) -> Any:
    if isinstance(value, dict):
        raise problem("must be a list; put '- ' before the entry")
    if not isinstance(value, (list, tuple)):
        raise problem(f"must be a list, not {shown(value)}")
    return list(value)


def _named(value: Any) -> Any:
    if not isinstance(value, dict):
        raise problem(f"must be a block of names, not {shown(value)}")
    return value


class Scene(Block):
    """Everything a run is told.

    Attributes
    ----------
    title : str
        One line for summaries and pages.
    mesh : list of MeshSource
        Where the sheets come from: one block, or a list whose vertices are numbered consecutively.
    material : list of Material
        One block, or a list; at most one without a group: it serves the triangles that no other block names.
    gravity : (3,) [m/s²] or None
        Acceleration of gravity; without this key there is none.
    wind : Wind or None
        Uniform wind; without this key there is no air.
    handles : list of Handle
        Vertices that are held or moved.
    motions : dict of list of Keyframe
        Motions of handles, by name; times strictly ascending.
    loads : list of Load
        Forces, pressures and tractions.
    initial : Initial or None
        State at t = 0, where it is not rest.
    time : Time
        Time stepping, or the way to an equilibrium.
    output : Output
        What is written, and how often.
    probes : dict of Selector
        Vertices whose mean position goes into probes.csv at every step, by name.
    solver : Solver
        When a step counts as converged.
    render : Render or None
        What ``render`` shows; a run does not read it.
    petsc : dict
        PETSc options without the leading dash; an empty value is an option without one.
    """

    # a static analysis starts at rest
    rules = (
        when(
            given(time=given(analysis={"const": "static"}), initial={"type": "object"}),
            {
                "properties": {
                    "initial": {"properties": dict.fromkeys(("velocity", "angular_velocity"), _AT_REST)}
                }
            },
        ),
    )

    title: Text = ""
    mesh: Annotated[list[MeshSource], BeforeValidator(_one_or_many)]
    material: Annotated[list[Material], BeforeValidator(_one_or_many)]
    gravity: Vector | None = None
    wind: Wind | None = None
    handles: Annotated[list[Handle], BeforeValidator(_many)] = Field(default_factory=list)
    motions: Annotated[
        dict[Name, Annotated[list[Keyframe], BeforeValidator(_many)]], BeforeValidator(_named)
    ] = Field(default_factory=dict)
    loads: Annotated[list[Load], BeforeValidator(_many)] = Field(default_factory=list)
    initial: Initial | None = None
    time: Time
    output: Output = Field(default_factory=Output)
    probes: Annotated[dict[Name, Selector], BeforeValidator(_named)] = Field(default_factory=dict)
    solver: Solver = Field(default_factory=Solver)
    render: Render | None = None
    petsc: Annotated[dict[str, PetscValue], BeforeValidator(petsc_options), JsonSchema(PETSC_BLOCK)] = Field(
        default_factory=dict
    )

    _source: Path | None = PrivateAttr(default=None)
    _given: dict[str, Any] | None = PrivateAttr(default=None)
    _directory: Path | None = PrivateAttr(default=None)

    @property
    def source(self) -> Path | None:
        """The file this scene was read from, for messages; no part of its value."""
        return self._source

    def changed(self, changes: Mapping[str, Any]) -> Scene:
        """Another scene with some keys changed, as in ``{"time.end": 2.0, "handles[0].until": 1.0}``.

        None removes a key. The other keys stand as they were given: defaults follow the changes.

        Raises
        ------
        InputError
            On anything that cannot be used, naming the key.
        """
        from lyra_petsc.scene.load import change_scene

        return change_scene(self, changes)

    def __eq__(self, other: object) -> bool:
        # equal in value: which file it came from does not count
        return isinstance(other, Scene) and self.model_dump() == other.model_dump()

    __hash__ = None  # type: ignore[assignment]

    @model_validator(mode="after")
    def _time_advances(self) -> Self:
        smallest = self.time.end * SMALLEST_STEP
        if self.time.step != "auto" and self.time.step < smallest:
            raise problem(_too_small(self.time.step, self.time.end), "time", "step")
        if self.output.every is not None and self.output.every < smallest:
            raise problem(_too_small(self.output.every, self.time.end), "output", "every")
        return self

    @model_validator(mode="after")
    def _names_agree(self) -> Self:
        for name, keyframes in self.motions.items():
            if not keyframes:
                raise problem("must hold at least one keyframe", "motions", name)
            for i in range(1, len(keyframes)):
                if keyframes[i].time <= keyframes[i - 1].time:
                    raise problem(
                        f"must be later than the keyframe before ({keyframes[i - 1].time:g} s),"
                        f" not {keyframes[i].time:g}",
                        "motions",
                        name,
                        i,
                        "time",
                    )
        for i, handle in enumerate(self.handles):
            if handle.motion is not None and handle.motion not in self.motions:
                raise problem(
                    f"unknown motion {handle.motion!r}, {nearest(handle.motion, self.motions)}",
                    "handles",
                    i,
                    "motion",
                )
        if self.time.analysis == "static" and self.initial is not None:
            for name in ("velocity", "angular_velocity"):
                if any(getattr(self.initial, name)):
                    raise problem("has no meaning in a static analysis; leave it out", "initial", name)
        groups: set[str | None] = set()
        for i, material in enumerate(self.material):
            if material.group in groups:
                what = (
                    f"group {material.group!r}"
                    if material.group
                    else "triangles without a group of their own"
                )
                raise problem(f"is a second material for the {what}", "material", i, "group")
            groups.add(material.group)
        names = [source.name for source in self.mesh]
        for i, sheet in enumerate(names):
            if sheet is not None and sheet in names[:i]:
                raise problem(f"{sheet!r} is the name of an earlier sheet too", "mesh", i, "name")
        return self
