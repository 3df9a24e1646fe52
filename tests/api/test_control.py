"""A program that drives a simulation: what it sets, reads, saves and restores."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lyra_petsc

SCENE: dict[str, Any] = {
    "mesh": {"grid": {"width": 0.4, "height": 0.4, "nx": 4, "ny": 4}},
    "material": {
        "density": 0.15,
        "membrane": {"c11": 800, "c22": 800, "c12": 160, "c33": 240},
        "bending": 2.0e-5,
        "damping": 0.005,
    },
    "gravity": [0, 0, -9.81],
    "handles": [{"nodes": [0, 4]}],
    "time": {"end": 0.1, "step": 0.01},
    "solver": {"force_tolerance": 1e-11, "step_tolerance": 1e-11},
    "petsc": {"ksp_rtol": 1e-12},
}
INTEGRATORS = "beuler", "semi-implicit", "midpoint", "alpha2", "bdf2"


def scene_with(integrator: str, **changes: Any) -> dict[str, Any]:
    return SCENE | {"time": SCENE["time"] | {"integrator": integrator}} | changes


def place(number: int) -> dict[str, Any]:
    """Where the handle is after so many steps."""
    angle = 3.0 * number * (1 + number % 3)
    return {
        "translate": [0.002 * number**2, 0.0, 0.003 * (number % 4)],
        "rotate": {"axis": [0, 0, 1], "degrees": angle},
    }


def ends(simulation: lyra_petsc.Simulation) -> tuple[Any, Any]:
    return simulation.gather(simulation.positions), simulation.gather(simulation.velocities)


@pytest.mark.parallel
@pytest.mark.parametrize("model", ["hinge", "midedge"])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_driven_handle_is_one_with_keyframes(comm: Any, integrator: str, model: str) -> None:
    material = SCENE["material"] | {"bending_model": model}
    scene = scene_with(integrator, material=material)
    keyframes = [{"time": 0.0}, *({"time": round(0.01 * n, 2)} | place(n) for n in range(1, 11))]
    handle = {"nodes": [0, 4], "motion": "path", "interpolation": "linear"}
    with lyra_petsc.Simulation(scene | {"handles": [handle], "motions": {"path": keyframes}}) as twin:
        energies = [step.energies for step in twin]
        expected = ends(twin)
    with lyra_petsc.Simulation(scene, drives=["handles[0]"]) as driven:
        for number in range(1, 11):
            driven.move("handles[0]", **place(number), at=round(0.01 * number, 2))
            while driven.time < round(0.01 * number, 2):  # steps may be halved
                step = driven.step()
        assert driven.finished
        reached = ends(driven)
    if comm.rank == 0:
        np.testing.assert_allclose(reached[0], expected[0], atol=1e-10)
        moves = slice(1, None)
        np.testing.assert_allclose(reached[1][moves], expected[1][moves], atol=1e-7)
    if integrator not in ("midpoint", "alpha2"):  # where reactions depend on the velocity after the step
        assert step.energies["external_work"] == pytest.approx(energies[-1]["external_work"], abs=1e-6)


@pytest.mark.parallel
def test_a_driven_obstacle_is_one_with_keyframes(comm: Any) -> None:
    ball = {"sphere": {"center": [0.2, 0.2, -0.13], "radius": 0.12}}
    scene = scene_with("beuler", contact={"friction": 0.3}, obstacles={"ball": ball})
    poses = [{"translate": [0.0, 0.001 * n, 0.003 * n + 0.001 * (n % 2)]} for n in range(11)]
    keyframes = [{"time": round(0.01 * n, 2)} | pose for n, pose in enumerate(poses)]
    moving = {"ball": ball | {"motion": keyframes, "interpolation": "linear"}}
    with lyra_petsc.Simulation(scene | {"obstacles": moving}) as twin:
        forces = [twin.obstacle_forces["ball"] for _ in twin]
        expected = ends(twin)
    with lyra_petsc.Simulation(scene, drives=["obstacles.ball"]) as driven:
        for pose in poses[1:]:
            driven.move("obstacles.ball", **pose)
            driven.step()
        reached, force = ends(driven), driven.obstacle_forces["ball"]
    assert forces[-1][2] < -0.01
    np.testing.assert_allclose(force, forces[-1], atol=1e-6)
    if comm.rank == 0:
        np.testing.assert_allclose(reached[0], expected[0], atol=1e-9)


VALUES: dict[str, tuple[Any, Any]] = {
    "gravity": (lambda value: {"gravity": value}, [0.0, 1.0, -9.0]),
    "wind.velocity": (lambda value: {"wind": {"velocity": value, "density": 1.2}}, [0.0, 1.0, 4.0]),
    "loads[0].pressure": (lambda value: {"loads": [{"pressure": value}]}, 3.0),
    "loads[0].force": (lambda value: {"loads": [{"nodes": [24], "force": value}]}, [0.0, 0.01, 0.02]),
    "loads[0].moment": (lambda value: {"loads": [{"group": "top", "moment": value}]}, 1e-4),
}
"""Keys that change a scene, and a typical value of each."""


@pytest.mark.parallel(2)
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", VALUES)
def test_a_driven_value_is_a_curve(comm: Any, name: str, integrator: str) -> None:
    keys, size = VALUES[name]
    points = [[round(0.01 * n, 2), (np.array(size) * (n * (4 - n) / 5)).tolist()] for n in range(6)]
    scene = scene_with(integrator, material=SCENE["material"] | {"bending_model": "midedge"})
    scene["time"] = scene["time"] | {"end": 0.05}
    del scene["gravity"]
    with lyra_petsc.Simulation(scene | keys(points)) as twin:
        energies = [step.energies for step in twin]
        expected = ends(twin)
    with lyra_petsc.Simulation(scene | keys(points[0][1]), drives=[name]) as driven:
        for time, value in points[1:]:
            driven.set(name, value, at=time)
            while driven.time < time:  # steps may be halved
                step = driven.step()
        reached = ends(driven)
    if comm.rank == 0:
        np.testing.assert_allclose(reached[0], expected[0], atol=1e-10)
        assert np.abs(expected[1]).max() > 1e-3
    assert step.energies == pytest.approx(energies[-1], rel=1e-6, abs=1e-12)


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_restored_state_goes_on_as_the_saved_one(comm: Any, integrator: str) -> None:
    material = SCENE["material"] | {"bending_model": "midedge", "bending": 2e-4}
    floor = {"plane": {"point": [0, 0, -0.01], "normal": [0, 0, 1]}}
    scene = scene_with(integrator, material=material, contact={"friction": 0.3}, obstacles={"floor": floor})
    with lyra_petsc.Simulation(scene, drives=["handles[0]"]) as simulation:
        start = simulation.positions

        def go_on(count: int) -> list[lyra_petsc.Step]:
            steps = []
            for _ in range(count):
                simulation.move("handles[0]", translate=[0, 0, 0.1 * simulation.time])
                steps.append(simulation.step())
            return steps

        go_on(4)
        simulation.forces = np.full((len(simulation.vertices), 3), 1e-3)
        saved = simulation.save()
        first = go_on(5)
        simulation.restore(saved)
        assert (simulation.step_number, simulation.time) == (4, pytest.approx(0.04))
        second = go_on(5)
        for one, other in zip(first, second, strict=True):
            np.testing.assert_allclose(one.positions, other.positions, atol=1e-11)
            assert one.energies == pytest.approx(other.energies, rel=1e-6, abs=1e-12)
        for name in ("handles[0]", "forces"):
            (note,) = (note for note in simulation.notes if f"program has set {name}" in note)
            assert "does not repeat this run" in note
        simulation.reset()
        assert not any("program has set" in note for note in simulation.notes)
        np.testing.assert_array_equal(simulation.positions, start)
        assert not simulation.forces.any()
        assert simulation.step_number == 0


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_positions_velocities_and_forces_of_the_program(comm: Any, integrator: str) -> None:
    scene = scene_with(integrator, handles=[])
    del scene["gravity"]
    with lyra_petsc.Simulation(scene) as sheet:
        start = sheet.positions
        sheet.velocities = np.tile([1.0, 2.0, 0.0], (len(start), 1))
        assert sheet.energies["external_work"] == pytest.approx(0.5 * 0.15 * 0.16 * 5.0)
        step = sheet.step()
        np.testing.assert_allclose(step.positions - start, [[0.01, 0.02, 0.0]] * len(start), atol=1e-12)
        sheet.reset()
        sheet.positions = start + [0.0, 0.0, 5.0]
        np.testing.assert_allclose(sheet.step().positions, start + [0.0, 0.0, 5.0], atol=1e-12)
        forces = np.zeros_like(start)
        forces[sheet.vertices == 12] = [0.0, 0.0, 0.4]
        sheet.forces = forces
        np.testing.assert_array_equal(sheet.forces, forces)
        for _ in range(4):
            step = sheet.step()
        velocity = sheet.gather(step.velocities)
        if comm.rank == 0:
            areas = np.full(len(sheet.mesh.triangles), 0.01 / 2.0)
            masses = 0.15 * np.bincount(sheet.mesh.triangles.ravel(), np.repeat(areas / 3.0, 3))
            np.testing.assert_allclose(masses @ velocity, [0.0, 0.0, 0.4 * (step.time - 0.01)], atol=1e-9)
        balance = sum(step.energies[name] for name in ("kinetic", "membrane", "bending"))
        assert balance <= step.energies["external_work"]


DRIVEN = {
    "gravity": {"gravity": [[0.0, [0, 0, 0]], [0.1, [0, 1, -9.81]]]},
    "wind.velocity": {"wind": {"velocity": [[0.0, [0, 0, 0]], [0.1, [0, 1, -9.81]]], "density": 1.2}},
    "loads[0].pressure": {"loads": [{"pressure": [[0.0, 0], [0.1, 4.0]]}]},
    "loads[0].force": {"loads": [{"nodes": [12], "force": [[0.0, [0, 0, 0]], [0.1, [0, 0.01, 0.02]]]}]},
}


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["beuler", "semi-implicit", "bdf2"])
@pytest.mark.parametrize("name", DRIVEN)
def test_a_driven_value_is_one_with_points(comm: Any, name: str, integrator: str) -> None:
    scene = scene_with(integrator, **DRIVEN[name])
    if name != "gravity":
        del scene["gravity"]
    start = {
        key: ([0.0] * 3 if key != "pressure" else 0.0) for key in ("gravity", "velocity", "force", "pressure")
    }
    key = name.split(".")[-1]
    still = lyra_petsc.load(scene, {name: start[key]})
    with lyra_petsc.Simulation(scene) as twin:
        final = list(twin)[-1]
        expected = ends(twin)
    with lyra_petsc.Simulation(still, drives=[name]) as driven:
        driven.set(
            name,
            [0, 1, -9.81] if key in ("gravity", "velocity") else DRIVEN[name]["loads"][0][key][1][1],
            at=0.1,
        )
        step = list(driven)[-1]
        reached = ends(driven)
    assert final.energies["kinetic"] > 1e-8
    assert step.energies == pytest.approx(final.energies, rel=1e-6, abs=1e-12)
    if comm.rank == 0:
        np.testing.assert_allclose(reached[0], expected[0], atol=1e-10)


def test_a_driven_value_changes_at_once() -> None:
    with lyra_petsc.Simulation(scene_with("beuler", handles=[]), drives=["gravity"]) as sheet:
        start = sheet.positions
        sheet.set("gravity", [0.0, 0.0, 0.0])
        np.testing.assert_allclose(sheet.step().positions, start, atol=1e-14)
        sheet.set("gravity", [2.0, 0.0, 0.0])
        np.testing.assert_allclose(sheet.step().velocities - [0.02, 0.0, 0.0], 0.0, atol=1e-12)


def test_a_state_that_crosses_is_refused() -> None:
    floor = {"plane": {"point": [0, 0, -0.1], "normal": [0, 0, 1]}}
    with lyra_petsc.Simulation(SCENE | {"contact": {}, "obstacles": {"floor": floor}}) as sheet:
        before = sheet.step().positions
        below = before - [0.0, 0.0, 0.2]
        with pytest.raises(lyra_petsc.InputError, match="floor"):
            sheet.positions = below
        np.testing.assert_array_equal(sheet.positions, before)
        sheet.step()


def test_mistakes_name_the_call_to_use() -> None:
    with pytest.raises(
        lyra_petsc.InputError, match=r"cannot drive 'handle\[0\]', did you mean 'handles\[0\]'"
    ):
        lyra_petsc.Simulation(SCENE, drives=["handle[0]"])
    with lyra_petsc.Simulation(SCENE, drives=["handles[0]", "gravity"]) as sheet:
        with pytest.raises(lyra_petsc.InputError, match=r"changed by set\(\), not move\(\)"):
            sheet.move("gravity", translate=[0, 0, 1])
        with pytest.raises(lyra_petsc.InputError, match="must be three finite numbers"):
            sheet.set("gravity", 9.81)
        with pytest.raises(lyra_petsc.InputError, match=r"row for each of \.vertices"):
            sheet.positions = np.zeros((3, 3))
        with pytest.raises(lyra_petsc.InputError, match="not finite"):
            sheet.velocities = np.full((25, 3), np.nan)
        for unusable in ("abc", [[1.0, 2.0], [3.0]], sheet.positions + 1j, None):
            with pytest.raises(lyra_petsc.InputError, match=r"row for each of \.vertices|not finite"):
                sheet.forces = unusable
            with pytest.raises(lyra_petsc.InputError, match="must be three finite numbers"):
                sheet.set("gravity", unusable)
        for unusable in ("x", [1.0], float("nan")):
            with pytest.raises(lyra_petsc.InputError, match="must be later than now"):
                sheet.move("handles[0]", at=unusable)
        with pytest.raises(lyra_petsc.InputError, match=r"needs what save\(\) returned"):
            sheet.restore(None)  # type: ignore[arg-type]
        with pytest.raises(lyra_petsc.InputError, match=r"drives=\['wind.velocity'\]"):
            sheet.set("wind.velocity", [0, 1, 0])
        with pytest.raises(lyra_petsc.InputError, match="must be later than now"):
            sheet.move("handles[0]", at=-1.0)
        with pytest.raises(ValueError, match="read-only"):
            sheet.positions[0] = 1.0


def test_what_cannot_move_so_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "top.npz", time=[0.0, 0.1], position=np.zeros((2, 5, 3)))
    framed = SCENE | {"handles": [{"group": "top", "frames": str(tmp_path / "top.npz")}]}
    with pytest.raises(lyra_petsc.InputError, match=r"handles\[0\] moves by its frames"):
        lyra_petsc.Simulation(framed, drives=["handles[0]"])
    ball = {"sphere": {"center": [0.2, 0.2, -0.13], "radius": 0.12}}
    scene = SCENE | {"contact": {}, "obstacles": {"ball": ball}}
    rigid = pytest.raises(lyra_petsc.InputError, match="an obstacle is rigid: leave out scale")
    with lyra_petsc.Simulation(scene, drives=["obstacles.ball"]) as sheet, rigid:
        sheet.move("obstacles.ball", scale=2.0)


def test_scenes_are_immutable() -> None:
    scene = lyra_petsc.load(SCENE)
    for change in (
        lambda: setattr(scene.time, "end", 2.0),
        lambda: delattr(scene, "gravity"),
        lambda: scene.handles.append(scene.handles[0]),
        lambda: scene.petsc.update(ksp_type="cg"),
        lambda: scene.probes.__setitem__("tip", None),
    ):
        with pytest.raises(lyra_petsc.InputError, match=r"immutable; scene\.changed"):
            change()
    assert scene == lyra_petsc.load(SCENE)


@pytest.mark.parallel
def test_a_feedback_controller_holds_a_height(comm: Any) -> None:
    """The height of the free edge is held by the handle, by proportional and integral feedback."""
    with lyra_petsc.Simulation(scene_with("beuler"), drives=["handles[0]"]) as cloth:
        tip = cloth.vertices == 24
        raised, speed = 0.0, 0.0
        for _ in range(8):
            height = comm.allreduce(float(cloth.positions[tip, 2].sum()))
            speed += 2.0 * (0.02 - height)
            raised += 0.01 * speed
            cloth.move("handles[0]", translate=[0.0, 0.0, raised])
            cloth.step()
            held = cloth.positions[np.isin(cloth.vertices, [0, 4]), 2]
            np.testing.assert_allclose(held, raised, atol=1e-12)
        reaction = cloth.reactions["handles[0]"]
        assert reaction[2] > 0.0
