"""The verb ``new``: writes a commented starter scene."""

from __future__ import annotations

import os
import shlex
import shutil
from pathlib import Path
from typing import Any

import click

from lyra_petsc.cli.options import Session, trust_mesh, verb
from lyra_petsc.errors import InputError


@verb("lyra-petsc new pennant --mesh pennant.geo", start=Session.without_petsc)
@click.argument("name")
@click.option(
    "--mesh",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Your own mesh file; its groups are listed.",
)
@trust_mesh
def new(comm: Any, name: str, mesh: Path | None, trust_mesh: bool) -> None:
    """Write the starter scene NAME.yaml."""
    from lyra_petsc.parallel import on_root

    path = on_root(comm, lambda: write_starter(name, mesh, trust_mesh=trust_mesh))
    if comm.rank == 0:
        name, (one, several) = shlex.quote(str(path)), start_commands()
        click.echo(f"{path} written; next: {one} check {name}, then: {several} run {name}")


def start_commands() -> tuple[str, str]:
    """Commands that start the program on one and on two ranks; in a checkout a script that chooses itself."""
    script = Path(__file__).resolve().parents[2] / "scripts" / "lyra.sh"
    if shutil.which("lyra-petsc") is None and script.is_file():
        command = f"bash {shlex.quote(os.path.relpath(script))}"
        return command, command
    return "lyra-petsc", "mpirun -n 2 lyra-petsc"


def write_starter(name: str, mesh: Path | None, *, trust_mesh: bool) -> Path:
    """Write a starter scene; returns the file's path.

    Raises
    ------
    InputError
        If the file exists or cannot be written, or the mesh cannot be used.
    """
    from lyra_petsc.cli.starter import starter
    from lyra_petsc.output.file_operations import open_output

    path = Path(name)
    if not path.name or not name.isprintable():
        raise InputError("must be a name for the scene's file", key="NAME")
    if path.suffix.lower() not in (".yaml", ".yml"):
        path = path.with_name(f"{path.name}.yaml")
    if os.path.lexists(path):  # before the mesh is read, which may take long
        raise InputError("exists and is left as it is; choose another name", file=path)
    text = starter(path, start_commands(), mesh, trust_mesh=trust_mesh)
    try:
        # exclusive creation: of two processes at the same time only one succeeds
        with open_output(path, "xb") as file:
            file.write(text.encode())
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", file=path) from None
    return path
