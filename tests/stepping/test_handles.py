"""Handles as exact constraints: positions of held vertices under all motions."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, Simulation, grid, rotation, scene_of

from lyra_petsc.errors import InputError
from lyra_petsc.output.fields import FIELDS
from lyra_petsc.scene.schema import Keyframe, Obstacle
from lyra_petsc.terms.handles.motion import Motion, Window, motion_of
from lyra_petsc.terms.handles.spring import Spring

DT = 0.05
MESH = grid(1.0, 0.6, 4, 3)


def keyframes(*rows: dict[str, Any]) -> list[Keyframe]:
    return [Keyframe.model_validate(row) for row in rows]


def turn(degrees: float, axis: list[float] | None = None) -> dict[str, Any]:
    return {"axis": axis or [0, 0, 1], "degrees": degrees}


# -- motions -------------------------------------------------------------------------------------------


def test_linear_translation_is_a_straight_line() -> None:
    motion = Motion(keyframes({"time": 1}, {"time": 3, "translate": [2, 0, -4]}), "linear")
    points = np.array([[0.1, 0.2, 0.3]])
    for t, share in ((0.0, 0.0), (1.0, 0.0), (1.5, 0.25), (2.5, 0.75), (3.0, 1.0), (9.0, 1.0)):
        np.testing.assert_allclose(
            motion.moved(points, 0.0, t) - points, [[2 * share, 0, -4 * share]], atol=1e-15
        )
    np.testing.assert_allclose(motion.velocity(points, 0.0, 2.0), [[1, 0, -2]], rtol=1e-8)
    np.testing.assert_allclose(motion.velocity(points, 0.0, 4.0), 0.0)


def test_hermite_starts_and_ends_at_rest_and_passes_with_the_central_difference() -> None:
    motion = Motion(
        keyframes({"time": 0}, {"time": 1, "translate": [1, 0, 0]}, {"time": 3, "translate": [4, 0, 0]}),
        "hermite",
    )
    origin = np.zeros((1, 3))
    slope = 4.0 / 3.0
    for t in np.linspace(0.05, 0.95, 7):
        expected = 3 * t**2 - 2 * t**3 + slope * (t**3 - t**2)
        assert motion.moved(origin, 0.0, t)[0, 0] == pytest.approx(expected, rel=1e-13)
    assert motion.velocity(origin, 0.0, 0.0)[0, 0] == pytest.approx(0.0, abs=1e-4)
    assert motion.velocity(origin, 0.0, 1.0)[0, 0] == pytest.approx(slope, rel=1e-5)
    assert motion.velocity(origin, 0.0, 3.0)[0, 0] == pytest.approx(0.0, abs=1e-4)


def test_a_keyframe_velocity_replaces_the_tangent() -> None:
    motion = Motion(
        keyframes(
            {"time": 0, "velocity": [1, 0, 0]}, {"time": 2, "translate": [2, 0, 0], "velocity": [1, 0, 0]}
        ),
        "hermite",
    )
    for t in (0.3, 1.0, 1.7):
        assert motion.moved(np.zeros((1, 3)), 0.0, t)[0, 0] == pytest.approx(t, rel=1e-13)


@pytest.mark.parametrize("degrees", [45.0, -120.0, 200.0, 300.0])
@pytest.mark.parametrize("kind", ["linear", "hermite", "monotone"])
def test_half_of_a_rotation_is_half_the_angle(degrees: float, kind: str) -> None:
    motion = Motion(keyframes({"time": 0}, {"time": 2, "rotate": turn(degrees, [1, 1, 0])}), kind)
    points = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    for t, part in ((1.0, 0.5), (2.0, 1.0), (0.0, 0.0)):
        expected = points @ rotation([1, 1, 0], np.radians(part * degrees)).T
        np.testing.assert_allclose(motion.moved(points, 0.0, t), expected, atol=1e-13)
    middle = motion.moved(points, 0.0, 0.7)
    np.testing.assert_allclose(np.linalg.norm(middle, axis=1), np.linalg.norm(points, axis=1), rtol=1e-13)


@pytest.mark.parametrize("kind", ["linear", "hermite", "monotone"])
@pytest.mark.parametrize("degrees", [(0, 50, -90), (0, 500, 300)])
def test_velocity_is_the_derivative(degrees: tuple[float, ...], kind: str) -> None:
    rows = [
        {"time": i, "rotate": turn(angle, [1, 2, -1]), "scale": [1 + i, 1, 1], "translate": [0, 2 * i * i, 1]}
        for i, angle in enumerate(degrees)
    ]
    motion, points, h = Motion(keyframes(*rows), kind), np.array([[1.0, 2.0, 3.0], [0.0, -1.0, 0.5]]), 1e-5
    for time in (-0.5, 0.3, 0.8, 1.6, 2.5):
        change = motion.moved(points, 0.2, time + h) - motion.moved(points, 0.2, time - h)
        np.testing.assert_allclose(motion.velocity(points, 0.2, time), change / (2 * h), rtol=0, atol=1e-6)


def test_a_keyframe_scales_then_rotates_then_translates() -> None:
    rows = keyframes({"time": 0, "scale": [2, 1, 3], "rotate": turn(90), "translate": [0, 0, 1]})
    matrix, offset = Motion(rows, "linear").transform(0.0)
    np.testing.assert_allclose(matrix @ [1, 1, 1] + offset, [-1, 2, 4], atol=1e-15)


def test_a_motion_is_relative_to_the_start_of_the_handle() -> None:
    motion = Motion(
        keyframes({"time": 0, "translate": [1, 0, 0]}, {"time": 2, "translate": [3, 0, 0]}), "linear"
    )
    np.testing.assert_allclose(motion.moved(np.zeros((1, 3)), 1.0, 2.0), [[1, 0, 0]])
    np.testing.assert_allclose(motion.moved(np.zeros((1, 3)), 1.0, 1.0), [[0, 0, 0]])


@pytest.mark.parametrize("kind", ["linear", "hermite", "monotone"])
@pytest.mark.parametrize(
    "degrees", [[0, 360], [0, 450], [0, -3600], [10, 3610, -90], [0, 90, 630], [0, 720, 0, 30]]
)
def test_angles_beyond_one_turn_are_kept(degrees: list[float], kind: str) -> None:
    rows = [{"time": i, "rotate": turn(angle, [0, 0, 2])} for i, angle in enumerate(degrees)]
    # the same axis, the other way round, and none
    rows[-1]["rotate"] = turn(-degrees[-1], [0, 0, -1])
    motion = Motion(keyframes(*rows), kind)
    times = np.linspace(0, len(degrees) - 1, 400 * (len(degrees) - 1) + 1)
    points = np.array([[1.0, 0.0, 0.0]])
    angles = np.degrees(np.unwrap([np.arctan2(*motion.moved(points, 0.0, t)[0, 1::-1]) for t in times]))
    np.testing.assert_allclose(angles[::400], np.array(degrees) - degrees[0], atol=1e-9)
    middle = motion.moved(points, 0.0, 0.5)
    if kind == "linear" or len(degrees) == 2:
        half = np.radians(0.5 * (degrees[1] - degrees[0]))
        np.testing.assert_allclose(middle, [[np.cos(half), np.sin(half), 0.0]], atol=1e-12)
    rates = np.diff(angles) / np.diff(times)
    jumps = np.abs(np.diff(rates)).max() / np.abs(rates).max()
    assert jumps < (3.0 if kind == "linear" else 0.05)


@pytest.mark.parametrize("turns", [170.0, 2000.0])
def test_a_monotone_motion_stays_between_neighbouring_keyframes(turns: float) -> None:
    """Also a rotation by its angle, and exactly at rest through a hold; the original's swings beyond."""
    random = np.random.default_rng(3)
    places, scales = random.uniform(-1.0, 1.0, (8, 3)), random.uniform(0.5, 2.0, 8)
    angles = random.uniform(-turns, turns, 8)
    for values in (places, scales, angles):
        values[4:6] = values[3]  # a hold
    times = np.cumsum(random.uniform(0.1, 1.0, 8))
    rows = [
        {"time": t, "translate": place.tolist(), "scale": scale, "rotate": turn(angle, [0, 0, 3])}
        for t, place, scale, angle in zip(
            times.tolist(), places, scales.tolist(), angles.tolist(), strict=True
        )
    ]
    overshoot = {}
    for kind in ("monotone", "hermite"):
        motion = Motion(keyframes(*rows), kind)
        worst = 0.0
        for i in range(7):
            fine = [motion.transform(t) for t in np.linspace(times[i], times[i + 1], 200)]
            size = np.array([np.linalg.norm(a[:, 0]) for a, _ in fine])
            turned = np.unwrap([np.arctan2(a[1, 0], a[0, 0]) for a, _ in fine])
            found = np.column_stack([np.array([d for _, d in fine]), size, np.degrees(turned - turned[0])])
            ends = np.column_stack([places, scales, angles - angles[i]])[i : i + 2]
            found[:, 4] += ends[0, 4]
            worst = max(worst, (ends.min(axis=0) - found).max(), (found - ends.max(axis=0)).max())
            if 3 <= i < 5 and kind == "monotone":
                assert np.ptp(found, axis=0).max() < 1e-12
        overshoot[kind] = worst
    assert overshoot["monotone"] < 1e-9
    assert overshoot["hermite"] > 0.01


