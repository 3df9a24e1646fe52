"""Friction on a slope: a sheet sticks below the angle of friction, and slides by Coulomb's law above it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray
from physics import CLOTH, end_on_one_rank, finished, gathered, grid, obj_file, scene_of, shape, stepped

from lyra_petsc.contact.friction import CoulombFriction
from lyra_petsc.contact.pair_distances import EDGE_EDGE, VERTEX_TRIANGLE
from lyra_petsc.output.recorder import Recorder
from lyra_petsc.stepping.simulation import SteppedScene

Array = NDArray[np.float64]

pytestmark = pytest.mark.parallel(2)

SLOPE, GAP, G = math.radians(30.0), 0.01, 9.81
NORMAL = [math.sin(SLOPE), 0.0, math.cos(SLOPE)]
DOWN = np.array([math.cos(SLOPE), 0.0, -math.sin(SLOPE)])


FLAT = {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}
PLANE = {"plane": {"point": [0.0, 0.0, 0.0], "normal": NORMAL}}
LIGHT = CLOTH | {"bending": 1e-4, "damping": 0.0}


def on_plane(
    size: tuple[float, int], gap: float, above: float, friction: Any, motion: dict[str, Any], **more: Any
) -> dict[str, Any]:
    """A sheet of side [m] and cells that starts ``above`` gaps over a plane, which may move."""
    side, cells = size
    return {
        "mesh": grid(side, side, cells, cells) | {"transform": {"translate": [0.0, 0.0, above * gap]}},
        "material": LIGHT,
        "gravity": [0.0, 0.0, -G],
        "contact": {"gap": gap, "friction": friction, "self": False},
        "obstacles": {"floor": {"plane": FLAT} | motion},
    } | more


def on_slope(
    comm: MPI.Comm,
    friction: float,
    end: float,
    slope: dict[str, Any] = PLANE,
    integrator: str = "beuler",
    above: float = 0.9,
) -> tuple[float, float, Array, float, float]:
    """Mean slip and speed down the slope, force on it, weight and friction work of a sheet released on it."""
    place = [above * GAP * component for component in NORMAL]
    turn = {"axis": [0.0, 1.0, 0.0], "degrees": math.degrees(SLOPE)}
    content = {
        "mesh": grid(0.4, 0.4, 3, 3) | {"transform": {"rotate": turn, "translate": place}},
        "material": LIGHT,
        "gravity": [0.0, 0.0, -G],
        "contact": {"gap": GAP, "friction": friction, "self": False},
        "obstacles": {"slope": slope},
        "time": {"end": end, "step": 0.01, "integrator": integrator},
    }
    simulation = SteppedScene(comm, scene_of(content))
    equations, n = simulation.problem.equations, simulation.problem.points.n_owned
    start = equations.x[:n].copy()
    while not simulation.finished:
        simulation.step()
    mass = equations.points.global_sum(float(equations.mass.sum()))[0]
    slip, speed = (
        float(equations.points.global_sum(float(equations.mass @ (values @ DOWN)))[0]) / mass
        for values in (equations.x[:n] - start, equations.v[:n])
    )
    force = simulation.energy_balance.obstacle_forces(1)[0]
    work = simulation.energy_balance.columns()["friction_work"]
    simulation.destroy()
    return slip, speed, np.asarray(force), mass * G, work


def test_a_sheet_slides_by_coulombs_law(comm: MPI.Comm) -> None:
    friction, end = 0.5 * math.tan(SLOPE), 0.4
    slip, speed, force, weight, work = on_slope(comm, friction, end)
    pull = G * 0.5 * math.sin(SLOPE)
    assert speed == pytest.approx(pull * end, rel=0.05)  # it settles on the barrier at first
    pressed = weight * math.cos(SLOPE)
    np.testing.assert_allclose(force[:3] @ NORMAL, -pressed, rtol=1e-3)
    np.testing.assert_allclose(force[:3] @ DOWN, friction * pressed, rtol=1e-3)
    assert work == pytest.approx(friction * pressed * slip, rel=0.05)


def test_friction_is_a_part_of_the_residual_by_its_own_name(comm: MPI.Comm) -> None:
    """Messages on failed steps list the parts; a scene without handles has no springs."""
    content = {
        "mesh": grid(0.4, 0.4, 3, 3) | {"transform": {"translate": [0.0, 0.0, 0.9 * GAP]}},
        "gravity": [2.0, 0.0, -G],
        "contact": {"gap": GAP, "friction": 0.1},
        "obstacles": {"floor": {"plane": FLAT}},
    }
    simulation = SteppedScene(comm, scene_of(content))
    equations, n = simulation.problem.equations, simulation.problem.points.n_owned
    for _ in range(3):
        simulation.step()
    parts = {name: part.sum(axis=0) for name, part in equations.forces_at_stage()}
    assert "springs" not in parts
    friction, internal = (comm.allreduce(parts[name]) for name in ("friction", "internal"))
    weight = G * comm.allreduce(float(equations.mass[:n].sum()))
    assert 0.05 * weight < friction[0] < 0.2 * weight
    assert -internal[2] > 0.5 * weight
    simulation.destroy()


def test_a_slope_of_triangles_acts_as_a_plane(comm: MPI.Comm, shared_tmp: Path) -> None:
    """The sheet's vertices, edges and triangles slide over the slope's edges."""
    if comm.rank == 0:
        along, across = np.meshgrid([-1.0, -0.13, 0.03, 0.25, 0.41, 0.57, 2.0], [-1.0, 0.11, 0.17, 0.29, 1.0])
        flat = np.column_stack([along.ravel(), across.ravel()])
        points = flat[:, :1] * DOWN + flat[:, 1:] * [0.0, 1.0, 0.0]
        rows = [(i, i + 1, i + 7) for j in range(4) for i in range(7 * j, 7 * j + 6)]
        sides = [*rows, *((b, c + 1, c) for _, b, c in rows)]
        obj_file(shared_tmp / "slope.obj", points.tolist(), sides)
    comm.Barrier()
    friction, end = 0.5 * math.tan(SLOPE), 0.4
    plane = on_slope(comm, friction, end)
    triangles = on_slope(comm, friction, end, {"mesh": {"file": str(shared_tmp / "slope.obj")}})
    for one, other in zip(plane, triangles, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9 * plane[3])


def test_a_sheet_sticks_below_the_angle_of_friction(comm: MPI.Comm) -> None:
    slip, speed, force, weight, _ = on_slope(comm, 1.2 * math.tan(SLOPE), 1.0)
    assert abs(speed) < 1e-5
    assert 0.0 < slip < 2e-3
    np.testing.assert_allclose(force[:3], [0.0, 0.0, -weight], atol=2e-4 * weight)


def test_a_sheet_sticks_until_static_friction_is_exceeded(comm: MPI.Comm) -> None:
    """On a tilting plane, also if kinetic friction is smaller: the normal force is smaller at the border."""
    threshold, gap, side = 0.5, 0.005, 0.3
    turned = [
        {"time": 0.0},
        {"time": 0.3},
        {"time": 1.3, "rotate": {"axis": [0.0, 1.0, 0.0], "degrees": 25.7}},
        {"time": 1.8, "rotate": {"axis": [0.0, 1.0, 0.0], "degrees": 29.0}},
    ]
    content = {
        "mesh": grid(side, side, 5, 5, "alternating")
        | {"transform": {"translate": [-0.5 * side, -0.5 * side, 0.95 * gap]}},
        "material": {"cloth": "gray-interlock"},
        "gravity": [0.0, 0.0, -G],
        "contact": {"gap": gap, "friction": {"static": threshold, "kinetic": 0.6 * threshold}, "self": False},
        "obstacles": {"slope": {"plane": FLAT, "motion": turned}},
        "time": {"end": 1.8, "step": 0.02},
        "solver": {},
    }
    simulation = SteppedScene(comm, scene_of(content))
    equations, ratios = simulation.problem.equations, []
    weight = equations.points.global_sum(float(equations.mass.sum()))[0]
    for time in (1.3, 1.8):
        while simulation.time < time - 0.01:
            simulation.step()
        middle = equations.points.global_sum(
            *(float(equations.mass @ x) for x in equations.x[: len(equations.mass)].T)
        )
        ratios.append(math.hypot(middle[0], middle[2]) / weight)
    simulation.destroy()
    assert ratios[0] < 0.01
    assert ratios[1] > 0.05


@pytest.mark.parametrize("integrator", ["beuler", "bdf2", "alpha2"])
def test_a_sheet_slips_on_a_plane_that_accelerates_at_its_static_friction(
    comm: MPI.Comm, integrator: str
) -> None:
    """The acceleration grows evenly; friction has to give the sheet its velocity in every step."""
    static, end = 0.5, 1.2
    fastest = 1.1 * static * G  # acceleration at the end
    moved, speed = [fastest * end**2 / 6.0, 0.0, 0.0], [0.5 * fastest * end, 0.0, 0.0]
    last = {"time": end, "translate": moved, "velocity": speed}
    both, motion = {"static": static, "kinetic": 0.6 * static}, {"motion": [{"time": 0.0}, last]}
    time = {"end": end, "step": 0.01, "integrator": integrator}
    content = on_plane((0.3, 3), GAP, 0.95, both, motion, time=time)
    simulation = SteppedScene(comm, scene_of(content))
    equations, n = simulation.problem.equations, simulation.problem.points.n_owned
    start, slip = equations.x[:n, 0].copy(), 0.0
    while slip < 0.02 * GAP:
        simulation.step()
        behind = moved[0] * (simulation.time / end) ** 3 - equations.x[:n, 0] + start
        slip = comm.allreduce(float(np.abs(behind).max(initial=0.0)), MPI.MAX)
    slips = simulation.time / end * fastest / (static * G)
    simulation.destroy()
    assert 0.99 < slips < 1.03


@pytest.mark.parallel(1)
@pytest.mark.parametrize("integrator", ["beuler", "bdf2"])
def test_a_sheet_released_at_rest_is_held_by_static_friction(comm: MPI.Comm, integrator: str) -> None:
    """Springs of sticking contact must not oscillate beyond their limit, or the sheet would slide."""
    turn = {"axis": [0.0, 1.0, 0.0], "degrees": math.degrees(SLOPE)}

    def let_go(
        above: float, static: float, kinetic: float, end: float, step: float = 0.01
    ) -> tuple[float, float]:
        """Its distance over the gap at the end, and its way [m]."""
        place = [above * GAP * component for component in NORMAL]
        content = {
            "mesh": grid(0.3, 0.3, 3, 3) | {"transform": {"rotate": turn, "translate": place}},
            "material": LIGHT,
            "gravity": [0.0, 0.0, -G],
            "contact": {"gap": GAP, "friction": {"static": static, "kinetic": kinetic}, "self": False},
            "obstacles": {"slope": PLANE},
            "time": {"end": end, "step": step, "integrator": integrator},
        }
        simulation = SteppedScene(comm, scene_of(content))
        equations = simulation.problem.equations
        start = equations.x.copy()
        while not simulation.finished:
            simulation.step()
        distance, slip = (values.mean(axis=0) for values in (equations.x, equations.x - start))
        simulation.destroy()
        return float(distance @ NORMAL) / GAP, float(slip @ DOWN)

    lies, _ = let_go(0.95, 3.0, 3.0, 1.0)
    limit = math.tan(SLOPE)
    for step in (0.01, 0.04):
        assert let_go(lies, 1.01 * limit, 0.6 * limit, 0.3, step)[1] < 1.5e-2 * GAP
    assert let_go(lies, 0.99 * limit, 0.6 * limit, 0.3)[1] > 5.0 * GAP


def first_accelerations(comm: MPI.Comm, content: dict[str, Any]) -> Array:
    """Accelerations [m/s²] of all vertices with which the integrator for contact starts."""
    content = content | {"time": {"end": 0.02, "step": 0.02, "integrator": "alpha2"}}
    simulation = SteppedScene(comm, scene_of(content))
    integrator, found = simulation.problem.equations.integrators.in_contact, []
    keep = integrator.set_acceleration

    def set_acceleration(acceleration: Array) -> None:
        found.append(acceleration)
        keep(acceleration)

    integrator.set_acceleration = set_acceleration  # type: ignore[method-assign]
    simulation.step()
    a = gathered(simulation.problem.points, found[0])
    simulation.destroy()
    return a


def test_accelerations_at_the_start_are_those_with_friction(comm: MPI.Comm) -> None:
    """Friction stops a slow sheet within the step, brakes a fast one, and takes it along with an obstacle."""
    mu, step = 0.5, 0.02
    content = on_plane((0.1, 3), 0.005, 0.985, {"static": mu, "kinetic": 0.3}, {})
    rest = first_accelerations(comm, content)
    friction = mu * (G + rest[:, 2].mean())
    assert friction > 0.1
    np.testing.assert_allclose(rest[:, :2], 0.0, atol=1e-6)
    pull = {"gravity": [0.3 * friction, 0.4 * friction, -G]}
    np.testing.assert_allclose(first_accelerations(comm, content | pull)[:, :2], 0.0, atol=1e-6)
    pull = {"gravity": [1.2 * friction, 1.6 * friction, -G]}
    slides = first_accelerations(comm, content | pull)
    np.testing.assert_allclose(slides[:, :2], friction * np.tile([0.6, 0.8], (16, 1)), rtol=1e-6)
    fast = first_accelerations(comm, content | {"initial": {"velocity": [-1.0, 0.0, 0.0]}})
    np.testing.assert_allclose(fast[:, 0], friction, rtol=1e-6)
    drift = {"initial": {"velocity": [0.2 * friction * step, 0.0, 0.0]}}
    slow = first_accelerations(comm, content | drift)
    np.testing.assert_allclose(slow[:, 0], -0.4 * friction, rtol=1e-6)
    away = [{"time": 0.0}, {"time": 1.0, "translate": [0.0, 2.0, 0.0]}]
    belt = {"floor": {"plane": FLAT, "motion": away, "interpolation": "linear"}}
    carried = first_accelerations(comm, content | {"obstacles": belt})
    np.testing.assert_allclose(carried[:, 1], friction, rtol=1e-6)
    rides = {"obstacles": belt, "initial": {"velocity": [0.0, 2.0, 0.0]}}
    np.testing.assert_allclose(first_accelerations(comm, content | rides)[:, :2], 0.0, atol=1e-6)


def test_a_stack_is_held_by_friction_from_the_start(comm: MPI.Comm) -> None:
    """The friction between all sheets is found together."""
    gap, push = 0.002, 0.1
    sheets = [
        grid(0.1, 0.1, 4, 4) | {"transform": {"translate": [0.0, 0.0, (k + 1) * 0.96 * gap]}}
        for k in range(3)
    ]
    content = {
        "mesh": sheets,
        "material": LIGHT,
        "gravity": [push, 0.0, -G],
        "contact": {"gap": gap, "friction": 0.5},
        "obstacles": {"floor": {"plane": FLAT}},
    }
    np.testing.assert_allclose(first_accelerations(comm, content)[:, :2], 0.0, atol=0.15 * push)


def test_friction_on_a_tilting_plane_has_a_potential(comm: MPI.Comm) -> None:
    """Otherwise line searches fail: slip excludes the plane's rotation beside its normal."""
    tilted = {"axis": [1.0, 0.0, 0.0], "degrees": 30.0}
    content = {
        "mesh": grid(0.4, 0.4, 4, 4) | {"transform": {"translate": [-0.2, -0.2, 0.95 * GAP]}},
        "material": CLOTH | {"bending": 1e-4},
        "gravity": [0.0, 0.0, -G],
        "contact": {"gap": GAP, "friction": 0.4, "self": False},
        "obstacles": {"floor": {"plane": FLAT, "motion": [{"time": 0.0}, {"time": 0.3, "rotate": tilted}]}},
        "time": {"end": 0.3, "step": 0.01},
    }
    with finished(comm, content) as simulation:
        assert simulation.totals["rejected"] == 0


