"""Conversion of scenes of the original Lyra program and of ARCSim (conf.json, material tables, labels).

As in the originals, Δt = frame_time/frame_steps with one linear solve a step (``semi-implicit``), handles are
springs of 1000 N/m, a negative c12 of a measured cloth is set to 0, and there is no gravity by default. Other
than in Lyra, ``end_time`` has an effect; ``texture`` has none, as it is for the original's window.

Lyra has part of ARCSim's keys. A scene with any of the others (`ARCSIM_KEYS`) is ARCSim's: then there is
contact, with the friction of ARCSim, still air of 1 kg/m³ unless the scene has wind, and ``thicken`` makes
bending proportional to the thickness. What has no counterpart (`IGNORED`) is named in a note. (Format: ARCSim
0.3.1, Narain, Samii, Pfaff & O'Brien.)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from lyra_petsc.errors import InputError, suggest
from lyra_petsc.scene.block import Block
from lyra_petsc.scene.materials.library import ClothTable, library_entries, shell_of_table
from lyra_petsc.scene.messages import validated
from lyra_petsc.scene.text import parse_json, read_text
from lyra_petsc.scene.values import (
    Count,
    Index,
    NonNegative,
    Number,
    Positive,
    Text,
    Vector,
    integer,
    number,
    one_line,
    problem,
    require,
    shown,
)

ARCSIM_KEYS = {
    "scene": {"obstacles", "disable", "magic", "friction", "obs_friction", "timestep", "duration", "morphs"},
    "cloth": {"remeshing", "reference", "velocity"},
    "material": {"strain_limits", "yield_curv", "weakening", "elastic_modulus"},
}
"""Keys that Lyra does not have."""

_REASONS = {
    "scene": {"": "morphs passive_time remeshing_frames"},
    "cloth": {
        ": the triangles stay those of the mesh file, which must be fine enough": "remeshing",
        ": the rest shape is that of the mesh file": "reference",
    },
    "material": {
        ": the sheet stretches by its stiffness": "strain_limits",
        ": plasticity is not simulated": "yield_curv weakening yield_stretch plastic_flow plastic_limit",
        ": fracture is not simulated": "toughness fracture_bending_mult bending_factor bend_width "
        "initiation_factor",
    },
    "obstacle": {
        ": obstacles are always there": "start_time end_time",
        ": the obstacle is its mesh": "proxy",
    },
    "magic": {
        ": for ARCSim's own algorithms": "fixed_high_res_mesh collision_stiffness projection_thickness "
        "edge_flip_threshold rib_stiffening combine_tensors add_jitter preserve_creases "
        "separation_step_size relax_method max_cracks enable_localopt"
    },
}
IGNORED = {
    kind: {name: f"no effect here{reason}" for reason, names in reasons.items() for name in names.split()}
    for kind, reasons in _REASONS.items()
}
"""ARCSim's keys of each kind of block that have no effect here, and why."""


def _rotation(value: Any) -> Any:
    if not isinstance(value, (list, tuple)) or len(value) != 4:
        raise problem(f"must be [degrees, x, y, z], not {shown(value)}")
    return tuple(number(entry) for entry in value)


def _motion_keyframes(value: Any) -> Any:
    if isinstance(value, dict):
        if "motfile" in value:
            raise problem("motion files are not read; write the keyframes into the scene", "motfile")
        for key in value:
            if key not in ("center", "points"):
                raise problem("unknown key, known: center, points", str(key))
        center = value.get("center")
        if center is not None and any(number(c) != 0 for c in (center if isinstance(center, list) else [])):
            raise problem("must be [0, 0, 0]: motions are about the origin", "center")
        value = value.get("points")
    if not isinstance(value, list) or not value:
        raise problem(f"must be a list of keyframes, not {shown(value)}")
    return value


def _motion_number(value: Any) -> Any:
    # −1 means none in the original
    return None if value == -1 else value


