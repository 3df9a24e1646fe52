"""Frequencies of small motions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from oracle import blocks_of, expanded, summed

from lyra_petsc.errors import SolverError
from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.verification.flat_plates import lowest_modes, lowest_squares
from lyra_petsc.stepping.statics.stability import add_exact_hessian
from lyra_petsc.terms.term import Elastic

pytestmark = pytest.mark.parallel(2)

SHEET: dict[str, Any] = {
    "mesh": {"grid": {"width": 1.0, "height": 0.6, "nx": 4, "ny": 3}},
    "material": {"density": 0.2, "membrane": {"c11": 120, "c22": 80, "c12": 30, "c33": 25}, "bending": 0.1},
    "handles": [{"group": "left", "clamp": True}, {"nodes": [19], "axes": ["z"]}],
    "time": {"end": 1.0, "step": 1.0},
}


def dense(trial: Trial) -> np.ndarray[Any, np.dtype[np.float64]]:
    """All ω² of a simulation on one rank, from element Hessians summed here."""
    problem = trial.simulation.problem
    n = problem.points.n_owned
    stiffness = np.zeros((n, 3, n, 3))
    for term in problem.terms.values():
        if isinstance(term, Elastic):
            blocks = blocks_of(term, problem.equations.x, problem.equations.step.frozen[term])
            stiffness += summed(term.stencil, blocks, n)
    free = ~problem.equations.held.mask(0.0, 0.0, n).ravel()
    root = np.sqrt(np.repeat(problem.equations.mass, 3))[free]
    matrix = stiffness.reshape(3 * n, 3 * n)[np.ix_(free, free)] / np.outer(root, root)
    return np.linalg.eigvalsh(matrix)


@pytest.mark.parametrize("count", [1, 5, 30])
def test_frequencies_agree_with_a_dense_solver(comm: MPI.Comm, count: int) -> None:
    with Bench(MPI.COMM_SELF) as bench, bench.simulation(SHEET) as trial:
        exact = np.sqrt(dense(trial)[:count])
    with Bench(comm) as bench, bench.simulation(SHEET) as trial:
        frequencies, shapes = lowest_modes(trial, count)
        mass = trial.mass
    np.testing.assert_allclose(frequencies, exact, rtol=1e-9)
    inertia = np.einsum("avi,v,bvi->ab", shapes, mass, shapes)
    np.testing.assert_allclose(inertia, np.eye(count), rtol=0.0, atol=1e-9)
    assert np.abs(shapes[:, [0, 5, 10, 15]]).max() == 0.0  # the held edge


def test_massless_edges_are_condensed(comm: MPI.Comm) -> None:
    """Compared with a dense solver; a free sheet, whose rigid motions need a shift."""
    material = SHEET["material"] | {"bending_model": "midedge"}
    content = SHEET | {"material": material, "handles": [{"group": "sheet", "axes": ["x", "y"]}]}
    with Bench(MPI.COMM_SELF) as bench, bench.simulation(content) as trial:
        problem = trial.simulation.problem
        n, layout = problem.points.n_owned, problem.points
        values = problem.discretisation.rows.zeros()
        add_exact_hessian(problem.equations, values)
        matrix = expanded(problem.pattern, values, n).reshape(3 * n, 3 * n)
        heights, edges = 3 * np.arange(layout.n_vertices) + 2, layout.edge_indices
        across = matrix[np.ix_(heights, edges)]
        condensed = matrix[np.ix_(heights, heights)] - across @ np.linalg.solve(
            matrix[np.ix_(edges, edges)], across.T
        )
        root = np.sqrt(problem.equations.mass[: layout.n_vertices])
        exact = np.linalg.eigvalsh(condensed / np.outer(root, root))[:6]
    with Bench(comm) as bench, bench.simulation(content) as trial:
        squares, _ = lowest_squares(trial, 6, shift=10.0)
        frequencies, shapes = lowest_modes(trial, 6, shift=10.0)
    np.testing.assert_allclose(squares, exact, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(frequencies[:3], 0.0, rtol=0.0, atol=0.0)
    assert np.abs(shapes[:, :, :2]).max() == 0.0


def test_squared_frequencies_are_negative_beyond_the_critical_load(comm: MPI.Comm) -> None:
    with Bench(comm) as bench, bench.simulation(SHEET) as trial:
        trial.set_state(x=trial.start * [0.95, 1.0, 1.0])
        squares, _ = lowest_squares(trial, 1, shift=1e4)
        assert squares[0] < 0.0
        with pytest.raises(SolverError, match="no stable equilibrium"):
            lowest_modes(trial, 1, shift=1e4)
        with pytest.raises(SolverError, match="not positive definite"):
            lowest_modes(trial, 1)