def test_a_sticking_sheet_rotates_with_a_plane(comm: MPI.Comm) -> None:
    """The elastic part of the slip, which balances inertia, must rotate, too; else the sheet would creep."""
    quarter, heavy = {"axis": [0.0, 0.0, 1.0], "degrees": 90.0}, LIGHT | {"density": 400.0}
    turns, time = {"motion": [{"time": 0.3}, {"time": 1.5, "rotate": quarter}]}, {"end": 1.6, "step": 0.02}
    content = on_plane((0.06, 2), GAP, 0.95, 0.5, turns, time=time, material=heavy)
    content["mesh"]["transform"]["translate"][0] = 0.4
    simulation = SteppedScene(comm, scene_of(content))
    layout = simulation.problem.points
    settled = None
    while not simulation.finished:
        simulation.step()
        if settled is None and simulation.time > 0.29:
            settled = gathered(layout, simulation.problem.equations.x)
    x = gathered(layout, simulation.problem.equations.x)
    simulation.destroy()
    assert settled is not None
    crept = np.column_stack([x[:, 1], -x[:, 0]]) - settled[:, :2]
    assert np.abs(crept).max() < 1e-6


def running(speed: float) -> dict[str, Any]:
    """Motion of a belt along x [m/s]."""
    away = {"time": 1.0, "translate": [speed, 0.0, 0.0]}
    return {"motion": [{"time": 0.0}, away], "interpolation": "linear"}


