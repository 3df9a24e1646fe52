"""The keys of the original program's conf.json, with its defaults."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, Field, model_validator
from typing_extensions import Self

from lyra_petsc.scene.block import Block
from lyra_petsc.scene.values import (
    Count,
    Index,
    NonNegative,
    Number,
    Positive,
    Text,
    Vector,
    integer,
    number,
    problem,
    shown,
)

DEFAULT_FRAME_TIME = 0.04  # s
DEFAULT_FRAME_STEPS = 8


def _rotation(value: Any) -> Any:
    if not isinstance(value, (list, tuple)) or len(value) != 4:
        raise problem(f"must be [degrees, x, y, z], not {shown(value)}")
    return tuple(number(entry) for entry in value)


def _motion_keyframes(value: Any) -> Any:
    if isinstance(value, dict):
        if "motfile" in value:
            raise problem("motion files are not read; write the keyframes into the scene", "motfile")
        for key in value:
            if key not in ("center", "points"):
                raise problem("unknown key, known: center, points", str(key))
        center = value.get("center")
        if center is not None and any(number(c) != 0 for c in (center if isinstance(center, list) else [])):
            raise problem("must be [0, 0, 0]: motions are about the origin", "center")
        value = value.get("points")
    if not isinstance(value, list) or not value:
        raise problem(f"must be a list of keyframes, not {shown(value)}")
    return value


def _motion_number(value: Any) -> Any:
    # the original writes "none" as -1
    return None if value == -1 else value


class Placement(Block):
    """``transform``: scale, then rotate, then translate."""

    translate: Vector = (0.0, 0.0, 0.0)
    scale: Number = 1.0
    rotate: Annotated[tuple[float, float, float, float], BeforeValidator(_rotation)] = (0.0, 0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _has_axis(self) -> Self:
        if self.rotate[0] != 0.0 and not any(self.rotate[1:]):
            raise problem("needs an axis: [degrees, x, y, z]", "rotate")
        return self

    def in_our_keys(self) -> dict[str, Any]:
        """As our ``transform``, or as the spatial part of a keyframe."""
        block: dict[str, Any] = {"scale": self.scale, "translate": list(self.translate)}
        degrees, *axis = self.rotate
        if degrees != 0.0:
            block["rotate"] = {"axis": axis, "degrees": degrees}
        return block


class OriginalMaterial(Block):
    not_yet = dict.fromkeys(("yield_curv", "weakening"), "plastic creases are not there; leave the key out")

    data: Text
    density_mult: Positive = 1.0
    stretching_mult: Positive = 1.0
    bending_mult: NonNegative = 1.0
    thicken: Positive = 1.0
    damping: NonNegative = 0.0


class OriginalCloth(Block):
    mesh: Text
    transform: Placement = Field(default_factory=Placement)
    materials: list[OriginalMaterial]
    texture: Text = ""

    @model_validator(mode="after")
    def _one_material(self) -> Self:
        if len(self.materials) != 1:
            raise problem(f"must hold one material, not {len(self.materials)}", "materials")
        if self.transform.scale <= 0:
            raise problem("must be > 0", "transform", "scale")
        return self


class OriginalHandle(Block):
    type: Text = "node"
    cloth: Index = 0
    nodes: list[Index] = Field(default_factory=list)
    label: Annotated[int, BeforeValidator(integer)] = -1
    motion: Annotated[Index | None, BeforeValidator(_motion_number)] = None
    start_time: Number = 0.0
    end_time: Number | None = None
    fade_time: NonNegative = 0.0

    @model_validator(mode="after")
    def _on_nodes(self) -> Self:
        if self.type != "node":
            raise problem(f"only handles of type 'node' are read, not {self.type!r}", "type")
        if self.label == -1 and not self.nodes:
            raise problem("must have nodes or label")
        return self


class OriginalKeyframe(Block):
    time: Number
    transform: Placement = Field(default_factory=Placement)
    velocity: Placement | None = None

    @model_validator(mode="after")
    def _translation_only(self) -> Self:
        moving = self.velocity
        if moving is not None and (moving.scale not in (0.0, 1.0) or moving.rotate[0] != 0.0):
            raise problem("may hold translate only", "velocity")
        return self


class OriginalWind(Block):
    density: NonNegative = 0.0
    velocity: Vector = (0.0, 0.0, 0.0)
    drag: NonNegative = 0.0


class OriginalScene(Block):
    """The keys of a conf.json, with the original's defaults."""

    frame_time: Positive = DEFAULT_FRAME_TIME
    frame_steps: Count
    end_time: Positive | None = None
    end_frame: Count | None = None
    cloths: list[OriginalCloth]
    handles: list[OriginalHandle] = Field(default_factory=list)
    motions: list[Annotated[list[OriginalKeyframe], BeforeValidator(_motion_keyframes)]] = Field(
        default_factory=list
    )
    gravity: Vector | None = None
    wind: OriginalWind = Field(default_factory=OriginalWind)

    @classmethod
    def complete(cls, data: dict[str, Any]) -> dict[str, Any]:
        """Without a frame_time the step is that of the shipped scene, else one step a frame."""
        return {"frame_steps": 1 if "frame_time" in data else DEFAULT_FRAME_STEPS, **data}

    @model_validator(mode="after")
    def _numbers_exist(self) -> Self:
        if not self.cloths:
            raise problem("must hold at least one cloth", "cloths")
        for i, handle in enumerate(self.handles):
            if handle.motion is not None and handle.motion >= len(self.motions):
                raise problem(
                    f"there is no motion {handle.motion}, only {len(self.motions)}", "handles", i, "motion"
                )
            if handle.cloth >= len(self.cloths):
                raise problem(
                    f"there is no cloth {handle.cloth}, only {len(self.cloths)}", "handles", i, "cloth"
                )
        return self
