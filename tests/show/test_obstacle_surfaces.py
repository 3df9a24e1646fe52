"""Surfaces that represent obstacles in pictures and exports."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from written_run import written_with_obstacles

from lyra_petsc.mesh.mesh import TriangleSurface
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.scene.schema import Obstacle
from lyra_petsc.show.obstacle_surfaces import (
    ObstacleSurface,
    is_smooth,
    obstacle_surfaces,
    shape_surface,
)

pytestmark = pytest.mark.quick

BALL = 4.0 / 3.0 * np.pi


@pytest.mark.parametrize(
    ("shape", "volume"),
    [
        ({"sphere": {"center": [1, 2, 3], "radius": 0.5}}, BALL / 8),
        ({"capsule": {"from": [1, 0, 0], "to": [2, 2, 2], "radius": 0.5}}, BALL / 8 + 0.75 * np.pi),
        ({"capsule": {"from": [0, 0, 0], "to": [0, 0, -2], "radius": 0.1}}, BALL / 1000 + 0.02 * np.pi),
        ({"box": {"min": [-1, 0, 2], "max": [1, 3, 2.5]}}, 3.0),
    ],
)
def test_shapes_are_closed_and_face_outwards(shape: dict[str, Any], volume: float) -> None:
    x, triangles = shape_surface(Obstacle.model_validate(shape))
    sides = np.concatenate([triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    assert len(np.unique(sides, axis=0)) == len(sides)
    assert {tuple(side) for side in sides.tolist()} == {tuple(side) for side in sides[:, ::-1].tolist()}
    assert set(triangles.ravel()) == set(range(len(x)))
    a, b, c = np.moveaxis(x[triangles] - x[0], 1, 0)
    assert (np.cross(a, b) * c).sum() / 6.0 == pytest.approx(volume, rel=0.01)
    if "capsule" in shape:
        start, to = (np.array(shape["capsule"][key], dtype=float) for key in ("from", "to"))
        part = np.clip((x - start) @ (to - start) / ((to - start) @ (to - start)), 0, 1)
        away = np.linalg.norm(x - start - part[:, None] * (to - start), axis=1)
        np.testing.assert_allclose(away, shape["capsule"]["radius"], rtol=1e-12)


def test_a_mesh_is_drawn_smooth_unless_it_has_edges() -> None:
    ball = shape_surface(Obstacle.model_validate({"sphere": {"center": [0, 0, 0], "radius": 1}}))
    box = shape_surface(Obstacle.model_validate({"box": {"min": [0, 0, 0], "max": [1, 1, 1]}}))
    assert is_smooth(ball)
    assert not is_smooth(box)
    assert not is_smooth(TriangleSurface(np.eye(3), np.array([[0, 1, 2]])))


def shown(folder: Path, obstacle: dict[str, Any], middle: list[float], size: float) -> ObstacleSurface:
    run = StoredRun(written_with_obstacles(folder, {"one": obstacle}))
    (surface,) = obstacle_surfaces(run, np.array(middle, dtype=float), size)
    return surface


def test_a_plane_is_a_square_near_the_sheets_at_all_times(tmp_path: Path) -> None:
    """Also if it moves far within itself, or rotates."""
    frames = [
        {"time": 0},
        {"time": 1, "translate": [90, 0, 1]},
        {"time": 2, "translate": [90, 0, 1], "rotate": {"axis": [0, 1, 0], "degrees": 90}},
    ]
    plane = {"plane": {"point": [0, 0, -1], "normal": [0, 0, 2]}, "motion": frames}
    surface = shown(tmp_path / "run", plane, [3, 4, 5], 2.0)
    assert surface.infinite
    assert not surface.fixed
    assert 0 < surface.opacity < 1
    # turned about the origin by 90°, z = -1 becomes x = -1, then it is moved by 90
    for time, centre, normal in ((0, [3, 4, -1], 2), (1, [3, 4, 0], 2), (2, [89, 4, 5], 0)):
        x = surface.positions(float(time))
        np.testing.assert_allclose(x.mean(axis=0), centre, atol=1e-12)
        assert np.ptp(x[:, normal]) == pytest.approx(0.0, abs=1e-12)
        sides = x - np.roll(x, 1, axis=0)
        np.testing.assert_allclose(np.linalg.norm(sides, axis=1), 3.0, rtol=1e-12)
        out = np.cross(x[1] - x[0], x[2] - x[0])
        assert out[normal] == pytest.approx(9.0)


def test_only_containers_and_planes_are_transparent(tmp_path: Path) -> None:
    shape = {"sphere": {"center": [0, 0, 0], "radius": 2}}
    ball = shown(tmp_path / "out", shape, [0, 0, 0], 1.0)
    hull = shown(tmp_path / "in", shape | {"inside": True}, [0, 0, 0], 1.0)
    assert (ball.opacity, ball.fixed, ball.smooth, ball.infinite) == (1.0, True, True, False)
    assert 0 < hull.opacity < 1
    np.testing.assert_array_equal(ball.positions(0.0), hull.positions(9.0))