@pytest.mark.parametrize("integrator", ["beuler", "midpoint", "bdf2"])
def test_friction_turns_half_of_the_work_of_a_belt_into_heat(comm: MPI.Comm, integrator: str) -> None:
    """A sheet falls on it and slides until it has its speed, whatever the normal force is meanwhile."""
    speed = 0.35
    time = {"end": 0.14, "step": 0.001, "integrator": integrator}
    with finished(comm, on_plane((0.2, 4), 0.002, 1.5, 0.4, running(speed), time=time)) as simulation:
        equations, n = simulation.problem.equations, simulation.problem.points.n_owned
        own = float(equations.mass.sum()), float(equations.mass @ equations.v[:n, 0])
        mass, momentum = equations.points.global_sum(*own)
        work = simulation.energy_balance.columns()["friction_work"]
    assert momentum == pytest.approx(mass * speed, rel=1e-6)
    assert work == pytest.approx(0.5 * mass * speed**2, rel=0.04)


@pytest.mark.parametrize("integrator", ["midpoint", pytest.param("alpha2", marks=pytest.mark.parallel(1))])
def test_an_obstacle_does_work_on_a_sheet_that_it_moves(comm: MPI.Comm, integrator: str) -> None:
    """A plane starts to move by many times the limit of elastic slip in a step.

    The sheet bounces by some per cent of the gap and slips meanwhile, under alpha2 0.05 mm with this Δt.
    """
    end, far = 0.1, 0.6
    motion = {"motion": running(far)["motion"]}
    time = {"end": end, "step": 0.005, "integrator": integrator}
    with stepped(comm, on_plane((0.06, 3), 0.003, 0.985, 0.5, motion, time=time)) as simulation:
        start = shape(simulation)
        while not simulation.finished:
            simulation.step()
        slip = (shape(simulation) - start)[:, 0]
        rejected = simulation.totals["rejected"]
    np.testing.assert_allclose(slip, far * (3.0 * end**2 - 2.0 * end**3), rtol=4e-3)
    assert rejected <= 4


