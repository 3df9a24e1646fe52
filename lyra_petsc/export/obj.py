"""Wavefront OBJ: a file for each state, for Houdini, Blender, Cinema 4D and most others.

Positions are those of the states to the last bit, vertices and triangles in the order of the mesh file.
Written here, as the libraries at hand write neither all digits nor texture coordinates with seams.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lyra_petsc.export.frames import Frames


def write(frames: Frames, folder: Path, name: str) -> None:
    """Write ``<name>_0000.obj``, …; texture coordinates where the mesh came with them."""
    texture, faces = _texture_and_faces(frames)
    for number, (time, position) in enumerate(zip(frames.times, frames.positions, strict=True)):
        points = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in position.tolist())
        text = f"# state {frames.chosen[number]}, t = {time!r} s; m\n{points}{texture}{faces}"
        (folder / f"{name}_{number:04d}.obj").write_text(text, encoding="utf-8")


def _texture_and_faces(frames: Frames) -> tuple[str, str]:
    """The ``vt`` lines and the ``f`` lines, which all states share; numbers count from 1."""
    run = frames.run
    corners = run.triangles + 1
    if run.corner_uv is None:
        return "", "".join(f"f {a} {b} {c}\n" for a, b, c in corners.tolist())
    if run.uv is not None:
        uv, places = run.uv, corners
    else:
        uv, found = np.unique(run.corner_uv.reshape(-1, 2), axis=0, return_inverse=True)
        places = found.reshape(-1, 3) + 1
    texture = "".join(f"vt {u!r} {v!r}\n" for u, v in uv.tolist())
    rows = np.stack([corners, places], axis=2).reshape(-1, 6).tolist()
    return texture, "".join(f"f {a}/{p} {b}/{q} {c}/{r}\n" for a, p, b, q, c, r in rows)
