"""The assembled system matrix: against differences of the residual, in every storage format."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from physics import CLOTH, Simulation, grid, rotation

from lyra_petsc.assembly.matrix import SystemMatrix

Array = NDArray[np.float64]

pytestmark = pytest.mark.parallel

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
    n = simulation.model.points.n_global
    x = simulation.x
    simulation.set_state(
        x=(x + rng.uniform(-0.04, 0.04, (n, 3))) @ rotation([1, 1, 0], 0.3).T, v=rng.uniform(-1, 1, (n, 3))
    )
    simulation.system.begin_step(0.0, DT)
    original = simulation.model.points.original
    iterate, direction = rng.uniform(-1, 1, (n, 3)), rng.uniform(-1, 1, (n, 3))
    return iterate[original], direction[original]


def residual(simulation: Simulation, v: Array) -> Array:
    system = simulation.system
    out = np.empty_like(v)
    system.residual(v, (v - system.v[: len(v)]) / DT, out)
    return out


def jacobian(simulation: Simulation, v: Array, blend: float) -> Array:
    system = simulation.system
    system.jacobian(v, blend, values := system._blocks.zeros())
    return values


def product(matrix: SystemMatrix, direction: Array) -> Array:
    x, y = matrix.mat.createVecs()
    x.setArray(direction.ravel())
    matrix.mat.mult(x, y)
    out = y.getArray().reshape(direction.shape).copy()
    x.destroy()
    y.destroy()
    return out


def largest(comm: MPI.Comm, values: Array) -> float:
    return float(comm.allreduce(float(np.abs(values).max(initial=0.0)), MPI.MAX))


@pytest.mark.parametrize("kind", ["aij", "baij", "sbaij"])
def test_matrix_is_the_derivative_of_the_residual(comm: MPI.Comm, kind: str) -> None:
    with Simulation(EVERYTHING, comm) as simulation:
        v, direction = bent_state(simulation)
        values = jacobian(simulation, v, 0.0)
        database = PETSc.Options()
        before = database.getString("mat_type", "")
        database.setValue("mat_type", kind)
        try:
            matrix = SystemMatrix(simulation.model.points, simulation.model.pattern, kind)
        finally:
            database.setValue("mat_type", before)
        matrix.set(values)
        assert matrix.kind == kind
        analytic = product(matrix, direction)
        # prescribed coordinates are decoupled in the matrix: move only the free ones for their rows
        free = ~simulation.system.prescribed.mask[: len(v)]
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


@pytest.mark.parametrize("blend", [0.0, 0.5, 1.0])
def test_formats_agree_and_the_matrix_is_symmetric(comm: MPI.Comm, blend: float) -> None:
    with Simulation(EVERYTHING, comm) as simulation:
        v, direction = bent_state(simulation)
        values = jacobian(simulation, v, blend)
        products = []
        database = PETSc.Options()
        before = database.getString("mat_type", "")
        for kind in ("aij", "baij", "sbaij"):
            database.setValue("mat_type", kind)
            matrix = SystemMatrix(simulation.model.points, simulation.model.pattern, kind)
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
        database.setValue("mat_type", before)
        scale = largest(comm, products[0])
        for other in products[1:]:
            assert largest(comm, other - products[0]) <= 1e-13 * scale


def test_residual_is_the_gradient_of_the_objective(comm: MPI.Comm) -> None:
    with Simulation(EVERYTHING, comm) as simulation:
        v, direction = bent_state(simulation)
        free = ~simulation.system.prescribed.mask[: len(v)]
        d = np.where(free, direction, 0.0)
        h = 1e-3

        def value(step: float) -> float:
            return simulation.system.objective(v + step * d)[0]

        numeric = (8.0 * (value(h) - value(-h)) - (value(2 * h) - value(-2 * h))) / (12.0 * h)
        slope = comm.allreduce(float(np.vdot(residual(simulation, v), d)))
        assert slope == pytest.approx(numeric, rel=1e-8)


def test_product_of_rows_needs_no_petsc(comm: MPI.Comm) -> None:
    with Simulation(EVERYTHING, comm) as simulation:
        v, direction = bent_state(simulation)
        values = jacobian(simulation, v, 0.0)
        simulation.stepper.matrix.set(values)
        points = simulation.model.points
        local = np.zeros((points.n_local, 3))
        local[: points.n_owned] = direction
        points.update_ghosts(local)
        by_rows = simulation.system._blocks.product(values, local)
        expected = product(simulation.stepper.matrix, direction)
        assert largest(comm, by_rows - expected) <= 1e-13 * largest(comm, expected)


@pytest.mark.parametrize("blend", [0.0, 0.5, 1.0])
def test_hessians_added_at_once_are_those_of_the_elements(comm: MPI.Comm, blend: float) -> None:
    with Simulation(EVERYTHING, comm) as simulation:
        bent_state(simulation)
        blocks, x = simulation.system._blocks, simulation.system.x
        before = x + 0.01 * np.cos(9.0 * x[:, ::-1])
        done = set()
        for term in simulation.system.elastic:
            term.linearise_from(before)
            weight = 1.0 + np.arange(term.n_elements)
            found, expected = blocks.zeros(), blocks.zeros()
            offsets = blocks.pattern.offsets
            if not term.add_hessians(x, blend, weight, offsets, found):
                assert not found.any()
                continue
            done.add(term.name)
            rows = term.offsets_of_elements(offsets)
            blocks.add(rows, lambda lo, hi, out, t=term: t.hessians(x, lo, hi, blend, out), weight, expected)
            np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-13 * np.abs(expected).max())
        assert done == {"membrane", "bending"}