def test_a_running_belt_drags_a_sheet_from_rest(comm: MPI.Comm) -> None:
    """Friction, zero at the start, reaches its limit early in the first step: all steps balance energy."""
    speed, friction, end = 1.0, 0.5, 0.1
    time, heavy = {"end": end, "step": 0.01, "integrator": "midpoint"}, LIGHT | {"density": 40.0}
    content = on_plane((0.06, 2), GAP, 0.985, friction, running(speed), time=time, material=heavy)
    with finished(comm, content) as simulation:
        equations, n = simulation.problem.equations, simulation.problem.points.n_owned
        momentum = comm.allreduce(np.append(equations.mass @ equations.v[:n], equations.mass.sum()))
        rejected = simulation.totals["rejected"]
    assert momentum[0] / momentum[3] == pytest.approx(friction * G * end, rel=0.05)  # the sheet bounces
    assert rejected <= 2


@pytest.mark.parallel(1)
@pytest.mark.parametrize("integrator", ["beuler", "alpha2", "semi-implicit"])
def test_friction_uses_normal_forces_of_the_same_time(comm: MPI.Comm, integrator: str) -> None:
    """A sheet dropped on the slope: friction that is one step late would lack g sin α Δt permanently.

    The first step of ``bdf2`` and ``alpha2``, of another form than the others, leaves some percent of that.
    """
    accuracy = 0.05 if integrator in ("bdf2", "alpha2") else 0.01
    for part in (0.5, 1.01):
        _, speed, *_ = on_slope(comm, part * math.tan(SLOPE), 0.5, integrator=integrator, above=0.97)
        expected = max(1.0 - part, 0.0) * G * math.sin(SLOPE) * 0.5
        assert speed == pytest.approx(expected, abs=accuracy * G * math.sin(SLOPE) * 0.01)


