"""A scene fragment for every registered term, for the tests of the contract.

A new term needs an entry here; without one the contract test fails.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from physics import CLOTH, Simulation, obj_file

BENDING = CLOTH | {"bending": [2.0e-3, 1.0e-3, 3.0e-3], "damping": 0.02, "warp_degrees": 25.0}

TAUT = {"length": "start"}

FRAGMENTS: dict[str, dict[str, Any]] = {
    "membrane": {},
    "bending": {},
    "midedge": {"material": BENDING | {"bending_model": "midedge"}},
    "midedge_friction": {"material": BENDING | {"friction_moment": [3.0e-3, 1.0e-3]}},
    "hinge_plasticity": {"material": BENDING | {"yield_curvature": 0.8, "hardening": 0.2}},
    "midedge_plasticity": {
        "material": BENDING | {"bending_model": "midedge", "yield_curvature": 0.8, "hardening": 0.2}
    },
    "clamp_plasticity": {
        "material": BENDING | {"yield_curvature": 0.8, "hardening": 0.2},
        "handles": [{"nodes": [0, 1, 2, 3], "clamp": True}],
    },
    "stretch_limit": {"material": BENDING | {"stretch_limit": 1.8}},
    "shear_friction": {"material": BENDING | {"friction_force": 2.0}},
    "seam": {
        "mesh": [
            {"grid": {"width": 1.0, "height": 0.7, "nx": 2, "ny": 3}, "name": "front"},
            {
                "grid": {"width": 0.7, "height": 0.9, "nx": 2, "ny": 2},
                "name": "back",
                "transform": {"translate": [1.2, 0.1, 0.2]},
            },
        ],
        "seams": [{"between": ["front/right", "back/left"], "close": {"from": 1.0, "until": 2.0}}],
    },
    "seam_bending": {
        "mesh": [
            {"grid": {"width": 1.0, "height": 0.7, "nx": 2, "ny": 3}, "name": "front"},
            {
                "grid": {"width": 0.7, "height": 0.7, "nx": 2, "ny": 2},
                "name": "back",
                "transform": {"translate": [1.0, 0.0, 0.0]},
            },
        ],
        "seams": [{"between": ["front/right", "back/left"], "angle": "rest", "bending": 2.0e-3}],
    },
    "clamp": {"handles": [{"nodes": [0, 1, 2, 3], "clamp": True}]},
    "attachments": {
        "attachments": [
            {"from": {"nodes": [0]}, "to": {"nodes": [11]}, "stiffness": 60.0, "breaks_at": 1.0} | TAUT,
            {"from": {"nodes": [3, 4]}, "to": {"point": [0.1, 0.5, 0.2]}, "stiffness": 90.0} | TAUT,
        ]
    },
    "spring": {"handles": [{"nodes": [1, 5, 9], "stiffness": 300.0}, {"nodes": [9, 10], "stiffness": 50.0}]},
    "creases": {
        "creases": [{"group": "sheet", "angle": 40.0, "stiffness": 0.02}],
    },
    "chambers": {
        "loads": [
            {"gas": {"group": ["roof", "wall"], "pressure": 900.0, "ambient": 3000.0}},
            {"gas": {"group": ["floor", "wall"], "pressure": -40.0, "exponent": 1.0, "amount": 1.3}},
            {"liquid": {"group": ["roof", "floor"], "name": "both", "volume": 0.3}},
        ],
    },
    "gravity": {"gravity": [0.3, -1.0, -9.0]},
    "varying_gravity": {"gravity": [[0.0, [0.0, 0.0, 0.0]], [0.1, [0.3, -1.0, -9.0]]]},
    "wind": {"wind": {"velocity": [1.0, 2.0, -3.0], "density": 1.2, "drag": 0.4}},
    "pressure": {"loads": [{"pressure": 7.0}]},
    "force": {"loads": [{"nodes": [3, 4], "force": [1.0, 2.0, 3.0]}, {"traction": [0.0, 5.0, -1.0]}]},
    "moment": {
        "material": BENDING | {"bending_model": "midedge"},
        "loads": [{"group": "sheet", "moment": 2.0}],
    },
}

CLOSED = {"chambers"}
"""Terms on two tetrahedra with a common wall instead of the curved sheet."""

NX, NY = 3, 2


def curved_sheet(path: Path) -> dict[str, Any]:
    """A small cylindrical sheet whose rest shape is itself, its mesh irregular."""
    rng = np.random.default_rng(7)
    u, w = np.meshgrid(np.linspace(0.0, 1.0, NX + 1), np.linspace(0.0, 0.7, NY + 1))
    flat = np.column_stack([u.ravel(), w.ravel()]) + rng.uniform(-0.05, 0.05, (u.size, 2))
    radius = 0.8
    vertices = np.column_stack(
        [radius * np.sin(flat[:, 0] / radius), flat[:, 1], radius * (1.0 - np.cos(flat[:, 0] / radius))]
    )
    triangles = []
    for j in range(NY):
        for i in range(NX):
            a, b = j * (NX + 1) + i, (j + 1) * (NX + 1) + i
            triangles += [(a, a + 1, b + 1), (a, b + 1, b)]
    return obj_file(path, vertices, triangles)


def two_tetrahedra(path: Path) -> dict[str, Any]:
    """Two tetrahedra with a common wall, in groups; some normals point inwards."""
    vertices = [(0.0, 0.0, 0.0), (1.0, 0.1, 0.0), (0.2, 0.9, 0.1), (0.3, 0.4, 0.8), (0.4, 0.2, -0.9)]
    corners = [(1, 2, 4), (2, 3, 4), (3, 1, 4), (1, 2, 5), (3, 2, 5), (3, 1, 5), (1, 2, 3)]
    groups = ["roof"] * 3 + ["floor"] * 3 + ["wall"]
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    for group, triangle in zip(groups, corners, strict=True):
        lines += [f"g {group}", "f " + " ".join(map(str, triangle))]
    path.write_text("\n".join(lines) + "\n")
    return {"file": str(path)}


def example(name: str, folder: Path) -> Simulation:
    """The curved sheet with the term ``name`` active, on this process alone."""
    mesh = two_tetrahedra if name in CLOSED else curved_sheet
    content = {
        "mesh": mesh(folder / "sheet.obj") | {"name": "sheet"},
        "material": BENDING | ({"bending_model": "midedge"} if name in CLOSED else {}),
    } | FRAGMENTS[name]
    return Simulation(content, MPI.COMM_SELF)
