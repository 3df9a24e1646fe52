"""Text of a starter scene, with a grid or a given mesh file."""

from __future__ import annotations

import json
import os
import shlex
from importlib.resources import files
from pathlib import Path
from string import Template

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.build import build_mesh
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.mesh.select import DIMENSION_NAMES
from lyra_petsc.scene.json_schema import schema_file
from lyra_petsc.scene.materials.library import material_names
from lyra_petsc.scene.messages import validated
from lyra_petsc.scene.schema import FIELDS, MeshSource

_GRID = """\
mesh:
  grid: {width: 1.0, height: 1.0, nx: 30, ny: 30}   # m, cells; in the xy plane, one corner at the origin
  # file: sheet.geo             # instead: a gmsh script (.geo), a .msh or an .obj, beside this file
  # transform: {rotate: {axis: [1, 0, 0], degrees: 90}, translate: [0, 0, 1]}"""

_GRID_HANDLE = """\
  - box: [[0, 1, 0], [1, 1, 0]] # the vertices in it: the edge y = 1. Or nodes: [0, 1], or group: NAME
    # motion: swing"""


def starter(scene: Path, commands: tuple[str, str], file: Path | None, *, trust_mesh: bool) -> str:
    """Text of a commented scene that can be run without changes.

    Parameters
    ----------
    scene : Path
        Path of the scene; the mesh file is named relative to it.
    commands : pair of str
        Commands that start the program on one rank and on two.
    file : Path or None
        A mesh file; None for a grid.
    trust_mesh : bool
        Let the script read any file, and run where there is no seccomp.

    Raises
    ------
    InputError
        If the mesh cannot be used.
    """
    schema = schema_file()
    mesh = None
    if file is not None:
        source = validated(MeshSource, {"file": str(file)}, file=file)
        mesh = build_mesh([source], trust_scripts=trust_mesh)
    text = files("lyra_petsc.cli").joinpath("starter.yaml").read_text(encoding="utf-8")
    return Template(text).substitute(
        schema=schema.as_uri() if " " in str(schema) and schema.is_absolute() else schema,
        one=commands[0],
        two=commands[1],
        file=shlex.quote(scene.name),
        title=_quoted(scene.stem),
        mesh=_GRID if file is None or mesh is None else _mesh(file, mesh, scene),
        handle=_GRID_HANDLE if mesh is None else _handle(mesh),
        cloths=", ".join(material_names()[:4]),
        fields=", ".join(name for name in FIELDS if name != "velocity"),
    )


def _mesh(file: Path, mesh: Mesh, scene: Path) -> str:
    name = os.path.relpath(file.absolute(), scene.absolute().parent)
    if name.startswith(os.path.join("..", "..")):  # so far apart that they will hardly be moved together
        name = str(file.absolute())
    low, high = _corner(mesh.positions.min(axis=0)), _corner(mesh.positions.max(axis=0))
    lines = [
        "mesh:",
        f"  file: {_quoted(name)}",
        "  # size: 0.02                # m, instead of the element sizes in a .geo",
        "  # transform: {scale: 0.001}   # for a mesh in millimetres; also: rotate, translate",
        f"  # {mesh.n_vertices} vertices, {mesh.n_triangles} triangles, from {low} to {high}",
        "  # groups, for handles, loads and probes, and those of surfaces for materials"
        + (":" if mesh.groups else ": none (gmsh: Physical Curve, Physical Surface; .obj: g NAME)"),
    ]
    lines += [
        f"  #   {_quoted(name)}  {DIMENSION_NAMES[group.dimension]}, vertices: {len(group.vertices)}"
        for name, group in mesh.groups.items()
    ]
    return "\n".join(lines)


def _handle(mesh: Mesh) -> str:
    held = ""
    for name, group in mesh.groups.items():
        if not held and group.dimension < 2 and len(group.vertices) < mesh.n_vertices:
            held = f"  - group: {_quoted(name)}"
    if not held:  # a box at the upper end of the sheet, along z or the longest axis of a flat sheet
        low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
        extent = high - low
        axis = 2 if extent[2] > 0.01 * extent.max() else int(extent.argmax())
        low[axis] = high[axis] - 0.01 * extent[axis]
        held = f"  - box: [{_corner(low)}, {_corner(high)}]   # the vertices at the end of {'xyz'[axis]}"
    return f"{held}\n    # motion: swing"


def _corner(point: Array) -> str:
    return "[" + ", ".join(f"{x:.12g}" for x in point) + "]"


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)
