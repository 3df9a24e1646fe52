"""The block ``render``: the camera of the pictures."""

from __future__ import annotations

import numpy as np

from lyra_petsc.scene.block import Block
from lyra_petsc.scene.values import (
    Angle,
    Axis,
    Positive,
    Share,
    Vec3,
    Vector,
    require,
)


class Camera(Block):
    """Camera of the pictures; keys left out are computed from the whole motion.

    Attributes
    ----------
    direction : (3,) or None
        Direction from the sheet towards the camera, whose distance is fitted to the whole motion.
    position : (3,) [m] or None
        Position of the camera, instead of a direction; needs a target.
    target : (3,) [m] or None
        Point at which the camera looks.
    up : (3,) or None
        Direction upwards in the picture; by default against gravity, else z.
    angle : float [degrees]
        Vertical angle of view, from 1 to 120.
    zoom : float
        Magnification relative to the fitted distance.
    frame : float [percent]
        Percentage of the states that the fitted distance shows completely, from 50 to 100; by default 95.
    """

    direction: Axis | None = None
    position: Vector | None = None
    target: Vector | None = None
    up: Axis | None = None
    angle: Angle = 25.0
    zoom: Positive | None = None
    frame: Share | None = None

    def check(self) -> None:
        """Refuse half of a line of sight, or one given twice, or along the direction upwards."""
        for here, other in (("position", "target"), ("target", "position")):
            text = f"needs {other} beside it; to have the distance fitted give direction"
            self.require_with(here, self.get(other) is not None, text)
        for key in ("direction", "zoom", "frame"):
            text = "has no meaning beside position and target; leave it out"
            self.require_with(key, self.position is None, text)
        if self.position is not None:
            text = "is where the camera stands; it must look at another point"
            require(self.position != self.target, text, "target")
        view = self.line_of_sight
        if view is not None and self.up is not None:
            require(not parallel(view, self.up), "must not point along the line of sight", "up")

    @property
    def line_of_sight(self) -> Vec3 | None:
        """Direction from the target to the camera, of any length; None if the scene does not give it."""
        if self.position is None or self.target is None:
            return self.direction
        x, y, z = (a - b for a, b in zip(self.position, self.target, strict=True))
        return x, y, z


def parallel(a: Vec3, b: Vec3) -> bool:
    """Whether two directions are the same or opposite."""
    first, second = (np.asarray(v) / np.abs(v).max() for v in (a, b))
    sine = np.linalg.norm(np.cross(first, second)) / (np.linalg.norm(first) * np.linalg.norm(second))
    # sine of the angle between two directions below which they count as one
    return bool(sine < 1e-6)


class Render(Block):
    """Settings of the command ``render``.

    Attributes
    ----------
    camera : Camera or None
        Camera of the pictures; by default one that sees most of the sheet.
    """

    camera: Camera | None = None
