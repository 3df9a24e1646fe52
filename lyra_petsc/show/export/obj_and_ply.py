"""Formats with a file for each state: Wavefront OBJ and Stanford PLY.

Positions are exactly those of the states; vertices and triangles are in the order of the mesh file. OBJ is
written here, as meshio writes neither all digits nor texture coordinates with seams.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.show.export.exported_states import ExportedStates


def write_obj(states: ExportedStates, folder: Path, name: str) -> None:
    """Write ``<name>_0000.obj``, …; texture coordinates where the mesh came with them.

    Where there are obstacles, they and the cloth are objects (``o``), the cloth first.
    """
    texture, faces = _texture_and_faces(states)
    moving = {label: states.places(obstacle) for label, obstacle in states.obstacles.items()}
    for number, (time, position) in enumerate(zip(states.times, states.positions, strict=True)):
        text = [f"# state {states.chosen[number]}, t = {time!r} s; m\n", "o cloth\n" if moving else ""]
        text += [_points(position), texture, faces]
        before = len(position)
        for label, places in moving.items():
            x = next(places)
            text += [f"o {label}\n", _points(x), _faces(states.obstacles[label].triangles + before + 1)]
            before += len(x)
        (folder / f"{name}_{number:04d}.obj").write_text("".join(text), encoding="utf-8")


def _points(x: NDArray[np.float64]) -> str:
    return "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in x.tolist())


def _faces(corners: NDArray[np.int64]) -> str:
    return "".join(f"f {a} {b} {c}\n" for a, b, c in corners.tolist())


def _texture_and_faces(states: ExportedStates) -> tuple[str, str]:
    """The ``vt`` lines and the ``f`` lines, which all states share; numbers count from 1."""
    run = states.run
    corners = run.triangles + 1
    if run.corner_uv is None:
        return "", _faces(corners)
    if run.uv is not None:
        uv, places = run.uv, corners
    else:
        uv, found = np.unique(run.corner_uv.reshape(-1, 2), axis=0, return_inverse=True)
        places = found.reshape(-1, 3) + 1
    texture = "".join(f"vt {u!r} {v!r}\n" for u, v in uv.tolist())
    rows = np.stack([corners, places], axis=2).reshape(-1, 6).tolist()
    return texture, "".join(f"f {a}/{p} {b}/{q} {c}/{r}\n" for a, p, b, q, c, r in rows)


def write_ply(states: ExportedStates, folder: Path, name: str) -> None:
    """Write ``<name>_0000.ply``, …: binary, double precision, with the fields on vertices.

    Texture coordinates are ``s`` and ``t``; a texture with seams is left out. Obstacles have files of their
    own, ``<name>-<obstacle>_0000.ply``, ….
    """
    import meshio

    run = states.run
    fields = {field: states.field(field) for field in states.fields if states.field_on(field) == "vertex"}
    texture = {} if run.uv is None else {"s": run.uv[:, 0], "t": run.uv[:, 1]}
    triangles = run.triangles.astype(np.int32)
    for number, position in enumerate(states.positions):
        data = dict(texture)
        for field, values in fields.items():
            rows = next(values)
            if rows.ndim == 1:
                data[field] = rows
            else:
                data |= {f"{field}_{axis}": rows[:, i] for i, axis in enumerate("xyz")}
        mesh = meshio.Mesh(position, [("triangle", triangles)], point_data=data)
        meshio.write(folder / f"{name}_{number:04d}.ply", mesh, binary=True)
    for label, obstacle in states.obstacles.items():
        cells = [("triangle", obstacle.triangles.astype(np.int32))]
        for number, x in enumerate(states.places(obstacle)):
            meshio.write(folder / f"{name}-{label}_{number:04d}.ply", meshio.Mesh(x, cells), binary=True)
