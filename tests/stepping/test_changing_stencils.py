"""Stencils that change as the sheet moves, with a term of the tests by which vertices repel each other."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, SOLVERS, finished, gathered, grid, options, scene_of, shape
from repulsion_term import DISTANCE, REPULSION, Repulsion

from lyra_petsc.arrays import Array
from lyra_petsc.output.recorder import Recorder
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.terms import registry

pytestmark = pytest.mark.parallel

GAP = 0.11
"""Initial distance of the sheets [m], at which they do not repel each other yet."""

LOWER = grid(0.6, 0.4, 5, 4, "alternating")
UPPER = grid(0.55, 0.4, 4, 4) | {"transform": {"translate": [0.03, 0.01, GAP]}}

SCENE: dict[str, Any] = {
    "mesh": [LOWER, UPPER],
    "material": CLOTH | {"bending": 1e-4},
    "time": {"end": 0.06, "step": 0.002},
}
TIGHT = {"force_tolerance": 1e-10, "step_tolerance": 1e-10}
SPEED = 2.0
"""Speed of either sheet towards the other [m/s]."""


@pytest.fixture(autouse=True)
def repulsion(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Adds the term to every scene."""
    with monkeypatch.context() as patch:
        patch.setattr(registry, "REGISTRY", [*registry.REGISTRY, REPULSION])
        yield


def thrown(comm: MPI.Comm, scene: dict[str, Any]) -> SteppedScene:
    """Two sheets that fly towards each other."""
    simulation = SteppedScene(comm, scene_of(SCENE | {"solver": TIGHT} | scene))
    system = simulation.problem.system
    n = system.points.n_owned
    v = np.zeros((n, 3))
    v[:, 2] = np.where(system.x[:n, 2] > 0.5 * GAP, -SPEED, SPEED)
    system.state.set(system.x[:n].copy(), v)
    simulation.energy_balance.measure()
    simulation.stepper.start(0.0, 0)
    return simulation


def term_of(simulation: SteppedScene) -> Repulsion:
    term = simulation.problem.terms["repulsion"]
    assert isinstance(term, Repulsion)
    return term


def momentum(simulation: SteppedScene) -> Array:
    """Total momentum (3,) [kg m/s]."""
    system = simulation.problem.system
    n = system.points.n_owned
    return np.asarray(system.points.global_sum(*(system.mass @ system.v[:n])))


def flown(
    comm: MPI.Comm,
    scene: dict[str, Any],
    watch: Callable[[SteppedScene], None] = lambda simulation: None,
    **petsc: Any,
) -> tuple[Array, float, float]:
    """Positions in mesh order, mean upward speed of the upper sheet, largest number of pairs."""
    with options(petsc):
        simulation = thrown(comm, scene)
        pairs = 0.0
        while not simulation.finished:
            simulation.step()
            watch(simulation)
            pairs = max(pairs, simulation.energy_balance.columns()["pairs"])
        x, v = shape(simulation), gathered(simulation.problem.points, simulation.problem.system.v)
        simulation.destroy()
    return x, float(v[30:, 2].mean()), pairs


@pytest.mark.parametrize("integrator", ["beuler", "semi-implicit", "midpoint", "bdf2", "alpha2"])
def test_two_sheets_bounce(comm: MPI.Comm, integrator: str) -> None:
    def watch(simulation: SteppedScene) -> None:
        system, term = simulation.problem.system, term_of(simulation)
        force = np.zeros((system.points.n_local, 3))
        term.add_gradient(system.x, None, force)
        own = force[: system.points.n_owned]
        largest = comm.allreduce(float(np.abs(own).max(initial=0.0)), MPI.MAX)
        total = np.asarray(system.points.global_sum(*own.sum(axis=0)))
        assert np.abs(total).max() <= 1e-13 * max(largest, 1e-3)
        assert np.abs(momentum(simulation) - before).max() < 1e-9

    scene = {"time": SCENE["time"] | {"integrator": integrator}}
    start = thrown(comm, scene)
    before = momentum(start)
    start.destroy()
    tight = {"ksp_rtol": 1e-12} if integrator == "semi-implicit" else {}
    _, speed, pairs = flown(comm, scene, watch, **tight)
    assert pairs > 20
    assert speed > (0.3 if integrator in ("beuler", "semi-implicit") else 0.6) * SPEED


