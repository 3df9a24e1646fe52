"""Scenes of the original Lyra program (conf.json) in our keys.

What differs from a scene of ours, and is kept as the original has it: Δt = frame_time/frame_steps
with one linearised step each (``semi-implicit``); handles are springs of 1000 N/m; measured
cloths lose a negative c12; absent gravity is none. ``end_time`` is honoured, which the original
does not do. ``texture`` is for its window only and has no counterpart.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from lyra_petsc.errors import InputError
from lyra_petsc.scene.messages import input_error
from lyra_petsc.scene.original_files import ObjLabels, find_beside, material_numbers
from lyra_petsc.scene.original_keys import (
    OriginalCloth,
    OriginalHandle,
    OriginalKeyframe,
    OriginalMaterial,
    OriginalScene,
)
from lyra_petsc.scene.values import shown

HANDLE_STIFFNESS = 1000.0  # N/m


def import_original(data: Any, path: Path) -> dict[str, Any]:
    """A conf.json, parsed, as plain values in our keys.

    Parameters
    ----------
    data : parsed JSON
    path : Path
        The file: its meshes and materials are looked for beside it, beside its folder and in the
        working directory, the last two because the original is run from above ``conf/``.

    Raises
    ------
    InputError
        Unknown keys, values out of range, files that do not exist.
    """
    try:
        scene = OriginalScene.model_validate(data)
    except ValidationError as error:
        raise input_error(error, data, file=path) from None
    labels = ObjLabels([_mesh_file(cloth, i, path) for i, cloth in enumerate(scene.cloths)])
    several = len(scene.cloths) > 1
    ours: dict[str, Any] = {
        "title": path.stem,
        "mesh": [],
        "material": [],
        "time": {"step": scene.frame_time / scene.frame_steps, "integrator": "semi-implicit"},
        "output": {"every": scene.frame_time},
    }
    ends = [scene.end_time, scene.end_frame and scene.end_frame * scene.frame_time]
    if any(ends):
        ours["time"]["end"] = min(end for end in ends if end)
    if scene.gravity is not None and any(scene.gravity):
        ours["gravity"] = list(scene.gravity)
    if scene.wind.density > 0 or scene.wind.drag > 0:
        ours["wind"] = {**scene.wind.model_dump(), "velocity": list(scene.wind.velocity)}
    for i, cloth in enumerate(scene.cloths):
        if cloth.transform.scale != 1.0 and labels.has_texture_coordinates(i):
            raise InputError(
                "scales the material coordinates (vt) as well, which is not there yet; scale the mesh file",
                file=path,
                key=f"cloths[{i}].transform.scale",
            )
        name = {"name": f"cloth{i}"} if several else {}
        group = {"group": f"cloth{i}"} if several else {}
        ours["mesh"].append(
            {"file": str(labels.files[i]), "transform": cloth.transform.in_our_keys(), **name}
        )
        ours["material"].append({**_material(cloth.materials[0], i, path), **group})
    ours["motions"] = {
        f"motion{i}": [_keyframe(keyframe) for keyframe in keyframes]
        for i, keyframes in enumerate(scene.motions)
    }
    ours["handles"] = [_handle(handle, i, labels, path) for i, handle in enumerate(scene.handles)]
    return ours


def _mesh_file(cloth: OriginalCloth, i: int, path: Path) -> Path:
    key = f"cloths[{i}].mesh"
    if not cloth.mesh.lower().endswith(".obj"):
        raise InputError(f"must be an .obj file, not {shown(cloth.mesh)}", file=path, key=key)
    found = find_beside(cloth.mesh, path)
    if found is None:
        raise InputError(f"no such file: {cloth.mesh}", file=path, key=key)
    return found


def _material(material: OriginalMaterial, i: int, path: Path) -> dict[str, Any]:
    return {
        **material_numbers(material.data, path, key=f"cloths[{i}].materials[0].data"),
        "density_scale": material.density_mult,
        "stretching_scale": material.stretching_mult,
        "bending_scale": material.bending_mult,
        "thicken": material.thicken,
        "damping": material.damping,
    }


def _keyframe(keyframe: OriginalKeyframe) -> dict[str, Any]:
    block = {"time": keyframe.time, **keyframe.transform.in_our_keys()}
    if keyframe.velocity is not None:
        block["velocity"] = list(keyframe.velocity.translate)
    return block


def _handle(handle: OriginalHandle, i: int, labels: ObjLabels, path: Path) -> dict[str, Any]:
    key = f"handles[{i}]"
    if handle.label != -1:
        nodes = labels.labelled(handle.cloth, handle.label)
        if not nodes:
            raise InputError(f"no vertex has label {handle.label}", file=path, key=f"{key}.label")
    else:
        offset = labels.first_vertex(handle.cloth)
        nodes = [offset + node for node in handle.nodes]
    block: dict[str, Any] = {
        "nodes": nodes,
        "from": handle.start_time,
        "until": handle.end_time,
        "fade": handle.fade_time,
        "stiffness": HANDLE_STIFFNESS,
    }
    if handle.motion is not None:
        block["motion"] = f"motion{handle.motion}"
    return block
