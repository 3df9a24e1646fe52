"""Noise and velocities of the state at t = 0, of the whole mesh on rank 0."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.scene.schema import MAX_SPEED, Initial, Scene

RESOLVED = 1e6
"""Smallest mean edge length over the round-off of the largest coordinate."""


def start_positions(initial: Initial, mesh: Mesh, held: dict[int, NDArray[np.int64]]) -> dict[str, Array]:
    """``start`` (V, 3) [m], positions displaced along vertex normals by Gaussian noise except at held
    vertices; empty without noise.
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


def start_velocities(
    initial: Initial, mesh: Mesh, mass: Array, *, file: object | None = None
) -> dict[str, Array]:
    """``velocity`` (V, 3) [m/s]: uniform, plus a rotation about the centre of mass; empty if zero.

    Raises
    ------
    InputError
        If a vertex is faster than `MAX_SPEED`.
    """
    if not any(initial.velocity) and not any(initial.angular_velocity):
        return {}
    centre = mass @ mesh.positions / mass.sum()
    with np.errstate(over="ignore", invalid="ignore"):
        spin = np.cross(np.asarray(initial.angular_velocity), mesh.positions - centre)
        velocity = np.asarray(initial.velocity) + spin
    fastest = float(np.abs(velocity).max())  # a norm might overflow
    if not fastest <= MAX_SPEED:
        key = "velocity" if np.abs(initial.velocity).max() > MAX_SPEED else "angular_velocity"
        raise InputError(
            f"lets vertices fly at {fastest:.3g} m/s; at most {MAX_SPEED:g} m/s",
            file=file,
            key=f"initial.{key}",
        )
    return {"velocity": velocity}


def check_resolved(spacing: float, largest: float, scene: Scene) -> None:
    """Refuse a mesh whose mean edge length ``spacing`` [m] is too near the round-off of its ``largest``
    coordinate [m].

    Raises
    ------
    InputError
    """
    smallest = RESOLVED * float(np.finfo(np.float64).eps) * largest
    if spacing < smallest:
        raise InputError(
            f"edges of {spacing:.3g} m in the mean are too short for coordinates of {largest:.3g} m, whose "
            f"round-off moves them; at least {smallest:.2g} m: move the sheet nearer to the origin",
            file=scene.source,
            key="mesh",
        )
