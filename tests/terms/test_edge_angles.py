"""Unknowns on edges, with a term of the tests that equals a plain hinge in equilibrium."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from edge_angle_term import IN_PLACE_OF_HINGES
from mpi4py import MPI
from physics import CLOTH, SOLVERS, end_on_one_rank, finished, grid, rotation, scene_of, shape

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.terms import registry
from lyra_petsc.terms.term import Elastic

pytestmark = pytest.mark.parallel

SCENE: dict[str, Any] = {
    "mesh": grid(0.6, 0.4, 5, 4, "alternating"),
    "material": CLOTH | {"bending": 2e-2},
    "gravity": [0, 0, -9.81],
    "handles": [{"box": [[-1, -1, -1], [0.01, 1, 1]]}],
}
STEPS = {"end": 0.08, "step": 0.01}
TIGHT = {"force_tolerance": 1e-10, "step_tolerance": 1e-10}
INTEGRATORS = ("beuler", "midpoint", "bdf2", "alpha2")


@pytest.fixture
def on_edges(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Use the term of the tests for bending."""
    with monkeypatch.context() as patch:
        patch.setattr(registry, "REGISTRY", IN_PLACE_OF_HINGES)
        yield


def outcome(comm: MPI.Comm, scene: dict[str, Any], **petsc: Any) -> tuple[Array, Array, Array, int]:
    """Positions in mesh order, energies, reactions, and unknowns of edges after a whole run."""
    with finished(comm, SCENE | {"solver": TIGHT} | scene, **petsc) as simulation:
        budget, layout = simulation.budget, simulation.problem.points
        bending = budget.bending + budget.more.get("angle_energy", 0.0)
        energies = np.array([budget.kinetic, budget.membrane, bending, budget.potential])
        reactions = np.array(simulation.energy_balance.handle_forces(1))
        return shape(simulation), energies, reactions, layout.n_edges_global