class Placement(Block):
    """``transform`` of the original: scaling, then rotation, then translation."""

    translate: Vector = (0.0, 0.0, 0.0)
    scale: Number = 1.0
    rotate: Annotated[tuple[float, float, float, float], BeforeValidator(_rotation)] = (0.0, 0.0, 0.0, 0.0)

    def check(self) -> None:
        """Refuse a rotation about no axis."""
        has_axis = self.rotate[0] == 0.0 or any(self.rotate[1:])
        require(has_axis, "needs an axis: [degrees, x, y, z]", "rotate")

    def to_our_keys(self) -> dict[str, Any]:
        """As our ``transform``, or as the keys of a keyframe other than time and velocity."""
        block: dict[str, Any] = {"scale": self.scale, "translate": list(self.translate)}
        degrees, *axis = self.rotate
        if degrees != 0.0:
            block["rotate"] = {"axis": axis, "degrees": degrees}
        return block


class OriginalMaterial(Block):
    data: Text = ""
    thickness: Positive | None = None
    density: Positive | None = None
    elastic_modulus: Positive | None = None
    poisson_ratio: Number = 0.0
    density_mult: Positive = 1.0
    stretching_mult: Positive = 1.0
    bending_mult: NonNegative = 1.0
    thicken: Positive = 1.0
    damping: NonNegative = 0.0

    def check(self) -> None:
        """Refuse a material without data or some of its numbers."""
        text = "missing (a material has data, or thickness, density and elastic_modulus)"
        for name in ("thickness", "density", "elastic_modulus"):
            require(self.data or self.get(name) is not None, text, name)


class OriginalVelocity(Block):
    linear: Vector = (0.0, 0.0, 0.0)
    angular: Vector = (0.0, 0.0, 0.0)
    origin: Vector = (0.0, 0.0, 0.0)


class OriginalCloth(Block):
    mesh: Text
    transform: Placement = Field(default_factory=Placement)
    materials: list[OriginalMaterial]
    texture: Text = ""
    velocity: OriginalVelocity = Field(default_factory=OriginalVelocity)

    def check(self) -> None:
        """Refuse several materials, and a mirrored mesh."""
        n_materials = len(self.materials)
        require(n_materials == 1, f"must hold one material, not {n_materials}", "materials")
        require(self.transform.scale > 0, "must be > 0", "transform", "scale")


class OriginalHandle(Block):
    type: Text = "node"
    cloth: Index = 0
    nodes: list[Index] = Field(default_factory=list)
    label: Annotated[int, BeforeValidator(integer)] = -1
    motion: Annotated[Index | None, BeforeValidator(_motion_number)] = None
    start_time: Number = 0.0
    end_time: Number | None = None
    fade_time: NonNegative = 0.0

    def check(self) -> None:
        """Refuse handles of other types, and of no vertices."""
        require(self.type == "node", f"only handles of type 'node' are read, not {self.type!r}", "type")
        require(self.label != -1 or self.nodes, "must have nodes or label")


class OriginalKeyframe(Block):
    time: Number
    transform: Placement = Field(default_factory=Placement)
    velocity: Placement | None = None

    def check(self) -> None:
        """Refuse a rate of rotation or scale."""
        rate = self.velocity
        moves = rate is None or (rate.scale in (0.0, 1.0) and rate.rotate[0] == 0.0)
        require(moves, "may hold translate only", "velocity")


class OriginalObstacle(Block):
    mesh: Text
    transform: Placement = Field(default_factory=Placement)
    motion: Annotated[Index | None, BeforeValidator(_motion_number)] = None


class OriginalMagic(Block):
    handle_stiffness: Positive = 1000.0
    repulsion_thickness: Positive | None = None


class OriginalWind(Block):
    density: NonNegative | None = None
    velocity: Vector = (0.0, 0.0, 0.0)
    drag: NonNegative = 0.0


