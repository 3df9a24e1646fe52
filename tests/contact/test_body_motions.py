"""Obstacles that deform: a rigid motion given point by point moves sheets as the rigid motion does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from closed_surfaces import sphere

import lyra_petsc
from lyra_petsc.contact.body_motions import BodyMotions
from lyra_petsc.mesh import obstacles


@pytest.mark.quick
def test_places_on_triangles_edges_and_points_are_carried() -> None:
    rng = np.random.default_rng(3)
    angle, shift = 0.7, np.array([0.1, -2.0, 0.4])
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    before = rng.normal(size=(6, 3))
    after, triangle_of = before @ turn.T + shift, np.array([[0, 1, 2]] * 3 + [[3, 4, 5]] * 3)
    at_rest, both = [(np.eye(3), np.zeros(3))], (before, after, triangle_of)
    motions, rigid = BodyMotions(at_rest, (0,), *both), BodyMotions([(turn, shift)], (), *both)
    simplices = np.array([[7, ~0, ~1, ~2], [7, 8, ~3, ~4], [~2, ~1, 4, ~0], [0, 1, 2, ~5]])
    places = rng.normal(size=(4, 3))
    for one, other in zip(
        motions.carried(0, places, simplices), rigid.carried(0, places, simplices), strict=True
    ):
        np.testing.assert_allclose(one, other, atol=1e-12)
    moved = [motion.displacements(0, places, simplices) for motion in (motions, rigid)]
    np.testing.assert_allclose(*moved, atol=1e-12)


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["beuler", "alpha2"])
def test_a_body_that_turns_point_by_point_carries_a_sheet(
    shared_tmp: Path, comm: Any, monkeypatch: pytest.MonkeyPatch, integrator: str
) -> None:
    if comm.rank == 0:
        points, triangles = sphere(3, 0.1)
        lines = [f"v {x} {y} {z}" for x, y, z in points - [0.0, 0.0, 0.115]]
        lines += [f"f {a} {b} {c}" for a, b, c in triangles + 1]
        (shared_tmp / "ball.obj").write_text("\n".join(lines))
    comm.barrier()
    turn = {"rotate": {"axis": [0, 0, 1], "degrees": 30}, "translate": [0.01, 0, 0.01]}
    motion = [{"time": 0}, {"time": 0.1} | turn]
    ball = {"mesh": {"file": str(shared_tmp / "ball.obj")}, "motion": motion, "interpolation": "linear"}
    scene = {
        "mesh": {
            "grid": {"width": 0.2, "height": 0.2, "nx": 6, "ny": 6},
            "transform": {"translate": [-0.1, -0.1, 0]},
        },
        "material": {"cloth": "gray-interlock", "damping": 0.01},
        "gravity": [0, 0, -9.81],
        "contact": {"friction": 0.4, "gap": 0.004},
        "obstacles": {"ball": ball},
        "time": {"end": 0.1, "step": 0.005, "integrator": integrator},
    }

    def run() -> tuple[Any, Any, Any]:
        with lyra_petsc.Simulation(scene) as simulation:
            steps = list(simulation)
            positions, forces = simulation.gather(steps[-1].positions), simulation.obstacle_forces
            return positions, steps[-1].energies, forces["ball"]

    expected = run()
    build = obstacles._build_obstacle

    def deforming(*arguments: Any) -> Any:
        body = build(*arguments)
        return replace(body, motion=None, deformation=body.positions)

    monkeypatch.setattr(obstacles, "_build_obstacle", deforming)
    reached = run()
    assert expected[2][2] < -0.01
    if comm.rank == 0:
        assert np.abs(expected[0][:, :2].mean(axis=0)).max() > 1e-4  # carried along
        np.testing.assert_allclose(reached[0], expected[0], atol=2e-6)
    np.testing.assert_allclose(reached[2], expected[2], atol=2e-2 * np.abs(expected[2]).max())
    for name, energy in expected[1].items():
        assert reached[1][name] == pytest.approx(energy, rel=2e-3, abs=1e-7), name
