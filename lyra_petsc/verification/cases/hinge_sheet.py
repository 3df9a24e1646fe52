"""Homogenised bending stiffness of endless sheets of hinges."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.verification.bench import Bench, data
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Exact
from lyra_petsc.verification.flat_sheet import hinge_blocks
from lyra_petsc.verification.periodic_cell import sheet_stiffness

DATA = data("hinge_sheet")

CELLS = 8
"""Along each side of the meshes."""

ENTRIES = {"D11": (0, 0), "D22": (1, 1), "D12": (0, 1), "D13": (0, 2), "D23": (1, 2), "D33": (2, 2)}


def _lattice(mesh: str) -> NDArray[np.float64]:
    """Edge vectors [m] of the smallest cell, as columns."""
    if mesh == "equilateral":
        return np.array([[1.0, 0.5], [0.0, np.sqrt(0.75)]])
    return np.eye(2)


def _equilateral(bench: Bench) -> dict[str, Any]:
    """A rhombus of equilateral triangles with edges of 1 m."""
    column, row = np.meshgrid(np.arange(CELLS + 1), np.arange(CELLS + 1))
    at = np.stack([column.ravel(), row.ravel()]) * 1.0
    vertices = np.column_stack([(_lattice("equilateral") @ at).T, np.zeros(at.shape[1])])
    low = (row * (CELLS + 1) + column)[:-1, :-1].ravel()
    up = low + CELLS + 1
    triangles = np.concatenate(
        [np.stack([low, low + 1, up], axis=1), np.stack([low + 1, up + 1, up], axis=1)]
    )
    return bench.mesh(vertices, triangles)


def _scene(source: dict[str, Any]) -> dict[str, Any]:
    return {
        "mesh": source,
        "material": {"density": 1.0, "membrane": {"c11": 1, "c22": 1, "c12": 0, "c33": 0.5}, "bending": 1.0},
        "time": {"end": 1.0, "step": 1.0},
    }


def _measure(bench: Bench, n: float) -> Sequence[Measured]:
    found = []
    for mesh, wanted in DATA["D_over_k"].items():
        grid = {"width": CELLS, "height": CELLS, "nx": CELLS, "ny": CELLS, "pattern": mesh}
        source = _equilateral(bench) if mesh == "equilateral" else {"grid": grid}
        with bench.simulation(_scene(source)) as trial:
            hinges, points = hinge_blocks(trial), trial.x[:, :2]
        # k = B/6
        stiffness = 6.0 * sheet_stiffness(hinges, points, (1.0 / n, 1.0 / n), n * _lattice(mesh))
        exact = np.array(wanted)
        found += [
            Measured(f"{name} / k, {mesh}", stiffness[at], exact[at], scale=exact[0, 0])
            for name, at in ENTRIES.items()
        ]
    return found


CASE = Case(
    name="hinge-sheet",
    title="Bending stiffness of endless sheets, energy per area ½ κᵀDκ, κ = (κ11, κ22, 2κ12), over k = B/6",
    source=DATA["source"],
    resolutions=(2, 4, 6),
    measure=_measure,
    claim=Exact(1e-10),
    counts="cells in the period",
)