# in contact midpoint and alpha2 take the steps of bdf2, and semi-implicit those of beuler
INTEGRATORS = ["bdf2", pytest.param("beuler", marks=pytest.mark.parallel(1))]


def on_a_sheet(friction: float, integrator: str, end: float) -> dict[str, Any]:
    """A sheet on a larger sheet with another mesh, which is held on the slope."""
    turn, side, low = {"axis": [0.0, 1.0, 0.0], "degrees": math.degrees(SLOPE)}, 0.2, 0.35
    gap = 0.2 * GAP
    place = [0.07 * along + 0.97 * gap * out for along, out in zip(DOWN, NORMAL, strict=True)]
    lower = grid(1.4, low, 24, 6, "alternating") | {"transform": {"rotate": turn}}
    upper = grid(side, side, 4, 4) | {"transform": {"rotate": turn, "translate": [place[0], 0.06, place[2]]}}
    return {
        "mesh": [lower, upper],
        "material": CLOTH | {"bending": 1e-4, "damping": 0.01},
        "gravity": [0.0, 0.0, -G],
        "contact": {"gap": gap, "friction": friction},
        "handles": [{"nodes": list(range(25 * 7))}],
        "time": {"end": end, "step": 0.01, "integrator": integrator},
    }


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_sheet_sticks_to_a_plane_and_to_a_sheet(comm: MPI.Comm, integrator: str) -> None:
    """With 1.01 of the necessary friction it bounces at first, and then does not move."""
    place = [0.96 * GAP * component for component in NORMAL]
    turn = {"axis": [0.0, 1.0, 0.0], "degrees": math.degrees(SLOPE)}
    friction = 1.01 * math.tan(SLOPE)
    sheet = on_a_sheet(friction, integrator, 1.2)
    plane = sheet | {
        "mesh": grid(0.4, 0.4, 3, 3) | {"transform": {"rotate": turn, "translate": place}},
        "obstacles": {"slope": PLANE},
        "contact": {"gap": GAP, "friction": friction},
        "handles": [],
    }
    for content in (plane, sheet):
        simulation = SteppedScene(comm, scene_of(content))
        equations, n = simulation.problem.equations, simulation.problem.points.n_owned
        settled = None
        while not simulation.finished:
            simulation.step()
            if settled is None and simulation.time > 0.8 - 1e-9:
                settled = equations.x[:n].copy()
        moved = comm.allreduce(float(np.abs(equations.x[:n] - settled).max(initial=0.0)), MPI.MAX)
        simulation.destroy()
        assert moved < 1e-6


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_sheet_slides_on_a_sheet_by_coulombs_law(comm: MPI.Comm, integrator: str) -> None:
    friction, end, begin = 0.8 * math.tan(SLOPE), 0.5, 0.2
    simulation = SteppedScene(comm, scene_of(on_a_sheet(friction, integrator, end)))
    equations, layout = simulation.problem.equations, simulation.problem.points
    upper = np.where(layout.mesh_vertices >= 25 * 7, equations.mass[: layout.n_vertices], 0.0)
    mass = comm.allreduce(float(upper.sum()))
    speeds, times = [], []
    while not simulation.finished:
        simulation.step()
        if simulation.time > begin - 1e-9:
            times.append(simulation.time)
            speeds.append(comm.allreduce(float(upper @ equations.v[: layout.n_vertices] @ DOWN)) / mass)
    found = (speeds[-1] - speeds[0]) / (times[-1] - times[0])
    simulation.destroy()
    assert found == pytest.approx(0.2 * G * math.sin(SLOPE), rel=6e-3)