def test_the_linear_solver_can_change_together_with_stencils(comm: MPI.Comm) -> None:
    """Points that were near when the last matrix was created are far apart now."""
    simulation = thrown(comm, {})
    simulation.step()
    system = simulation.problem.system
    n, n_local = system.points.n_owned, system.points.n_local
    v = np.zeros((n, 3))
    v[:, 2] = np.where(system.x[:n, 2] > 0.5 * GAP, 0.0, 0.8 * GAP / system.stage.c)
    system.evaluate_at(v)
    assert comm.size == 1 or comm.allreduce(system.points.n_local > n_local, MPI.LOR)
    assert simulation.stepper.linear.update_pattern()
    system.evaluate_at_start()
    simulation.stepper.presets = ["multigrid", "direct"]
    assert simulation.stepper.next_preset() == "direct"
    simulation.step()
    simulation.destroy()


def test_nothing_crosses_and_newton_increments_are_limited(comm: MPI.Comm) -> None:
    nearest: list[float] = []

    def watch(simulation: SteppedScene) -> None:
        nearest.append(simulation.energy_balance.columns()["nearest"])
        assert simulation.problem.system.active.limiting

    flown(comm, {"time": {"end": 0.06, "step": 0.02}}, watch)
    assert 0.0 < min(nearest) < DISTANCE


@pytest.mark.parallel(alone=False)
def test_the_answer_does_not_depend_on_ranks(comm: MPI.Comm) -> None:
    x, _, pairs = flown(comm, {})
    alone = comm.Split(comm.rank)
    single, _, serial_pairs = flown(alone, {})
    alone.Free()
    assert pairs == serial_pairs
    np.testing.assert_allclose(x, single, rtol=0.0, atol=1e-8)


SHORT = {"time": SCENE["time"] | {"end": 0.03}}

ALL_SOLVERS = SOLVERS | {"assembled operator": {"pc_type": "pbjacobi", "mat_type": "aij"}}


@cache
def short_flight() -> Array:
    return flown(MPI.COMM_WORLD, SHORT)[0]


@pytest.mark.parametrize("name", ALL_SOLVERS)
def test_every_linear_solver_works(comm: MPI.Comm, name: str) -> None:
    x = flown(comm, SHORT, ksp_rtol=1e-8, **ALL_SOLVERS[name])[0]
    np.testing.assert_allclose(x, short_flight(), rtol=0.0, atol=2e-8)


@pytest.mark.parallel(2)
@pytest.mark.parametrize("integrator", ["beuler", "alpha2"])
def test_adaptive_steps(comm: MPI.Comm, integrator: str) -> None:
    time = {"end": 0.05, "step": "auto", "tolerance": 2e-3, "integrator": integrator}
    _, speed, pairs = flown(comm, {"time": time})
    assert pairs > 20
    assert speed > 0.3 * SPEED


def test_a_sheet_rests_on_another(comm: MPI.Comm) -> None:
    """In a static analysis, the forces between the sheets carry the load on the upper one."""
    pressed = {
        "mesh": [LOWER | {"name": "lower"}, UPPER | {"transform": {"translate": [0.03, 0.01, 0.07]}}],
        "handles": [
            {"box": [[-1, -1, -1], [2, 2, 0.01]]},
            {"box": [[-1, -1, 0.01], [2, 2, 1]], "axes": ["x", "y"]},
        ],
        "loads": [{"box": [[-1, -1, 0.01], [2, 2, 1]], "force": [0, 0, -3.0]}],
        "time": {"analysis": "static", "end": 1.0, "step": 0.5},
    }
    with finished(comm, SCENE | {"solver": TIGHT} | pressed) as simulation:
        system = simulation.problem.system
        force = np.zeros((system.points.n_local, 3))
        term_of(simulation).add_gradient(system.x, None, force)
        upper = system.x[: system.points.n_owned, 2] > 0.01
        (force_on_upper,) = system.points.global_sum(float(-force[: system.points.n_owned][upper, 2].sum()))
        assert force_on_upper == pytest.approx(3.0, rel=1e-6)


