"""Scenes: sound ones of every kind, with numbers of every size, and what mutation makes of them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from hypothesis import strategies as st
from judge import Case
from odd_values import (
    NUMBERS,
    Raw,
    anything,
    document,
    emit,
    magnitude,
    places_of,
    raw,
    signed,
    usual,
    vector,
)
from text_damage import damaged

from lyra_petsc.scene.schema import (
    FIELDS,
    INTEGRATORS,
    AppliedLoad,
    Capsule,
    Contact,
    Cuboid,
    Grid,
    Handle,
    Initial,
    Keyframe,
    Material,
    MembraneStiffness,
    MeshSource,
    Obstacle,
    Output,
    Plane,
    Scene,
    Solver,
    Sphere,
    Time,
    Transform,
    UniformWind,
)

ROOT = Path(__file__).parents[2]
KEYS = sorted(
    {
        key
        for block in (
            Scene,
            MeshSource,
            Grid,
            Transform,
            Material,
            MembraneStiffness,
            UniformWind,
            Handle,
            Keyframe,
            AppliedLoad,
        )
        + (Initial, Time, Output, Solver)
        + (Contact, Obstacle, Plane, Sphere, Capsule, Cuboid)
        for key in block.keys()  # noqa: SIM118
    }
    | {"axis", "degrees", "seconds", "<<", "stepp"}
)
SHEET = b"""v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0.5 0.5 0.2
g all
f 1 2 5
f 2 3 5
f 3 4 5
f 4 1 5
"""
HUGE = [10**5, 10**6, 10**9, 2**31 - 2, 2**31]

Draw = Any


def _grid(draw: Draw) -> dict[str, Any]:
    nx, ny = draw(st.integers(1, 4)), draw(st.integers(1, 4))
    if draw(st.integers(0, 30)) == 0:
        nx, ny = draw(st.sampled_from(HUGE)), draw(st.sampled_from(HUGE))
    return {
        "width": draw(usual(0.1, 2.0)),
        "height": draw(usual(0.1, 2.0)),
        "nx": nx,
        "ny": ny,
        "pattern": draw(st.sampled_from(["diagonal", "alternating", "criss-cross"])),
    }


def _rotation(draw: Draw) -> dict[str, Any]:
    axis = draw(st.sampled_from([[0, 0, 1], [1, 2, 3], [0, 1e-100, 0], [1e200, 0, 1e200]]) | vector(0.1, 1.0))
    return {"axis": axis, "degrees": draw(signed(0.0, 360.0))}


def _transform(draw: Draw) -> dict[str, Any]:
    block: dict[str, Any] = {}
    if draw(st.booleans()):
        block["scale"] = draw(usual(0.5, 2.0) | st.lists(usual(0.5, 2.0), min_size=3, max_size=3))
    if draw(st.booleans()):
        block["rotate"] = _rotation(draw)
    if draw(st.booleans()):
        block["translate"] = draw(vector(0.0, 1.0))
    return block


def _source(draw: Draw) -> dict[str, Any]:
    block = {"file": "sheet.obj"} if draw(st.integers(0, 9)) == 0 else {"grid": _grid(draw)}
    return {**block, "transform": _transform(draw)} if draw(st.integers(0, 2)) == 0 else block


def _material(draw: Draw) -> dict[str, Any]:
    way = draw(st.integers(0, 2))
    if way == 0:
        block: dict[str, Any] = {
            "cloth": draw(st.sampled_from(["gray-interlock", "paper", "11oz-black-denim"]))
        }
    elif way == 1:
        c = draw(usual(10.0, 1e4))
        block = {
            "density": draw(usual(0.05, 1.0)),
            "membrane": {
                "c11": c,
                "c22": draw(st.just(c) | magnitude()),
                "c12": 0.3 * c,
                "c33": draw(usual(1.0, 1e4)),
            },
            "bending": draw(usual(0.0, 1e-3) | st.lists(usual(0.0, 1e-3), min_size=3, max_size=3)),
        }
    else:
        block = {
            "young": draw(usual(1e5, 1e11)),
            "poisson": draw(st.floats(-0.9, 0.5)),
            "thickness": draw(usual(1e-4, 1e-2)),
            "density": draw(usual(0.1, 10.0)),
        }
    for key, value in (
        ("damping", usual(0.0, 0.1)),
        ("warp_degrees", signed(0.0, 90.0)),
        ("density_scale", usual(0.5, 2.0)),
        ("stretching_scale", usual(0.5, 2.0)),
        ("bending_scale", usual(0.0, 2.0)),
        ("thicken", usual(0.5, 2.0)),
        ("rest_curvature", vector(0.0, 2.0)),
    ):
        if draw(st.integers(0, 5)) == 0:
            block[key] = draw(value)
    return block


def _selection(draw: Draw) -> dict[str, Any]:
    which = draw(st.integers(0, 2))
    if which == 0:
        return {"nodes": draw(st.lists(st.integers(0, 3), min_size=1, max_size=3, unique=True))}
    if which == 1:
        return {"group": draw(st.sampled_from(["left", "corners", "sheet", "top"]))}
    return {"box": [[-9, -9, -9], [draw(usual(0.0, 1.0)), 9, 9]]}


def _window(draw: Draw, block: dict[str, Any]) -> dict[str, Any]:
    if draw(st.integers(0, 3)) == 0:
        block["from"] = draw(signed(0.0, 0.05))
    if draw(st.integers(0, 3)) == 0:
        block["until"] = max(block.get("from", 0.0), 0.0) + draw(usual(1e-3, 0.1))
    return block


def _handle(draw: Draw, motions: list[str]) -> dict[str, Any]:
    block = _window(draw, _selection(draw))
    if motions and draw(st.booleans()):
        block["motion"] = draw(st.sampled_from(motions))
        block["interpolation"] = draw(st.sampled_from(["hermite", "linear"]))
    for key, value in (
        ("axes", st.lists(st.sampled_from("xyz"), min_size=1, max_size=3)),
        ("clamp", st.booleans()),
        ("fade", usual(0.0, 0.1)),
        ("stiffness", usual(1.0, 1e4)),
    ):
        if draw(st.integers(0, 3)) == 0:
            block[key] = draw(value)
    return block


def _motion(draw: Draw) -> list[dict[str, Any]]:
    frames = []
    time = draw(signed(0.0, 0.1))
    for _ in range(draw(st.integers(1, 3))):
        frame: dict[str, Any] = {"time": time, **_transform(draw)}
        if draw(st.integers(0, 4)) == 0:
            frame["velocity"] = draw(vector(0.0, 1.0))
        frames.append(frame)
        time = max(time + draw(usual(0.001, 0.1)), math.nextafter(time, math.inf))
    return frames


def _load(draw: Draw) -> dict[str, Any]:
    which = draw(st.integers(0, 2))
    if which == 0:
        return _window(draw, {**_selection(draw), "force": draw(vector(0.0, 10.0))})
    if which == 1:
        return _window(draw, {"pressure": draw(signed(0.0, 100.0))})
    return _window(draw, {"traction": draw(vector(0.0, 10.0))})


def _friction(draw: Draw) -> Any:
    if draw(st.booleans()):
        return draw(usual(0.0, 1.0))
    static = draw(usual(0.0, 1.0))
    return {"static": static, "kinetic": draw(st.floats(0.0, 1.0)) * static}


def _contact(draw: Draw) -> dict[str, Any]:
    block: dict[str, Any] = {"gap": draw(usual(1e-5, 1e-2)), "friction": _friction(draw)}
    if draw(st.booleans()):
        block |= {"thickness": draw(usual(0.0, 1e-3)), "self": draw(st.booleans())}
    return block


def _obstacle(draw: Draw, motions: list[str]) -> dict[str, Any]:
    low, radius = draw(vector(0.0, 1.0)), draw(usual(0.1, 1.0))
    shape = draw(st.sampled_from(["plane", "sphere", "capsule", "box", "mesh"]))
    block: dict[str, Any] = {
        shape: {
            "plane": {"point": low, "normal": [0, 1, draw(signed(0.1, 1.0))]},
            "sphere": {"center": low, "radius": radius},
            "capsule": {"from": low, "to": [draw(usual(2.0, 3.0)), 0, 0], "radius": radius},
            "box": {"min": [-1, -1, -1], "max": draw(st.lists(usual(0.1, 1.0), min_size=3, max_size=3))},
            "mesh": {"file": "sheet.obj", "transform": _transform(draw)},
        }[shape]
    }
    if shape not in ("plane", "mesh"):
        block["inside"] = draw(st.booleans())
    if draw(st.booleans()):
        block["friction"] = _friction(draw)
    kind = draw(st.integers(0, 2))
    if kind == 1 and motions:
        block["motion"] = draw(st.sampled_from(motions))
    elif kind == 2:
        frames = _motion(draw)
        block["motion"] = [{key: frame[key] for key in frame if key != "scale"} for frame in frames]
    return block


def _time(draw: Draw) -> dict[str, Any]:
    if draw(st.integers(0, 5)) == 0:
        return {"analysis": "static", **({"step": draw(usual(0.01, 1.0))} if draw(st.booleans()) else {})}
    block: dict[str, Any] = {"end": draw(usual(0.02, 1.0)), "step": draw(usual(0.001, 0.1))}
    block["integrator"] = draw(st.sampled_from(INTEGRATORS))
    if draw(st.integers(0, 5)) == 0:
        block["step"] = "auto"
        block["tolerance"] = draw(usual(1e-4, 0.5))
    return block


@st.composite
def scenes(draw: Draw) -> dict[str, Any]:
    """Blocks of a scene that is meant to be sound, numbers of any size among the usual ones."""
    blocks: dict[str, Any] = {
        "title": "fuzz",
        "mesh": _source(draw),
        "material": _material(draw),
        "time": _time(draw),
    }
    if draw(st.booleans()):
        blocks["gravity"] = draw(vector(0.0, 10.0))
    if draw(st.integers(0, 3)) == 0:
        blocks["wind"] = {
            "velocity": draw(vector(0.0, 20.0)),
            "density": draw(usual(0.0, 2.0)),
            "drag": draw(usual(0.0, 1.0)),
        }
    motions = [f"m{i}" for i in range(draw(st.integers(0, 2)))]
    if motions:
        blocks["motions"] = {name: _motion(draw) for name in motions}
    blocks["handles"] = [_handle(draw, motions) for _ in range(draw(st.integers(0, 2)))]
    if draw(st.integers(0, 3)) == 0:
        blocks["loads"] = [_load(draw) for _ in range(draw(st.integers(1, 2)))]
    if draw(st.integers(0, 3)) == 0:
        blocks["initial"] = {
            "velocity": draw(vector(0.0, 5.0)),
            "angular_velocity": draw(vector(0.0, 5.0)),
            "noise": draw(usual(0.0, 0.01)),
            "seed": draw(st.integers(0, 2**63 - 1)),
        }
    if draw(st.integers(0, 3)) == 0:
        blocks["output"] = {
            "every": draw(usual(0.001, 0.1)),
            "fields": draw(st.lists(st.sampled_from(FIELDS), max_size=3)),
            "checkpoint": {"seconds": draw(usual(1.0, 60.0))},
            "reactions": draw(st.booleans()),
        }
    if draw(st.integers(0, 2)) == 0:
        blocks["contact"] = _contact(draw)
        blocks["obstacles"] = {
            name: _obstacle(draw, motions) for name in ("one", "two")[: draw(st.integers(0, 2))]
        }
    if draw(st.integers(0, 4)) == 0:
        blocks["probes"] = {"tip": _selection(draw)}
    if draw(st.integers(0, 4)) == 0:
        blocks["solver"] = {
            "force_tolerance": draw(usual(1e-9, 1e-3)),
            "step_tolerance": draw(usual(1e-9, 1e-3)),
            "max_iterations": draw(st.integers(1, 100)),
        }
    if draw(st.integers(0, 4)) == 0:
        blocks["petsc"] = _petsc(draw)
    return blocks


def _petsc(draw: Draw) -> dict[str, Any]:
    names = [
        "ksp_type",
        "pc_type",
        "ksp_rtol",
        "snes_type",
        "snes_rtol",
        "ts_dt",
        "ts_type",
        "ksp_max_it",
        "mat_type",
    ]
    names += [
        "snes_max_it",
        "ts_max_time",
        "snes_linesearch_type",
        "pc_factor_levels",
        "no_such_option",
        "ksp_view",
    ]
    words = [
        "cg",
        "gmres",
        "preonly",
        "lu",
        "cholesky",
        "jacobi",
        "none",
        "ksponly",
        "newtontr",
        "basic",
        "aij",
        "abc",
    ]
    values = (
        st.sampled_from(words) | st.integers(-2, 100) | magnitude() | st.none() | st.booleans() | raw(NUMBERS)
    )
    return draw(st.dictionaries(st.sampled_from(names), values, max_size=2))


@st.composite
def mutated(draw: Draw) -> dict[str, Any]:
    """Blocks of a scene with one to three entries that are out of place."""
    blocks = draw(scenes())
    for _ in range(draw(st.integers(1, 3))):
        places = places_of(blocks)
        if not places:
            break
        *path, last = draw(st.sampled_from(places))
        block = blocks
        for key in path:
            block = block[key]
        what = draw(st.integers(0, 5))
        if what <= 2:
            block[last] = draw(anything())
        elif what == 3:
            del block[last]
        elif what == 4 and isinstance(block, dict):
            block[draw(st.sampled_from(KEYS))] = block.pop(last) if draw(st.booleans()) else draw(anything())
        else:
            block[last] = draw(st.sampled_from([[block[last]], {"a": block[last]}, [block[last]] * 3]))
    return blocks


def _settings(draw: Draw) -> tuple[str, ...]:
    paths = [
        "time.step",
        "time.end",
        "mesh",
        "mesh.grid.nx",
        "handles[0]",
        "handles.0.until",
        "handles[1].box",
        "petsc",
    ]
    paths += [
        "material.density",
        "material[0].bending",
        "gravity",
        "gravity[2]",
        "output.every",
        "motions.m0[0].time",
    ]
    paths += [
        "",
        ".",
        "a..b",
        "handles[99999999999]",
        "handles[-1]",
        "x" * 2000,
        "mesh[0][0]",
        "time",
        "a\nb",
        "ü",
    ]
    paths += ["handles." + "9" * 5000, "mesh.file", "a.b.c.d.e.f", "[0]", "title"]
    chosen = []
    for _ in range(draw(st.integers(0, 2))):
        equals = "" if draw(st.integers(0, 9)) == 0 else "="
        value = draw(anything() | magnitude())
        chosen.append(f"{draw(st.sampled_from(paths))}{equals}{emit(value)}".replace("\0", ""))
    return tuple(chosen)


@st.composite
def scene_cases(draw: Draw) -> Case:
    """A scene file and ``--set`` arguments."""
    kind = draw(st.sampled_from(["sound", "mutated", "mutated", "damaged", "shipped"]))
    if kind == "shipped":
        name = draw(
            st.sampled_from(["drape.yaml", "flag.yaml", "plate.yaml", "sail.yaml", "spin.yaml", "swing.yaml"])
        )
        text = (ROOT / "configs" / name).read_bytes()
    else:
        text = document(draw(scenes() if kind == "sound" else mutated())).encode()
    if kind in ("damaged", "shipped"):
        text = draw(damaged(text))
    settings = _settings(draw) if draw(st.integers(0, 4)) == 0 else ()
    verb = draw(st.sampled_from(["run", "run", "run", "check"]))
    return Case(f"scene-{kind}", {"scene.yaml": text, "sheet.obj": SHEET}, settings=settings, verb=verb)


def bomb(kind: str, depth: int = 12, width: int = 9) -> bytes:
    """A small file whose anchors expand to ``width ** depth`` entries: as lists, blocks or merged keys."""
    lines = ["a0: &a0 [1]"] if kind == "lists" else ["a0: &a0 {k: 1}"]
    for i in range(1, depth):
        names = ", ".join([f"*a{i - 1}"] * width)
        if kind == "lists":
            lines.append(f"a{i}: &a{i} [{names}]")
        elif kind == "blocks":
            entries = ", ".join(f"k{j}: *a{i - 1}" for j in range(width))
            lines.append(f"a{i}: &a{i} {{{entries}}}")
        else:
            lines.append(f"a{i}: &a{i} {{<<: [{names}], k{i}: 1}}")
    return "\n".join(lines).encode() + b"\n"


def nested(depth: int, form: str) -> bytes:
    """A value nested ``depth`` times."""
    if form == "indented":
        return b"".join(b" " * i + b"a:\n" for i in range(depth))
    opening, closing = {"list": ("[", "]"), "block": ("{a: ", "}")}[form]
    return f"mesh: {opening * depth}1{closing * depth}\n".encode()


@st.composite
def text_bombs(draw: Draw) -> Case:
    """Small files that grow."""
    which = draw(st.integers(0, 3))
    if which == 0:
        form = draw(st.sampled_from(["lists", "blocks", "merges"]))
        text = bomb(form, draw(st.integers(2, 40)), draw(st.integers(2, 20)))
    elif which == 1:
        form = draw(st.sampled_from(["list", "block", "indented"]))
        text = nested(draw(st.sampled_from([10, 100, 500, 1000, 3000])), form)
    elif which == 2:
        long = draw(st.sampled_from([1000, 4000]))
        entry = draw(st.sampled_from(["0", "{nodes: [0]}", "a", "[0, 0, 0]"]))
        key = draw(st.sampled_from(["handles", "mesh", "loads", "gravity", "material", "title"]))
        text = f"{key}: [{', '.join([entry] * long)}]\n".encode()
    else:
        text = document({"mesh": Raw("&m {grid: {width: 1, height: 1, nx: 2, ny: 2}}")}).encode()
        copies = draw(st.sampled_from([2, 50]))
        text = text.replace(b"mesh: &m ", b"x: &m ") + f"mesh: [{', '.join(['*m'] * copies)}]\n".encode()
    return Case("scene-bomb", {"scene.yaml": text})