def test_sheets_with_friction_conserve_momentum(comm: MPI.Comm) -> None:
    """Thrown at each other, and rotating against each other; angular momentum up to the error of bdf2."""
    side, gap, low = 0.2, 0.004, 49
    turn = {"axis": [0.3, 1.0, 0.2], "degrees": 40.0}
    upper = {"transform": {"rotate": turn, "translate": [0.02, 0.04, 0.13]}}
    content = {
        "mesh": [grid(side, side, 6, 6, "alternating"), grid(0.8 * side, 0.7 * side, 5, 4) | upper],
        "material": {"cloth": "gray-interlock"},
        "contact": {"gap": gap, "friction": 0.6},
        "time": {"end": 0.04, "step": 0.002, "integrator": "midpoint"},
    }
    simulation = SteppedScene(comm, scene_of(content))
    equations, layout = simulation.problem.equations, simulation.problem.points
    n = layout.n_vertices
    below = (layout.mesh_vertices < low)[:, None]
    spin = np.cross(np.where(below, [0.0, 0.0, 8.0], [0.0, 0.0, -8.0]), equations.x[:n] - 0.5 * side)
    equations.v[:n] = np.where(below, [0.4, 0.0, 2.0], [0.0, 0.0, -2.0]) + spin
    layout.update_ghosts(equations.v)
    simulation.energy_balance.measure()

    def momenta() -> tuple[Array, Array]:
        """Momentum and angular momentum, and the sums of their parts' magnitudes."""
        momentum = equations.mass[:n, None] * equations.v[:n]
        each = np.column_stack([momentum, np.cross(equations.x[:n], momentum)])
        both = comm.allreduce(np.stack([each.sum(axis=0), np.abs(each).sum(axis=0)]))
        return both[0], both[1].reshape(2, 3).sum(axis=1).repeat(3)

    (before, size), rubbed = momenta(), 0.0
    allowed = size * np.repeat([1e-11, 2e-3], 3)
    while not simulation.finished:
        simulation.step()
        assert (np.abs(momenta()[0] - before) < allowed).all()
        rubbed = simulation.energy_balance.columns()["friction_work"]
    assert rubbed > 0.05 * simulation.budget.total
    simulation.destroy()


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["beuler", "midpoint"])
def test_a_resumed_run_keeps_sticking_contacts(comm: MPI.Comm, shared_tmp: Path, integrator: str) -> None:
    """Two crossed sheets stick on a slope, so heavy that their edges touch.

    On one rank the edges have another numbering.
    """
    place = [0.9 * GAP * component for component in NORMAL]
    above = [1.85 * GAP * component for component in NORMAL]
    turn = {"axis": [0.0, 1.0, 0.0], "degrees": math.degrees(SLOPE)}
    lower = grid(0.4, 0.4, 3, 3) | {"transform": {"rotate": turn, "translate": place}}
    upper = grid(0.37, 0.33, 4, 3) | {"transform": {"rotate": turn, "translate": above}}
    tight = {"force_tolerance": 1e-11, "step_tolerance": 1e-10}
    scene = scene_of(
        {
            "mesh": [lower, upper],
            "material": CLOTH | {"bending": 1e-4, "damping": 0.01, "density": 400.0},
            "gravity": [0.0, 0.0, -G],
            "contact": {"gap": GAP, "friction": 1.2 * math.tan(SLOPE)},
            "obstacles": {"slope": {"plane": {"point": [0.0, 0.0, 0.0], "normal": NORMAL}}},
            "time": {"end": 0.16, "step": 0.004, "integrator": integrator},
            "solver": tight,
        }
    )
    simulation = SteppedScene(comm, scene)
    start = gathered(simulation.problem.points, simulation.problem.equations.x)
    while not simulation.finished:
        simulation.step()
    unbroken = gathered(simulation.problem.points, simulation.problem.equations.x)
    term = simulation.problem.terms["friction"]
    assert isinstance(term, CoulombFriction)
    stored = term.state()
    vertices, values = (
        stored["slip"].vertices,
        {name: stored[name].values for name in ("pair", "slip", "slides")},
    )
    assert vertices is not None
    between = (values["pair"][:, 0] == EDGE_EDGE) & (values["pair"][:, 1] < 0)
    renamed, turned = vertices.copy(), values["slip"].copy()
    renamed[between] = vertices[between][:, [3, 2, 1, 0]]
    turned[between] *= -1.0
    term.restore_pairs(renamed, values | {"slip": turned}, {})
    again = term.state()
    np.testing.assert_array_equal(again["slip"].vertices, vertices)
    for name in values:
        np.testing.assert_array_equal(again[name].values, values[name])
    slips = comm.allgather(np.linalg.norm(values["slip"], axis=1).max(initial=0.0))
    kinds = set().union(
        *comm.allgather({(int(kind), obstacle < 0) for kind, obstacle in values["pair"][:, :2]})
    )
    simulation.destroy()
    assert max(slips) > 1e-6  # without which the sheets would creep on
    assert {(EDGE_EDGE, True), (VERTEX_TRIANGLE, True)} <= kinds
    x = end_on_one_rank(comm, scene, shared_tmp / "run", 20)
    if x is not None:
        assert np.abs(unbroken - start).max() > 1e-4
        np.testing.assert_allclose(x, unbroken, rtol=0, atol=1e-9)


