"""Pressures in equilibria: their stiffness, and rings that buckle under them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from mpi4py import MPI
from oracle import expanded
from physics import SteppedScene, grid, scene_of

from lyra_petsc.arrays import Array
from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.meshes import rectangle
from lyra_petsc.experiments.verification.cases.shells import symmetric
from lyra_petsc.experiments.verification.flat_plates import plate_material
from lyra_petsc.experiments.verification.rods import pressed_tip
from lyra_petsc.experiments.verification.verification_case import STATIC, scene
from lyra_petsc.phases import Phases
from lyra_petsc.stepping.statics.following_loads import FollowingLoads, newton_displacement
from lyra_petsc.terms.term import Load, UpcomingStep


def force_of(load: Load, x: Array, out: Array) -> None:
    load.add_force(UpcomingStep(0.0, 1.0, 0.5, x, lambda start, rows: x[rows]), out)


def test_force_and_stiffness_are_derivatives_of_the_energy() -> None:
    content = scene_of({"mesh": grid(1.0, 0.7, 3, 2), "loads": [{"pressure": 7.0}]})
    simulation = SteppedScene(MPI.COMM_SELF, content, Phases())
    equations, random = simulation.problem.equations, np.random.default_rng(0)
    x = equations.x + 0.1 * random.normal(size=equations.x.shape)
    u, direction = (0.1 * random.normal(size=x.shape) for _ in range(2))
    loads = FollowingLoads(equations.active.loads, x, force_of)

    force, change = np.zeros_like(x), np.zeros_like(x)
    loads.add_force(x + u, force)
    energies = [loads.energy(x + u + sign * direction) for sign in (1.0, -1.0)]
    assert float(np.vdot(force, direction)) == pytest.approx(0.5 * (energies[1] - energies[0]), rel=1e-12)

    rows = equations.discretisation.rows
    values = rows.zeros()
    loads.add_hessian(2.0, rows.pattern, values)
    loads.add_force(x + direction, change)
    product = np.einsum("aibj,bj->ai", expanded(rows.pattern, values, len(x)), direction)
    np.testing.assert_allclose(product, -2.0 * change, rtol=0, atol=1e-12 * np.abs(product).max())

    # with a rim that is held the stiffness is symmetric, and that of the force itself
    inside = (np.abs(equations.x[:, :1] - 0.5) < 0.4) & (np.abs(equations.x[:, 1:2] - 0.35) < 0.3)
    direction *= inside
    there, back, change = (np.zeros_like(x) for _ in range(3))
    force_of(equations.active.loads[0], x + 1e-6 * direction, there)
    force_of(equations.active.loads[0], x - 1e-6 * direction, back)
    loads.add_force(x + direction, change)
    expected = (there - back) / 2e-6
    np.testing.assert_allclose(change * inside, expected * inside, rtol=0, atol=1e-6 * np.abs(change).max())
    simulation.destroy()


RADIUS, THICKNESS, YOUNG, OVAL = 1.0, 0.02, 1e6, 0.01


def ring(comm: MPI.Comm, part: float, start: float = OVAL) -> tuple[float, int]:
    """How far a ring of radius 1 that is ``start`` oval is so under a part of the pressure at which it
    buckles, 3 D / R³, and Newton iterations.

    M. Lévy, Journal de mathématiques pures et appliquées 10 (1884); S. P. Timoshenko, J. M. Gere, Theory of
    Elastic Stability, 2nd ed. 1961, § 7.3.
    """
    bench = Bench(comm, direct=False)
    flat, faces = rectangle(16, 2, 1.0, 1.0, alternating=True)
    angle = 0.5 * math.pi * flat[:, 0]
    radius = RADIUS + start * np.cos(2.0 * angle)
    vertices = np.column_stack([radius * np.cos(angle), 0.25 * flat[:, 1], radius * np.sin(angle)])
    pressure = part * 3.0 * YOUNG * THICKNESS**3 / 12.0 / RADIUS**3
    content = scene(
        bench.mesh(vertices, faces),
        {"young": YOUNG, "poisson": 0.0, "thickness": THICKNESS, "density": 1.0},
        handles=symmetric("xyz", 2.0 * RADIUS),
        loads=[{"pressure": pressure}],
        time=STATIC | {"step": 0.2},
    )
    newton = 0
    with bench.simulation(content) as trial:
        while not trial.simulation.finished:
            newton += trial.step().newton_iterations
        x = trial.x
    return 0.5 * float(x[:, 0].max() - x[:, 2].max()), newton


@pytest.mark.parallel(2)
def test_a_ring_buckles_under_pressure(comm: MPI.Comm) -> None:
    """Deviations grow by 1 / (1 − p / p_c) below the critical pressure; solutions exist beyond it."""
    oval, newton = ring(comm, 0.5)
    assert oval == pytest.approx(OVAL / 0.5, rel=0.02)
    assert newton <= 15  # 30 with pressures that are taken as they were
    oval, newton = ring(comm, 1.3)
    assert oval > 0.3
    assert newton <= 35  # 109


def test_a_round_ring_leaves_its_unstable_equilibrium() -> None:
    """Between 3 D/R³ and 4 D/R³, the critical value of forces that keep their directions."""
    assert abs(ring(MPI.COMM_SELF, 1.1, start=0.0)[0]) > 0.1


def test_forces_on_the_way_to_an_equilibrium_do_not_loosen_the_tolerance() -> None:
    """Nothing holds this ring along its axis, and iterations that shear it have large forces."""
    flat, faces = rectangle(16, 1, 1.0, 0.1, alternating=True)
    angle = 0.5 * math.pi * flat[:, 0]
    vertices = np.column_stack([np.sin(angle), flat[:, 1], np.cos(angle)])
    bench, worst = Bench(MPI.COMM_SELF), 0.0
    content = scene(
        bench.mesh(vertices, faces),
        plate_material(1e6),
        STATIC | {"step": 0.1},
        handles=symmetric("xz", 2.0),
        loads=[{"pressure": -2.5}, {"nodes": [0, 17], "force": [0.0, 0.0, -1e-3]}],
        solver={},
    )
    with bench.simulation(content) as trial:
        while not trial.simulation.finished:
            trial.step()
            equations = trial.simulation.problem.equations
            force = float(np.linalg.norm(equations.out_of_balance()))
            worst = max(worst, force / equations.forces.largest_force())
    assert worst <= 1e-6  # the force tolerance; it was 0.3


def test_systems_with_skew_stiffness_are_solved() -> None:
    random = np.random.default_rng(0)
    skew = random.normal(size=(6, 6))
    skew = 3.0 * (skew - skew.T)  # more than the symmetric part: a fixed point would run away
    size = random.uniform(1.0, 2.0, 6)
    force = random.normal(size=(2, 3))

    def of_skew(direction: Array) -> Array:
        return (skew @ direction.ravel()).reshape(2, 3)

    direction = newton_displacement(force, lambda force: force / size.reshape(2, 3), of_skew, MPI.COMM_SELF)
    assert direction is not None
    assert (
        newton_displacement(force, lambda force: None, of_skew, MPI.COMM_SELF) is None
    )  # there are no factors
    np.testing.assert_allclose((np.diag(size) - skew) @ direction.ravel(), force.ravel(), atol=1e-2)


def curled(
    comm: MPI.Comm, load: float, step: float, cells: tuple[int, int] = (40, 4)
) -> tuple[Array, int, str]:
    """Tip of a cantilever under a pressure of ``load`` B/L³, Newton iterations, and notes."""
    thickness, young = 0.002, 1.2e9
    strip = {"width": 1.0, "height": 0.1, "nx": cells[0], "ny": cells[1], "pattern": "alternating"}
    mesh = {"grid": strip}
    content = scene(
        mesh,
        {"young": young, "poisson": 0.0, "thickness": thickness, "density": 1.0},
        STATIC | {"step": step},
        gravity=[0, 0, 0],
        handles=[{"group": "left", "clamp": True}],
        loads=[{"pressure": load * young * thickness**3 / 12.0}],
    )
    newton = 0
    with Bench(comm, direct=False).simulation(content) as trial:
        while not trial.simulation.finished:
            newton += trial.step().newton_iterations
        tip = trial.x[np.isclose(trial.start[:, 0], 1.0)].mean(axis=0)
        return tip[[0, 2]], newton, "; ".join(trial.simulation.notes)


@pytest.mark.parallel(2)
def test_a_strip_with_free_edges_curls_under_pressure(comm: MPI.Comm) -> None:
    """Beyond half a circle; at free edges the stiffness of the pressure is not symmetric."""
    tip, newton, notes = curled(comm, 30.0, 0.125)
    np.testing.assert_allclose(tip, pressed_tip(30.0), atol=6e-3)
    assert newton <= 90  # 353 with the skew part constant in a solve
    assert "stable" not in notes


@pytest.mark.parallel(2)
def test_long_increments_take_few_iterations(comm: MPI.Comm) -> None:
    tip, newton, _ = curled(comm, 50.0, 0.25)
    np.testing.assert_allclose(tip, pressed_tip(50.0), atol=6e-3)
    assert newton <= 75  # 62; 101 where all of the stiffness is tried first after 40 iterations alone


@pytest.mark.parallel(2)
def test_it_curls_further_when_the_symmetric_part_is_indefinite(comm: MPI.Comm) -> None:
    """From 57 B/L³ on. The whole stiffness is regular: the rod has one shape at each load."""
    tip, newton, notes = curled(comm, 80.0, 0.25)
    np.testing.assert_allclose(tip, pressed_tip(80.0), atol=6e-3)
    assert newton <= 110  # 72
    assert "whether the equilibrium is stable is not known: pressure beside free edges" in notes


def test_an_increment_that_has_grown_too_long_is_shortened() -> None:
    """It leads to the same equilibrium; the failed attempt takes more than half of the iterations."""
    expected, few, _ = curled(MPI.COMM_SELF, 80.0, 0.25, cells=(20, 2))
    shortened, newton, _ = curled(MPI.COMM_SELF, 80.0, 0.125, cells=(20, 2))
    np.testing.assert_allclose(shortened, expected, atol=1e-6)
    assert 2 * few < newton <= 700  # 71, 447
