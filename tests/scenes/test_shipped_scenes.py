"""Shipped scenes, reduced: a physical number each."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray
from physics import finished, stepped

from lyra_petsc.contact.crossings import self_crossings
from lyra_petsc.scene.load import load_scene
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.terms.bending.hinge import dihedral_angles
from lyra_petsc.terms.chambers import Chambers
from lyra_petsc.terms.creases import Creases

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SHIPPED = (
    "ball",
    "balloon",
    "buckle",
    "crease",
    "cushion",
    "drape",
    "flag",
    "miura",
    "paper",
    "plate",
    "sail",
    "shell",
    "spin",
    "swing",
    "twisted-strip",
)
OF_CONTACT = ("flag-contact", "reef-knot", "shirt", "skirt", "stack", "tablecloth", "twist")
"""Scenes that ``test_contact_scenes.py`` tests."""


def simulated(name: str, *settings: str) -> AbstractContextManager[SteppedScene]:
    """A shipped scene with settings, run to its end on one rank."""
    return finished(MPI.COMM_SELF, load_scene(CONFIGS / f"{name}.yaml", settings))


def mean_of(simulation: SteppedScene, probe: str) -> NDArray[np.float64]:
    return simulation.problem.equations.x[simulation.problem.probes[probe]].mean(axis=0)


def test_a_turning_ball_rotates_its_cloth() -> None:
    with simulated("ball", "mesh.grid.nx=10", "mesh.grid.ny=10", "time.step=0.01") as simulation:
        x, surface = simulation.problem.equations.x, simulation.problem.surface
        columns = simulation.energy_balance.columns()
        crossings = self_crossings(x, surface.triangles.astype(np.int64))
    near = (distance := np.linalg.norm(surface.x[:, :2], axis=1)) < 0.25
    near &= distance > 0.01
    before, after = (at[near, 0] + 1j * at[near, 1] for at in (surface.x, x))
    turned = np.degrees(np.angle(after / before))
    # by 120° at most; it slips while the ball starts
    assert turned.min() > 90.0
    assert turned.max() < 120.0
    assert len(crossings) == 0
    assert np.linalg.norm(x, axis=1).min() > 0.3
    assert columns["smallest_gap"] > 0.0


def filling(simulation: SteppedScene) -> tuple[float, float, float]:
    """Volume [m³], pressure [Pa] and amount of the gas."""
    term, here = simulation.problem.terms["chambers"], simulation.problem.equations.here()
    assert isinstance(term, Chambers)
    ((_, volume, pressure, amount),) = term.table_rows(here.x, here.frozen[term])
    return float(volume), float(pressure), float(amount)


def test_the_balloon_has_passed_its_largest_pressure() -> None:
    with simulated("balloon", "mesh.size=0.02") as simulation:
        volume, pressure, _ = filling(simulation)
    # a free sphere has 1239 Pa at its limit point and 760 Pa at the end, at the stretch 2.6
    assert volume == pytest.approx(20.0 * 0.00413 * 101325.0 / (101325.0 + pressure), rel=1e-3)
    assert pressure == pytest.approx(770.0, abs=40.0)


def test_the_pressed_cushion_keeps_its_gas_and_the_balance_of_energies() -> None:
    scene = load_scene(CONFIGS / "cushion.yaml", ("mesh.size=0.06", "time.step=0.01", "time.end=1.1"))
    path, work, relaxed = [], 0.0, None
    with stepped(MPI.COMM_SELF, scene) as simulation:
        while not simulation.finished:
            simulation.step()
            path.append(filling(simulation))
            if simulation.time > 0.505:  # the plate works
                relaxed = relaxed or simulation.energy_balance.account.before
                work += simulation.energy_balance.account.external
        pressed = simulation.budget
        floor, plate = simulation.energy_balance.obstacle_forces(2)[:, 2]
    volume, pressure, amount = np.array(path).T
    constant = (pressure + 101325.0) * (volume / amount) ** 1.4
    np.testing.assert_allclose(constant, 101325.0 * 0.0048**1.4, rtol=1e-6)
    # in equilibrium at the end, both plates carry the pressure, and the floor also the weight
    weight = 9.81 * float(simulation.problem.equations.mass.sum())
    assert plate > 400.0
    assert -floor - plate == pytest.approx(weight, rel=1e-3)
    assert relaxed is not None
    stored, heat = pressed.total - relaxed.total, pressed.dissipation - relaxed.dissipation
    assert pressed.more["gas_energy"] - relaxed.more["gas_energy"] > 1.0
    assert 0.0 < work - stored - heat < 0.03 * work  # lost by backward Euler


@pytest.mark.parametrize("model", ["midedge", "hinge"])
def test_the_miura_ori_folds_along_its_exact_kinematics(model: str) -> None:
    # at each vertex tan ½φ' = cos γ tan ½φ, with the angles φ' of straight creases and φ of those across, the
    # same all over the sheet (Schenk & Guest, PNAS 110 (2013) 3276-3281)
    settings = "mesh.size=0.05", "time.step=0.25", f"material.bending_model={model}"
    with simulated("miura", *settings) as simulation:
        term, x = simulation.problem.terms["creases"], simulation.problem.equations.x
        assert isinstance(term, Creases)
        group = np.asarray(term.elements.data["crease"]).astype(np.int64)
        angle = -np.degrees(dihedral_angles(x, term.stencil)) * np.array([1.0, -1.0, 1.0, -1.0])[group]
        assert term.n_elements == 2 * 12 * 11
    across = float(angle[group < 2].mean())
    straight = np.degrees(2.0 * np.arctan(np.cos(np.radians(60.0)) * np.tan(np.radians(0.5 * across))))
    # the rest angles, 120° and 30°, do not fit together
    assert 90.0 < across < 100.0
    assert 55.0 < straight < 62.0
    np.testing.assert_allclose(angle[group < 2], across, rtol=0.0, atol=0.5)
    np.testing.assert_allclose(angle[group >= 2], straight, rtol=0.0, atol=0.5)


def test_every_shipped_scene_is_tested() -> None:
    assert sorted(path.stem for path in CONFIGS.glob("*.yaml")) == sorted(SHIPPED + OF_CONTACT)


def test_the_tip_of_the_flag_agrees_with_finer_steps() -> None:
    # the same mesh with Δt = 0.00078125 s gave (1.4778, 0.2017, 0.7594); first order, so a few mm are left
    with simulated("flag", "mesh.size=0.1", "time.end=0.25", "time.step=0.003125") as simulation:
        tip = mean_of(simulation, "tip")
    np.testing.assert_allclose(tip, [1.4778, 0.2017, 0.7594], atol=2e-3)


def test_the_paper_keeps_its_crease() -> None:
    strip = "mesh.grid.ny=1", "mesh.grid.height=0.002", "mesh.transform.translate=[-0.1, -0.001, 0]"
    with simulated("crease", *strip, "output.every=0.5") as simulation:
        x = simulation.problem.equations.x[: simulation.problem.points.n_vertices]
        # on one rank, vertices may be in another order than in the mesh
        start = simulation.problem.surface.x
        kinetic = simulation.budget.kinetic
    assert kinetic < 1e-9  # at rest
    near, far = (x[np.abs(start[:, 0] - at) < 1e-6].mean(axis=0) for at in (0.02, 0.04))
    angle = np.degrees(np.arctan2(far[2] - near[2], far[0] - near[0]))
    assert angle == pytest.approx(136.4, abs=2.0)  # of 150


def test_the_draped_square_hangs_with_its_whole_weight() -> None:
    with simulated(
        "drape", "mesh.size=0.1", "time.step=0.25", "time.end=20", "output.every=20"
    ) as simulation:
        pull = sum(simulation.energy_balance.handle_forces(2))
        lowest = simulation.problem.equations.x[:, 2].min()
    np.testing.assert_allclose(pull, [0.0, 0.0, 0.187 * 9.81], atol=2e-3)
    assert lowest < -0.9


def test_turned_corners_are_opposite_after_half_a_turn() -> None:
    # half-way between the keyframes at 144° and 216°, by symmetry
    with simulated(
        "spin", "mesh.size=0.12", "time.end=3.5", "time.step=0.05", "output.every=3.5"
    ) as simulation:
        equations = simulation.problem.equations
        corners = {number: equations.x[equations.held.vertices(number)][0] for number in (0, 1)}
    ends = sorted(corner[0] for corner in corners.values())
    np.testing.assert_allclose(ends, [-0.5, 0.5], atol=1e-9)
    np.testing.assert_allclose([corner[1:] for corner in corners.values()], 0.0, atol=1e-9)


def test_handles_of_the_sail_carry_wind_and_weight() -> None:
    with simulated("sail", "mesh.size=0.2", "time.step=0.1", "time.end=20", "output.every=20") as simulation:
        equations, scene = simulation.problem.equations, simulation.scene
        pull = sum(simulation.energy_balance.handle_forces(2))
        membrane = simulation.problem.membrane
        corners = equations.x[membrane.stencil]
        area = membrane.elements.data["area"][:, None]
        weight = equations.mass.sum() * np.asarray(scene.gravity)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    wind = np.asarray(scene.wind.velocity)
    across = normal @ wind
    along = wind - across[:, None] * normal
    push = scene.wind.density * area * np.abs(across)[:, None] * across[:, None] * normal
    push += scene.wind.drag * area * along
    np.testing.assert_allclose(pull + weight + push.sum(axis=0), 0.0, atol=0.01 * np.linalg.norm(pull))


def test_the_plate_bends_like_a_beam_under_a_small_weight() -> None:
    # w L⁴ / 8 D for a hundredth of its weight; a beam has (1 − ν²) D, but at the clamp it cannot curve
    # across: 1.0816 on elements of 0.0125 m
    settings = (
        "gravity=[0, 0, -0.0981]",
        "time.step=0.25",
        "time.end=20",
        "output.every=20",
        "mesh.size=0.04",
    )
    with simulated("plate", *settings) as simulation:
        sag = -mean_of(simulation, "tip")[2]
    stiffness = 2.0e11 * 0.0005**3 / (12 * (1 - 0.3**2))
    beam = 3.925 * 0.0981 / (8 * stiffness)
    assert sag / beam == pytest.approx(1.0816, abs=0.005)


def test_the_free_edge_of_the_swing_falls_freely_and_swings_in() -> None:
    # of a strip of 20 cells; 0.4738, -0.7848 by a converged calculation in one dimension
    small = ("mesh.grid.nx=20", "mesh.grid.ny=2", "mesh.grid.height=0.1", "mesh.grid.pattern=alternating")
    with simulated("swing", *small) as simulation:
        edge = mean_of(simulation, "edge")
    assert edge[2] == pytest.approx(-0.5 * 9.81 * 0.4**2, abs=1e-4)
    assert edge[0] == pytest.approx(0.4738, abs=5e-3)


def test_paper_falls_like_the_ensemble() -> None:
    # known from an ensemble: at 0.2 s, before the wrinkles matter, 0.1623 J moving
    with simulated("paper", "time.end=0.2") as simulation:
        equations = simulation.problem.equations
        height = float(equations.mass @ equations.x[:, 2] / equations.mass.sum())
        moving = simulation.budget.kinetic
    assert moving == pytest.approx(0.1623, abs=5e-4)
    assert height == pytest.approx(-0.1657, abs=5e-4)


def test_the_shell_opens_as_far_as_on_a_finer_mesh() -> None:
    # mesh.size=0.3 gives 3.4046 and 5.8314 m
    with simulated("shell", "mesh.size=1.2") as simulation:
        pulled, pushed = (mean_of(simulation, name) for name in ("pulled", "pushed"))
    np.testing.assert_allclose([pulled[0] - 10.0, 10.0 - pushed[1]], [3.4046, 5.8314], rtol=3e-3)
    np.testing.assert_allclose([pulled[1], pushed[0]], 0.0, atol=1e-9)


def test_the_buckled_strip_hangs_between_its_clamps() -> None:
    settings = ("mesh.grid.nx=40", "time.step=0.02", "output.every=2")
    with simulated("buckle", *settings) as simulation:
        middle, (left, right) = mean_of(simulation, "middle"), simulation.energy_balance.handle_forces(2)
    np.testing.assert_allclose(middle[:2], [0.25, 0.05], atol=1e-3)
    assert -0.4 < middle[2] < -0.3
    assert left[0] > 10.0 > -10.0 > right[0]  # signs of the forces of the clamps
    np.testing.assert_allclose((left + right)[2], 3.925 * 0.1 * 9.81, rtol=0.02)


def test_the_twisted_strip_has_turned_by_half_in_the_middle() -> None:
    settings = ("mesh.grid.nx=50", "mesh.grid.ny=6", "time.step=0.02", "output.every=2")
    with simulated("twisted-strip", *settings) as simulation:
        problem, forces = simulation.problem, simulation.energy_balance.handle_forces(2)
        x = problem.equations.x[np.argsort(problem.points.mesh_vertices)].reshape(7, 51, 3)
    assert np.linalg.norm(x[3, 25, 1:]) < 0.015
    assert x[6, 25, 1] < -0.02 < 0.02 < x[0, 25, 1]
    np.testing.assert_allclose(forces[0], -forces[1], atol=0.02 * abs(forces[0][0]))