class OriginalScene(Block):
    """The keys of a conf.json, with the defaults of the original."""

    frame_time: Positive = 0.04
    frame_steps: Count
    timestep: Positive | None = None
    save_frames: Count = 1
    save_every: Count = 1
    end_time: Positive | None = None
    end_frame: Count | None = None
    duration: Positive | None = None
    cloths: list[OriginalCloth]
    handles: list[OriginalHandle] = Field(default_factory=list)
    motions: list[Annotated[list[OriginalKeyframe], BeforeValidator(_motion_keyframes)]] = Field(
        default_factory=list
    )
    obstacles: list[OriginalObstacle] = Field(default_factory=list)
    disable: list[Text] = Field(default_factory=list)
    magic: OriginalMagic = Field(default_factory=OriginalMagic)
    # ARCSim's coefficients of friction of cloths, and of cloths on obstacles, by default
    friction: NonNegative = 0.6
    obs_friction: NonNegative = 0.3
    gravity: Vector | None = None
    wind: OriginalWind = Field(default_factory=OriginalWind)

    @classmethod
    def with_defaults(cls, data: dict[str, Any]) -> dict[str, Any]:
        """``frame_steps`` is 1 by default, but without ``frame_time`` that of the original's own scene."""
        return {"frame_steps": 1 if "frame_time" in data else 8, **data}

    def check(self) -> None:
        """Refuse cloths and motions that do not exist."""
        require(self.cloths, "must hold at least one cloth", "cloths")
        moved = [("handles", i, handle.motion) for i, handle in enumerate(self.handles)]
        moved += [("obstacles", i, obstacle.motion) for i, obstacle in enumerate(self.obstacles)]
        for key, i, motion in moved:
            text = f"there is no motion {motion}, only {len(self.motions)}"
            require(motion is None or motion < len(self.motions), text, key, i, "motion")
        for i, handle in enumerate(self.handles):
            text = f"there is no cloth {handle.cloth}, only {len(self.cloths)}"
            require(handle.cloth < len(self.cloths), text, "handles", i, "cloth")


def find_beside(name: str, scene: Path) -> Path | None:
    """The file ``name`` beside the scene, beside its folder, or in the working directory."""
    folder = scene.absolute().parent
    for directory in (folder, folder.parent, Path.cwd()):
        try:
            if (directory / name).is_file():
                return directory / name
        except (OSError, ValueError):
            return None
    return None


def _table(shape: tuple[int, int]) -> BeforeValidator:
    rows, columns = shape

    def check(value: Any) -> Any:
        right = isinstance(value, list) and len(value) == rows
        if not right or any(not isinstance(row, list) or len(row) != columns for row in value):
            raise problem(f"must be {rows} rows of {columns} numbers")
        return [[number(entry) for entry in row] for row in value]

    return BeforeValidator(check)


class MaterialFile(Block):
    """The tables of one cloth in a material file of the original."""

    density: Positive
    stretching: Annotated[list[list[float]], _table((6, 4))]
    bending: Annotated[list[list[float]], _table((3, 5))]


def material_numbers(data: str, scene: Path, *, key: str) -> dict[str, Any]:
    """density, membrane and bending in our keys, for the material ``data`` of a conf.json.

    It is read from the file of that name if there is one, else from the library. Negative entries count as
    0, as in the original.

    Raises
    ------
    InputError
        Neither a file nor a known name; a stiffness that is not positive definite.
    """
    file = find_beside(data, scene)
    if file is not None:
        table = _read_material(file)
    else:
        cloths = {name: entry for name, entry in library_entries().items() if isinstance(entry, ClothTable)}
        name = Path(data).stem
        if name not in cloths:
            raise InputError(
                f"neither a file nor a library cloth: {data!r}, {suggest(name, cloths)}", file=scene, key=key
            )
        table = cloths[name]
    c11, c12, c22, c33 = (max(c, 0.0) for c in (table.c11, table.c12, table.c22, table.c33))
    if min(c11, c22, c33) == 0.0 or c11 * c22 <= c12 * c12:
        raise InputError(
            f"the small-strain row [{c11:g}, {c12:g}, {c22:g}, {c33:g}] N/m is not positive definite",
            file=file or scene,
            key="stretching[0]" if file else key,
        )
    at_0, at_45, at_90 = (max(k, 0.0) for k in table.bending)
    shell, _ = shell_of_table(ClothTable(table.density, c11, c12, c22, c33, (at_0, at_45, at_90)), data)
    return {
        "density": shell.density,
        "membrane": {"c11": shell.c11, "c22": shell.c22, "c12": shell.c12, "c33": shell.c33},
        "bending": list(shell.bending),
    }