@pytest.mark.parallel
def test_obstacles_in_another_order_keep_sticking_contacts(comm: MPI.Comm, shared_tmp: Path) -> None:
    """A sheet sticks on two rails down a slope; the scene that goes on has an obstacle more."""
    turn = {"axis": [0.0, 1.0, 0.0], "degrees": math.degrees(SLOPE)}
    place = [(0.01 + 0.9 * GAP) * component for component in NORMAL]
    ends = (-DOWN).tolist(), (2.0 * DOWN).tolist()
    rails: dict[str, Any] = {
        name: {"capsule": {"from": [a, y, b], "to": [c, y, d], "radius": 0.01}}
        for (a, _, b), (c, _, d), name, y in ((*ends, "left", 0.07), (*ends, "right", 0.31))
    }
    content = {
        "mesh": grid(0.4, 0.4, 5, 5) | {"transform": {"rotate": turn, "translate": place}},
        "material": CLOTH | {"bending": 1e-2, "damping": 0.01},
        "gravity": [0.0, 0.0, -G],
        "contact": {"gap": GAP, "friction": 1.2 * math.tan(SLOPE), "self": False},
        "obstacles": rails,
        "time": {"end": 0.16, "step": 0.004},
        "solver": {"force_tolerance": 1e-11, "step_tolerance": 1e-10},
    }
    far = {"sphere": {"center": [0.0, 0.0, 9.0], "radius": 0.5}}
    changed = content | {"obstacles": {"ball": far, "right": rails["right"], "left": rails["left"]}}
    with finished(comm, content) as simulation:
        unbroken = shape(simulation)
    simulation = SteppedScene(comm, scene_of(content))
    recorder = Recorder(simulation)
    if comm.rank == 0:
        (shared_tmp / "run").mkdir()
    comm.Barrier()
    recorder.begin(shared_tmp / "run")
    for _ in range(20):
        recorder.record(simulation.step())
    before = shape(simulation)
    recorder.write_checkpoint()
    recorder.flush()
    recorder.close()
    simulation.destroy()
    resumed = SteppedScene(comm, scene_of(changed))
    recorder = Recorder(resumed)
    recorder.resume(shared_tmp / "run")
    term = resumed.problem.terms["friction"]
    assert isinstance(term, CoulombFriction)
    assert EDGE_EDGE in set().union(*comm.allgather(set(term.state()["pair"].values[:, 0].tolist())))
    while not resumed.finished:
        recorder.record(resumed.step())
    after = shape(resumed)
    recorder.flush()
    recorder.close()
    resumed.destroy()
    assert np.abs(unbroken - before).max() > 1e-6
    np.testing.assert_allclose(after, unbroken, rtol=0.0, atol=1e-9)
