"""Meshes of a scene's sources."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lyra_petsc.mesh.build import build_mesh
from lyra_petsc.mesh.measures import rest_matrices
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.scene.schema import Grid, MeshSource, Rotation, Transform

__all__ = ["MeshSource", "Transform", "grid", "grid_mesh", "mesh_of", "obj_mesh", "rest_areas", "turn"]


def grid(**options: Any) -> Grid:
    return Grid(**{"width": 1.0, "height": 1.0, "nx": 2, "ny": 2, **options})


def turn(axis: tuple[float, float, float], degrees: float) -> Rotation:
    return Rotation(axis=axis, degrees=degrees)


def mesh_of(file: Path, **options: Any) -> Mesh:
    return build_mesh([MeshSource(file=file, **options)])


def grid_mesh(transform: Transform | None = None, **options: Any) -> Mesh:
    return build_mesh([MeshSource(grid=grid(**options), transform=transform or Transform())])


def obj_mesh(folder: Path, text: str, transform: Transform | None = None) -> Mesh:
    file = folder / "mesh.obj"
    file.write_text(text)
    return mesh_of(file, transform=transform or Transform())


def rest_areas(mesh: Mesh) -> np.ndarray:
    return rest_matrices(mesh)[1]
