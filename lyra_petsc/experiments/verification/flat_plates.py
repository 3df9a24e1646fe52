"""Plates and strips: meshes (patterns of grids, irregular, gmsh), materials, small vibrations.

Strips one cell wide are cantilevers of length 1 m, clamped at x = 0, with B = 1 N·m and c12 = 0, or hang
between two supports. In wider strips the membrane resists the lateral curvature that hinges cause, which is
an effect of plates that one cell across excludes.

Natural frequencies follow from the assembled stiffness and the lumped masses by Lanczos iterations with the
shifted and inverted stiffness. Unknowns on edges have no mass.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import SolverError
from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.meshes import SIDES, irregular_rectangle, rectangle, rectangle_script, side_edges
from lyra_petsc.experiments.verification.verification_case import G, grid, isotropic, scene
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.linear.matrix import AssembledMatrix
from lyra_petsc.parallel import on_root
from lyra_petsc.terms.term import Elastic

KINDS = ("diagonal", "alternating", "criss-cross", "irregular", "gmsh")


HELD = {"CCCC": (True, SIDES), "SSSS": (False, SIDES), "CFFF": (True, ("left",)), "FFFF": (True, ())}
"""Whether the named edges of a plate are clamped (C) or supported (S); the other edges are free (F)."""


def held(edges: str) -> list[dict[str, Any]]:
    """The handles of a plate with the boundary conditions ``edges``, a key of `HELD`."""
    clamp, clamped = HELD[edges]
    return [{"group": side, "clamp": clamp} for side in clamped]


def flat_mesh(
    bench: Bench, kind: str, nx: int, ny: int, width: float = 1.0, height: float = 1.0
) -> dict[str, Any]:
    """The mesh block of a rectangle of nx × ny cells with groups left, right, bottom, top; collective.

    Edges of gmsh's mesh are as long as a cell along x; it has a vertex in the middle if ny is even.
    """
    if kind == "irregular":
        return bench.grouped_mesh(*irregular_rectangle(nx, ny, width, height), side_edges(nx, ny))
    if kind == "gmsh":
        middle = () if ny % 2 else (0.5 * width, 0.5 * height)
        return bench.gmsh_mesh(rectangle_script(width, height, width / nx, middle))
    return grid(width, height, nx, ny, kind)


def strip_mesh(bench: Bench, kind: str, n: float, width: float, length: float = 1.0) -> dict[str, Any]:
    """The mesh block of a strip with n cells along it; collective.

    ``width`` is relative to the length; 0 means one square cell. Cells are nearly square.
    """
    across = max(1, round(width * n))
    return flat_mesh(bench, kind, round(n), across, length, (width or 1.0 / n) * length)


def plate_material(membrane: float, stiffness: float = 1.0, poisson: float = 0.0) -> dict[str, Any]:
    """Material of 1 kg/m² with directors: c11 [N/m] and plate stiffness D [N·m], both with ``poisson``."""
    return {
        "density": 1.0,
        "membrane": isotropic(membrane, poisson),
        "bending_model": "midedge",
        "bending": {
            "d11": stiffness,
            "d22": stiffness,
            "d12": poisson * stiffness,
            "d33": 0.5 * (1.0 - poisson) * stiffness,
        },
    }


MEMBRANE = 1e6
"""C L²/B, as of a strip of thickness 0.0035 L. The exact shapes take its stretch into account."""

DENSITY = 1.0
"""kg/m²"""


def hinged_strip(pattern: str, n: float, membrane: float = MEMBRANE, **more: Any) -> dict[str, Any]:
    """Static scene of a strip with n square cells along it, clamped at one end.

    ``more`` are further keys of the scene; entries of ``material`` are added.
    """
    along = round(n)
    material = {"density": DENSITY, "membrane": isotropic(membrane), "bending": 1.0}
    held = [{"group": "left", "clamp": True}]
    mesh = grid(1.0, 1.0 / along, along, 1, pattern)
    return scene(mesh, material | more.pop("material", {}), handles=held, **more)


LENGTH, WIDTH, STIFFNESS = 1.0, 0.1, 1000.0
"""Length [m], width [m], membrane stiffness [N/m] of hanging strips"""


def arc(s: Array, span: float) -> Array:
    """Points (n, 2) [m] at arc lengths s of a sagging circular arc of length 1 over a chord ``span``."""
    if span >= LENGTH:
        return np.column_stack([s, 0.0 * s])
    from scipy.optimize import brentq

    # chord = 2 R sin(L/2R), by the half angle L/2R
    half = brentq(lambda angle: math.sin(angle) / angle - span / LENGTH, 1e-9, math.pi, xtol=1e-15)
    radius = 0.5 * LENGTH / half
    angle = s / radius - half
    return radius * np.column_stack([np.sin(angle) + math.sin(half), math.cos(half) - np.cos(angle)])


def hung(bench: Bench, n: int, e: float, dx: float, dz: float) -> dict[str, Any]:
    """Static scene of a strip between two supports at distance (dx, dz) [m]; weight e × c11, n cells.

    The strip starts from a circular arc between the supports, independent of the catenary.
    """
    # all inner vertices of a diagonal grid have the same mass, so that both edges hang equally
    vertices, triangles = rectangle(n, 1, LENGTH, WIDTH, alternating=False)
    chord = math.hypot(dx, dz)
    along = arc(vertices[:, 0], chord)
    cos, sin = dx / chord, dz / chord
    start = np.column_stack(
        [cos * along[:, 0] - sin * along[:, 1], vertices[:, 1], sin * along[:, 0] + cos * along[:, 1]]
    )
    mesh = bench.mesh(start, triangles, rest=vertices[:, :2])
    material = {"density": e * STIFFNESS / (G * LENGTH), "membrane": isotropic(STIFFNESS)}
    held = [{"nodes": [0, n, n + 1, 2 * n + 1]}, {"box": [[-9, -9, -9], [9, 9, 9]], "axes": ["y"]}]
    return scene(mesh, material, gravity=[0, 0, -G], handles=held)


@dataclass(frozen=True)
class SmallMotions:
    """Stiffness and mass matrices of a sheet in its present state, the same on every rank.

    Attributes
    ----------
    stiffness : (n, n) scipy.sparse.csr_array
        Stiffness [N/m] of the coordinates of vertices and the unknowns of edges.
    mass : (n,) float64
        Masses [kg]; 0 for unknowns of edges.
    free : (n,) int64
        Unknowns that no handle prescribes at the present time.
    vertices : (V, 3) int64
        The unknowns of each vertex, in mesh order.
    """

    stiffness: Any
    mass: Array
    free: Ints
    vertices: Ints

    @property
    def stiffness_of_free(self) -> Any:
        """Stiffness of the free unknowns, (m, m), in csc format."""
        return self.stiffness[self.free][:, self.free].tocsc()

    def displacements(self, force: Array) -> Array:
        """Displacements (V, 3) [m] under small forces (V, 3) [N]."""
        from scipy.sparse.linalg import spsolve

        forces, unknowns = np.zeros((2, len(self.mass)))
        forces[self.vertices] = force
        unknowns[self.free] = spsolve(self.stiffness_of_free, forces[self.free])
        return unknowns[self.vertices]


def small_motions(trial: Trial) -> SmallMotions:
    """Stiffness of all elastic terms and masses in the present state; collective."""
    from scipy.sparse import csr_array, vstack

    problem = trial.simulation.problem
    equations, points = problem.equations, problem.points
    rows, n = BlockRows(problem.pattern), points.n_owned
    values = rows.zeros()
    for term in problem.terms.values():
        if isinstance(term, Elastic):
            rows.add_stiffness(term, equations.x, equations.step.frozen[term], 0.0, 1.0, values)
    matrix = AssembledMatrix(points, problem.pattern, "aij", prefix="verify_")
    matrix.set(values)
    mine = csr_array(matrix.mat.getValuesCSR()[::-1], shape=(3 * n, 3 * points.n_global))
    matrix.destroy()
    free = ~equations.held.mask(trial.simulation.time, trial.simulation.time, n).ravel()
    free[points.padding] = False
    owned = mine, np.repeat(equations.mass, 3), free, points.mesh_vertices
    stiffness, mass, are_free, original = zip(*points.comm.allgather(owned), strict=True)
    vertices = np.empty((points.n_vertices_global, 3), dtype=np.int64)
    for first, numbers in zip(points.bounds, original, strict=False):
        vertices[numbers] = 3 * (first + np.arange(len(numbers)))[:, None] + np.arange(3)
    return SmallMotions(
        vstack(stiffness, "csr"), np.concatenate(mass), np.flatnonzero(np.concatenate(are_free)), vertices
    )


def lowest_modes(trial: Trial, count: int, shift: float = 0.0) -> tuple[Array, Array]:
    """Lowest natural frequencies and their shapes about the present state; collective.

    As `lowest_squares`.

    Returns
    -------
    frequencies : (count,) float64
        ω [rad/s], ascending; 0 for squares within round-off of 0.
    shapes : (count, V, 3) float64
        Modes φ in mesh order, with φᵀMφ = 1.

    Raises
    ------
    SolverError
        If the iteration does not converge, or the state is unstable.
    """
    squares, shapes = lowest_squares(trial, count, shift)
    # squared frequency over the shift below which a frequency counts as zero
    squares[np.abs(squares) < 1e-6 * shift] = 0.0
    if squares[0] < 0.0:
        raise SolverError("no stable equilibrium: a squared frequency is not positive", collective=True)
    return np.sqrt(squares), shapes


def lowest_squares(trial: Trial, count: int, shift: float = 0.0) -> tuple[Array, Array]:
    """Lowest squared natural frequencies and their shapes about the present state; collective.

    Handles fix what they prescribe at the present time. The state must be an equilibrium.

    Parameters
    ----------
    trial : Trial
    count : int
        Number of modes.
    shift : float [1/s²]
        K + shift · M is factored and must be positive definite, which rigid-body modes require.

    Returns
    -------
    squares : (count,) float64
        ω² [1/s²], ascending; negative where the state is unstable.
    shapes : (count, V, 3) float64
        Modes φ in mesh order, with φᵀMφ = 1.

    Raises
    ------
    SolverError
        If the iteration does not converge, or K + shift · M is not positive definite.
    """
    motions = small_motions(trial)
    comm = trial.simulation.comm
    squares, vectors = on_root(comm, lambda: _lowest(motions, count, shift))
    shapes = np.zeros((count, len(motions.mass)))
    shapes[:, motions.free] = vectors.T
    return squares, shapes[:, motions.vertices]


def _lowest(motions: SmallMotions, count: int, shift: float) -> tuple[Array, Array]:
    """Lowest eigenvalues (count,) of K φ = λ M φ of the free unknowns, and the vectors (m, count)."""
    from scipy.sparse import diags
    from scipy.sparse.linalg import ArpackError, eigsh

    stiffness, mass = motions.stiffness_of_free, motions.mass[motions.free]
    inertia = diags(mass, format="csc")
    rank = np.count_nonzero(mass)
    # additional eigenvectors: the mode of an unstable state may be farther from the shift than stable modes
    more = min(count + 8, rank - 1)
    first = np.random.default_rng(0).standard_normal(len(mass))  # reproducible
    try:
        squares, vectors = eigsh(
            stiffness, more, inertia, sigma=-shift, v0=first, ncv=min(2 * more + 1, rank)
        )
    except (ArpackError, RuntimeError) as error:
        raise SolverError(f"{count} modes not found: {error}", collective=True) from None
    order = np.argsort(squares)[:count]
    if not squares[order[0]] > -shift:
        raise SolverError("the stiffness of the state is not positive definite", collective=True)
    return squares[order], vectors[:, order]