def _read_material(path: Path) -> ClothTable:
    tables = validated(MaterialFile, parse_json(read_text(path), file=path), file=path)
    c11, c12, c22, c33 = tables.stretching[0]
    at_0, at_45, at_90 = (row[0] for row in tables.bending)
    return ClothTable(tables.density, c11, c12, c22, c33, (at_0, at_45, at_90))


@dataclass
class ObjVertices:
    """Vertices of an .obj file.

    Attributes
    ----------
    count : int
    labels : dict of str to set of int
        Vertices with each label (``nl`` lines, each after its vertex).
    textured : bool
        Whether the file has ``vt`` lines, which give the rest shape.
    """

    count: int = 0
    labels: dict[str, set[int]] = field(default_factory=dict)
    textured: bool = False


def read_vertices(file: Path) -> ObjVertices:
    """The vertices of an .obj file and their labels; raises as `read_text`."""
    vertices = ObjVertices()
    for line in read_text(file, largest=math.inf).splitlines():
        word, *label = line.split(maxsplit=2)[:2] or [""]
        vertices.count += word == "v"
        vertices.textured |= word == "vt"
        if word == "nl" and label and vertices.count:
            vertices.labels.setdefault(label[0], set()).add(vertices.count - 1)
    return vertices


def _blocks(data: Any) -> Iterator[tuple[str, str, Any]]:
    """Kind, key and content of the blocks of a conf.json that may have keys of ARCSim."""

    def entries(block: Any, name: str) -> list[tuple[str, Any]]:
        blocks = block.get(name) if isinstance(block, dict) else None
        return [(f"{name}[{i}]", entry) for i, entry in enumerate(blocks if isinstance(blocks, list) else [])]

    yield "scene", "", data
    yield "magic", "magic", data.get("magic") if isinstance(data, dict) else None
    yield from (("obstacle", key, block) for key, block in entries(data, "obstacles"))
    for key, cloth in entries(data, "cloths"):
        yield "cloth", key, cloth
        yield from (("material", f"{key}.{name}", block) for name, block in entries(cloth, "materials"))


def _without_ignored(data: Any) -> tuple[Any, bool, list[str]]:
    """A copy of ``data`` without `IGNORED` keys, whether it has keys of ARCSim only, and notes."""
    data = deepcopy(data)
    arcsim, places = False, dict[str, list[str]]()
    for kind, key, block in _blocks(data):
        if isinstance(block, dict):
            arcsim |= not ARCSIM_KEYS.get(kind, set()).isdisjoint(block)
            for name in [name for name in block if name in IGNORED[kind]]:
                del block[name]
                places.setdefault(IGNORED[kind][name], []).append(f"{key}.{name}" if key else name)
    return data, arcsim, [f"{', '.join(keys)}: {why}" for why, keys in places.items()]


