"""The camera: its direction, and a position from which most of the motion is in the picture.

The support of a set of points for a direction n is the largest product x · n of a point with n.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.scene.camera_block import Camera, parallel
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.time_curve import largest

MARGIN = 0.86
"""Fraction of the picture's height and width that the motion fills."""
BAR_HEIGHT = 0.12
"""Fraction of the picture's height that is reserved for the colour bar."""

FRAMED_STATES = 95.0
"""Percentage of the states that are entirely in the picture, unless the scene says otherwise."""

LOWEST, HIGHEST = 15.0, 50.0
"""Bounds of the camera's elevation above the horizon [degrees]."""
FRONT_BONUS = 0.05
"""Part of the sheet's area that the side towards the viewer counts as seen in addition."""
FIRST_WEIGHT = 3.0
"""Weight of the first state, with which films begin, among the states that choose the direction."""
SIDE_ANGLE = 25.0
"""Angle [degrees] between the camera and the direction that sees most of the sheet; it shows folds."""


@dataclass(frozen=True)
class PerspectiveCamera:
    """Position, direction and field of view of a camera.

    Attributes
    ----------
    position, target : (3,) [m]
    up : (3,)
    angle : float
        Vertical field of view [degrees].
    raised : float
        Distance of the target above the middle of the picture, relative to half the picture's height.
    """

    position: Array
    target: Array
    up: Array
    angle: float
    raised: float = 0.0


def up_direction(scene: Scene) -> Array:
    """Unit vector that points up in pictures: the camera's ``up``, else against gravity, else z."""
    camera = _scene_camera(scene)
    gravity = np.zeros(3) + largest(scene.gravity)
    up = np.array(camera.up) if camera.up is not None else -gravity
    return _unit(up) if up.any() else np.array([0.0, 0.0, 1.0])


def line_of_sight(scene: Scene, up: Array, shapes: Iterable[Array], triangles: Ints) -> Array:
    """Unit vector from the sheet to the camera.

    Unless the scene gives it, the azimuth is `SIDE_ANGLE` beside the horizontal direction that sees most of
    the sheet, on its front side, and the elevation compares what is seen from there and from above.

    Parameters
    ----------
    scene : Scene
    up : (3,)
    shapes : iterable of (V, 3)
        Positions in some states [m], used if the scene gives no direction.
    triangles : (F, 3)
    """
    chosen = _scene_camera(scene).line_of_sight
    if chosen is not None:
        return _unit(np.array(chosen))
    side, front = horizon(up)
    axes = np.array([side, front, up])
    seen, facing = np.zeros((3, 3)), np.zeros(3)
    for number, positions in enumerate(shapes):
        corners = positions[triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ axes.T
        areas = np.linalg.norm(normals, axis=1, keepdims=True)
        weight = 1.0 if number else FIRST_WEIGHT
        # s @ seen @ s: area times the squared cosine between the normal and a direction s
        seen += weight * normals.T @ np.divide(normals, areas, out=np.zeros_like(normals), where=areas > 0.0)
        facing += weight * normals.sum(axis=0)
    # of nearly equal directions that towards the viewer, where x points to the right
    seen[1, 1] += FRONT_BONUS * np.trace(seen)
    facing[1] += FRONT_BONUS * np.trace(seen)
    level, directions = np.linalg.eigh(seen[:2, :2])
    x, y = directions[:, 1] * math.copysign(1.0, float(directions[:, 1] @ facing[:2]))
    azimuth = math.atan2(x, y) - math.copysign(math.radians(SIDE_ANGLE), x)
    steep = math.degrees(math.atan2(math.sqrt(seen[2, 2]), math.sqrt(max(float(level[1]), 0.0))))
    elevation = math.radians(min(max(steep, LOWEST), HIGHEST))
    towards = math.cos(azimuth) * front + math.sin(azimuth) * side
    return math.cos(elevation) * towards + math.sin(elevation) * up


def horizon(up: Array) -> tuple[Array, Array]:
    """Unit vectors normal to ``up``, to the right and towards the viewer; x and −y if ``up`` is z."""
    right = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    right = _unit(right - (right @ up) * up)
    return right, np.cross(right, up)


class CameraFit:
    """Finds the nearest camera position from which given points are in the picture.

    Four planes through the camera bound the picture, so only the support of the points for the normals of
    these planes is needed.

    Attributes
    ----------
    normals : (6, 3) float64
        Normals of the four planes, the line of sight and its opposite.

    Parameters
    ----------
    scene : Scene
    sight : (3,)
        Unit vector towards the camera.
    up : (3,)
    aspect : float
        Width of the picture over its height.
    bar : bool
        Reserve space for the colour bar at the bottom.
    """

    def __init__(self, scene: Scene, sight: Array, up: Array, aspect: float, *, bar: bool = False) -> None:
        self._camera = _scene_camera(scene)
        # seen from straight above, the direction away from the viewer is up in the picture
        self._up = -horizon(up)[1] if parallel(tuple(sight), tuple(up)) else up
        self._sight = sight
        self._right = _unit(np.cross(self._up, sight))
        self._upper = np.cross(sight, self._right)
        self._raised = BAR_HEIGHT if bar else 0.0
        half = math.tan(math.radians(self._camera.angle) / 2.0)
        self._slope = half * np.array([MARGIN * aspect, MARGIN - self._raised])
        sides = [
            sign * axis + slope * sight
            for axis, slope in zip((self._right, self._upper), self._slope, strict=True)
            for sign in (1.0, -1.0)
        ]
        self.normals = np.array([*sides, sight, -sight])

    def framed_support(self, supports: Array) -> Array:
        """Support (6,) [m] of most states, for `view`, from the ``supports`` (n, 6) of all states."""
        framed = FRAMED_STATES if self._camera.frame is None else self._camera.frame
        return np.asarray(np.percentile(supports, framed, axis=0, method="higher"))

    def view(self, support: Array) -> PerspectiveCamera:
        """The camera from which points with this support are in the picture.

        Parameters
        ----------
        support : (6,)
            Support of the points for each of ``normals`` [m].
        """
        camera = self._camera
        if camera.position is not None and camera.target is not None:
            return PerspectiveCamera(
                np.array(camera.position), np.array(camera.target), self._up, camera.angle
            )
        pairs = support[:4].reshape(2, 2)
        offset = (pairs[:, 0] - pairs[:, 1]) / 2.0
        depth = float((pairs.sum(axis=1) / (2.0 * self._slope)).max())
        middle = float(support[4] - support[5]) / 2.0
        centre = offset[0] * self._right + offset[1] * self._upper
        distance = (depth - middle) / (camera.zoom or 1.0)
        target = centre + middle * self._sight
        return PerspectiveCamera(
            target + distance * self._sight, target, self._up, camera.angle, self._raised
        )


def _scene_camera(scene: Scene) -> Camera:
    camera = scene.render.camera if scene.render is not None else None
    return camera or Camera()


def _unit(vector: Array) -> Array:
    scaled = vector / np.abs(vector).max()
    return scaled / np.linalg.norm(scaled)
