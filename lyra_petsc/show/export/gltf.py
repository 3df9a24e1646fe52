"""glTF 2.0: one binary file with the first state, a morph target for each further one, and an animation."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
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
OBSTACLE = [0.35, 0.37, 0.4]
"""Looks of the materials, which are seen from both sides."""

VERTICES, INDICES, UNSIGNED_INT, FLOAT = 34962, 34963, 5125, 5126
"""Numbers of the format: targets ARRAY_BUFFER and ELEMENT_ARRAY_BUFFER, and component types."""


def write_gltf(states: ExportedStates, folder: Path, name: str) -> None:
    """Write ``<name>.glb``, single precision. Vertices on a texture seam are stored once for each side.

    ``extras.vertex`` of the mesh then holds the number of each of its vertices in the mesh file. Obstacles
    are meshes and nodes of their own.

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
    # positions are not changed; a rotation makes y, the format's upward axis, point up
    document = _Document(states.times, turned_up(states.up, 1))
    document.check_size(n * len(source) + sum(len(s.positions(0.0)) * n for s in states.obstacles.values()))
    title = run.scene.title or run.name
    cloth = document.add(title, 0, triangles, (position[source] for position in states.positions))
    if uv is not None:  # v runs downwards
        texture = np.column_stack([uv[:, 0], 1.0 - uv[:, 1]])
        cloth["primitives"][0]["attributes"]["TEXCOORD_0"] = document.buffer.add(texture, target=VERTICES)
    if len(source) != len(run.rest):
        cloth["extras"] = {"vertex": source.tolist()}
    for obstacle in states.obstacles.values():
        places = islice(states.places(obstacle), 1 if obstacle.still else n)
        material = 1 if obstacle.opacity == 1.0 else 2
        document.add(obstacle.name, material, obstacle.triangles, places)
    gltf = GLTF2.from_dict(document.content(title, obstacles=bool(states.obstacles)))
    gltf.set_binary_blob(bytes(document.buffer.data))
    gltf.save_binary(str(folder / f"{name}.glb"))


class _Document:
    """Meshes that move, each with a node of its own; see `write_gltf`.

    Parameters
    ----------
    times : (n,) float64
        Of the states [s].
    rotation : (4,) float
        Quaternion of all nodes.
    """

    def __init__(self, times: NDArray[np.float64], rotation: tuple[float, ...]) -> None:
        self.buffer = _Buffer()
        self._times, self._rotation = times, rotation
        self._meshes: list[dict[str, Any]] = []
        self._nodes: list[dict[str, Any]] = []
        self._moving: list[int] = []

    def check_size(self, points: int) -> None:
        """Refuse more ``points`` in all states than the format can count."""
        if (size := points * 24) >= LARGEST:
            raise InputError(
                f"{len(self._times)} states take {size / 2**30:.0f} GiB, 4 are the most; choose fewer by "
                "--every, or another format",
                key="gltf",
            )

    def add(
        self,
        name: str,
        material: int,
        triangles: NDArray[np.int64],
        positions: Iterator[NDArray[np.float64]],
    ) -> dict[str, Any]:
        """Add a mesh: positions and normals of the first state, differences from them for the others.

        ``positions`` has one for each state, or a single one of what stands still.
        """
        start = next(positions)
        position, normal = start.astype(np.float32), _normals(start, triangles).astype(np.float32)

        def stored(x: NDArray[Any], normals: NDArray[Any]) -> dict[str, int]:
            return {
                "POSITION": self.buffer.add(x, target=VERTICES, bounds=True),
                "NORMAL": self.buffer.add(normals, target=VERTICES),
            }

        primitive: dict[str, Any] = {"attributes": stored(position, normal), "material": material}
        targets = [stored(moved - position, _normals(moved, triangles) - normal) for moved in positions]
        primitive["indices"] = self.buffer.add(triangles.astype(np.uint32).ravel(), target=INDICES)
        mesh: dict[str, Any] = {"name": name, "primitives": [primitive]}
        if targets:
            primitive["targets"] = targets
            mesh["weights"] = [0.0] * len(targets)
            self._moving.append(len(self._nodes))
        self._nodes.append({"name": name, "mesh": len(self._meshes), "rotation": self._rotation})
        self._meshes.append(mesh)
        return mesh

    def content(self, title: str, *, obstacles: bool) -> dict[str, Any]:
        """The whole document, after which nothing is added."""
        materials = [{"name": "cloth", "pbrMetallicRoughness": CLOTH, "doubleSided": True}]
        for name, opacity in (("obstacle", 1.0), ("see-through obstacle", 0.3)) if obstacles else ():
            look = {**CLOTH, "baseColorFactor": [*OBSTACLE, opacity]}
            blend = {} if opacity == 1.0 else {"alphaMode": "BLEND"}
            materials.append({"name": name, "pbrMetallicRoughness": look, "doubleSided": True, **blend})
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "lyra_petsc"},
            "materials": materials,
            "meshes": self._meshes,
            "nodes": self._nodes,
            "scenes": [{"name": title, "nodes": list(range(len(self._nodes)))}],
            "scene": 0,
        }
        n = len(self._times)
        if self._moving:
            times = self.buffer.add(self._times.astype(np.float32), bounds=True)
            weights = self.buffer.add(np.eye(n, dtype=np.float32)[:, 1:].ravel())
            sampler = {"input": times, "output": weights, "interpolation": "LINEAR"}
            channels = [{"sampler": 0, "target": {"node": i, "path": "weights"}} for i in self._moving]
            document["animations"] = [{"name": "run", "samplers": [sampler], "channels": channels}]
        document |= {"bufferViews": self.buffer.views, "accessors": self.buffer.accessors}
        return document | {"buffers": [{"byteLength": len(self.buffer.data)}]}


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