def test_a_handle_and_an_obstacle_do_not_swing_beyond_a_hold_unless_told() -> None:
    frames = [{"time": 0}, {"time": 1, "rotate": turn(90)}, {"time": 2, "rotate": turn(178)}]
    frames.append({"time": 3, "rotate": turn(178)})
    content = {"mesh": MESH, "handles": [{"nodes": [0], "motion": "fold"}], "motions": {"fold": frames}}
    for interpolation in ("monotone", "hermite"):
        if interpolation == "hermite":
            content["handles"][0]["interpolation"] = interpolation
        motion = motion_of(scene_of(content), 0)
        angle = np.degrees([np.arctan2(*motion.transform(t)[0][1::-1, 0]) for t in np.linspace(1, 3, 201)])
        beyond = (angle[angle > 0.0].max() > 178.0 + 1e-9) | (angle < 0.0).any()
        assert beyond == (interpolation == "hermite")
    assert Obstacle.model_validate({"box": {"min": [0, 0, 0], "max": [1, 1, 1]}}).interpolation == "monotone"


@pytest.mark.parametrize("kind", ["linear", "hermite", "monotone"])
@pytest.mark.parametrize("extra", [[], [turn(30, [0, 1, 0]), turn(750, [0, 1, 0])]])
def test_rotations_about_different_axes_are_interpolated_by_the_shortest_rotation(
    extra: list[dict[str, Any]], kind: str
) -> None:
    turns = [turn(170, [1, 0, 0]), turn(170, [-1, 0.1, 0]), turn(160, [-1, 0.1, 0]), *extra]
    motion = Motion(keyframes(*({"time": i, "rotate": each} for i, each in enumerate(turns))), kind)
    matrices = [motion.transform(t)[0] for t in np.linspace(0, 2, 201)]
    angles = [np.arccos(np.clip(0.5 * (np.trace(b @ a.T) - 1.0), -1.0, 1.0)) for a, b in pairwise(matrices)]
    ends = np.degrees(np.arccos(0.5 * (np.trace(matrices[100] @ matrices[0].T) - 1.0)))
    assert ends < 30.0
    assert np.degrees(sum(angles[:100])) == pytest.approx(ends, rel=0.05)
    assert np.degrees(sum(angles[100:])) == pytest.approx(10.0, rel=0.05)


