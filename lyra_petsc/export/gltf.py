"""glTF 2.0: one binary file, the first state and a morph target for each further one, and their animation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.export.frames import Frames, turned_up

Floats = NDArray[np.float32]

LARGEST = 2**32
"""Bytes; the format counts them with 32 bits."""

CLOTH = (0.75, 0.72, 0.66, 1.0)
"""Colour of the material; roughness 1, seen from both sides."""


def write(frames: Frames, folder: Path, name: str) -> None:
    """Write ``<name>.glb``, single precision. Vertices on a seam of the texture are there once for each side.

    ``extras.vertex`` of the mesh then holds the number in the mesh file of each of its vertices.

    Raises
    ------
    InputError
        If the states do not fit.
    """
    from pygltflib import GLTF2

    file = _Buffer()
    split, triangles, uv = _seams_opened(frames)
    size = len(frames) * len(split) * 24
    if size >= LARGEST:
        raise InputError(
            f"{len(frames)} states take {size / 2**30:.0f} GiB, 4 are the most; choose fewer by --every, "
            "or another format",
            key="gltf",
        )
    gltf = GLTF2()
    primitive = _first_state_and_targets(frames, file, split, triangles)
    if uv is not None:  # v runs downwards
        primitive.attributes.TEXCOORD_0 = file.add(np.column_stack([uv[:, 0], 1.0 - uv[:, 1]]), vertices=True)
    primitive.indices = file.add(triangles.astype(np.uint32).ravel(), indices=True)
    _describe(gltf, frames, primitive, None if uv is None or len(split) == len(frames.run.rest) else split)
    if len(frames) > 1:
        _animate(gltf, frames, file)
    file.into(gltf)
    gltf.save_binary(str(folder / f"{name}.glb"))


def _seams_opened(frames: Frames) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64] | None]:
    """Vertex of the mesh for each vertex here, triangles of these, and their texture coordinates."""
    run = frames.run
    if run.uv is not None or run.corner_uv is None:
        return np.arange(len(run.rest)), run.triangles, run.uv
    corners = np.column_stack([run.triangles.ravel(), run.corner_uv.reshape(-1, 2)])
    rows, found = np.unique(corners, axis=0, return_inverse=True)
    return rows[:, 0].astype(np.int64), found.reshape(-1, 3), rows[:, 1:]


def _first_state_and_targets(
    frames: Frames, file: _Buffer, split: NDArray[np.int64], triangles: NDArray[np.int64]
) -> Any:
    """The primitive: positions and normals of the first state, differences to them for the others."""
    from pygltflib import Attributes, Primitive

    states = (position[split] for position in frames.positions)
    start = next(states)
    position = start.astype(np.float32)
    normal = _normals(start, triangles).astype(np.float32)
    primitive = Primitive(
        attributes=Attributes(
            POSITION=file.add(position, vertices=True, bounds=True), NORMAL=file.add(normal, vertices=True)
        ),
        material=0,
    )
    primitive.targets = [
        {
            "POSITION": file.add(state - position, vertices=True, bounds=True),
            "NORMAL": file.add(_normals(state, triangles) - normal, vertices=True),
        }
        for state in states
    ]
    return primitive


def _normals(position: NDArray[np.float64], triangles: NDArray[np.int64]) -> NDArray[np.float64]:
    """(V, 3) unit normals, weighted by the triangles' areas."""
    a, b, c = (position[triangles[:, i]] for i in range(3))
    area = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    sums = [np.bincount(triangles.ravel(), area[:, i], len(position)) for i in range(3)]
    normals = np.stack(sums, axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 0.0, normals / np.where(length > 0.0, length, 1.0), [0.0, 0.0, 1.0])


def _describe(gltf: Any, frames: Frames, primitive: Any, split: NDArray[np.int64] | None) -> None:
    from pygltflib import Asset, Material, Mesh, Node, PbrMetallicRoughness, Scene

    title = frames.run.scene.title or frames.run.name
    gltf.asset = Asset(version="2.0", generator="lyra_petsc")
    look = PbrMetallicRoughness(baseColorFactor=list(CLOTH), metallicFactor=0.0, roughnessFactor=1.0)
    gltf.materials = [Material(name="cloth", pbrMetallicRoughness=look, doubleSided=True)]
    mesh = Mesh(name=title, primitives=[primitive])
    if len(frames) > 1:
        mesh.weights = [0.0] * (len(frames) - 1)
    if split is not None:
        mesh.extras = {"vertex": split.tolist()}
    gltf.meshes = [mesh]
    # positions as they are; the format's up is y
    gltf.nodes = [Node(name=title, mesh=0, rotation=list(turned_up(frames.up, 1)))]
    gltf.scenes = [Scene(name=title, nodes=[0])]
    gltf.scene = 0


def _animate(gltf: Any, frames: Frames, file: _Buffer) -> None:
    from pygltflib import Animation, AnimationChannel, AnimationChannelTarget, AnimationSampler

    weights = np.eye(len(frames), dtype=np.float32)[:, 1:].ravel()
    moments = file.add(frames.times.astype(np.float32), bounds=True)
    sampler = AnimationSampler(input=moments, output=file.add(weights), interpolation="LINEAR")
    target = AnimationChannelTarget(node=0, path="weights")
    gltf.animations = [
        Animation(name="run", samplers=[sampler], channels=[AnimationChannel(sampler=0, target=target)])
    ]


class _Buffer:
    """The binary part of the file, with the views and accessors into it."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []
        self._length = 0
        self._views: list[Any] = []
        self._accessors: list[Any] = []

    def add(
        self, array: NDArray[Any], *, vertices: bool = False, indices: bool = False, bounds: bool = False
    ) -> int:
        """Append (n,), (n, 2) or (n, 3) numbers; the number of their accessor."""
        from pygltflib import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, FLOAT, UNSIGNED_INT, Accessor, BufferView

        rows = array if array.dtype == np.uint32 else array.astype(np.float32)
        data = rows.tobytes()
        target = ARRAY_BUFFER if vertices else ELEMENT_ARRAY_BUFFER if indices else None
        self._views.append(BufferView(buffer=0, byteOffset=self._length, byteLength=len(data), target=target))
        width = 1 if rows.ndim == 1 else rows.shape[1]
        low = np.atleast_1d(rows.min(axis=0)).tolist() if bounds else None
        high = np.atleast_1d(rows.max(axis=0)).tolist() if bounds else None
        self._accessors.append(
            Accessor(
                bufferView=len(self._views) - 1,
                componentType=UNSIGNED_INT if rows.dtype == np.uint32 else FLOAT,
                count=len(rows),
                type={1: "SCALAR", 2: "VEC2", 3: "VEC3"}[width],
                min=low,
                max=high,
            )
        )
        self._pieces.append(data)
        self._length += len(data)
        return len(self._accessors) - 1

    def into(self, gltf: Any) -> None:
        from pygltflib import Buffer

        gltf.bufferViews, gltf.accessors = self._views, self._accessors
        gltf.buffers = [Buffer(byteLength=self._length)]
        gltf.set_binary_blob(b"".join(self._pieces))
