"""Triangulated surfaces of a run's obstacles, for pictures and exports."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

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
from lyra_petsc.mesh.topology import hinges
from lyra_petsc.output.layout import MESH_FILE, SUMMARY_FILE
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.scene.schema import Keyframe, Obstacle
from lyra_petsc.terms.handles.motion import Motion


def run_obstacles(run: StoredRun) -> list[Solid | Container]:
    """The obstacles of a run, in the order of its scene, moved as the run moved them.

    If a run was resumed with another motion, the earlier one counts until then.

    Raises
    ------
    InputError
        If the run is damaged or lacks a mesh that its scene names.
    """
    specs = run.scene.obstacles or {}
    meshes = {name for name, spec in specs.items() if spec.mesh is not None}
    stored = run.mesh.obstacles if meshes else {}
    if missing := meshes - stored.keys():
        raise InputError(f"does not hold the mesh of obstacle {min(missing)!r}", file=run.folder / MESH_FILE)
    obstacles = build_obstacles(run.scene, stored, Motion)
    for resumption in reversed(run.summary.get("resumed", [])):
        earlier, until = resumption.get("earlier_motions", {}), resumption.get("time", 0.0)
        obstacles = [
            _with_earlier_motion(run, body, earlier[body.name], until) if body.name in earlier else body
            for body in obstacles
        ]
    return obstacles


def _with_earlier_motion(
    run: StoredRun, obstacle: Solid | Container, earlier: Mapping[str, Any], until: float
) -> Solid | Container:
    """The obstacle with an earlier motion, an entry of summary.json, until a time [s]."""
    file, motion = run.folder / SUMMARY_FILE, None
    if earlier.get("motion"):
        try:
            keyframes = [Keyframe.model_validate(keyframe) for keyframe in earlier["motion"]]
        except ValueError:
            raise InputError("is damaged, holds what no run writes", file=file, key="resumed") from None
        motion = Motion(
            keyframes, earlier.get("interpolation", "hermite"), key="resumed", file=file
        ).transform
    before = replace(obstacle, motion=motion)

    def moved(time: float) -> tuple[Array, Array]:
        return (before if time <= until else obstacle).rigid_motion(time)

    if isinstance(obstacle, Container) or obstacle.deformation is None:
        return replace(obstacle, motion=moved)
    rigid = replace(obstacle, motion=motion, deformation=None)
    return replace(obstacle, deformation=lambda time: (rigid if time <= until else obstacle).positions(time))


CIRCLE_POINTS = 48
"""Points per circle of a sphere or capsule."""
PLANE_SIZE = 1.5
"""Side of the square that represents a plane, relative to the size of the sheets' motion."""
OPACITY = 0.3
"""Opacity of planes and containers, which would hide the sheets."""

SHARP, SHARP_PART = 50.0, 0.01
"""Angle [°] between two triangles from which their edge is sharp; and part of such edges in a mesh from which
it is no smooth surface.
"""

_SQUARE: Ints = np.array([[0, 1, 2], [0, 2, 3]])
_AXES = np.eye(3)


@dataclass(frozen=True)
class ObstacleSurface:
    """The surface of an obstacle as triangles.

    Attributes
    ----------
    name : str
    triangles : (m, 3) int64
    positions : callable
        Returns the points (n, 3) [m] at a time [s].
    fixed : bool
        Whether the points do not move.
    infinite : bool
        Whether the obstacle is a plane, represented by a square.
    opacity : float
        Below 1 if the surface would hide the sheets.
    smooth : bool
        Whether the triangles approximate a smooth surface.
    """

    name: str
    triangles: Ints
    positions: Callable[[float], Array]
    fixed: bool
    infinite: bool = False
    opacity: float = 1.0
    smooth: bool = False


