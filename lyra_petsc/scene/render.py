"""Scene block of the pictures: where the camera stands. Read by ``render``, never by a run."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import PlainValidator, model_validator
from typing_extensions import Self

from lyra_petsc.scene.block import Block
from lyra_petsc.scene.rules import absent, given, when
from lyra_petsc.scene.values import Axis, JsonSchema, Positive, Vec3, Vector, number, problem, shown

SMALLEST_ANGLE, LARGEST_ANGLE = 1.0, 120.0
PARALLEL = 1e-6
"""Sine of the angle between two directions below which they count as one."""


def _angle(value: object) -> float:
    angle = number(value)
    if not SMALLEST_ANGLE <= angle <= LARGEST_ANGLE:
        raise problem(f"must be from {SMALLEST_ANGLE:g} to {LARGEST_ANGLE:g} degrees, not {shown(value)}")
    return angle


Angle = Annotated[
    float,
    PlainValidator(_angle),
    JsonSchema({"type": "number", "minimum": SMALLEST_ANGLE, "maximum": LARGEST_ANGLE}),
]


class Camera(Block):
    """Where the pictures are taken from; what is left out is found from the whole motion.

    Attributes
    ----------
    direction : (3,) or None
        From the sheet towards the camera; its distance is fitted to the whole motion.
    position : (3,) [m] or None
        Where it stands, instead of a direction; needs a target.
    target : (3,) [m] or None
        What it looks at.
    up : (3,) or None
        Upwards in the picture; without: against gravity, or z.
    angle : float [degrees]
        Height of the field of view, from 1 to 120.
    zoom : float
        With a fitted distance: how much larger than it fits.
    """

    rules = (
        when(given("position"), {"allOf": [given("target"), absent("direction", "zoom")]}),
        when(given("target"), given("position")),
    )

    direction: Axis | None = None
    position: Vector | None = None
    target: Vector | None = None
    up: Axis | None = None
    angle: Angle = 25.0
    zoom: Positive | None = None

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if (self.position is None) != (self.target is None):
            here, other = ("position", "target") if self.target is None else ("target", "position")
            raise problem(f"needs {other} beside it; to have the distance fitted give direction", here)
        if self.position is not None:
            for name in self.given("direction", "zoom"):
                raise problem("has no meaning beside position and target; leave it out", name)
            if self.position == self.target:
                raise problem("is where the camera stands; it must look at another point", "target")
        view = self.line_of_sight
        if view is not None and self.up is not None and parallel(view, self.up):
            raise problem("must not point along the line of sight", "up")
        return self

    @property
    def line_of_sight(self) -> Vec3 | None:
        """Direction from what is seen to the camera, of any length, if the scene gives it."""
        if self.position is None or self.target is None:
            return self.direction
        x, y, z = (a - b for a, b in zip(self.position, self.target, strict=True))
        return x, y, z


def parallel(a: Vec3, b: Vec3) -> bool:
    """Whether two directions are the same or opposite."""
    first, second = (np.asarray(v) / np.abs(v).max() for v in (a, b))
    sine = np.linalg.norm(np.cross(first, second)) / (np.linalg.norm(first) * np.linalg.norm(second))
    return bool(sine < PARALLEL)


class Render(Block):
    """How ``render`` shows the scene.

    Attributes
    ----------
    camera : Camera or None
        Where the pictures are taken from; without: where most of the sheet is seen.
    """

    camera: Camera | None = None
