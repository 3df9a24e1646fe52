"""The assembled Jacobian compared with differences of the residual, in every matrix type."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from oracle import blocks_of, expanded, summed
from physics import CLOTH, Simulation, grid, options, rotation

from lyra_petsc.arrays import Array
from lyra_petsc.linear.matrix import AssembledMatrix, BlockMatrix, Matrix
from lyra_petsc.terms.membrane import Membrane

pytestmark = [pytest.mark.parallel, pytest.mark.quick]

DT = 0.02

#: every term, a moving handle, a clamp, a spring, a handle on one axis
EVERYTHING: dict[str, Any] = {
    "mesh": grid(1.0, 0.8, 4, 3, "alternating"),
    "material": CLOTH | {"bending": [0.02, 0.01, 0.03], "damping": 0.05, "warp_degrees": 20.0},
    "gravity": [0.0, 0.0, -9.81],
    "wind": {"velocity": [1.0, 2.0, 4.0], "density": 1.2, "drag": 0.3},
    "handles": [
        {"nodes": [0, 5, 10, 15], "clamp": True, "motion": "turn"},
        {"nodes": [9], "axes": ["y"]},
        {"nodes": [19, 14], "stiffness": 200.0},
    ],
    "motions": {
        "turn": [
            {"time": 0},
            {"time": 1, "rotate": {"axis": [1, 0, 0], "degrees": 50}, "translate": [0.1, 0, 0]},
        ]
    },
    "loads": [{"pressure": 5.0}, {"nodes": [12], "force": [0.0, 1.0, 1.0]}],
}


def bent_state(simulation: Simulation) -> tuple[Array, Array]:
    """Set a state far from rest and begin a step; owned velocities of an iterate, and a direction."""
    rng = np.random.default_rng(11)
    n = simulation.problem.points.n_global
    x = simulation.x
    simulation.set_state(
        x=(x + rng.uniform(-0.04, 0.04, (n, 3))) @ rotation([1, 1, 0], 0.3).T, v=rng.uniform(-1, 1, (n, 3))
    )
    simulation.equations.begin_step(0.0, DT)
    original = simulation.problem.points.mesh_vertices
    iterate, direction = rng.uniform(-1, 1, (n, 3)), rng.uniform(-1, 1, (n, 3))
    return iterate[original], direction[original]


def residual(simulation: Simulation, v: Array) -> Array:
    return simulation.equations.residual_at(v)


def jacobian(simulation: Simulation, v: Array, convexity: float) -> Array:
    equations = simulation.equations
    equations.forces.jacobian(
        equations.linearised(v), convexity, values := equations.discretisation.rows.zeros()
    )
    return values


def matrix_of(simulation: Simulation, kind: str) -> Matrix:
    """An empty matrix of a PETSc type: ``python`` multiplies by our rows."""
    points, pattern = simulation.problem.points, simulation.problem.pattern
    if kind == "python":
        return BlockMatrix(points, pattern)
    with options({"mat_type": kind}):
        return AssembledMatrix(points, pattern, "aij")


def product(matrix: Matrix, direction: Array) -> Array:
    x, y = matrix.mat.createVecs()
    x.setArray(direction.ravel())
    matrix.mat.mult(x, y)
    out = y.getArray().reshape(direction.shape).copy()
    x.destroy()
    y.destroy()
    return out


def largest(comm: MPI.Comm, values: Array) -> float:
    return float(comm.allreduce(float(np.abs(values).max(initial=0.0)), MPI.MAX))


@pytest.mark.parametrize("kind", ["aij", "baij", "sbaij", "python"])
def test_matrix_is_the_derivative_of_the_residual(comm: MPI.Comm, kind: str) -> None:
    with Simulation(EVERYTHING, comm) as simulation:
        v, direction = bent_state(simulation)
        values = jacobian(simulation, v, 0.0)
        matrix = matrix_of(simulation, kind)
        matrix.set(values)
        assert matrix.kind == kind
        analytic = product(matrix, direction)
        # prescribed coordinates are decoupled in the matrix: move only the free ones for their rows
        free = ~simulation.equations.step.prescribed.mask[: len(v)]
        h = 1e-3
        d = np.where(free, direction, 0.0)
        numeric = (
            8.0 * (residual(simulation, v + h * d) - residual(simulation, v - h * d))
            - (residual(simulation, v + 2 * h * d) - residual(simulation, v - 2 * h * d))
        ) / (12.0 * h)
        scale = largest(comm, analytic)
        assert largest(comm, np.where(free, analytic - numeric, 0.0)) <= 1e-9 * scale
        # and each prescribed row is a positive number times its own coordinate
        row, own = analytic[~free], direction[~free]
        assert np.all(row * own > 0.0)
        assert comm.allreduce(int((~free).sum())) == 4 * 3 + 1
        matrix.destroy()


def test_formats_agree_and_the_matrix_is_symmetric(comm: MPI.Comm) -> None:
    with Simulation(EVERYTHING, comm) as simulation:
        v, direction = bent_state(simulation)
        values = jacobian(simulation, v, 0.5)
        products = []
        for kind in ("aij", "baij", "sbaij", "python"):
            matrix = matrix_of(simulation, kind)
            matrix.set(values)
            once = product(matrix, direction)
            matrix.set(values)  # setting again must replace, not add
            np.testing.assert_array_equal(product(matrix, direction), once)
            products.append(product(matrix, direction))
            if kind == "aij":
                other = np.cos(direction * 7.0)
                left = comm.allreduce(float(np.vdot(other, products[0])))
                right = comm.allreduce(float(np.vdot(product(matrix, other), direction)))
                assert left == pytest.approx(right, rel=1e-11)
            matrix.destroy()
        scale = largest(comm, products[0])
        for other in products[1:]:
            assert largest(comm, other - products[0]) <= 1e-13 * scale


def test_residual_is_the_gradient_of_the_objective(comm: MPI.Comm) -> None:
    with Simulation(EVERYTHING, comm) as simulation:
        v, direction = bent_state(simulation)
        free = ~simulation.equations.step.prescribed.mask[: len(v)]
        d = np.where(free, direction, 0.0)
        h = 1e-3

        def value(step: float) -> float:
            return simulation.equations.evaluate(v + step * d).objective[0]

        numeric = (8.0 * (value(h) - value(-h)) - (value(2 * h) - value(-2 * h))) / (12.0 * h)
        slope = comm.allreduce(float(np.vdot(residual(simulation, v), d)))
        assert slope == pytest.approx(numeric, rel=1e-8)


@pytest.mark.parametrize("convexity", [0.0, 0.5])
def test_block_rows_are_sums_of_element_hessians(comm: MPI.Comm, convexity: float) -> None:
    with Simulation(EVERYTHING, comm) as simulation:
        bent_state(simulation)
        equations = simulation.equations
        rows, x, n = equations.discretisation.rows, equations.x, simulation.problem.points.n_owned
        for term in equations.active.elastic:
            weight, frozen = 1.0 + np.arange(term.n_elements), equations.step.frozen[term]
            cases: list[tuple[Array, Array] | None] = [None]
            if isinstance(
                term, Membrane
            ):  # whose stress may be predicted from another iterate, or be another's
                y, z = x + 0.01 * np.cos(9.0 * x[:, ::-1]), x + 0.01 * np.sin(7.0 * x)
                cases += [(y, x), (y, y), (y, z)]
            for predicted in cases:
                rows.add_stiffness(term, x, frozen, convexity, weight, values := rows.zeros(), predicted)
                blocks = weight[:, None, None, None, None] * blocks_of(term, x, frozen, convexity, predicted)
                expected = summed(term.stencil, blocks, len(x))[:n]
                atol = 1e-13 * np.abs(blocks).max(initial=1.0)
                np.testing.assert_allclose(
                    expanded(rows.pattern, values, len(x)), expected, rtol=0.0, atol=atol
                )
        assert {term.name for term in equations.active.elastic} == {"membrane", "bending", "clamp", "spring"}
        for term in equations.active.viscous:
            frozen, v = equations.step.frozen[term], np.cos(5.0 * x)
            term.add_hessian(v, frozen, rows.pattern.offsets, values := rows.zeros())
            expected = summed(term.stencil, blocks := blocks_of(term, v, frozen), len(x))[:n]
            np.testing.assert_allclose(
                expanded(rows.pattern, values, len(x)), expected, rtol=0.0, atol=1e-13 * np.abs(blocks).max()
            )