def test_more_than_half_a_turn_between_different_axes_is_refused() -> None:
    rows = keyframes(
        {"time": 0}, {"time": 1, "rotate": turn(90)}, {"time": 2, "rotate": turn(181, [1, 0, 0])}
    )
    with pytest.raises(InputError, match=r"keyframes 1 and 2 .*180°") as refused:
        Motion(rows, "hermite", key="motions.swing")
    assert refused.value.key == "motions.swing"


def test_from_until_and_fade() -> None:
    window = Window(1.0, 2.0, 0.5)
    assert [window.holds(*step) for step in ((0.9, 1.0), (1.0, 1.1), (1.9, 2.0), (1.95, 2.05))] == [
        False,
        True,
        True,
        False,
    ]
    assert window.strength(1.5, 1.6) == 1.0
    assert window.strength(2.0, 2.25) == pytest.approx(0.5**4)
    assert window.strength(2.4, 2.5) == 0.0
    assert window.strength(0.5, 0.6) == 0.0
    assert window.events() == [1.0, 2.0, 2.5]


# -- on a sheet ----------------------------------------------------------------------------------------


def held_scene(handles: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    motions = {
        "swing": [
            {"time": 0.1},
            {"time": 0.4, "rotate": turn(45, [0, 1, 0]), "translate": [0.1, 0, 0.2], "scale": 1.2},
            {"time": 0.8, "rotate": turn(90, [0, 1, 0])},
        ]
    }
    return {"mesh": MESH, "gravity": [0, 0, -9.81], "handles": handles, "motions": motions} | more


@pytest.mark.parallel(2)
@pytest.mark.parametrize("integrator", ["beuler", "semi-implicit"])
@pytest.mark.parametrize("interpolation", ["linear", "hermite"])
def test_held_vertices_follow_the_motion_in_every_step(
    comm: MPI.Comm, integrator: str, interpolation: str
) -> None:
    nodes = [0, 5, 10, 15, 7]
    content = held_scene(
        [{"nodes": nodes, "motion": "swing", "interpolation": interpolation}],
        time={"end": 1.0, "step": DT, "integrator": integrator},
    )
    with Simulation(content, comm) as simulation:
        motion, start = motion_of(simulation.scene, 0), simulation.x[nodes]
        for step in range(1, 19):
            simulation.step(DT)
            expected = motion.moved(start, 0.0, simulation.time)
            np.testing.assert_allclose(simulation.x[nodes], expected, rtol=0.0, atol=1e-15)
            written = simulation.gather(FIELDS["velocity"].compute(simulation.problem))[nodes]
            np.testing.assert_allclose(written, motion.velocity(start, 0.0, simulation.time), atol=1e-12)
            assert step < 2 or np.abs(simulation.x[19] - start[0]).max() > 0.0


@pytest.mark.parallel
def test_holding_one_axis_leaves_the_others_free(comm: MPI.Comm) -> None:
    with Simulation(held_scene([{"group": "sheet", "axes": ["x", "y"]}]), comm) as simulation:
        before = simulation.x
        fallen = simulation.run(DT, 4) - before
        np.testing.assert_array_equal(fallen[:, :2], 0.0)
        np.testing.assert_allclose(fallen[:, 2], -9.81 * DT**2 * 10, rtol=1e-10)


@pytest.mark.parallel
def test_a_late_handle_starts_from_the_present_position_and_releases(comm: MPI.Comm) -> None:
    handle = {"nodes": [0, 4], "from": 0.1, "until": 0.2}
    with Simulation(held_scene([handle]), comm) as simulation:
        start = simulation.x
        caught = simulation.run(DT, 2)
        np.testing.assert_allclose(caught[:, 2] - start[:, 2], -9.81 * DT**2 * 3, rtol=1e-10)
        held = simulation.run(DT, 2)
        np.testing.assert_array_equal(held[[0, 4]], caught[[0, 4]])
        assert np.all(held[[10, 12], 2] < caught[[10, 12], 2])
        released = simulation.run(DT, 2)
        assert np.all(released[[0, 4], 2] < held[[0, 4], 2])


@pytest.mark.parallel
def test_a_late_moving_handle_makes_the_rest_of_its_motion(comm: MPI.Comm) -> None:
    handle = {"nodes": [0, 4], "from": 0.1, "motion": "swing"}
    with Simulation(held_scene([handle], initial={"velocity": [0.5, 0, 0]}), comm) as simulation:
        motion = motion_of(simulation.scene, 0)
        caught = simulation.run(DT, 2)[[0, 4]]
        for _ in range(5):
            simulation.step(DT)
            np.testing.assert_allclose(
                simulation.x[[0, 4]], motion.moved(caught, 0.1, simulation.time), rtol=0.0, atol=1e-15
            )


@pytest.mark.parallel
@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_last_handle_in_the_scene_wins(comm: MPI.Comm, order: tuple[int, int]) -> None:
    handles = [{"nodes": [0, 1]}, {"nodes": [1, 2], "motion": "swing"}]
    with Simulation(held_scene([handles[i] for i in order]), comm) as simulation:
        start = simulation.x
        motion = motion_of(simulation.scene, order.index(1))
        end = simulation.run(DT, 6)
        moved = motion.moved(start[[1, 2]], 0.0, 0.3)
        np.testing.assert_allclose(end[0], start[0])
        np.testing.assert_allclose(end[2], moved[1], atol=1e-15)
        np.testing.assert_allclose(end[1], moved[0] if order == (0, 1) else start[1], atol=1e-15)


@pytest.mark.parallel
def test_noise_does_not_move_held_vertices_or_the_start_of_handles(comm: MPI.Comm) -> None:
    content = held_scene([{"nodes": [0, 1]}], initial={"noise": 0.01})
    with Simulation(content, comm) as simulation, Simulation(held_scene([]), comm) as flat:
        np.testing.assert_array_equal(simulation.x[[0, 1]], flat.x[[0, 1]])
        simulation.step(DT)
        np.testing.assert_array_equal(simulation.x[[0, 1]], flat.x[[0, 1]])


# -- springs and fading --------------------------------------------------------------------------------


def test_a_spring_handle_settles_at_its_static_deflection() -> None:
    handle = {"group": "sheet", "stiffness": 50.0, "axes": ["z"]}
    side = {"group": "sheet", "axes": ["x", "y"]}
    stiff_shear = {"c11": 1e-3, "c22": 1e-3, "c12": 0.0, "c33": 1e-3}  # each vertex nearly for itself
    content = held_scene([handle, side], material=CLOTH | {"membrane": stiff_shear})
    with Simulation(content, MPI.COMM_SELF) as simulation:
        start = simulation.x
        sag = start - simulation.run(10.0, 6)
        np.testing.assert_allclose(sag[:, 2], simulation.mass * 9.81 / 50.0, rtol=1e-3)


def test_a_spring_handle_pulls_towards_its_moving_target() -> None:
    content = held_scene([{"nodes": [0, 1], "stiffness": 1e7, "motion": "swing"}], gravity=None)
    with Simulation(content, MPI.COMM_SELF) as simulation:
        start = simulation.x[:2]
        for _ in range(10):
            simulation.step(DT)
            target = motion_of(simulation.scene, 0).moved(start, 0.0, simulation.time)
            np.testing.assert_allclose(simulation.x[:2], target, atol=2e-5)


@pytest.mark.parametrize("soft", [True, False])
def test_a_fading_handle_weakens_with_the_fourth_power(soft: bool) -> None:
    handle = {"nodes": [0], "until": 0.1, "fade": 0.2} | ({"stiffness": 400.0} if soft else {})
    with Simulation(held_scene([handle]), MPI.COMM_SELF) as simulation:
        spring = simulation.problem.terms["spring"]
        assert isinstance(spring, Spring)
        full = 400.0 if soft else 1000.0
        start = simulation.x[0]
        for step in range(1, 9):
            simulation.step(DT)
            t = step * DT
            block = np.empty((1, 1, 1, 3, 3))
            spring.hessians(
                simulation.equations.x, simulation.equations.step.frozen[spring], 0, 1, 0.0, block
            )
            share = 1.0 if t <= 0.1 + 1e-12 else max(0.0, 1.0 - (t - 0.1) / 0.2) ** 4
            if not soft and t <= 0.1 + 1e-12:
                share = 0.0  # held exactly: no spring yet
                np.testing.assert_array_equal(simulation.x[0], start)
            np.testing.assert_allclose(block[0, 0, 0], full * share * np.eye(3), rtol=1e-9, atol=1e-9)
        assert simulation.x[0, 2] < start[2] - 0.05


# -- clamps --------------------------------------------------------------------------------------------


def tip_deflection(nx: int, clamp: bool, pattern: str = "criss-cross") -> float:
    """Deflection of a cantilever strip over P L³/(3 B w), for small P."""
    length, width, b = 1.0, 1.0 / nx, 0.5  # one square cell wide: a wide clamp would stiffen its surroundings
    load = 1e-6
    stiff = {"c11": 1e4, "c22": 1e4, "c12": 0.0, "c33": 5e3}
    content = {
        "mesh": grid(length, width, nx, 1, pattern),
        "material": {"density": 0.1, "membrane": stiff, "bending": b},
        "handles": [{"group": "left", "clamp": clamp}]
        if clamp
        else [{"box": [[-1, -1, -1], [1.001 * length / nx, 1, 1]]}],
        "loads": [{"group": "right", "force": [0, 0, load]}],
    }
    with Simulation(content, MPI.COMM_SELF) as simulation:
        x = simulation.run(1e6, 3)  # so long a step is the static answer
        tip = x[np.isclose(x[:, 0], length, atol=1e-3), 2].mean()
    return float(tip / (load * length**3 / (3.0 * b * width)))


@pytest.mark.parametrize(
    ("pattern", "stiffness"), [("criss-cross", 1.0), ("diagonal", 0.8), ("alternating", 0.8)]
)
def test_clamped_cantilever_converges_to_the_beam(pattern: str, stiffness: float) -> None:
    """With the stiffness of a strip with free edges on each kind of mesh, relative to B."""
    errors = [abs(tip_deflection(nx, clamp=True, pattern=pattern) * stiffness - 1.0) for nx in (10, 20, 40)]
    assert errors[2] < 3e-4
    assert errors[0] > 3.5 * errors[1] > 12.0 * errors[2]


def test_two_held_rows_without_a_half_hinge_are_a_worse_clamp() -> None:
    held_rows = abs(tip_deflection(20, clamp=False) - 1.0)
    assert held_rows > 3.0 * abs(tip_deflection(20, clamp=True) - 1.0)


def test_a_clamp_turns_with_its_handle() -> None:
    content = {
        "mesh": grid(1.0, 0.2, 10, 2),
        "material": CLOTH | {"bending": 0.5, "damping": 0.05},
        "handles": [{"group": "left", "clamp": True, "motion": "tip"}],
        "motions": {"tip": [{"time": 0}, {"time": 1, "rotate": turn(-60, [0, 1, 0])}]},
    }
    with Simulation(content, MPI.COMM_SELF) as simulation:
        start = simulation.x
        simulation.run(0.1, 10)
        end = simulation.run(1.0, 30)  # held still by now: the strip comes to rest, straight
        np.testing.assert_allclose(end, start @ rotation([0, 1, 0], -np.pi / 3).T, atol=1e-6)


# -- handles that disagree -----------------------------------------------------------------------------

LIFT = {"lift": [{"time": 0}, {"time": 1, "translate": [0, 0, 1]}], "same": [{"time": 0}, {"time": 1}]}


@pytest.mark.parametrize(
    ("handles", "noted"),
    [
        ([{"nodes": [0, 1]}, {"nodes": [1, 2], "motion": "lift"}], True),
        (
            [
                {"nodes": [0, 1], "motion": "lift"},
                {"nodes": [1], "motion": "lift", "interpolation": "linear"},
            ],
            True,
        ),
        ([{"nodes": [0, 1]}, {"nodes": [1, 2], "motion": "lift", "from": 0.5}], True),
        ([{"nodes": [0, 1]}, {"nodes": [1, 2], "motion": "same"}], False),
        ([{"nodes": [0, 1], "axes": ["x", "y"]}, {"nodes": [1, 2], "motion": "lift"}], False),
        ([{"nodes": [0, 1], "stiffness": 10.0}, {"nodes": [1, 2], "motion": "lift"}], False),
    ],
)
def test_handles_that_hold_the_same_vertices_elsewhere_are_noted(
    handles: list[dict[str, Any]], noted: bool
) -> None:
    content = {"mesh": MESH, "handles": handles, "motions": LIFT, "time": {"end": 2.0, "step": 0.1}}
    with Simulation(content, MPI.COMM_SELF) as simulation:
        notes = [note for note in simulation.problem.whole.notes if "different places" in note]
    assert len(notes) == noted
    assert all("hold 1 vertices (first: 1)" in note and "handles[1], the later" in note for note in notes)


@pytest.mark.parametrize(("nodes", "noted"), [([0], True), ([0, 1], False)])
def test_clamps_without_edges_are_noted(nodes: list[int], noted: bool) -> None:
    content = {"mesh": MESH, "handles": [{"nodes": nodes, "clamp": True}]}
    with Simulation(content, MPI.COMM_SELF) as simulation:
        notes = [note for note in simulation.problem.whole.notes if "clamp" in note]
    words = "handles[0]: clamp keeps the slope of edges whose two ends are held, and there are none"
    assert notes == [words] * noted
