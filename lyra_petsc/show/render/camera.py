"""The camera: its direction, and a position from which most of the motion is in the picture."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.scene.schema import Camera, Scene, parallel

MARGIN = 0.86
"""Fraction of the picture's height and width that the motion fills."""
BAR = 0.12
"""Fraction of its height that is left free for the bar of colours."""

FRAMED = 95.0
"""Percentage of the states that are wholly in the picture, unless the scene says otherwise."""

ELEVATIONS = (15.0, 25.0, 35.0, 50.0)
AZIMUTHS = 24
LEAST_SEEN = 0.05
"""Added to the share of a state's area that is seen: none is worth everything."""
FIRST_WEIGHT = 3.0
ASIDE = 25.0
"""Degrees by which the camera turns away from the largest view of the sheet, as folds show from the side."""


@dataclass(frozen=True)
class PerspectiveCamera:
    """Position, direction and field of view of a camera.

    Attributes
    ----------
    position, target : (3,) [m]
    up : (3,)
    angle : float
        Height of the field of view [degrees].
    raised : float
        Distance of the target above the middle of the picture, over half its height.
    """

    position: Array
    target: Array
    up: Array
    angle: float
    raised: float = 0.0


def upwards(scene: Scene) -> Array:
    """Unit vector that points up in the pictures: as the scene says, else against gravity, else z."""
    camera = _camera(scene)
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
        Some states of the motion [m], used if the scene gives no direction.
    triangles : (F, 3)
    """
    given = _camera(scene).line_of_sight
    if given is not None:
        return _unit(np.array(given))
    azimuths = 2.0 * math.pi * np.arange(AZIMUTHS) / AZIMUTHS
    corners = [x[triangles] for x in shapes]
    normals = [np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]) for c in corners]
    best = azimuths[int(np.argmax(_seen(up, azimuths, normals).max(axis=1)))]
    aside = best + math.radians(ASIDE) * np.array([1.0, -1.0])
    seen = _seen(up, aside, normals) * [[1.05], [1.0]]
    turned, raised = np.unravel_index(int(np.argmax(seen)), seen.shape)
    return direction(up, float(aside[turned]), math.radians(ELEVATIONS[int(raised)]))


def _seen(up: Array, azimuths: Array, normals: Sequence[Array]) -> Array:
    """How well triangles with normals (F, 3) are seen from each direction, (azimuths, elevations).

    A mean of the shares of their areas that they show, in which one state seen from its edge weighs more
    than many that are seen a little better; the first one, with which films begin, counts as three. Where
    that is nearly the same: a direction that sees the sheet's front, then one from the front.
    """
    elevations = [math.radians(elevation) for elevation in ELEVATIONS]
    sights = np.array([direction(up, float(a), e) for a in azimuths for e in elevations])
    squares, facing = np.zeros(len(sights)), np.zeros(len(sights))
    for number, areas in enumerate(normals):
        towards = areas @ sights.T
        whole = max(float(np.linalg.norm(areas, axis=1).sum()), 1e-300)
        weight = 1.0 if number else FIRST_WEIGHT
        squares += weight / (LEAST_SEEN + np.abs(towards).sum(axis=0) / whole) ** 2
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
    """Two unit vectors normal to ``up``: to the right, and towards the viewer; x and −y where z is up."""
    right = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    right = _unit(right - (right @ up) * up)
    return right, np.cross(right, up)


class Fit:
    """Finds the nearest camera position from which given points are in the picture.

    Four planes through the camera bound the picture, so that of the points only the largest products with the
    normals of these planes are needed.

    Parameters
    ----------
    scene : Scene
    sight : (3,)
        Unit vector towards the camera.
    up : (3,)
    aspect : float
        Width of the picture over its height.
    bar : bool
        Leave room for the bar of colours at the bottom.
    """

    def __init__(self, scene: Scene, sight: Array, up: Array, aspect: float, *, bar: bool = False) -> None:
        self._camera = _camera(scene)
        # seen from straight above, the direction away from the viewer is up in the picture
        self._up = -horizon(up)[1] if parallel(tuple(sight), tuple(up)) else up
        self._sight = sight
        self._right = _unit(np.cross(self._up, sight))
        self._upper = np.cross(sight, self._right)
        self._raised = BAR if bar else 0.0
        half = math.tan(math.radians(self._camera.angle) / 2.0)
        self._slope = half * np.array([MARGIN * aspect, MARGIN - self._raised])
        sides = [
            sign * axis + slope * sight
            for axis, slope in zip((self._right, self._upper), self._slope, strict=True)
            for sign in (1.0, -1.0)
        ]
        self.normals = np.array([*sides, sight, -sight])

    def most(self, reaches: Array) -> Array:
        """The reach (6,) [m] of most states, as `view` takes it; ``reaches`` (n, 6) has that of each."""
        framed = FRAMED if self._camera.frame is None else self._camera.frame
        return np.asarray(np.percentile(reaches, framed, axis=0, method="higher"))

    def view(self, reach: Array) -> PerspectiveCamera:
        """The camera.

        Parameters
        ----------
        reach : (6,)
            Largest product of a point with each of ``normals`` [m].
        """
        camera = self._camera
        if camera.position is not None and camera.target is not None:
            return PerspectiveCamera(
                np.array(camera.position), np.array(camera.target), self._up, camera.angle
            )
        pairs = reach[:4].reshape(2, 2)
        across = (pairs[:, 0] - pairs[:, 1]) / 2.0
        away = float((pairs.sum(axis=1) / (2.0 * self._slope)).max())
        middle = float(reach[4] - reach[5]) / 2.0
        centre = across[0] * self._right + across[1] * self._upper
        distance = (away - middle) / (camera.zoom or 1.0)
        target = centre + middle * self._sight
        return PerspectiveCamera(
            target + distance * self._sight, target, self._up, camera.angle, self._raised
        )


def _camera(scene: Scene) -> Camera:
    asked = scene.render.camera if scene.render is not None else None
    return asked or Camera()


def _unit(vector: Array) -> Array:
    scaled = vector / np.abs(vector).max()
    return scaled / np.linalg.norm(scaled)
