"""Cases with valid and mutated scenes, and numbers of all magnitudes."""

from __future__ import annotations

import math
from copy import deepcopy
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
    joined,
    listed,
    magnitude,
    paths_of,
    rarely,
    raw,
    signed,
    sometimes,
    usual,
    vector,
)
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
HUGE = [10**5, 10**6, 10**9, 2**31 - 2, 2**31]

Draw = Any
Blocks = st.SearchStrategy[dict[str, Any]]

block, one_of = st.fixed_dictionaries, st.sampled_from
NOTHING: Blocks = st.just({})

CELLS = rarely(one_of(HUGE), st.integers(1, 4), 60)
GRID = block(
    {
        "width": usual(0.1, 2.0),
        "height": usual(0.1, 2.0),
        "nx": CELLS,
        "ny": CELLS,
        "pattern": one_of(["diagonal", "alternating", "criss-cross"]),
    }
)
AXES = [[0, 0, 1], [1, 2, 3], [0, 1e-100, 0], [1e200, 0, 1e200]]
ROTATION = block({"axis": one_of(AXES) | vector(0.1, 1.0), "degrees": signed(0.0, 360.0)})
SCALE = usual(0.5, 2.0) | st.lists(usual(0.5, 2.0), min_size=3, max_size=3)
MOVE = {"rotate": ROTATION, "translate": vector(0.0, 1.0)}
TRANSFORM = sometimes(2, {"scale": SCALE, **MOVE})
SOURCE = joined(
    rarely(st.just({"file": "sheet.obj"}), block({"grid": GRID}), 10), sometimes(3, {"transform": TRANSFORM})
)

CLOTH = block({"cloth": one_of(["gray-interlock", "paper", "11oz-black-denim"])})
FABRIC = usual(10.0, 1e4).flatmap(
    lambda c: block(
        {
            "density": usual(0.05, 1.0),
            "membrane": block(
                {
                    "c11": st.just(c),
                    "c22": st.just(c) | magnitude(),
                    "c12": st.just(0.3 * c),
                    "c33": usual(1.0, 1e4),
                }
            ),
            "bending": usual(0.0, 1e-3) | st.lists(usual(0.0, 1e-3), min_size=3, max_size=3),
        }
    )
)
PLATE = block(
    {
        "young": usual(1e5, 1e11),
        "poisson": st.floats(-0.9, 0.5),
        "thickness": usual(1e-4, 1e-2),
        "density": usual(0.1, 10.0),
    }
)
MATERIAL = joined(
    st.one_of(CLOTH, FABRIC, PLATE),
    sometimes(
        6,
        {
            "damping": usual(0.0, 0.1),
            "warp_degrees": signed(0.0, 90.0),
            "density_scale": usual(0.5, 2.0),
            "stretching_scale": usual(0.5, 2.0),
            "bending_scale": usual(0.0, 2.0),
            "thicken": usual(0.5, 2.0),
            "rest_curvature": vector(0.0, 2.0),
        },
    ),
)

SELECTION = st.one_of(
    block({"nodes": st.lists(st.integers(0, 3), min_size=1, max_size=3, unique=True)}),
    block({"group": one_of(["left", "corners", "sheet", "top"])}),
    block({"box": usual(0.0, 1.0).map(lambda x: [[-9, -9, -9], [x, 9, 9]])}),
)


def _later(window: dict[str, Any]) -> dict[str, Any]:
    if "until" in window:
        window["until"] += max(window.get("from", 0.0), 0.0)
    return window


WINDOW = sometimes(4, {"from": signed(0.0, 0.05), "until": usual(1e-3, 0.1)}).map(_later)
LOAD = joined(
    st.one_of(
        joined(SELECTION, block({"force": vector(0.0, 10.0)})),
        block({"pressure": signed(0.0, 100.0)}),
        block({"traction": vector(0.0, 10.0)}),
    ),
    WINDOW,
)


def _handle(motions: list[str]) -> Blocks:
    moves = {"motion": one_of(motions), "interpolation": one_of(["hermite", "linear"])}
    further = {
        "axes": st.lists(one_of("xyz"), min_size=1, max_size=3),
        "clamp": st.booleans(),
        "fade": usual(0.0, 0.1),
        "stiffness": usual(1.0, 1e4),
    }
    return joined(SELECTION, WINDOW, NOTHING | block(moves) if motions else NOTHING, sometimes(4, further))


@st.composite
def _motion(draw: Draw, placed: Blocks = TRANSFORM) -> list[dict[str, Any]]:
    frames = []
    time = draw(signed(0.0, 0.1))
    for _ in range(draw(st.integers(1, 3))):
        frames.append({"time": time, **draw(placed), **draw(sometimes(5, {"velocity": vector(0.0, 1.0)}))})
        time = max(time + draw(usual(0.001, 0.1)), math.nextafter(time, math.inf))
    return frames


