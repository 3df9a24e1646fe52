"""glTF 2.0: one binary file with the first state, a morph target for each further one, and an animation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.show.export.exported_states import ExportedStates, turned_up
from lyra_petsc.show.render.sheet_geometry import split_at_seams, vertex_normals

LARGEST = 2**32
"""Bytes of a file; the format counts them in 32 bits."""

CLOTH = {"baseColorFactor": [0.75, 0.72, 0.66, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
"""Look of the material, which is seen from both sides."""

VERTICES, INDICES, UNSIGNED_INT, FLOAT = 34962, 34963, 5125, 5126
"""Numbers of the format: targets ARRAY_BUFFER and ELEMENT_ARRAY_BUFFER, and component types."""


def write_gltf(states: ExportedStates, folder: Path, name: str) -> None:
    """Write ``<name>.glb``, single precision. Vertices on a texture seam are stored once for each side.

    ``extras.vertex`` of the mesh then holds the number of each of its vertices in the mesh file.

    Raises
    ------
    InputError
        If the states are too large for the format.
    """
    from pygltflib import GLTF2

    run, n = states.run, len(states)
    source, triangles, uv = np.arange(len(run.rest)), run.triangles, run.uv
    if uv is None and run.corner_uv is not None:
        source, triangles, uv = split_at_seams(triangles, run.corner_uv)
    size = n * len(source) * 24
    if size >= LARGEST:
        raise InputError(
            f"{n} states take {size / 2**30:.0f} GiB, 4 are the most; choose fewer by --every, "
            "or another format",
            key="gltf",
        )
    buffer = _Buffer()
    primitive = _first_state_and_targets(states, buffer, source, triangles)
    if uv is not None:  # v runs downwards
        texture = np.column_stack([uv[:, 0], 1.0 - uv[:, 1]])
        primitive["attributes"]["TEXCOORD_0"] = buffer.add(texture, target=VERTICES)
    primitive["indices"] = buffer.add(triangles.astype(np.uint32).ravel(), target=INDICES)
    title = run.scene.title or run.name
    mesh: dict[str, Any] = {"name": title, "primitives": [primitive]}
    if len(source) != len(run.rest):
        mesh["extras"] = {"vertex": source.tolist()}
    document = {
        "asset": {"version": "2.0", "generator": "lyra_petsc"},
        "materials": [{"name": "cloth", "pbrMetallicRoughness": CLOTH, "doubleSided": True}],
        "meshes": [mesh],
        # positions are not changed; a rotation makes y, the format's upward axis, point up
        "nodes": [{"name": title, "mesh": 0, "rotation": turned_up(states.up, 1)}],
        "scenes": [{"name": title, "nodes": [0]}],
        "scene": 0,
    }
    if n > 1:
        mesh["weights"] = [0.0] * (n - 1)
        times = buffer.add(states.times.astype(np.float32), bounds=True)
        weights = buffer.add(np.eye(n, dtype=np.float32)[:, 1:].ravel())
        sampler = {"input": times, "output": weights, "interpolation": "LINEAR"}
        channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
        document["animations"] = [{"name": "run", "samplers": [sampler], "channels": [channel]}]
    document |= {"bufferViews": buffer.views, "accessors": buffer.accessors}
    document["buffers"] = [{"byteLength": len(buffer.data)}]
    gltf = GLTF2.from_dict(document)
    gltf.set_binary_blob(bytes(buffer.data))
    gltf.save_binary(str(folder / f"{name}.glb"))


def _first_state_and_targets(
    states: ExportedStates, buffer: _Buffer, source: NDArray[np.int64], triangles: NDArray[np.int64]
) -> dict[str, Any]:
    """The primitive: positions and normals of the first state, and differences from them for the others."""
    positions = (position[source] for position in states.positions)
    start = next(positions)
    position, normal = start.astype(np.float32), _normals(start, triangles).astype(np.float32)

    def add(x: NDArray[Any], normals: NDArray[Any]) -> dict[str, int]:
        return {
            "POSITION": buffer.add(x, target=VERTICES, bounds=True),
            "NORMAL": buffer.add(normals, target=VERTICES),
        }

    attributes = add(position, normal)
    targets = [add(moved - position, _normals(moved, triangles) - normal) for moved in positions]
    return {"attributes": attributes, "material": 0, "targets": targets}


def _normals(x: NDArray[np.float64], triangles: NDArray[np.int64]) -> NDArray[np.float64]:
    """(V, 3) unit normals; z where the triangles have no area."""
    normals = vertex_normals(x, triangles)
    normals[~normals.any(axis=1)] = 0.0, 0.0, 1.0
    return normals


class _Buffer:
    """The binary part of the file, with the views and accessors that say what is where in it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: NDArray[Any], *, target: int | None = None, bounds: bool = False) -> int:
        """Append (n,), (n, 2) or (n, 3) numbers; the number of their accessor."""
        rows = array if array.dtype == np.uint32 else array.astype(np.float32)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": rows.nbytes, "target": target}
        accessor = {
            "bufferView": len(self.views),
            "componentType": UNSIGNED_INT if rows.dtype == np.uint32 else FLOAT,
            "count": len(rows),
            "type": "SCALAR" if rows.ndim == 1 else f"VEC{rows.shape[1]}",
        }
        if bounds:
            accessor["min"] = np.atleast_1d(rows.min(axis=0)).tolist()
            accessor["max"] = np.atleast_1d(rows.max(axis=0)).tolist()
        self.data += rows.tobytes()
        self.views.append(view)
        self.accessors.append(accessor)
        return len(self.accessors) - 1