def obstacle_surfaces(run: StoredRun, middle: Array, size: float) -> list[ObstacleSurface]:
    """The surfaces of a run's obstacles, in the order of its scene.

    Parameters
    ----------
    run : StoredRun
    middle : (3,)
        Centre of the sheets' motion [m]; its projection on a plane is the centre of the plane's square.
    size : float
        Size of the sheets' motion [m].

    Raises
    ------
    InputError
        If the run lacks a mesh that its scene names.
    """
    scene = run.scene
    if not scene.obstacles:
        return []
    surfaces = []
    for obstacle, spec in zip(run_obstacles(run), scene.obstacles.values(), strict=True):
        fixed = not obstacle.moves
        if spec.plane is not None:
            assert isinstance(obstacle, Container)
            tangents, half = _tangents(obstacle.normals[0]), 0.5 * PLANE_SIZE * size
            positions = partial(_square, obstacle, tangents, middle, half)
            surfaces.append(ObstacleSurface(obstacle.name, _SQUARE, positions, fixed, True, OPACITY))
            continue
        if spec.mesh is not None:
            assert isinstance(obstacle, Solid)
            surface = TriangleSurface(obstacle.points, obstacle.triangles)
            smooth = is_smooth(surface)
        else:
            surface, smooth = shape_surface(spec), spec.shape in ("sphere", "capsule")
        positions = partial(_moved_points, obstacle, surface.points)
        opacity = OPACITY if spec.inside else 1.0
        surfaces.append(
            ObstacleSurface(obstacle.name, surface.triangles, positions, fixed, False, opacity, smooth)
        )
    return surfaces


def is_smooth(surface: TriangleSurface) -> bool:
    """Whether triangles approximate a smooth surface: nearly none meet at a sharp edge."""
    a, b, c = surface.points[surface.triangles.T]
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    first, second = normals[hinges(surface.triangles).triangles].transpose(1, 0, 2)
    sharp = np.einsum("ei,ei->e", first, second) < np.cos(np.radians(SHARP))
    return bool(np.count_nonzero(sharp) < SHARP_PART * len(sharp))


def _moved_points(obstacle: Solid | Container, points: Array, time: float) -> Array:
    if obstacle.deformation is not None:
        return obstacle.deformation(time)
    rotation, translation = obstacle.rigid_motion(time)
    return points @ rotation.T + translation


def _square(plane: Container, tangents: Array, middle: Array, half: float, time: float) -> Array:
    """(4, 3) corners [m] of a square in a plane at a time [s]; its centre is the projection of ``middle``."""
    normal, point = plane.normals_at(time)[0], plane.positions(time)[0]
    centre = middle - ((middle - point) @ normal) * normal
    first, second = half * tangents @ plane.rigid_motion(time)[0].T
    return np.array(
        [centre - first - second, centre + first - second, centre + first + second, centre - first + second]
    )


def _tangents(normal: Array) -> Array:
    """(2, 3) unit vectors that form a right-handed frame with a unit normal."""
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
    angles = np.linspace(0.0, np.pi, CIRCLE_POINTS // 2 + 1)[1:-1]
    middle = len(angles) // 2
    if length > 0.0:  # a circle around either end
        angles = np.insert(angles, middle, angles[middle])
    circle = 2.0 * np.pi * np.arange(CIRCLE_POINTS) / CIRCLE_POINTS
    rings = np.stack([np.cos(circle), np.sin(circle)], axis=1) @ across
    ends = np.where((np.arange(len(angles)) <= middle)[:, None], axis[-1], axis[0])
    points = ends[:, None] + radius * (
        np.sin(angles)[:, None, None] * rings + np.cos(angles)[:, None, None] * up
    )
    poles = np.array([axis[-1] + radius * up, axis[0] - radius * up])
    here, n = np.arange(CIRCLE_POINTS), CIRCLE_POINTS * len(angles)
    after = (here + 1) % CIRCLE_POINTS
    first = np.arange(len(angles) - 1)[:, None] * CIRCLE_POINTS
    a, b, c, d = first + here, first + CIRCLE_POINTS + here, first + CIRCLE_POINTS + after, first + after
    top = np.stack([np.full(CIRCLE_POINTS, n), here, after], axis=1)
    last = n - CIRCLE_POINTS
    bottom = np.stack([np.full(CIRCLE_POINTS, n + 1), last + after, last + here], axis=1)
    sides = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)]).reshape(-1, 3)
    triangles = np.concatenate([top, sides, bottom]).astype(np.int64)
    return TriangleSurface(np.concatenate([points.reshape(-1, 3), poles]), triangles)
