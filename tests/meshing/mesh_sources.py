"""Plain stand-ins for a scene's mesh sources and selectors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lyra_petsc.meshing.build import build_mesh
from lyra_petsc.meshing.mesh import Mesh


@dataclass
class Rotation:
    axis: Sequence[float]
    degrees: float


@dataclass
class Transform:
    scale: float | Sequence[float] = 1.0
    rotate: Rotation | None = None
    translate: Sequence[float] = (0.0, 0.0, 0.0)


@dataclass
class Grid:
    width: float = 1.0
    height: float = 1.0
    nx: int = 2
    ny: int = 2
    pattern: str = "diagonal"


@dataclass
class Source:
    file: Path | None = None
    grid: Grid | None = None
    size: float | None = None
    transform: Transform | None = None
    name: str | None = None


@dataclass
class Selector:
    group: str | None = None
    nodes: Sequence[int] | None = None
    box: Sequence[Sequence[float]] | None = None


def mesh_of(file: Path, **options: object) -> Mesh:
    return build_mesh([Source(file=file, **options)])  # type: ignore[arg-type]


def grid_mesh(transform: Transform | None = None, **options: object) -> Mesh:
    return build_mesh([Source(grid=Grid(**options), transform=transform)])  # type: ignore[arg-type]


def obj_mesh(folder: Path, text: str, transform: Transform | None = None) -> Mesh:
    file = folder / "mesh.obj"
    file.write_text(text)
    return mesh_of(file, transform=transform)