FRICTION = usual(0.0, 1.0) | st.tuples(usual(0.0, 1.0), st.floats(0.0, 1.0)).map(
    lambda two: {"static": two[0], "kinetic": two[1] * two[0]}
)
CONTACT = joined(
    block({"gap": usual(1e-5, 1e-2), "friction": FRICTION}),
    NOTHING | block({"thickness": usual(0.0, 1e-3), "self": st.booleans()}),
)
PLACE, RADIUS = vector(0.0, 1.0), usual(0.1, 1.0)
SHAPES = {
    "plane": {"point": PLACE, "normal": signed(0.1, 1.0).map(lambda z: [0, 1, z])},
    "sphere": {"center": PLACE, "radius": RADIUS},
    "capsule": {"from": PLACE, "to": usual(2.0, 3.0).map(lambda x: [x, 0, 0]), "radius": RADIUS},
    "box": {"min": st.just([-1, -1, -1]), "max": st.lists(RADIUS, min_size=3, max_size=3)},
    "mesh": {"file": st.just("sheet.obj"), "transform": TRANSFORM},
}


def _obstacle(motions: list[str]) -> Blocks:
    shapes = [
        joined(
            block({name: block(shape)}),
            NOTHING if name in ("plane", "mesh") else block({"inside": st.booleans()}),
        )
        for name, shape in SHAPES.items()
    ]
    moved = block({"motion": _motion(sometimes(2, MOVE))})
    named = block({"motion": one_of(motions)}) if motions else NOTHING
    return joined(st.one_of(shapes), sometimes(2, {"friction": FRICTION}), st.one_of(NOTHING, named, moved))


TIME = rarely(
    joined(st.just({"analysis": "static"}), sometimes(2, {"step": usual(0.01, 1.0)})),
    joined(
        block({"end": usual(0.02, 1.0), "integrator": one_of(INTEGRATORS)}),
        rarely(
            block({"step": st.just("auto"), "tolerance": usual(1e-4, 0.5)}),
            block({"step": usual(0.001, 0.1)}),
            6,
        ),
    ),
    6,
)
OPTIONS = listed("""
ksp_type pc_type ksp_rtol snes_type snes_rtol ts_dt ts_type ksp_max_it mat_type snes_max_it ts_max_time
snes_linesearch_type pc_factor_levels no_such_option ksp_view
""")
CHOICES = listed("cg gmres preonly lu cholesky jacobi none ksponly newtontr basic aij abc")
PETSC = st.dictionaries(
    one_of(OPTIONS),
    one_of(CHOICES) | st.integers(-2, 100) | magnitude() | st.none() | st.booleans() | raw(NUMBERS),
    max_size=2,
)
SELDOM = sometimes(
    4,
    {
        "wind": block({"velocity": vector(0.0, 20.0), "density": usual(0.0, 2.0), "drag": usual(0.0, 1.0)}),
        "loads": st.lists(LOAD, min_size=1, max_size=2),
        "initial": block(
            {
                "velocity": vector(0.0, 5.0),
                "angular_velocity": vector(0.0, 5.0),
                "noise": usual(0.0, 0.01),
                "seed": st.integers(0, 2**63 - 1),
            }
        ),
        "output": block(
            {
                "every": usual(0.001, 0.1),
                "fields": st.lists(one_of(FIELDS), max_size=3),
                "checkpoint": block({"seconds": usual(1.0, 60.0)}),
                "reactions": st.booleans(),
            }
        ),
        "probes": block({"tip": SELECTION}),
        "solver": block(
            {
                "force_tolerance": usual(1e-9, 1e-3),
                "step_tolerance": usual(1e-9, 1e-3),
                "max_iterations": st.integers(1, 100),
            }
        ),
        "petsc": PETSC,
    },
)


@st.composite
def scenes(draw: Draw) -> dict[str, Any]:
    """Blocks of a valid scene, in which some numbers may be of any magnitude."""
    motions = [f"m{i}" for i in range(draw(st.integers(0, 2)))]
    blocks: dict[str, Any] = {
        "title": "fuzz",
        "mesh": draw(SOURCE),
        "material": draw(MATERIAL),
        "time": draw(TIME),
        "handles": draw(st.lists(_handle(motions), max_size=2)),
    }
    if motions:
        blocks["motions"] = {name: draw(_motion()) for name in motions}
    if draw(st.integers(0, 2)) == 0:
        names = ("one", "two")[: draw(st.integers(0, 2))]
        blocks["contact"] = draw(CONTACT)
        blocks["obstacles"] = {name: draw(_obstacle(motions)) for name in names}
    return blocks | draw(sometimes(2, {"gravity": vector(0.0, 10.0)})) | draw(SELDOM)


@st.composite
def mutated(draw: Draw) -> dict[str, Any]:
    """Blocks of a scene in which one to three entries are mutated."""
    blocks = deepcopy(draw(scenes()))  # scenes share some blocks
    for _ in range(draw(st.integers(1, 3))):
        paths = paths_of(blocks)
        if not paths:
            break
        *path, last = draw(st.sampled_from(paths))
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
        chosen.append(f"{draw(one_of(PATHS))}{equals}{emit(value)}".replace("\0", ""))
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
