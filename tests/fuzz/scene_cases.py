"""Cases with valid and mutated scenes, and numbers of all magnitudes."""

from __future__ import annotations

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
    entry_at,
    listed,
    magnitude,
    paths_of,
    raw,
    varied,
)
from ruamel.yaml import YAML
from text_damage import damaged

from lyra_petsc.scene import schema
from lyra_petsc.scene.block import Block
from lyra_petsc.scene.schema import FIELDS, INTEGRATORS

ROOT = Path(__file__).parents[2]
KEYS = sorted(
    {
        key
        for block in vars(schema).values()
        if isinstance(block, type) and issubclass(block, Block)
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

Draw = Any

SCENES = """
mesh:
- grid: {width: 1.0, height: 0.8, nx: 3, ny: 2, pattern: criss-cross}
  transform: {scale: [1.0, 1.0, 0.5], rotate: {axis: [0.0, 0.0, 1.0], degrees: 30.0}}
  name: flag
material:
- density: 0.15
  membrane: {c11: 800.0, c22: 800.0, c12: 160.0, c33: 240.0}
  bending: [2.0e-5, 1.0e-5, 2.0e-5]
  damping: 0.005
  warp_degrees: 45.0
  rest_curvature: [0.5, 0.0, 0.1]
handles:
- {nodes: [0, 3], motion: m, interpolation: hermite, from: 0.01, until: 0.05, fade: 0.02}
- {group: right, axes: [x, z], stiffness: 100.0}
- {group: corners, clamp: true}
motions:
  m: [{time: 0.0, velocity: [0.0, 1.0, 0.0]}, {time: 0.05, translate: [0.1, 0.0, 0.0], scale: 1.1}]
wind: {velocity: [0.0, 3.0, 0.0], density: 1.2, drag: 0.1}
loads:
- {nodes: [4], force: [0.0, 0.0, 1.0], from: 0.0, until: 0.03}
- {pressure: 5.0}
- {traction: [0.0, 0.0, 1.0]}
initial: {velocity: [0.0, 0.5, 0.0], angular_velocity: [0.0, 0.0, 1.0], noise: 0.001, seed: 1}
output: {every: 0.01, fields: [velocity], checkpoint: {seconds: 10.0}, reactions: true}
probes: {tip: {nodes: [5]}}
---
mesh: {grid: {width: 1.0, height: 1.0, nx: 3, ny: 3}, transform: {translate: [0.0, 0.0, 0.05]}}
material: {cloth: gray-interlock, density_scale: 1.2, stretching_scale: 0.8, bending_scale: 1.1, thicken: 1.2}
contact: {gap: 0.01, thickness: 0.001, friction: {static: 0.5, kinetic: 0.3}}
motions: {m: [{time: 0.0}, {time: 0.1, rotate: {axis: [1.0, 0.0, 0.0], degrees: 20.0}}]}
obstacles:
  floor: {plane: {point: [0.0, 0.0, -0.1], normal: [0.0, 0.1, 1.0]}, friction: 0.2}
  ball: {sphere: {center: [0.5, 0.5, -0.3], radius: 0.2}, motion: m}
  rod: {capsule: {from: [-1.0, 0.5, -0.2], to: [2.0, 0.5, -0.2], radius: 0.1}}
  room: {box: {min: [-5.0, -5.0, -5.0], max: [5.0, 5.0, 5.0]}, inside: true}
  roof: {mesh: {file: sheet.obj, transform: {translate: [0.0, 0.0, 0.9]}}, motion: [{time: 0.0}, {time: 1.0}]}
solver: {force_tolerance: 1.0e-6, step_tolerance: 1.0e-6, max_iterations: 30, hessian: adaptive}
---
mesh: {file: sheet.obj, weld: 1.0e-9}
material: {young: 1.0e8, poisson: 0.3, thickness: 0.002, density: 1.0}
loads: [{pressure: 1.0}]
handles: [{box: [[-9.0, -9.0, -9.0], [0.1, 9.0, 9.0]], clamp: true}]
time: {analysis: static, step: 0.5}
---
mesh: {grid: {width: 0.5, height: 0.5, nx: 2, ny: 2, pattern: alternating}}
material: {cloth: paper, bending_model: midedge, friction_moment: 1.0e-4}
handles: [{group: left, clamp: true}]
loads: [{group: right, moment: 0.001}]
time: {end: 0.1, step: auto, tolerance: 0.01}
"""
"""Scenes that together have most keys; without ``time`` it is drawn, as are ``gravity`` and ``petsc``."""

OPTIONS = listed("""
ksp_type pc_type ksp_rtol snes_type snes_rtol ts_dt ts_type ksp_max_it mat_type snes_max_it ts_max_time
snes_linesearch_type pc_factor_levels no_such_option ksp_view
""")
CHOICES = listed("cg gmres preonly lu cholesky jacobi none ksponly newtontr basic aij abc")
PETSC = st.dictionaries(
    st.sampled_from(OPTIONS),
    st.sampled_from(CHOICES) | st.integers(-2, 100) | magnitude() | st.none() | st.booleans() | raw(NUMBERS),
    max_size=2,
)


@st.composite
def scenes(draw: Draw) -> dict[str, Any]:
    """Blocks of a valid scene without some of the optional ones; some numbers may be of any magnitude."""
    blocks: dict[str, Any] = draw(varied(draw(st.sampled_from(list(YAML(typ="safe").load_all(SCENES))))))
    optional = ("handles", "wind", "loads", "initial", "output", "probes", "solver", "obstacles")
    for key in draw(st.sets(st.sampled_from(optional), max_size=5)):
        blocks.pop(key, None)
    stepping = {"end": 0.1, "step": 0.01, "integrator": draw(st.sampled_from(INTEGRATORS))}
    blocks.setdefault("time", draw(varied(stepping)))
    if draw(st.booleans()):
        blocks["gravity"] = draw(varied([0.0, 0.0, -9.81]))
    if draw(st.integers(0, 3)) == 0:
        blocks["petsc"] = draw(PETSC)
    if "output" in blocks:
        blocks["output"]["fields"] = draw(st.lists(st.sampled_from(FIELDS), max_size=3))
    return blocks


@st.composite
def mutated(draw: Draw) -> dict[str, Any]:
    """Blocks of a scene in which one to three entries are mutated."""
    blocks = draw(scenes())
    for _ in range(draw(st.integers(1, 3))):
        paths = paths_of(blocks)
        if not paths:
            break
        *path, last = draw(st.sampled_from(paths))
        block = entry_at(blocks, path)
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


PATHS = listed("""
time.step time.end mesh mesh.grid.nx handles[0] handles.0.until handles[1].box petsc material.density
material[0].bending gravity gravity[2] output.every motions.m0[0].time . a..b handles[99999999999] handles[-1]
mesh[0][0] time ü mesh.file a.b.c.d.e.f [0] title
""")
PATHS += ["", "a\nb", "x" * 2000, "handles." + "9" * 5000]


def _settings(draw: Draw) -> tuple[str, ...]:
    chosen = []
    for _ in range(draw(st.integers(0, 2))):
        equals = "" if draw(st.integers(0, 9)) == 0 else "="
        value = draw(anything() | magnitude())
        chosen.append(f"{draw(st.sampled_from(PATHS))}{equals}{emit(value)}".replace("\0", ""))
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
    """Small files whose content expands."""
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
