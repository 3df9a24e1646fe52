"""Flat sheets of hinges: effective bending stiffness, small deflections and frequencies.

In a flat sheet at rest deflections are not coupled to displacements in the plane. All data are gathered on
every rank, in mesh order.

The stiffness of an infinite strip or sheet follows from the hinges of one periodic cell: the deflection is a
quadratic function with the mean curvatures plus a periodic part; the minimum of the energy over the periodic
part, and over curvatures that are free, gives the effective stiffness.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.meshes import rectangle
from lyra_petsc.experiments.verification.flat_plates import (
    DENSITY,
    held,
    hinged_strip,
    lowest_modes,
    small_motions,
)
from lyra_petsc.experiments.verification.verification_case import (
    ASSEMBLED,
    Measured,
    grid,
    load_data,
    scene,
)
from lyra_petsc.terms.bending.hinge import Bending


@dataclass(frozen=True)
class PlateHinges:
    """The energy ½ (slopes · z)² of every hinge for the deflections z [m] of its vertices.

    Attributes
    ----------
    stencil : (E, 4) int64
        Vertices of each hinge in mesh numbering.
    slopes : (E, 4) float64
        ∂θ/∂z times the square root of the hinge stiffness, [√(N/m)].
    """

    stencil: Ints
    slopes: Array


def hinges_of(trial: Trial) -> PlateHinges:
    """All hinges of the bending term in the start shape; collective."""
    problem = trial.simulation.problem
    term = next(term for term in problem.terms.values() if isinstance(term, Bending))
    n = term.n_owned
    slopes = _slopes(problem.equations.x[term.stencil[:n], :2])
    slopes *= np.sqrt(2.0 * term.elements.data["k"][:n, None])
    mine = (term.elements.index[:n], problem.points.mesh_vertex_of_local()[term.stencil[:n]], slopes)
    index, stencil, slopes = map(np.concatenate, zip(*problem.points.comm.allgather(mine), strict=True))
    order = np.argsort(index)
    return PlateHinges(stencil[order], slopes[order])


def _slopes(corners: Array) -> Array:
    """∂θ/∂z (E, 4) [1/m] of flat hinges with corners (E, 4, 2) [m] as in ``terms.hinge``.

    At the opposite vertices it is −1 over their heights above the edge; the values at the ends of the edge
    follow from invariance under rigid rotations.
    """
    edge = corners[:, 1] - corners[:, 0]
    length = np.linalg.norm(edge, axis=1)
    slopes = np.zeros((len(corners), 4))
    for opposite in (2, 3):
        side = corners[:, opposite] - corners[:, 0]
        inverse = length / np.abs(edge[:, 0] * side[:, 1] - edge[:, 1] * side[:, 0])
        along = (side * edge).sum(axis=1) / length**2
        slopes[:, opposite] = -inverse
        slopes[:, 0] += (1.0 - along) * inverse
        slopes[:, 1] += along * inverse
    return slopes


def strip_stiffness(hinges: PlateHinges, points: Array, start: float, period: float, width: float) -> float:
    """B_effective [N·m] of a strip along x with free edges: moment per width over curvature.

    Lateral curvature, twist and deflections of the vertices are relaxed.

    Parameters
    ----------
    hinges : PlateHinges
    points : (V, 2) float64
        Vertices at rest [m].
    start, period : float [m]
        Start and length of the periodic cell, far enough from the ends of the strip.
    width : float [m]
    """
    x, y = points.T
    shapes = np.stack([0.5 * x**2, x * y], axis=1)
    lattice = np.array([[period], [0.0]])
    energy = _relaxed(hinges, points, shapes, np.linalg.pinv(lattice), np.array([start / period]))
    bent = energy[0, 0] - energy[0, 1] ** 2 / energy[1, 1]
    return float(bent / (period * width))


def sheet_stiffness(hinges: PlateHinges, points: Array, start: Sequence[float], lattice: Array) -> Array:
    """D (3, 3) [N·m] of an infinite sheet: energy per area ½ κᵀ D κ with κ = (κ11, κ22, 2 κ12).

    Parameters
    ----------
    hinges : PlateHinges
    points : (V, 2) float64
        Vertices at rest [m].
    start : (2,)
        Start of the cell in lattice coordinates.
    lattice : (2, 2) float64
        The two periods [m], as columns.
    """
    x, y = points.T
    shapes = np.stack([0.5 * x**2, 0.5 * y**2, 0.5 * x * y], axis=1)
    energy = _relaxed(hinges, points, shapes, np.linalg.inv(lattice), np.asarray(start))
    return energy / abs(float(np.linalg.det(lattice)))


def _relaxed(hinges: PlateHinges, points: Array, shapes: Array, to_cell: Array, start: Array) -> Array:
    """Quadratic form (m, m) of the energy of a cell in the amplitudes of ``shapes`` (V, m).

    ``to_cell`` (d, 2) maps positions to lattice coordinates.
    """
    # offset of the periodic cell over its size, such that no hinge lies on its border
    cell = points @ to_cell.T - start - 0.0917
    middle = 0.5 * (cell[hinges.stencil[:, 0]] + cell[hinges.stencil[:, 1]])
    inside = ((middle >= 0.0) & (middle < 1.0)).all(axis=1)
    stencil, slopes = hinges.stencil[inside], hinges.slopes[inside]
    # vertices that differ by a period have the same periodic part
    lattice = np.linalg.pinv(to_cell)
    folded = points - (np.floor(cell) @ lattice.T)
    _, kind = np.unique(np.round(folded, 9), axis=0, return_inverse=True)
    kind = kind.reshape(-1)
    n = int(kind.max()) + 1
    size = shapes.shape[1]
    rows = np.zeros((len(stencil), size + n))
    rows[:, :size] = np.einsum("ek,eks->es", slopes, shapes[stencil])
    np.add.at(rows, (np.arange(len(stencil))[:, None], size + kind[stencil]), slopes)
    form = rows.T @ rows
    coupling, periodic = form[:size, size:], form[size:, size:]
    return form[:size, :size] - coupling @ np.linalg.pinv(periodic, rcond=1e-9) @ coupling.T


PATTERNS = ("diagonal", "alternating", "criss-cross")


def _plate(mesh: dict[str, Any], **more: Any) -> dict[str, Any]:
    """A flat sheet with B = 1 N m."""
    material = {"density": 1.0, "membrane": {"c11": 1, "c22": 1, "c12": 0, "c33": 0.5}, "bending": 1.0}
    return scene(mesh, material, ASSEMBLED, **more)


# -- infinite strips and sheets --------------------------------------------------------------------------


def expected(pattern: str, ratio: float = 1.0) -> float:
    """B_effective / B of a strip with free edges, derived from the hinges of one cell.

    Single diagonals and alternating: (1 + r²)² / ((1 + r²)² + r⁴); criss-cross:
    2 / (1 + 4 r⁴ / (1 + r²)²), r the width of a cell over its length.
    """
    square = (1.0 + ratio**2) ** 2
    if pattern == "criss-cross":
        return 2.0 / (1.0 + 4.0 * ratio**4 / square)
    return square / (square + ratio**4)


def hinge_strip(bench: Bench, n: float) -> Iterator[Measured]:
    # width of a cell over its length along the strip
    ratios = {"square cells": 1.0, "cells twice as long as wide": 0.5, "cells twice as wide as long": 2.0}
    for label, ratio in ratios.items():
        for pattern in PATTERNS:
            with bench.simulation(_plate(grid(6.0, round(n) * ratio, 6, round(n), pattern))) as trial:
                hinges, points = hinges_of(trial), trial.x[:, :2]
            value = strip_stiffness(hinges, points, start=2.0, period=2.0, width=n * ratio)
            yield Measured(f"B_effective / B, {pattern}, {label}", value, expected(pattern, ratio))


def _lattice(mesh: str) -> Array:
    """Edge vectors [m] of the primitive cell, as columns."""
    return np.array([[1.0, -0.5], [0.0, np.sqrt(0.75)]]) if mesh == "equilateral" else np.eye(2)


def _equilateral(bench: Bench, cells: int) -> dict[str, Any]:
    """A rhombus of equilateral triangles with edges of 1 m."""
    vertices, triangles = rectangle(cells, cells, cells, cells, alternating=False)
    vertices[:, :2] = vertices[:, :2] @ _lattice("equilateral").T
    return bench.mesh(vertices, triangles)


def hinge_sheet(bench: Bench, n: float) -> Iterator[Measured]:
    for mesh, rows in load_data("hinge_sheet")["D_over_k"].items():
        cells = 8  # along each side
        block = (
            _equilateral(bench, cells) if mesh == "equilateral" else grid(cells, cells, cells, cells, mesh)
        )
        with bench.simulation(_plate(block)) as trial:
            hinges, points = hinges_of(trial), trial.x[:, :2]
        # k = B/6
        value = 6.0 * sheet_stiffness(hinges, points, (1.0 / n, 1.0 / n), n * _lattice(mesh))
        exact = np.array(rows)
        for i, j in ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2), (2, 2)):
            yield Measured(f"D{i + 1}{j + 1} / k, {mesh}", value[i, j], exact[i, j], scale=exact[0, 0])


# -- deflections and frequencies -------------------------------------------------------------------------


def heights(trial: Trial, force: Array) -> Array:
    """Deflections (V,) [m] of a flat sheet under small transverse forces (V,) [N]; collective."""
    return small_motions(trial).displacements(force[:, None] * [0.0, 0.0, 1.0])[:, 2]


def wide_strip(bench: Bench, n: float) -> Iterator[Measured]:
    """The clamp suppresses the lateral curvature that bending by hinges causes."""
    along = round(n)
    for across in (2, 4):
        for pattern in PATTERNS:
            mesh = grid(1.0, across / along, along, across, pattern)
            with bench.simulation(hinged_strip(pattern, n) | {"mesh": mesh}) as trial:
                height = heights(trial, trial.mass / DENSITY)
            tips = [row * (along + 1) + along for row in range(across + 1)]
            beam = 1.0 / (8.0 * expected(pattern))
            name = f"deflection over that with B_effective, {pattern}, {across} cells wide"
            yield Measured(name, float(height[tips].mean() / beam), 1.0)


PLATES, EXACT = load_data("hinge_plate"), load_data("linear_plate")["deflection"]


def square_plate(edges: str, pattern: str, n: int) -> dict[str, Any]:
    """A unit square with B = 1 and a weight of 1 N/m²."""
    return _plate(grid(1.0, 1.0, n, n, pattern), handles=held(edges))


def hinge_plate(bench: Bench, n: float) -> Iterator[Measured]:
    for edges, pattern, *errors in PLATES["rows"]:
        with bench.simulation(square_plate(edges, pattern, round(n))) as trial:
            height, points = heights(trial, trial.mass), trial.x[:, :2]
        # the deflection of plates that are supported all round does not depend on ν
        exact = EXACT.get(f"{edges} 0") or EXACT[f"{edges} 0.3"]
        at = int(np.argmin(np.linalg.norm(points - exact["place"], axis=1)))
        error = height[at] / exact["at"] - 1.0
        predicted = errors[(8, 16, 32, 64).index(round(n))]  # the columns of the table
        yield Measured(f"error of the deflection, {edges} {pattern}", error, predicted, scale=1.0)


def strip_vibration(bench: Bench, n: float) -> Iterator[Measured]:
    # roots of cos βL cosh βL = −1
    beta_l = (1.8751040687119611, 4.694091132974175, 7.854757438237613)
    for pattern in PATTERNS:
        across = hinged_strip(pattern, n)
        across["handles"].append({"group": "sheet", "axes": ["x", "y"]})
        with bench.simulation(across) as trial:
            omegas, _ = lowest_modes(trial, len(beta_l))
        for number, (omega, beta) in enumerate(zip(omegas, beta_l, strict=True), 1):
            exact = beta**2 * np.sqrt(expected(pattern) / DENSITY)
            yield Measured(f"ω{number}, {pattern}", float(omega), float(exact), "rad/s")
