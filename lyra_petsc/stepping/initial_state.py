"""The state at t = 0 beside the start positions: noise and velocities (rank 0, whole mesh)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.scene.schema import Initial

Array = NDArray[np.float64]


def start_positions(initial: Initial, mesh: Mesh, held: dict[int, NDArray[np.int64]]) -> dict[str, Array]:
    """``start`` (V, 3) [m]: displaced along the vertex normals by normal noise, but for held vertices.

    Empty without noise.
    """
    if initial.noise == 0.0:
        return {}
    corners = mesh.positions[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    summed: Array = np.stack(
        [np.bincount(mesh.triangles.ravel(), np.repeat(normals[:, i], 3), mesh.n_vertices) for i in range(3)],
        axis=1,
    )
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    summed /= np.where(length > 0.0, length, 1.0)
    amount = initial.noise * np.random.default_rng(initial.seed).standard_normal(mesh.n_vertices)
    for vertices in held.values():
        amount[vertices] = 0.0
    return {"start": mesh.positions + amount[:, None] * summed}


def start_velocities(initial: Initial, mesh: Mesh, mass: Array) -> dict[str, Array]:
    """``velocity`` (V, 3) [m/s]: uniform, plus a rotation about the centre of mass; empty if zero."""
    if not any(initial.velocity) and not any(initial.angular_velocity):
        return {}
    centre = mass @ mesh.positions / mass.sum()
    spin = np.cross(np.asarray(initial.angular_velocity), mesh.positions - centre)
    return {"velocity": np.asarray(initial.velocity) + spin}
