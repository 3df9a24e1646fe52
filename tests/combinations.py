"""Small scenes with each feature, and with several at once; a new feature is one more entry of `FEATURES`.

They are run with every integrator and both bending models, stopped and resumed on changing numbers of ranks
(``output/test_combinations.py``).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from physics import CLOTH, grid

from lyra_petsc.arrays import Array

SIDE = 0.2  # m
HELD = [{"group": "front/left"}]
DRAPE = CLOTH | {"bending": 1e-4, "damping": 0.005}


def panel(name: str, place: Sequence[float], n: int = 4, **turn: Any) -> dict[str, Any]:
    """A square sheet."""
    transform = {"translate": list(place)} | ({"rotate": turn} if turn else {})
    return grid(SIDE, SIDE, n, n, "alternating") | {"name": name, "transform": transform}


def beside(gap: float, n: int = 4) -> list[dict[str, Any]]:
    """Two panels next to each other, the second of ``n`` cells along its side."""
    return [panel("front", [-SIDE, 0, 0]), panel("back", [gap, 0, 0], n)]


def seam(**more: Any) -> dict[str, Any]:
    return {"between": ["front/right", "back/left"]} | more


FACES = {
    "floor": ([1, 0, 0], 0, [0, 0, 0]),
    "roof": ([1, 0, 0], 0, [0, 0, SIDE]),
    "west": ([0, 1, 0], -90, [0, 0, 0]),
    "east": ([0, 1, 0], -90, [SIDE, 0, 0]),
    "south": ([1, 0, 0], 90, [0, 0, 0]),
    "north": ([1, 0, 0], 90, [0, SIDE, 0]),
}
"""Sides of a box: axis and degrees of the rotation, and translation of a panel."""

EDGES = {
    **{f"{side}/left": f"west/{edge}" for side, edge in (("floor", "left"), ("roof", "right"))},
    **{f"{side}/right": f"east/{edge}" for side, edge in (("floor", "left"), ("roof", "right"))},
    **{f"{side}/bottom": f"south/{edge}" for side, edge in (("floor", "bottom"), ("roof", "top"))},
    **{f"{side}/top": f"north/{edge}" for side, edge in (("floor", "bottom"), ("roof", "top"))},
    "west/bottom": "south/left",
    "west/top": "north/left",
    "east/bottom": "south/right",
    "east/top": "north/right",
}


def box(at: float = 0.0) -> dict[str, Any]:
    """Six panels sewn to a box, standing at x = ``at`` on its held floor."""
    return {
        "mesh": [
            panel(name, np.add(place, [at, 0, 0]).tolist(), 2, axis=axis, degrees=degrees)
            for name, (axis, degrees, place) in FACES.items()
        ],
        "seams": [{"between": list(pair)} for pair in EDGES.items()],
        "handles": [{"group": "floor"}],
    }


BODY = {
    "obstacles": {
        "body": {"mesh": {"file": "body.obj", "frames": "body.npz"}, "interpolation": "linear"},
    },
    "contact": {"gap": 0.006, "friction": 0.3},
}
EDGE = [{"group": "front/left", "frames": "edge.npz"}]


def write_files(folder: Path) -> None:
    """The files that features name: an uneven surface below z = 0 that rises and slides by frames, and frames
    that lift the left edge of the panel ``front``.
    """
    side = np.linspace(-0.25, 0.45, 5)
    first = [5 * j + i for j, i in product(range(4), repeat=2)]
    faces = [t for a in first for t in ((a, a + 1, a + 6), (a, a + 6, a + 5))]
    start = np.array([(x, y, -0.05) for y, x in product(side, repeat=2)])
    times, heights = np.array([0.0, 0.03, 0.06, 0.1]), np.array([0.0, 0.03, 0.045, 0.05])
    frames = np.repeat(start[None], len(times), axis=0)
    frames[:, :, 2] += heights[:, None] * (0.6 + 0.4 * np.sin(7.0 * start[:, 0]))
    frames[:, :, 0] += 0.3 * times[:, None]
    rows = [f"v {x!r} {y!r} {z!r}" for x, y, z in start.tolist()]
    rows += ["f " + " ".join(str(vertex + 1) for vertex in face) for face in faces]
    (folder / "body.obj").write_text("\n".join(rows) + "\n")
    np.savez(folder / "body.npz", time=times, position=frames)
    edge: Array = np.array([(-SIDE, y, 0.0) for y in np.linspace(0.0, SIDE, 5)])
    lift = np.array([0.0, 0.004, 0.01, 0.0])[:, None, None] * [0.0, 0.0, 1.0]
    np.savez(folder / "edge.npz", time=np.array([0.0, 0.02, 0.05, 0.1]), position=edge + lift)


ONE = [panel("front", [-SIDE, 0, 0])]
CLOSING = {"from": 0.0, "until": 0.05}
YIELDING = DRAPE | {"yield_curvature": 1.0, "hardening": 0.1}
TEARING = {
    "from": {"group": "back/left"},
    "to": {"group": "front"},
    "stiffness": 60.0,
    "length": "start",
    "breaks_at": 0.1,
}
STRAP = {
    "from": {"point": [0.1, 0.1, 0.0]},
    "to": {"point": [-0.02, 0.13, 0.0], "group": "front"},
    "stiffness": 40.0,
    "length": 0.1,
}
FOLD = {"group": "front", "angle": [[0, 0], [0.05, 30], [1, 20]], "stiffness": 2e-4}
GAS = {"pressure": 5.0, "ambient": 1000.0, "amount": [[0, 1], [0.08, 1.02]]}

FEATURES: dict[str, dict[str, Any]] = {
    "frames of an obstacle": {"mesh": ONE, "handles": []} | BODY,
    "frames of a handle": {"mesh": ONE, "handles": EDGE},
    "closing seam": {"mesh": beside(0.01, 6), "seams": [seam(close=CLOSING)]},
    "soft seam": {"mesh": beside(0.0, 5), "seams": [seam(stiffness=2e3)]},
    "joined seam": {"mesh": beside(0.0), "seams": [seam()]},
    "attachments": {"mesh": beside(0.02, 5), "attachments": [TEARING, STRAP]},
    "gas": box() | {"loads": [{"gas": GAS}]},
    "liquid": box() | {"loads": [{"liquid": {"volume": [[0, 8.0e-3], [0.1, 8.2e-3]]}}]},
    "curves": {
        "mesh": ONE,
        "gravity": [[0, [0, 0, 0]], [0.025, [0, 1, -9.81]], [0.06, [0, 0, -3]]],
        "wind": {"velocity": [[0, [0, 0, 0]], [0.044, [1, 2, 1]]], "density": 1.2},
        "loads": [{"pressure": [[0, 0], [0.03, 5], [0.1, -5]]}],
    },
    "creases": {"mesh": ONE, "creases": [FOLD]},
    "yielding": {"mesh": ONE, "material": YIELDING},
    "untangled": {
        "mesh": [panel("front", [0, 0, 0]), panel("back", [0.02, 0.01, -4e-3], axis=[1, 0, 0], degrees=3)],
        "contact": {"gap": 4e-3, "untangle": True},
        "handles": [*HELD, {"group": "back/right"}],
    },
    "all": {
        "mesh": [*box(0.25)["mesh"], *beside(0.01)],
        "seams": [*box()["seams"], seam(close=CLOSING)],
        "attachments": [TEARING | {"from": {"group": "back/right"}, "to": {"group": "west"}}],
        "creases": [FOLD | {"group": "back"}],
        "loads": [{"gas": GAS | {"group": list(FACES)}}, {"pressure": [[0, 0], [0.05, 2]]}],
        "material": [YIELDING | {"group": "front"}, YIELDING | {"group": "back"}, DRAPE],
        "handles": EDGE,
    }
    | BODY,
}
"""Changes of a scene of one panel that is held at one side; files are those of `write_files`."""

EXCEPT = {
    ("frames of an obstacle", "static"),
    ("curves", "static"),
    ("all", "static"),
    ("liquid", "midpoint"),
    ("liquid", "static"),
}
"""Features without a path of equilibria: what falls, flutters, lands at once, or is slack, as the box
that is filled no more than at the start; and pumped liquid, to which ``midpoint`` gives energy."""


def scene_with(feature: dict[str, Any], integrator: str, model: str) -> dict[str, Any]:
    """The content of a scene of six or more steps; ``static`` is an integrator here."""
    scene = {"material": DRAPE, "gravity": [0, 0, -9.81], "handles": HELD} | feature
    materials = scene["material"] if isinstance(scene["material"], list) else [scene["material"]]
    scene["material"] = [material | {"bending_model": model} for material in materials]
    if integrator == "static":
        time: dict[str, Any] = {"analysis": "static", "step": 0.25}
        scene["gravity"] = [0, 0, -0.5]
    else:
        time = {"end": 0.06, "step": 0.01, "integrator": integrator}
    output = {"every": None, "reactions": True, "fields": ["velocity"]}
    return scene | {"time": time, "output": output}
