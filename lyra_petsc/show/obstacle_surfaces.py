"""The surfaces of a run's obstacles as triangles, for pictures and exports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.mesh import TriangleSurface
from lyra_petsc.mesh.obstacles import (
    BOX_TRIANGLES,
    Container,
    Solid,
    axis_and_radius,
    box_corners,
    build_obstacles,
)
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.output.xdmf import MESH_FILE
from lyra_petsc.scene.schema import Obstacle
from lyra_petsc.terms.motion import Motion


def run_obstacles(run: StoredRun) -> list[Solid | Container]:
    """The obstacles of a run, in the order of its scene.

    Raises
    ------
    InputError
        If the run does not hold a mesh that its scene names, or is damaged.
    """
    obstacles = run.scene.obstacles or {}
    meshes = {name for name, obstacle in obstacles.items() if obstacle.mesh is not None}
    stored = run.mesh.obstacles if meshes else {}
    if missing := meshes - stored.keys():
        raise InputError(f"does not hold the mesh of obstacle {min(missing)!r}", file=run.folder / MESH_FILE)
    return build_obstacles(run.scene, stored, Motion)


AROUND = 48
"""Points of a circle of a sphere or capsule."""
PLANE_SIZE = 1.5
"""Side of the square that is shown of a plane, over the size of the sheets' motion."""
PLANE_OPACITY, CONTAINER_OPACITY = 0.5, 0.2

_SQUARE: Ints = np.array([[0, 1, 2], [0, 2, 3]])
_AXES = np.eye(3)


@dataclass(frozen=True)
class ObstacleSurface:
    """What is shown of an obstacle.

    Attributes
    ----------
    name : str
    triangles : (m, 3) int64
    positions : callable
        Of a time [s]: its points (n, 3) [m].
    still : bool
        Whether they are the same at all times.
    endless : bool
        It is a plane, of which a square is shown.
    opacity : float
        Below 1 where it would hide the sheets.
    round : bool
        Whether its triangles stand for a smooth surface.
    """

    name: str
    triangles: Ints
    positions: Callable[[float], Array]
    still: bool
    endless: bool = False
    opacity: float = 1.0
    round: bool = False


def obstacle_surfaces(run: StoredRun, middle: Array, size: float) -> list[ObstacleSurface]:
    """Of a run's obstacles, in the order of its scene.

    Parameters
    ----------
    run : StoredRun
    middle : (3,)
        Of the sheets' motion [m]: there, or beside it, the square of a plane has its centre.
    size : float
        Of the sheets' motion [m].

    Raises
    ------
    InputError
        If the run does not hold a mesh that its scene names.
    """
    scene = run.scene
    if not scene.obstacles:
        return []
    shown = []
    for one, obstacle in zip(run_obstacles(run), scene.obstacles.values(), strict=True):
        still = one.motion is None
        if obstacle.plane is not None:
            assert isinstance(one, Container)
            place = partial(_square, one, _tangents(one.normals[0]), middle, 0.5 * PLANE_SIZE * size)
            shown.append(ObstacleSurface(one.name, _SQUARE, place, still, True, PLANE_OPACITY))
            continue
        if obstacle.mesh is not None:
            assert isinstance(one, Solid)
            surface = TriangleSurface(one.points, one.triangles)
        else:
            surface = shape_surface(obstacle)
        place = partial(_carried, one, surface.points)
        opacity = CONTAINER_OPACITY if obstacle.inside else 1.0
        smooth = obstacle.shape in ("sphere", "capsule")
        shown.append(ObstacleSurface(one.name, surface.triangles, place, still, False, opacity, smooth))
    return shown


def _carried(obstacle: Solid | Container, points: Array, time: float) -> Array:
    rotation, translation = obstacle.rigid_motion(time)
    return points @ rotation.T + translation


def _square(plane: Container, tangents: Array, middle: Array, half: float, time: float) -> Array:
    """(4, 3) corners of a square in a plane at a time [s], whose centre is nearest to ``middle``."""
    normal, place = plane.normals_at(time)[0], plane.positions(time)[0]
    centre = middle - ((middle - place) @ normal) * normal
    first, second = half * tangents @ plane.rigid_motion(time)[0].T
    return np.array(
        [centre - first - second, centre + first - second, centre + first + second, centre - first + second]
    )


def _tangents(normal: Array) -> Array:
    """(2, 3) unit vectors that make a right-handed frame with a unit normal."""
    first = np.cross(_AXES[np.abs(normal).argmin()], normal)
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(normal, first)])


def shape_surface(obstacle: Obstacle) -> TriangleSurface:
    """A sphere, capsule or box at t = 0; triangles are anticlockwise seen from outside."""
    if obstacle.box is not None:
        return TriangleSurface(box_corners(obstacle.box), BOX_TRIANGLES)
    axis, radius = axis_and_radius(obstacle)
    along = axis[-1] - axis[0]
    length = float(np.linalg.norm(along))
    up = along / length if length > 0.0 else _AXES[2]
    across = _tangents(up)
    angles = np.linspace(0.0, np.pi, AROUND // 2 + 1)[1:-1]
    middle = len(angles) // 2
    if length > 0.0:  # a circle around either end
        angles = np.insert(angles, middle, angles[middle])
    circle = 2.0 * np.pi * np.arange(AROUND) / AROUND
    rings = np.stack([np.cos(circle), np.sin(circle)], axis=1) @ across
    ends = np.where((np.arange(len(angles)) <= middle)[:, None], axis[-1], axis[0])
    points = ends[:, None] + radius * (
        np.sin(angles)[:, None, None] * rings + np.cos(angles)[:, None, None] * up
    )
    poles = np.array([axis[-1] + radius * up, axis[0] - radius * up])
    here, n = np.arange(AROUND), AROUND * len(angles)
    after = (here + 1) % AROUND
    first = np.arange(len(angles) - 1)[:, None] * AROUND
    a, b, c, d = first + here, first + AROUND + here, first + AROUND + after, first + after
    top = np.stack([np.full(AROUND, n), here, after], axis=1)
    last = n - AROUND
    bottom = np.stack([np.full(AROUND, n + 1), last + after, last + here], axis=1)
    sides = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)]).reshape(-1, 3)
    triangles = np.concatenate([top, sides, bottom]).astype(np.int64)
    return TriangleSurface(np.concatenate([points.reshape(-1, 3), poles]), triangles)
