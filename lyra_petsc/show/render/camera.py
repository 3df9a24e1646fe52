"""The camera: its direction, and a position from which most of the motion is in the picture.

The support of a set of points for a direction n is the largest product x · n of a point with n.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.scene.camera_block import Camera, parallel
from lyra_petsc.scene.schema import Scene

MARGIN = 0.86
"""Fraction of the picture's height and width that the motion fills."""
BAR_HEIGHT = 0.12
"""Fraction of the picture's height that is reserved for the colour bar."""

FRAMED_STATES = 95.0
"""Percentage of the states that are entirely in the picture, unless the scene says otherwise."""

ELEVATIONS = (15.0, 25.0, 35.0, 50.0)
AZIMUTHS = 24
MIN_VISIBLE = 0.05
"""Added to the visible fraction of a state's area, so that a hidden state has a large but finite weight."""
FIRST_WEIGHT = 3.0
"""Weight of the first state, with which films begin."""
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
    gravity = np.array(scene.gravity or (0.0, 0.0, 0.0))
    up = np.array(camera.up) if camera.up is not None else -gravity
    return _unit(up) if up.any() else np.array([0.0, 0.0, 1.0])


def line_of_sight(scene: Scene, up: Array, shapes: Iterable[Array], triangles: Ints) -> Array:
    """Unit vector from the sheet to the camera.

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
    azimuths = 2.0 * math.pi * np.arange(AZIMUTHS) / AZIMUTHS
    corners = [x[triangles] for x in shapes]
    normals = [np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]) for c in corners]
    best = azimuths[int(np.argmax(_visibility(up, azimuths, normals).max(axis=1)))]
    aside = best + math.radians(SIDE_ANGLE) * np.array([1.0, -1.0])
    seen = _visibility(up, aside, normals) * [[1.05], [1.0]]
    turned, raised = np.unravel_index(int(np.argmax(seen)), seen.shape)
    return direction(up, float(aside[turned]), math.radians(ELEVATIONS[int(raised)]))


def _visibility(up: Array, azimuths: Array, normals: Sequence[Array]) -> Array:
    """Visibility of the sheet from each direction, (azimuths, elevations).

    A mean over states of the visible fraction f of the sheet's area, ⟨f⁻²⟩^(-1/2), in which a state seen from
    its edge outweighs many that are seen a little better. Directions of similar visibility are preferred
    if they see the sheet's front side, and then if they are close to the front.

    Parameters
    ----------
    up : (3,)
    azimuths : (n,) [rad]
    normals : sequence of (F, 3)
        Normals of the triangles in each state; their lengths are proportional to the areas.
    """
    elevations = [math.radians(elevation) for elevation in ELEVATIONS]
    sights = np.array([direction(up, float(a), e) for a in azimuths for e in elevations])
    squares, facing = np.zeros(len(sights)), np.zeros(len(sights))
    for number, areas in enumerate(normals):
        towards = areas @ sights.T
        whole = max(float(np.linalg.norm(areas, axis=1).sum()), 1e-300)
        weight = 1.0 if number else FIRST_WEIGHT
        squares += weight / (MIN_VISIBLE + np.abs(towards).sum(axis=0) / whole) ** 2
        facing += towards.sum(axis=0)
    mean = 1.0 / np.sqrt(np.maximum(squares, 1e-300))
    preferred: Array = mean * (1.0 + 0.1 * np.sign(facing) + 0.05 * sights @ horizon(up)[1])
    return preferred.reshape(len(azimuths), len(elevations))


def direction(up: Array, azimuth: float, elevation: float) -> Array:
    """Unit vector at angles [rad] from the front, about ``up`` and above the horizon."""
    side, front = horizon(up)
    level = math.cos(azimuth) * front + math.sin(azimuth) * side
    return math.cos(elevation) * level + math.sin(elevation) * up


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
