"""Obstacles of a scene: bodies that sheets stay outside of, and containers that they stay inside of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.mesh import Mesh, TriangleSurface
from lyra_petsc.mesh.topology import unique_edges
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.schema import Cuboid, Obstacle, Scene, coefficients

if TYPE_CHECKING:
    from mpi4py import MPI

    from lyra_petsc.mesh.frame_motion import FrameMotion


# corner i + 2 j + 4 k of a box is at its upper end in x, y, z where i, j, k are 1
_CORNERS = np.array([[i, j, k] for k in (0, 1) for j in (0, 1) for i in (0, 1)], dtype=np.float64)
_SIDES = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
BOX_TRIANGLES: Ints = _SIDES[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3).astype(np.int64)
"""(12, 3) of the corners of `box_corners`, anticlockwise seen from outside."""
_BOX_EDGES = np.array([[i, i + s] for s in (1, 2, 4) for i in range(8) if not i & s], dtype=np.int64)


RigidMotion: TypeAlias = Callable[[float], tuple[Array, Array]]
"""Rotation (3, 3) and translation (3,) [m] at a time [s]."""

MotionFactory: TypeAlias = type[Any]
"""`terms.motion.Motion`, which this package must not import."""


PointMotion: TypeAlias = Callable[[float], Array]
"""Points (n, 3) [m] of a body that deforms, at a time [s]."""


class _MovingBody:
    """A body that deforms, or moves rigidly from its place at t = 0: by T(t) T(0)⁻¹ for a rigid motion T."""

    points: Array
    motion: RigidMotion | None
    deformation: PointMotion | None = None

    @property
    def moves(self) -> bool:
        """Whether it moves or deforms."""
        return self.motion is not None or self.deformation is not None

    def rigid_motion(self, time: float) -> tuple[Array, Array]:
        """Rotation (3, 3) and translation (3,) [m] from t = 0 to a time [s]."""
        if self.motion is None or time == 0.0:  # without rounding errors
            return np.eye(3), np.zeros(3)
        (start_rotation, offset), (end_rotation, end_offset) = self.motion(0.0), self.motion(time)
        rotation = end_rotation @ start_rotation.T
        return rotation, end_offset - rotation @ offset

    def positions(self, time: float) -> Array:
        """Its points (n, 3) [m] at a time [s]; ``points`` itself if it does not move."""
        if self.deformation is not None:
            return self.deformation(time)
        if self.motion is None:
            return self.points
        rotation, translation = self.rigid_motion(time)
        return self.points @ rotation.T + translation


@dataclass(frozen=True, eq=False)
class Solid(_MovingBody):
    """An obstacle that sheets stay outside of.

    Attributes
    ----------
    name : str
    points : (n, 3) float64
        Points at t = 0 [m].
    edges : (m, 2) int64
        Each edge once; for a box without the diagonals of its sides.
    triangles : (k, 3) int64
        Triangles of a box are anticlockwise seen from outside, those of a mesh as in its file.
    radius : float
        Distance [m] of the surface from points, edges and triangles: of a sphere (one point) and a capsule
        (two points, one edge); otherwise 0.
    friction : (float, float)
        Static and kinetic coefficient.
    motion : RigidMotion or None
        None: it does not move as a rigid body.
    deformation : PointMotion or None
        None: it does not deform.
    """

    name: str
    points: Array
    edges: Ints
    triangles: Ints
    radius: float
    friction: tuple[float, float]
    motion: RigidMotion | None = None
    deformation: PointMotion | None = None


@dataclass(frozen=True, eq=False)
class Container(_MovingBody):
    """A convex region that all vertices stay inside of.

    Attributes
    ----------
    name : str
    kind : str
        ``planes``: the side of all planes to which their normals point; ``ball``: at most ``radius`` from the
        segment between the first and the last point (for a sphere there is only one).
    points : (n, 3) float64
        Points at t = 0 [m]: one on each plane, or the ends of the segment.
    normals : (n, 3) float64
        Unit normals at t = 0; (0, 3) for a ball.
    radius : float
        Radius of a ball [m], otherwise 0.
    friction : (float, float)
        Static and kinetic coefficient.
    motion : RigidMotion or None
        None: it does not move.
    """

    name: str
    kind: Literal["planes", "ball"]
    points: Array
    normals: Array
    radius: float
    friction: tuple[float, float]
    motion: RigidMotion | None = None

    def normals_at(self, time: float) -> Array:
        """Its normals (n, 3) at a time [s]; ``normals`` itself if it does not move."""
        if self.motion is None:
            return self.normals
        return self.normals @ self.rigid_motion(time)[0].T


def build_scene_obstacles(
    comm: MPI.Comm, scene: Scene, mesh: Mesh | None, motion: MotionFactory
) -> list[Solid | Container]:
    """The obstacles of a scene in its order, the same on all ranks; collective.

    Parameters
    ----------
    comm : MPI.Comm
    scene : Scene
    mesh : Mesh or None
        From `build.build_scene_mesh`; needed on rank 0 only, and only for obstacles that are meshes.
    motion : callable
        `terms.motion.Motion`.

    Raises
    ------
    InputError
        For invalid motions, on all ranks.
    """
    surfaces: Mapping[str, TriangleSurface] = {}
    if any(obstacle.mesh is not None for obstacle in (scene.obstacles or {}).values()):
        surfaces = on_root(comm, lambda: mesh.obstacles if mesh is not None else {})
    return build_obstacles(scene, surfaces, motion)


def build_obstacles(
    scene: Scene, surfaces: Mapping[str, TriangleSurface], motion: MotionFactory
) -> list[Solid | Container]:
    """The obstacles of a scene in its order.

    Parameters
    ----------
    scene : Scene
    surfaces : mapping of str to TriangleSurface
        Surfaces at t = 0 of the obstacles that are meshes, by name.
    motion : callable
        `terms.motion.Motion`.
    """
    return [_build_obstacle(scene, name, surfaces, motion) for name in scene.obstacles or {}]


def _build_obstacle(
    scene: Scene, name: str, surfaces: Mapping[str, TriangleSurface], motion: MotionFactory
) -> Solid | Container:
    assert scene.obstacles is not None
    assert scene.contact is not None
    obstacle = scene.obstacles[name]
    friction = coefficients(scene.contact.friction if obstacle.friction is None else obstacle.friction)
    rigid_motion: RigidMotion | None = None
    if isinstance(obstacle.motion, motion):  # of a program that drives it
        rigid_motion = obstacle.motion.transform
    elif keyframes := scene.keyframes(obstacle):
        key = f"motions.{obstacle.motion}" if isinstance(obstacle.motion, str) else f"obstacles.{name}.motion"
        rigid_motion = motion(keyframes, obstacle.interpolation, key=key, file=scene.source).transform
    if obstacle.plane is not None:
        normal = np.array(obstacle.plane.normal)
        normal /= np.abs(normal).max()  # squares of very large or small components would overflow
        normal /= np.linalg.norm(normal)
        point = np.array([obstacle.plane.point])
        return Container(name, "planes", point, normal[None], 0.0, friction, rigid_motion)
    if obstacle.box is not None and obstacle.inside:
        low, high = np.array(obstacle.box.min), np.array(obstacle.box.max)
        points, normals = np.array([low] * 3 + [high] * 3), np.concatenate([np.eye(3), -np.eye(3)])
        return Container(name, "planes", points, normals, 0.0, friction, rigid_motion)
    if obstacle.box is not None:
        corners = box_corners(obstacle.box)
        return Solid(name, corners, _BOX_EDGES.copy(), BOX_TRIANGLES.copy(), 0.0, friction, rigid_motion)
    if obstacle.mesh is not None:
        points, triangles = surfaces[name]
        edges, deformation = unique_edges(triangles), None
        if obstacle.mesh.frames is not None:
            deformation = surface_motion(obstacle).positions
        return Solid(name, points, edges, triangles, 0.0, friction, rigid_motion, deformation)
    axis, radius = axis_and_radius(obstacle)
    if obstacle.inside:
        return Container(name, "ball", axis, np.empty((0, 3)), radius, friction, rigid_motion)
    edges = np.array([[0, 1]] * (len(axis) - 1), dtype=np.int64).reshape(-1, 2)
    return Solid(name, axis, edges, np.empty((0, 3), dtype=np.int64), radius, friction, rigid_motion)


def surface_motion(obstacle: Obstacle) -> FrameMotion:
    """The motion through frames of an obstacle that is a mesh.

    Raises
    ------
    InputError
        If its files cannot be read as frames.
    """
    from lyra_petsc.mesh.build import transformed  # with frames only
    from lyra_petsc.mesh.frame_files import open_frames
    from lyra_petsc.mesh.frame_motion import FrameMotion

    mesh = obstacle.mesh
    assert mesh is not None
    assert mesh.frames is not None
    frames, transform = open_frames(mesh.frames, mesh.fps), mesh.transform
    return FrameMotion(
        frames, obstacle.interpolation, repeat=mesh.repeat, chosen=lambda x: transformed(x, transform)[1]
    )


def axis_and_radius(obstacle: Obstacle) -> tuple[Array, float]:
    """Centre (1, 3) of a sphere, or ends of the axis (2, 3) of a capsule, and the radius, all [m]."""
    if obstacle.sphere is not None:
        return np.array([obstacle.sphere.center]), obstacle.sphere.radius
    assert obstacle.capsule is not None
    return np.array([obstacle.capsule.start, obstacle.capsule.to]), obstacle.capsule.radius


def box_corners(box: Cuboid) -> Array:
    """Corners (8, 3) [m], numbered as in `BOX_TRIANGLES`."""
    low, high = np.array(box.min), np.array(box.max)
    return np.where(_CORNERS > 0.5, high, low)
