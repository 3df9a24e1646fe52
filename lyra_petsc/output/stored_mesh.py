"""mesh.h5 read back, without MPI."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.mesh import Group, TriangleSurface
from lyra_petsc.output.stored import open_stored, read_stored, text_of
from lyra_petsc.output.xdmf import MESH_FILE


class StoredMesh:
    """The mesh of a run's folder; an array is read when it is first asked for, and checked.

    Parameters
    ----------
    folder : path
        The run's folder.

    Raises
    ------
    InputError
        By each attribute, if ``mesh.h5`` is missing or damaged.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / MESH_FILE

    @cached_property
    def rest(self) -> Array:
        """(V, 3) rest shape [m]."""
        return read_stored(self.path, "mesh/rest", (None, 3), "f")

    @cached_property
    def triangles(self) -> Ints:
        """(F, 3) vertices of each triangle."""
        return self._numbers("mesh/triangles", (None, 3), len(self.rest))

    @cached_property
    def start(self) -> Array | None:
        """(V, 3) start positions [m]; None where an older version wrote none."""
        with open_stored(self.path) as file:
            if "start" not in file:
                return None
        return read_stored(self.path, "start", (len(self.rest), 3), "f")

    @cached_property
    def uv(self) -> Array | None:
        """(V, 2) material coordinates [m]; None where a vertex has more than one."""
        with open_stored(self.path) as file:
            there = "uv" in file["mesh"]
        return read_stored(self.path, "mesh/uv", (len(self.rest), 2), "f") if there else None

    @cached_property
    def corner_uv(self) -> Array:
        """(F, 3, 2) material coordinates [m] of the triangles' corners."""
        if self.uv is not None:
            return np.asarray(self.uv[self.triangles])
        return read_stored(self.path, "mesh/corner_uv", (len(self.triangles), 3, 2), "f")

    @cached_property
    def textured(self) -> bool:
        """Whether the material coordinates came with the mesh, as texture coordinates."""
        with open_stored(self.path) as file:
            return bool(file["mesh"].attrs.get("vt", 0))

    @property
    def groups(self) -> dict[str, Group]:
        """The groups by their names; their dimension is not stored."""
        with open_stored(self.path) as file:
            stored = file.get("groups", {})
            names = {number: text_of(group, "name") for number, group in stored.items()}
            filled = {f"groups/{number}/{part}" for number, group in stored.items() for part in group}

        def part(place: str, width: tuple[int, ...], end: int) -> Ints:
            if place not in filled:
                return np.empty((0, *width), np.int64)
            return self._numbers(place, (None, *width), end)

        n = len(self.rest)
        return {
            name: Group(
                0,
                part(f"groups/{number}/vertices", (), n),
                part(f"groups/{number}/triangles", (), len(self.triangles)),
                part(f"groups/{number}/edges", (2,), n),
            )
            for number, name in names.items()
        }

    @property
    def obstacles(self) -> dict[str, TriangleSurface]:
        """The obstacles that are meshes, at t = 0, by their names."""
        with open_stored(self.path) as file:
            names = {number: text_of(group, "name") for number, group in file.get("obstacles", {}).items()}
        found = {}
        for number, name in names.items():
            points = read_stored(self.path, f"obstacles/{number}/points", (None, 3), "f")
            triangles = self._numbers(f"obstacles/{number}/triangles", (None, 3), len(points))
            found[name] = TriangleSurface(points, triangles)
        return found

    def _numbers(self, dataset: str, shape: tuple[int | None, ...], end: int) -> Ints:
        """Whole numbers from 0 to before ``end``."""
        found = read_stored(self.path, dataset, shape, "iu")
        if found.size and (found.min() < 0 or found.max() >= end):
            raise InputError(f"is damaged: {dataset} holds numbers beyond 0 … {end - 1}", file=self.path)
        return found
