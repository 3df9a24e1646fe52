"""Stanford PLY: a binary file for each state, with the fields on vertices."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lyra_petsc.export.frames import Frames


def write(frames: Frames, folder: Path, name: str) -> None:
    """Write ``<name>_0000.ply``, …: double precision; ``s`` and ``t`` if the texture has no seams."""
    import meshio

    run = frames.run
    fields = {field: frames.field(field) for field in run.fields if frames.on_vertices(field)}
    texture = {} if run.uv is None else {"s": run.uv[:, 0], "t": run.uv[:, 1]}
    triangles = run.triangles.astype(np.int32)
    for number, position in enumerate(frames.positions):
        data = dict(texture)
        for field, values in fields.items():
            rows = next(values)
            if rows.ndim == 1:
                data[field] = rows
            else:
                data |= {f"{field}_{axis}": rows[:, i] for i, axis in enumerate("xyz")}
        mesh = meshio.Mesh(position, [("triangle", triangles)], point_data=data)
        meshio.write(folder / f"{name}_{number:04d}.ply", mesh, binary=True)