def import_original(data: Any, path: Path) -> tuple[dict[str, Any], list[str]]:
    """Convert a parsed conf.json to plain values in our keys; and notes on what has no effect here.

    Parameters
    ----------
    data : parsed JSON
    path : Path
        The file. Its meshes and materials are searched in its folder, in the parent folder and in the
        working directory, as the original is run from the folder that contains ``conf/``.

    Raises
    ------
    InputError
        Unknown keys, values out of range, files that do not exist.
    """
    data, arcsim, notes = _without_ignored(data)
    if isinstance(data, dict) and isinstance(pattern := data.get("obstacles"), str):
        data["obstacles"] = _numbered_obstacles(pattern, path, data.get("motions"))
    scene = validated(OriginalScene, data, file=path)
    files = [_mesh_file(cloth.mesh, path, f"cloths[{i}].mesh") for i, cloth in enumerate(scene.cloths)]
    vertices = cache(lambda cloth: read_vertices(files[cloth]))  # few scenes need them
    several = len(scene.cloths) > 1
    step, every = scene.frame_time / scene.frame_steps, scene.frame_time
    if scene.timestep is not None and "frame_time" not in data:
        step, every = scene.timestep, scene.timestep * scene.save_frames * scene.save_every
    ours: dict[str, Any] = {
        "title": one_line(path.stem),
        "mesh": [],
        "material": [],
        "time": {"step": step, "integrator": "semi-implicit"},
        "output": {"every": every},
    }
    ends = [scene.end_time, scene.end_frame and scene.end_frame * scene.frame_time, scene.duration]
    if any(ends):
        ours["time"]["end"] = min(end for end in ends if end)
    if scene.gravity is not None and any(scene.gravity):
        ours["gravity"] = list(scene.gravity)
    density = scene.wind.density if scene.wind.density is not None else float(arcsim)
    if density > 0 or scene.wind.drag > 0:
        ours["wind"] = {"density": density, "drag": scene.wind.drag, "velocity": list(scene.wind.velocity)}
    for i, cloth in enumerate(scene.cloths):
        name = {"name": f"cloth{i}"} if several else {}
        group = {"group": f"cloth{i}"} if several else {}
        scale = cloth.transform.scale
        uv = {"uv": scale} if scale != 1.0 and vertices(i).textured else {}
        ours["mesh"].append({"file": str(files[i]), "transform": cloth.transform.to_our_keys(), **uv, **name})
        ours["material"].append({**_material(cloth.materials[0], i, path, arcsim=arcsim), **group})
    velocities = {cloth.velocity.linear for cloth in scene.cloths}
    if len(velocities) == 1 and not any(any(cloth.velocity.angular) for cloth in scene.cloths):
        if any(linear := velocities.pop()):
            ours["initial"] = {"velocity": list(linear)}
    else:
        notes.append("cloths[].velocity: no effect here, unless it is linear and the same for all cloths")
    ours["motions"] = {
        f"motion{i}": _shortest_rotations([_keyframe(keyframe) for keyframe in keyframes])
        for i, keyframes in enumerate(scene.motions)
    }
    stiffness = scene.magic.handle_stiffness
    ours["handles"] = [
        _handle(handle, i, vertices, path) | {"stiffness": stiffness}
        for i, handle in enumerate(scene.handles)
    ]
    if arcsim and "collision" not in scene.disable:
        gap = scene.magic.repulsion_thickness
        ours["contact"] = {"friction": scene.friction, **({} if gap is None else {"gap": gap})}
        ours["obstacles"] = {f"obstacle{i}": _obstacle(scene, i, path) for i in range(len(scene.obstacles))}
    elif scene.obstacles:
        notes.append("obstacles: no effect, as disable names collision")
    if "physics" in scene.disable:
        notes.append("disable: no effect on physics, which is simulated all the same")
    return ours, notes


def _numbered_obstacles(pattern: str, path: Path, motions: Any) -> list[dict[str, Any]]:
    """The obstacles of the files ``pattern`` % 0, 1, …; the motion of the same number moves each."""
    obstacles: list[dict[str, Any]] = []
    try:
        while find_beside(name := pattern % len(obstacles), path) is not None:
            moves = isinstance(motions, list) and len(obstacles) < len(motions)
            obstacles.append({"mesh": name, "motion": len(obstacles) if moves else -1})
    except (TypeError, ValueError):
        name = pattern
    if not obstacles:
        raise InputError(
            f"no such file: {name} (a name with a number, as body%02d.obj)", file=path, key="obstacles"
        )
    return obstacles


