"""A scene with its mesh and masses, whole, on rank 0: what exact solutions check their assumptions on."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.mesh.build import mesh_of
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.registry import active
from lyra_petsc.terms.rest import RestShape

Array = NDArray[np.float64]

SAME = 1e-9
"""Relative difference up to which lengths and directions count as equal."""


class Body:
    """A scene's mesh, materials and masses.

    Parameters
    ----------
    scene : Scene
    mesh : Mesh, optional
        Built from the scene unless given.

    Raises
    ------
    InputError
        Whatever in the meshes cannot be simulated.
    """

    def __init__(self, scene: Scene, mesh: Mesh | None = None) -> None:
        self.scene = scene
        self.mesh = mesh_of(scene) if mesh is None else mesh
        self.rest = RestShape(scene, self.mesh)

    @cached_property
    def mass(self) -> float:
        """[kg]."""
        return float(self.rest.mass.sum())

    @property
    def gravity(self) -> Array:
        """(3,) [m/s²]; zero where the scene has none."""
        return np.asarray(self.scene.gravity or (0.0, 0.0, 0.0), dtype=np.float64)

    @property
    def start_velocity(self) -> Array:
        """(3,) [m/s] of the translation at t = 0."""
        initial = self.scene.initial
        return np.asarray((0.0, 0.0, 0.0) if initial is None else initial.velocity, dtype=np.float64)

    @cached_property
    def potential(self) -> float:
        """−Σ m g·x [J] at t = 0."""
        return -float(self.rest.mass @ (self.mesh.positions @ self.gravity))

    @cached_property
    def stretch(self) -> Array:
        """Start length over rest length of every triangle side, (F, 3)."""
        corners, flat = self.mesh.positions[self.mesh.triangles], self.mesh.triangle_uv
        start = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        rest = np.linalg.norm(flat - np.roll(flat, -1, axis=1), axis=2)
        return np.asarray(start / rest)

    @cached_property
    def normals(self) -> Array:
        """Unit normals (F, 3) of the start shape."""
        corners = self.mesh.positions[self.mesh.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))

    @property
    def is_bent(self) -> bool:
        """Whether some hinge starts away from its rest angle."""
        if not any(entry.name == "bending" for entry in active(self.scene, self.rest.shells)):
            return False
        from lyra_petsc.terms import bending

        found = bending.elements(self.rest)
        if len(found.stencil) == 0:
            return False
        angles = bending.dihedral_angles(self.mesh.positions, found.stencil)
        return bool(np.abs(angles - found.data["rest_angle"]).max() > 1e-7)

    # -- assumptions that solutions share ----------------------------------------------------------------

    def forced(self) -> list[str]:
        """What moves the sheet beside gravity, wind and its own velocity, in words."""
        scene, found = self.scene, []
        if scene.time.analysis == "static":
            found.append("a static analysis")
        if scene.handles:
            found.append("handles")
        if scene.loads:
            found.append("loads")
        if scene.initial is not None and scene.initial.noise > 0.0:
            found.append("initial.noise")
        if scene.initial is not None and any(scene.initial.angular_velocity):
            found.append("initial.angular_velocity")
        return found

    def strained(self) -> list[str]:
        """Why the start shape is not free of stress, in words."""
        found = []
        if np.abs(self.stretch - 1.0).max() > SAME:
            found.append("a start shape that is stretched")
        if self.is_bent:
            found.append("a start shape that is bent, or a rest curvature")
        return found

    @property
    def has_wind(self) -> bool:
        """Whether air acts on the sheet."""
        wind = self.scene.wind
        return wind is not None and (wind.density > 0.0 or wind.drag > 0.0)
