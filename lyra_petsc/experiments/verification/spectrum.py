"""Natural frequencies from the assembled stiffness and the lumped masses, by subspace iteration.

Unknowns of edges have no mass: the iteration, which solves with the stiffness for forces of inertia, lets
them balance by themselves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.errors import SolverError
from lyra_petsc.experiments.bench import Trial, direct_solver
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.linear.matrix import AssembledMatrix
from lyra_petsc.terms.term import Elastic

Array = NDArray[np.float64]

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


def _first_vectors(trial: Trial, held: NDArray[np.bool_], count: int) -> Array:
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