def compare(comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch, scene: dict[str, Any], **petsc: Any) -> None:
    """Compare a run with unknowns on edges to one with plain hinges."""
    x, energies, reactions, edges = outcome(comm, scene)
    assert edges == 0
    with monkeypatch.context() as patch:
        patch.setattr(registry, "REGISTRY", IN_PLACE_OF_HINGES)
        same = outcome(comm, scene, **petsc)
    assert same[3] == 5 * 3 + 4 * 4 + 5 * 4  # interior edges: across, along, diagonal
    np.testing.assert_allclose(same[0], x, rtol=0.0, atol=2e-8)
    np.testing.assert_allclose(same[1], energies, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(same[2], reactions, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_motion_is_that_of_plain_hinges(
    comm: MPI.Comm, integrator: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    compare(comm, monkeypatch, {"time": STEPS | {"integrator": integrator}})


def test_the_equilibrium_is_that_of_plain_hinges(comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch) -> None:
    compare(comm, monkeypatch, {"time": {"analysis": "static", "end": 1.0, "step": 0.25}})


def test_one_linear_solve_a_step(comm: MPI.Comm, on_edges: None) -> None:
    time = {"end": 0.01, "step": 1e-3, "integrator": "semi-implicit"}
    x, energies, _, edges = outcome(comm, {"time": time}, ksp_rtol=1e-10)
    exact = outcome(comm, {"time": time | {"integrator": "beuler"}})
    assert edges > 0
    np.testing.assert_allclose(x, exact[0], rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(energies[2], exact[1][2], rtol=0.05)


@pytest.mark.parametrize("integrator", ["beuler", "alpha2"])
def test_adaptive_steps(comm: MPI.Comm, integrator: str, monkeypatch: pytest.MonkeyPatch) -> None:
    time = {"end": 0.05, "step": "auto", "tolerance": 5e-3, "integrator": integrator}
    compare(comm, monkeypatch, {"time": time})


ALL_SOLVERS = SOLVERS | {"assembled operator": {"pc_type": "pbjacobi", "mat_type": "baij"}}


@pytest.mark.parametrize("name", ALL_SOLVERS)
def test_every_linear_solver_works(comm: MPI.Comm, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    compare(comm, monkeypatch, {"time": STEPS | {"end": 0.03}}, ksp_rtol=1e-8, **ALL_SOLVERS[name])


def test_energy_identity_of_backward_euler(comm: MPI.Comm, on_edges: None) -> None:
    """Δ(kinetic + potential) = −½‖Δv‖² + E(x₁) − E(x₀) − ∇E(x₁)·Δx, of vertices and edges."""
    simulation = SteppedScene(comm, scene_of(SCENE | {"time": STEPS, "solver": TIGHT}))
    system = simulation.problem.system
    n, elastic = system.points.n_owned, system.active.elastic

    def energy(x: Array) -> float:
        return sum(float(term.energies(x, system.active.frozen[term]).sum()) for term in elastic)

    for _ in range(4):
        x0, v0, before = system.x.copy(), system.v.copy(), simulation.budget.total
        simulation.step()
        gradient = np.zeros_like(system.x)
        for term in elastic:
            term.add_gradient(system.x, system.active.frozen[term], gradient)
        lost = 0.5 * np.sum(system.mass[:, None] * (system.v[:n] - v0[:n]) ** 2)
        bracket = energy(system.x) - energy(x0) - np.vdot(gradient[:n], (system.x - x0)[:n])
        expected = comm.allreduce(float(bracket - lost))
        assert simulation.budget.total - before == pytest.approx(expected, abs=1e-10)
        # a moment on no edge, and none of them has moved by chance
        of_edges = gradient[:n].ravel()[system.points.edge_indices]
        assert comm.allreduce(float(np.abs(of_edges).max(initial=0.0)), MPI.MAX) < 1e-8
        angles = system.x[:n].ravel()[system.points.edge_indices]
        assert comm.allreduce(float(np.abs(angles).max(initial=0.0)), MPI.MAX) > 1e-5
    simulation.destroy()


def test_derivatives_agree_with_finite_differences(comm: MPI.Comm, on_edges: None) -> None:
    """Gradient and Hessian against differences, with both kinds of unknowns, in the assembled matrix."""
    simulation = SteppedScene(comm, scene_of(SCENE | {"time": STEPS}))
    system, layout = simulation.problem.system, simulation.problem.points
    term = simulation.problem.terms["edge-angle"]
    assert isinstance(term, Elastic)
    turn = rotation([1.0, 2.0, 0.5], 0.9)

    def local(seed: int, size: float) -> Array:
        random = np.random.default_rng(seed)
        on_vertices = size * random.uniform(-1, 1, (layout.n_vertices_global, 3))[layout.mesh_vertices]
        on_edges = size * random.uniform(-1, 1, layout.n_edges_global)[layout.edges]
        out = np.zeros((layout.n_local, 3))
        out[: layout.n_owned] = layout.join(on_vertices, on_edges)
        layout.update_ghosts(out)
        return out

    x, direction = system.x @ turn.T + local(1, 0.02), local(2, 1.0)

    def energy(at: Array) -> float:
        return float(comm.allreduce(float(term.energies(at, None).sum())))

    def gradient(at: Array) -> Array:
        out = np.zeros_like(at)
        term.add_gradient(at, None, out)
        return out[: layout.n_owned]

    h = 1e-4
    slope = comm.allreduce(float(np.vdot(gradient(x), direction[: layout.n_owned])))
    numeric = (
        8 * (energy(x + h * direction) - energy(x - h * direction))
        - energy(x + 2 * h * direction)
        + energy(x - 2 * h * direction)
    ) / (12 * h)
    assert slope == pytest.approx(numeric, rel=1e-7)
    rows = system.discretisation.rows
    for blend in (0.0, 1.0):
        values = rows.zeros()
        term.add_hessian(x, None, blend, np.ones(term.n_elements), rows.pattern.offsets, values)
        product = rows.product(values, direction)
        if blend == 0.0:
            difference = 8 * (gradient(x + h * direction) - gradient(x - h * direction))
            difference -= gradient(x + 2 * h * direction) - gradient(x - 2 * h * direction)
            largest = comm.allreduce(float(np.abs(product).max(initial=0.0)), MPI.MAX)
            np.testing.assert_allclose(product, difference / (12 * h), rtol=0.0, atol=1e-6 * largest)
        else:
            assert comm.allreduce(float(np.vdot(product, direction[: layout.n_owned]))) > 0.0
    vertices = layout.are_vertices(layout.global_number)
    moved = system.x.copy()
    moved[vertices] = moved[vertices] @ turn.T + [1.0, 2.0, 3.0]
    assert energy(moved) < 1e-20
    simulation.destroy()


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_run_resumes_on_other_ranks(
    comm: MPI.Comm, integrator: str, on_edges: None, shared_tmp: Path
) -> None:
    scene = SCENE | {"time": STEPS | {"integrator": integrator}, "solver": TIGHT}
    whole = outcome(comm, scene)[0]
    x = end_on_one_rank(comm, scene_of(scene), shared_tmp / "run", steps=4)
    if comm.rank == 0:
        np.testing.assert_allclose(x, whole, rtol=0.0, atol=2e-8)


def test_without_the_term_only_vertices_have_unknowns(comm: MPI.Comm) -> None:
    simulation = SteppedScene(comm, scene_of(SCENE))
    layout = simulation.problem.points
    assert layout.n_owned == layout.n_vertices == len(layout.mesh_vertices)
    assert len(layout.padding) == len(layout.edges) == layout.n_edges_global == 0
    assert simulation.stepper.velocity.getSize() == 3 * layout.n_vertices_global
    simulation.destroy()
