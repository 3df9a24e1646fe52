"""``new``: write a commented starter scene."""

from __future__ import annotations

import os
import shlex
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lyra_petsc.cli.options import trust_mesh, verb
from lyra_petsc.errors import InputError

if TYPE_CHECKING:
    from lyra_petsc.scene.starter import OwnMesh


@verb("lyra-petsc new pennant --mesh pennant.geo")
@click.argument("name")
@click.option(
    "--mesh",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="A .geo, .msh or .obj of yours; its groups are listed.",
)
@trust_mesh
def new(comm: Any, name: str, mesh: Path | None, trust_mesh: bool) -> None:
    """Write the starter scene NAME.yaml."""
    from lyra_petsc.parallel import on_root

    path = on_root(comm, lambda: write_starter(name, mesh, trust_mesh=trust_mesh))
    if comm.rank == 0:
        word, (one, several) = shlex.quote(str(path)), ways_to_start()
        click.echo(f"{path} written; next: {one} check {word}, then: {several} run {word}")


def ways_to_start() -> tuple[str, str]:
    """Commands that start the program on one and on two ranks; the script of a checkout chooses by itself."""
    script = Path(__file__).resolve().parents[2] / "scripts" / "lyra.sh"
    if shutil.which("lyra-petsc") is None and script.is_file():
        command = f"bash {shlex.quote(os.path.relpath(script))}"
        return command, command
    return "lyra-petsc", "mpirun -n 2 lyra-petsc"


def write_starter(name: str, mesh: Path | None, *, trust_mesh: bool = False) -> Path:
    """Write it; the file's path.

    Raises
    ------
    InputError
        If there is such a file already, it cannot be written, or the mesh cannot be used.
    """
    from lyra_petsc.scene.starter import starter

    given = Path(name)
    if not given.name or not name.isprintable():
        raise InputError("must be a name for the scene's file", key="NAME")
    path = given if given.suffix.lower() in (".yaml", ".yml") else given.with_name(f"{given.name}.yaml")
    if os.path.lexists(path):  # before the mesh, which may take long
        raise InputError("exists and is left as it is; choose another name", file=path)
    text = starter(path, ways_to_start(), None if mesh is None else _own_mesh(mesh, trust_mesh))
    try:
        # two at the same time: only one makes the file
        with open(path, "x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", file=path) from None
    return path


def _own_mesh(file: Path, trust_mesh: bool) -> OwnMesh:
    from pydantic import ValidationError

    from lyra_petsc.mesh.build import build_mesh
    from lyra_petsc.mesh.select import DIMENSION_NAMES
    from lyra_petsc.scene.schema import MeshSource
    from lyra_petsc.scene.starter import OwnMesh

    try:
        source = MeshSource.model_validate({"file": str(file)})
    except ValidationError as error:
        raise InputError(error.errors()[0]["msg"], key="--mesh") from None
    if not file.is_file():
        raise InputError(f"no such file: {file}", key="--mesh")
    built = build_mesh([source], trust_scripts=trust_mesh)
    groups = {
        group: (DIMENSION_NAMES[found.dimension], len(found.vertices))
        for group, found in built.groups.items()
    }
    low, high = built.positions.min(axis=0), built.positions.max(axis=0)
    span = tuple(map(float, low)), tuple(map(float, high))
    return OwnMesh(file, built.n_vertices, built.n_triangles, groups, span)