def test_steps_without_change_do_not_search(comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = thrown(comm, {"time": {"end": 1.0, "step": 1e-4}})
    searches = []
    term, search = term_of(simulation), Repulsion.neighbours
    monkeypatch.setattr(term, "neighbours", lambda *given: (searches.append(1), search(term, *given))[1])
    simulation.step()
    searches.clear()
    matrices = simulation.stepper.linear.operator
    for _ in range(10):  # 2 mm, while half the skin is 10
        simulation.step()
    assert searches == []
    assert simulation.stepper.linear.operator is matrices
    simulation.destroy()


def test_history_has_the_columns_and_a_run_resumes_on_other_ranks(comm: MPI.Comm, shared_tmp: Path) -> None:
    folder = shared_tmp / "run"
    simulation = thrown(comm, {})
    recorder = Recorder(simulation)
    if comm.rank == 0:
        folder.mkdir()
    comm.Barrier()
    recorder.begin(folder)
    for _ in range(18):  # the sheets touch
        recorder.record(simulation.step())
    recorder.write_checkpoint()
    recorder.flush()
    recorder.close()
    touched = gathered(simulation.problem.points, term_of(simulation).state()["touched"].values)
    assert touched.max() > 1.0
    while not simulation.finished:
        simulation.step()
    x = shape(simulation)
    at_end = gathered(simulation.problem.points, term_of(simulation).state()["touched"].values)
    simulation.destroy()
    if comm.rank == 0:
        header, *rows = (folder / "history.csv").read_text().splitlines()
        assert header.endswith("wall_seconds,repulsion_energy,pairs,nearest")
        assert float(rows[-1].split(",")[-3]) > 0.0
    few = comm.Split(0 if comm.rank == 0 else 1)
    if comm.rank == 0:
        resumed = SteppedScene(few, scene_of(SCENE | {"solver": TIGHT}))
        again = Recorder(resumed)
        again.resume(folder)
        kept = gathered(resumed.problem.points, term_of(resumed).state()["touched"])
        np.testing.assert_array_equal(kept, touched)
        while not resumed.finished:
            again.record(resumed.step())
        again.flush()
        again.close()
        np.testing.assert_allclose(shape(resumed), x, rtol=0, atol=1e-8)
        np.testing.assert_array_equal(
            gathered(resumed.problem.points, term_of(resumed).state()["touched"]), at_end
        )
        resumed.destroy()
    few.Free()
    comm.Barrier()


def test_derivatives_agree_with_finite_differences(comm: MPI.Comm) -> None:
    """Gradient and Hessian, in the assembled matrix, while the sheets are near."""
    simulation = thrown(comm, {})
    system = simulation.problem.system
    for _ in range(12):
        simulation.step()
    layout, term = system.points, term_of(simulation)
    system.update_pattern()
    rng = np.random.default_rng(2)
    random = rng.standard_normal((layout.n_vertices_global, 3))
    direction = np.zeros((layout.n_local, 3))
    direction[: layout.n_owned] = random[layout.mesh_vertices]
    layout.update_ghosts(direction)
    x, n, h = system.x.copy(), layout.n_owned, 1e-6

    def energy(at: Array) -> float:
        return float(comm.allreduce(float(term.energies(at, None).sum())))

    def gradient(at: Array) -> Array:
        out = np.zeros_like(at)
        term.add_gradient(at, None, out)
        return out[:n]

    assert energy(x) > 0.0
    slope = comm.allreduce(float(np.vdot(gradient(x), direction[:n])))
    assert slope == pytest.approx((energy(x + h * direction) - energy(x - h * direction)) / (2 * h), rel=1e-6)
    rows = system.discretisation.rows
    values = rows.zeros()
    term.add_hessian(x, None, 0.0, np.ones(term.n_elements), rows.pattern.offsets, values)
    product = rows.product(values, direction)
    largest = comm.allreduce(float(np.abs(product).max(initial=0.0)), MPI.MAX)
    np.testing.assert_allclose(
        product,
        (gradient(x + h * direction) - gradient(x - h * direction)) / (2 * h),
        rtol=0.0,
        atol=1e-5 * largest,
    )
    simulation.destroy()