def _obstacle(scene: OriginalScene, i: int, path: Path) -> dict[str, Any]:
    obstacle, key = scene.obstacles[i], f"obstacles[{i}]"
    keyframes = [] if obstacle.motion is None else scene.motions[obstacle.motion]
    scales = {keyframe.transform.scale for keyframe in keyframes} or {1.0}
    if len(scales) > 1:
        raise InputError(
            f"motion {obstacle.motion} scales from {min(scales):g} to {max(scales):g}, but an obstacle is "
            "rigid here; give its keyframes one scale",
            file=path,
            key=f"{key}.motion",
        )
    # the motion scales the obstacle where its transform has put it
    (scale,), placed = scales, obstacle.transform.to_our_keys()
    placed |= {"scale": scale * placed["scale"], "translate": [scale * x for x in placed["translate"]]}
    mesh = {"file": str(_mesh_file(obstacle.mesh, path, f"{key}.mesh")), "transform": placed}
    block: dict[str, Any] = {"mesh": mesh, "friction": scene.obs_friction}
    if keyframes:
        rigid = [_keyframe(keyframe) | {"scale": 1.0} for keyframe in keyframes]
        block |= {"motion": _shortest_rotations(rigid), "interpolation": "hermite"}
    return block


def _mesh_file(name: str, path: Path, key: str) -> Path:
    if not name.lower().endswith(".obj"):
        raise InputError(f"must be an .obj file, not {shown(name)}", file=path, key=key)
    file = find_beside(name, path)
    if file is None:
        raise InputError(f"no such file: {name}", file=path, key=key)
    return file


def _material(material: OriginalMaterial, i: int, path: Path, *, arcsim: bool) -> dict[str, Any]:
    scales = material.stretching_mult, material.bending_mult
    if not material.data:
        assert material.density is not None
        assert material.thickness is not None
        numbers = {
            "young": material.elastic_modulus,
            "poisson": material.poisson_ratio,
            "thickness": material.thickness,
            "density": material.density * material.thickness,
            "bending_model": "hinge",
        }
    else:
        numbers = material_numbers(material.data, path, key=f"cloths[{i}].materials[0].data")
        numbers |= {"density_scale": material.density_mult, "thicken": material.thicken}
        if arcsim:  # there bending is proportional to the thickness, here to its cube
            scales = material.stretching_mult, material.bending_mult / material.thicken**2
    return {**numbers, "stretching_scale": scales[0], "bending_scale": scales[1], "damping": material.damping}


def _keyframe(keyframe: OriginalKeyframe) -> dict[str, Any]:
    block = {"time": keyframe.time, **keyframe.transform.to_our_keys()}
    if keyframe.velocity is not None:
        block["velocity"] = list(keyframe.velocity.translate)
    return block


def _shortest_rotations(keyframes: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Keyframes with angles changed by multiples of 360° so that successive ones differ by at most 180°.

    The original interpolates quaternions, which represent rotations only up to such multiples.
    """
    before: dict[str, Any] = {"axis": [0.0, 0.0, 1.0], "degrees": 0.0}
    for keyframe in keyframes:
        turn = keyframe.get("rotate", {"axis": before["axis"], "degrees": 0.0})
        size = math.hypot(*turn["axis"]) * math.hypot(*before["axis"])
        along = sum(a * b for a, b in zip(turn["axis"], before["axis"], strict=True)) / size
        previous = math.copysign(1.0, along) * before["degrees"] if abs(along) > 1.0 - 1e-12 else 0.0
        turns = (turn["degrees"] - previous) / 360.0
        turn["degrees"] -= 360.0 * math.copysign(math.ceil(abs(turns) - 0.5), turns)
        if turn["degrees"] != 0.0:
            keyframe["rotate"] = turn
        else:
            keyframe.pop("rotate", None)
        before = turn
    return keyframes


def _handle(
    handle: OriginalHandle, i: int, vertices: Callable[[int], ObjVertices], path: Path
) -> dict[str, Any]:
    nodes = handle.nodes
    if handle.label != -1:
        nodes = sorted(vertices(handle.cloth).labels.get(str(handle.label), ()))
        if not nodes:
            raise InputError(f"no vertex has label {handle.label}", file=path, key=f"handles[{i}].label")
    # our numbers are consecutive over all sheets
    first = sum(vertices(earlier).count for earlier in range(handle.cloth))
    block: dict[str, Any] = {
        "nodes": [first + node for node in nodes],
        "from": handle.start_time,
        "until": handle.end_time,
        "fade": handle.fade_time,
    }
    if handle.motion is not None:
        block |= {"motion": f"motion{handle.motion}", "interpolation": "hermite"}
    return block
