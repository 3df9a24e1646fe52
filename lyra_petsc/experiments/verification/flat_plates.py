"""Rectangles and strips, their meshes (patterns of grids, an irregular one, gmsh's), materials and
vibrations.

Strips one cell wide are cantilevers clamped at x = 0, of length 1 m with B = 1 N·m and c12 = 0, or hang
between two supports. One cell across keeps apart what a plate adds to a strip: wider strips resist with their
membrane against the lateral curvature that hinges give them.

Natural frequencies come from the assembled stiffness and the lumped masses, by subspace iteration. Unknowns
of edges have no mass: the iteration, which solves with the stiffness for forces of inertia, lets them balance
by themselves.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.errors import SolverError
from lyra_petsc.experiments.bench import Bench, Trial, direct_solver
from lyra_petsc.experiments.meshes import irregular_rectangle, rectangle, rectangle_script, sides
from lyra_petsc.experiments.verification.answers import grid, isotropic, scene
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.linear.matrix import AssembledMatrix
from lyra_petsc.terms.term import Elastic

KINDS = ("diagonal", "alternating", "criss-cross", "irregular", "gmsh")


def flat_mesh(
    bench: Bench, kind: str, nx: int, ny: int, width: float = 1.0, height: float = 1.0
) -> dict[str, Any]:
    """The mesh block of a rectangle of nx × ny cells with groups left, right, bottom, top; collective.

    gmsh's edges are as long as a cell along x, and it puts a vertex in the middle where ny is even.
    """
    if kind == "irregular":
        return bench.grouped(*irregular_rectangle(nx, ny, width, height), sides(nx, ny))
    if kind == "gmsh":
        middle = () if ny % 2 else (0.5 * width, 0.5 * height)
        return bench.script(rectangle_script(width, height, width / nx, middle))
    return grid(width, height, nx, ny, kind)


def strip_mesh(bench: Bench, kind: str, n: float, width: float, length: float = 1.0) -> dict[str, Any]:
    """The mesh block of a strip, n cells along; ``width`` over its length, 0 is one square cell; collective.

    Cells are as near to squares as the width allows.
    """
    across = max(1, round(width * n))
    return flat_mesh(bench, kind, round(n), across, length, (width or 1.0 / n) * length)


def plate_material(membrane: float, stiffness: float = 1.0, poisson: float = 0.0) -> dict[str, Any]:
    """Material of 1 kg/m²: c11 [N/m] and the plate stiffness D [N·m], both with ``poisson``; directors."""
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
"""C L²/B: as of a strip with a thickness of 0.0035 L. The exact shapes take its stretch into account."""

DENSITY = 1.0
"""kg/m²"""


def strip(pattern: str, n: float, membrane: float = MEMBRANE, **more: Any) -> dict[str, Any]:
    """A scene: n square cells along the strip, its end clamped, static.

    ``more`` are further keys of the scene; ``material`` is added to.
    """
    along = round(n)
    material = {"density": DENSITY, "membrane": isotropic(membrane), "bending": 1.0}
    held = [{"group": "left", "clamp": True}]
    mesh = grid(1.0, 1.0 / along, along, 1, pattern)
    return scene(mesh, material | more.pop("material", {}), handles=held, **more)


LENGTH, WIDTH, STIFFNESS, G = 1.0, 0.1, 1000.0, 9.81
"""m, m, N/m, m/s²"""


def arc(s: Array, span: float) -> Array:
    """Points (n, 2) [m] at arc lengths s of a sagging circular arc of length 1 over a chord ``span``."""
    if span >= LENGTH:
        return np.column_stack([s, 0.0 * s])
    # chord = 2 R sin(L/2R): the half angle by bisection
    low, high = 1e-9, math.pi
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if math.sin(middle) / middle > span / LENGTH else (low, middle)
    radius = 0.5 * LENGTH / low
    angle = s / radius - low
    return radius * np.column_stack([np.sin(angle) + math.sin(low), math.cos(low) - np.cos(angle)])


def hung(bench: Bench, n: int, e: float, dx: float, dz: float) -> dict[str, Any]:
    """The scene: supports (dx, dz) [m] apart, weight e times c11, n cells; static.

    Nothing in it knows the catenary: the strip starts from an arc of a circle between the supports.
    """
    # all inner vertices of a diagonal grid have the same mass, so that the edges hang alike
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


MORE_VECTORS = 8
"""Vectors beside those asked for: the more, the fewer iterations."""

MAX_ITERATIONS = 200
TOLERANCE = 1e-11
"""Relative change of the squared frequencies at which the iteration ends."""

ROUND_OFF = 1e-6
"""Square over the shift below which a frequency is called zero."""


def lowest_modes(trial: Trial, count: int, shift: float = 0.0) -> tuple[Array, Array]:
    """Lowest natural frequencies and their shapes about the present state; collective.

    As `lowest_squares`.

    Returns
    -------
    frequencies : (count,) float64
        ω [rad/s], ascending; 0 for squares within round-off of 0.
    shapes : (count, V, 3) float64
        In mesh order, φᵀMφ = 1.

    Raises
    ------
    SolverError
        If the iteration does not converge, or the state is unstable.
    """
    squares, shapes = lowest_squares(trial, count, shift)
    squares[np.abs(squares) < ROUND_OFF * shift] = 0.0
    if squares[0] < 0.0:
        raise SolverError("no stable equilibrium: a squared frequency is not positive", collective=True)
    return np.sqrt(squares), shapes


def lowest_squares(trial: Trial, count: int, shift: float = 0.0) -> tuple[Array, Array]:
    """Lowest squared natural frequencies and their shapes about the present state; collective.

    Handles hold what they prescribe at the present time. The state is taken to be an equilibrium.

    Parameters
    ----------
    trial : Trial
    count : int
        How many.
    shift : float [1/s²]
        K + shift · M is factored, which must be positive definite: for what moves without a force.

    Returns
    -------
    squares : (count,) float64
        ω² [1/s²], ascending; negative where the state is unstable.
    shapes : (count, V, 3) float64
        In mesh order, φᵀMφ = 1.

    Raises
    ------
    SolverError
        If the iteration does not converge, or K + shift · M is not positive definite.
    """
    problem = trial.simulation.problem
    system, points = problem.system, problem.points
    rows, n = BlockRows(problem.pattern), points.n_owned
    values = rows.zeros()
    for term in problem.terms.values():
        if isinstance(term, Elastic):
            rows.add_stiffness(term, system.x, system.active.frozen[term], 0.0, 1.0, values)
    held = np.zeros((points.n_local, 3))
    held[:n] = system.held.mask(trial.simulation.time, trial.simulation.time, n)
    held.ravel()[points.padding] = 1.0
    points.update_ghosts(held)
    mask = held > 0.5
    rows.add_diagonal(shift * system.mass, values)
    rows.constrain(values, mask, rows.beside(mask))
    matrix = AssembledMatrix(points, problem.pattern, "aij")
    matrix.set(values)
    solver = direct_solver(points.comm, matrix.mat, "verify_modes_")
    mass = np.where(mask[:n], 0.0, system.mass[:, None]).ravel()
    try:
        first = _first_vectors(trial, mask[: points.n_vertices], count)
        squares, vectors = _subspace_iteration(solver, mass, first, count)
    finally:
        solver.destroy()
        matrix.destroy()
    shapes = [trial.gather(np.ascontiguousarray(vector).reshape(n, 3)) for vector in vectors.T]
    return squares - shift, np.array(shapes)


def _first_vectors(trial: Trial, held: Mask, count: int) -> Array:
    """Random vectors (3 n_owned, m), the same on any number of ranks; zero where held, and on edges.

    ``held`` is of the vertices (n_vertices, 3).
    """
    points = trial.simulation.problem.points
    n_free = points.comm.allreduce(int(np.sum(~held)))
    m = min(2 * count + MORE_VECTORS, n_free)
    random = np.random.default_rng(0).standard_normal((points.n_vertices_global, 3, m))[points.original]
    first = np.zeros((points.n_owned, 3, m))
    first[: points.n_vertices] = np.where(held[:, :, None], 0.0, random)
    return first.reshape(-1, m)


def _subspace_iteration(solver: PETSc.KSP, mass: Array, x: Array, count: int) -> tuple[Array, Array]:
    """Lowest eigenvalues (count,) of K φ = λ M φ and this rank's rows of the vectors.

    Source: K.-J. Bathe, Finite Element Procedures, 1996, section 11.6.
    """
    comm = solver.getComm().tompi4py()
    right, left = solver.getOperators()[0].createVecs()
    before = np.full(count, np.inf)
    for _ in range(MAX_ITERATIONS):
        mx = mass[:, None] * x
        y = np.empty_like(x)
        for k in range(x.shape[1]):
            right.setArray(mx[:, k])
            solver.solve(right, left)
            if solver.getConvergedReason() < 0:
                raise SolverError("the stiffness of the state cannot be factored", collective=True)
            y[:, k] = left.getArray(readonly=True)
        stiffness = comm.allreduce(y.T @ mx)
        inertia = comm.allreduce(y.T @ (mass[:, None] * y))
        squares, combination = _small_problem(stiffness, inertia)
        x = y @ combination
        if np.all(np.abs(squares[:count] - before) <= TOLERANCE * np.abs(squares[:count])):
            break
        before = squares[:count]
    else:
        raise SolverError(f"{count} modes not found in {MAX_ITERATIONS} subspace iterations", collective=True)
    right.destroy()
    left.destroy()
    if not squares[0] > 0.0:
        raise SolverError("the stiffness of the state is not positive definite", collective=True)
    return squares[:count], x[:, :count]


def _small_problem(stiffness: Array, inertia: Array) -> tuple[Array, Array]:
    """All eigenpairs of a small symmetric pencil, eigenvalues ascending, vectors of unit inertia."""
    try:
        factor = np.linalg.inv(np.linalg.cholesky(0.5 * (inertia + inertia.T)))
    except np.linalg.LinAlgError:
        # the same numbers on all ranks
        raise SolverError(
            "subspace iteration lost the independence of its vectors", collective=True
        ) from None
    squares, vectors = np.linalg.eigh(factor @ (0.5 * (stiffness + stiffness.T)) @ factor.T)
    return squares, factor.T @ vectors
