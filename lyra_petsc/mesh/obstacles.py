"""Obstacles of a scene: bodies that sheets stay out of and containers that they stay in, at any time."""

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


# corner i + 2 j + 4 k of a box stands at its upper end in x, y, z where i, j, k are 1
_CORNERS = np.array([[i, j, k] for k in (0, 1) for j in (0, 1) for i in (0, 1)], dtype=np.float64)
_SIDES = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
BOX_TRIANGLES: Ints = _SIDES[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3).astype(np.int64)
"""(12, 3) of the corners of `box_corners`, anticlockwise seen from outside."""
_BOX_EDGES = np.array([[i, i + s] for s in (1, 2, 4) for i in range(8) if not i & s], dtype=np.int64)


RigidMotion: TypeAlias = Callable[[float], tuple[Array, Array]]
"""Rotation (3, 3) and translation (3,) [m] at a time [s]."""

MakesMotion: TypeAlias = Callable[..., Any]
"""`terms.motion.Motion`, which this package does not know."""


class _Carried:
    """A body that a rigid motion T moves from its place at t = 0: by T(t) T(0)⁻¹."""

    points: Array
    motion: RigidMotion | None

    def displacement(self, time: float) -> tuple[Array, Array]:
        """Rotation (3, 3) and translation (3,) [m] that lead from t = 0 to a time [s]."""
        if self.motion is None or time == 0.0:  # where rounding would move it
            return np.eye(3), np.zeros(3)
        (start, from_), (turn, to) = self.motion(0.0), self.motion(time)
        rotation = turn @ start.T
        return rotation, to - rotation @ from_

    def positions(self, time: float) -> Array:
        """Its points (n, 3) [m] at a time [s]; of what stands still ``points`` itself."""
        if self.motion is None:
            return self.points
        rotation, translation = self.displacement(time)
        return self.points @ rotation.T + translation


@dataclass(frozen=True, eq=False)
class Solid(_Carried):
    """An obstacle that sheets stay out of.

    Attributes
    ----------
    name : str
    points : (n, 3) float64
        At t = 0 [m].
    edges : (m, 2) int64
        Each once; of a box without the diagonals of its sides.
    triangles : (k, 3) int64
        Of a box anticlockwise seen from outside, of a mesh as in its file.
    radius : float
        Distance [m] from points, edges and triangles at which its surface is: of a sphere (one point) and a
        capsule (two points, one edge), else 0.
    friction : (float, float)
        Static and kinetic coefficient.
    motion : RigidMotion or None
        None: it stands still.
    """

    name: str
    points: Array
    edges: Ints
    triangles: Ints
    radius: float
    friction: tuple[float, float]
    motion: RigidMotion | None = None


@dataclass(frozen=True, eq=False)
class Container(_Carried):
    """An obstacle that all vertices are to stay on one side of, which is convex.

    Attributes
    ----------
    name : str
    kind : str
        ``planes``: on the side to which the normals of all planes point; ``ball``: at most ``radius`` from
        the segment between the first and the last point (of a sphere there is only one).
    points : (n, 3) float64
        At t = 0 [m]: one on each plane, or the ends of the segment.
    normals : (n, 3) float64
        At t = 0, unit vectors; (0, 3) of a ball.
    radius : float
        Of a ball [m], else 0.
    friction : (float, float)
        Static and kinetic coefficient.
    motion : RigidMotion or None
        None: it stands still.
    """

    name: str
    kind: Literal["planes", "ball"]
    points: Array
    normals: Array
    radius: float
    friction: tuple[float, float]
    motion: RigidMotion | None = None

    def normals_at(self, time: float) -> Array:
        """Its normals (n, 3) at a time [s]; of what stands still ``normals`` itself."""
        if self.motion is None:
            return self.normals
        return self.normals @ self.displacement(time)[0].T


