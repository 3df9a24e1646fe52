"""Paths of frames, positions of vertices at given times, as scene files name them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, ValidationInfo, WithJsonSchema

from lyra_petsc.scene.values import path_beside, problem, require, shown

FRAME_SUFFIXES = (".npz", ".usd", ".usda", ".usdc", ".usdz", ".obj")


def _frames(value: Any, info: ValidationInfo) -> Path | tuple[Path, ...]:
    """Absolute paths; a pattern keeps its ``*``."""
    many = isinstance(value, (list, tuple))
    require(not many or value, "must name at least one .obj file")
    paths = []
    for one in value if many else [value]:
        if not isinstance(one, (str, Path)) or not str(one).strip() or "\0" in str(one):
            raise problem(f"must be the path of a file of frames, not {shown(one)}")
        name = Path(one).name
        endings = (".obj",) if many else FRAME_SUFFIXES
        require(Path(one).suffix.lower() in endings, f"{name!r} must end in {', '.join(endings)}")
        sequence = Path(one).suffix.lower() == ".obj" and not many
        if sequence and name.count("*") != 1:
            raise problem(f"{name!r} must have one * for the number of each frame, as in body_*.obj")
        paths.append(path_beside(one, info))
    return tuple(paths) if many else paths[0]


FramesPath = Annotated[
    Path | tuple[Path, ...],
    BeforeValidator(_frames),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "string", "format": "path"},
                {"type": "array", "items": {"type": "string", "format": "path"}, "minItems": 1},
            ]
        }
    ),
]
