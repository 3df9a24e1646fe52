"""The obstacles of a run's scene, with the meshes that its folder holds."""

from __future__ import annotations

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.obstacles import Container, Solid, made
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.output.xdmf import MESH_FILE
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
    return made(run.scene, stored, Motion)