def obstacles_of(
    comm: MPI.Comm, scene: Scene, mesh: Mesh | None, motion: MakesMotion
) -> list[Solid | Container]:
    """The obstacles of a scene in its order, the same on all ranks; collective.

    Parameters
    ----------
    comm : MPI.Comm
    scene : Scene
    mesh : Mesh or None
        Of `build.build_scene_mesh`; needed on rank 0 only, and there only for obstacles that are meshes.
    motion : callable
        `terms.motion.Motion`.

    Raises
    ------
    InputError
        For motions that cannot be, on all ranks alike.
    """
    surfaces: Mapping[str, TriangleSurface] = {}
    if any(obstacle.mesh is not None for obstacle in (scene.obstacles or {}).values()):
        surfaces = on_root(comm, lambda: mesh.obstacles if mesh is not None else {})
    return made(scene, surfaces, motion)


def made(
    scene: Scene, surfaces: Mapping[str, TriangleSurface], motion: MakesMotion
) -> list[Solid | Container]:
    """The obstacles of a scene in its order.

    Parameters
    ----------
    scene : Scene
    surfaces : mapping of str to TriangleSurface
        Those that are meshes, at t = 0.
    motion : callable
        `terms.motion.Motion`.
    """
    return [_made(scene, name, surfaces, motion) for name in scene.obstacles or {}]


def _made(
    scene: Scene, name: str, surfaces: Mapping[str, TriangleSurface], motion: MakesMotion
) -> Solid | Container:
    assert scene.obstacles is not None
    assert scene.contact is not None
    obstacle = scene.obstacles[name]
    friction = coefficients(scene.contact.friction if obstacle.friction is None else obstacle.friction)
    carried: RigidMotion | None = None
    if keyframes := scene.keyframes(obstacle):
        named = (
            f"motions.{obstacle.motion}" if isinstance(obstacle.motion, str) else f"obstacles.{name}.motion"
        )
        carried = motion(keyframes, obstacle.interpolation, key=named, file=scene.source).transform
    if obstacle.plane is not None:
        normal = np.array(obstacle.plane.normal)
        normal /= np.abs(normal).max()  # squares of what is very large or small are no numbers
        normal /= np.linalg.norm(normal)
        point = np.array([obstacle.plane.point])
        return Container(name, "planes", point, normal[None], 0.0, friction, carried)
    if obstacle.box is not None and obstacle.inside:
        low, high = np.array(obstacle.box.min), np.array(obstacle.box.max)
        points, normals = np.array([low] * 3 + [high] * 3), np.concatenate([np.eye(3), -np.eye(3)])
        return Container(name, "planes", points, normals, 0.0, friction, carried)
    if obstacle.box is not None:
        corners = box_corners(obstacle.box)
        return Solid(name, corners, _BOX_EDGES.copy(), BOX_TRIANGLES.copy(), 0.0, friction, carried)
    if obstacle.mesh is not None:
        points, triangles = surfaces[name]
        return Solid(name, points, unique_edges(triangles), triangles, 0.0, friction, carried)
    axis, radius = axis_of(obstacle)
    if obstacle.inside:
        return Container(name, "ball", axis, np.empty((0, 3)), radius, friction, carried)
    edges = np.array([[0, 1]] * (len(axis) - 1), dtype=np.int64).reshape(-1, 2)
    return Solid(name, axis, edges, np.empty((0, 3), dtype=np.int64), radius, friction, carried)


def axis_of(obstacle: Obstacle) -> tuple[Array, float]:
    """Of a sphere its centre (1, 3), of a capsule the ends of its axis (2, 3), and the radius, all [m]."""
    if obstacle.sphere is not None:
        return np.array([obstacle.sphere.center]), obstacle.sphere.radius
    assert obstacle.capsule is not None
    return np.array([obstacle.capsule.start, obstacle.capsule.to]), obstacle.capsule.radius


def box_corners(box: Cuboid) -> Array:
    """(8, 3) corners [m], numbered as in `BOX_TRIANGLES`."""
    low, high = np.array(box.min), np.array(box.max)
    return np.where(_CORNERS > 0.5, high, low)
