"""The camera: everything is in the picture, as large as possible, from the most informative side."""

from __future__ import annotations

import numpy as np
import pytest
from written_run import scene

from lyra_petsc.scene.schema import Scene
from lyra_petsc.show.render.camera import (
    BAR_HEIGHT,
    MARGIN,
    CameraFit,
    PerspectiveCamera,
    line_of_sight,
    up_direction,
)

UP = np.array([0.0, 0.0, 1.0])


def with_camera(camera: dict | None, gravity: tuple | None = None) -> Scene:
    data = scene().model_dump(exclude_none=True, by_alias=True)
    data |= {"gravity": gravity} if gravity else {}
    return Scene.model_validate(data | ({"render": {"camera": camera}} if camera is not None else {}))


def in_picture(view: PerspectiveCamera, points: np.ndarray, aspect: float) -> np.ndarray:
    """Coordinates (n, 2) of points in the picture, −1 to 1 between its edges, after ``window_center``."""
    sight = view.position - view.target
    sight = sight / np.linalg.norm(sight)
    right = np.cross(view.up, sight)
    right /= np.linalg.norm(right)
    upper = np.cross(sight, right)
    depth = (view.position - points) @ sight
    assert depth.min() > 0.0
    half = np.tan(np.radians(view.angle) / 2.0)
    x, y = (points - view.position) @ right, (points - view.position) @ upper
    return np.column_stack([x / (depth * half * aspect), y / (depth * half) + view.raised])


@pytest.mark.parametrize("aspect", [0.5, 16 / 9])
@pytest.mark.parametrize("bar", [False, True])
@pytest.mark.parametrize("sight", [(0.0, -1.0, 0.3), (1.0, 2.0, -0.5), (0.0, 0.0, 1.0), (0.0, 0.0, -3.0)])
def test_all_points_are_seen_and_one_touches_the_margin(sight, bar, aspect):
    points = np.random.default_rng(1).normal(size=(200, 3)) * [3.0, 1.0, 0.2] + [5.0, -7.0, 100.0]
    chosen = with_camera({"direction": sight, "angle": 40.0})
    fit = CameraFit(chosen, line_of_sight(chosen, UP, [], np.empty((0, 3), int)), UP, aspect, bar=bar)
    view = fit.view((points @ fit.normals.T).max(axis=0))

    places = in_picture(view, points, aspect) - [0.0, BAR_HEIGHT if bar else 0.0]
    filled = np.abs(places).max(axis=0) / [MARGIN, MARGIN - (BAR_HEIGHT if bar else 0.0)]
    assert filled.max() == pytest.approx(1.0)
    # as far to the left as to the right in the direction that fills the picture
    full = int(np.argmax(filled))
    assert places[:, full].min() == pytest.approx(-places[:, full].max())


def test_zoom_enlarges_the_sheet():
    points = np.eye(3)
    distances = []
    for zoom in (1.0, 2.0):
        chosen = with_camera({"direction": [0, -1, 0], "zoom": zoom})
        fit = CameraFit(chosen, np.array([0.0, -1.0, 0.0]), UP, 1.0)
        view = fit.view((points @ fit.normals.T).max(axis=0))
        distances.append(np.linalg.norm(view.position - view.target))
    assert distances[0] == pytest.approx(2.0 * distances[1])


def test_a_camera_with_a_position_is_there():
    chosen = with_camera({"position": [1, 2, 3], "target": [0, 0, 1], "up": [0, 1, 0], "angle": 50})
    up = up_direction(chosen)
    view = CameraFit(chosen, line_of_sight(chosen, up, [], np.empty((0, 3), int)), up, 1.5).view(np.zeros(6))
    np.testing.assert_array_equal(view.position, [1, 2, 3])
    np.testing.assert_array_equal(view.target, [0, 0, 1])
    np.testing.assert_array_equal(view.up, [0, 1, 0])
    assert view.angle == 50.0


@pytest.mark.parametrize(
    ("camera", "gravity", "expected"),
    [
        (None, None, [0, 0, 1]),
        (None, (0.0, -9.81, 0.0), [0, 1, 0]),
        (None, (3.0, 0.0, 4.0), [-0.6, 0, -0.8]),
        ({"up": [0, 2, 0]}, (0.0, 0.0, -9.81), [0, 1, 0]),
    ],
)
def test_up_is_against_gravity(camera, gravity, expected):
    np.testing.assert_allclose(up_direction(with_camera(camera, gravity)), expected, atol=1e-15)


@pytest.mark.parametrize("degrees", [0.0, 70.0, 160.0, 250.0])
def test_without_a_camera_a_standing_sheet_is_seen_from_its_front(degrees):
    """Wherever it faces, its normal is nearly along the line of sight, and on the same side."""
    a = np.radians(degrees)
    along = np.array([np.cos(a), np.sin(a), 0.0])
    corners = np.array([np.zeros(3), along, along + UP, UP])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    sight = line_of_sight(with_camera(None), UP, [corners], triangles)
    assert np.cross(along, UP) @ sight > 0.8
    assert sight @ UP > 0.2
    assert np.linalg.norm(sight) == pytest.approx(1.0)


def test_a_lying_sheet_is_seen_from_the_front_and_above():
    """Against y where z is up, so that its x points to the right."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0.01], [0, 1, 0]])
    sight = line_of_sight(with_camera(None), UP, [corners], np.array([[0, 1, 2], [0, 2, 3]]))
    assert sight[1] < -0.5
    assert sight[2] > 0.5


def test_a_sheet_that_lies_and_later_hangs_is_not_seen_edge_on():
    lying = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    hanging = np.array([[0.0, 1, -1], [1, 1, -1], [1, 1, 0], [0, 1, 0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    sight = line_of_sight(with_camera(None), UP, [lying] + 8 * [hanging], triangles)
    assert sight @ UP > 0.4
    assert abs(sight[1]) > 0.7


@pytest.mark.parametrize(("frame", "reach"), [(None, 1.0), (100.0, 50.0), (50.0, 1.0)])
def test_a_short_excursion_does_not_determine_the_frame(frame, reach):
    chosen = with_camera({"direction": [0, -1, 0]} | ({"frame": frame} if frame else {}))
    fit = CameraFit(chosen, np.array([0.0, -1.0, 0.0]), UP, 1.0)
    supports = np.ones((50, 6))
    supports[0] = 50.0
    np.testing.assert_array_equal(fit.framed_support(supports), np.full(6, reach))
    few = np.ones((6, 6))
    few[0] = 2.0
    if frame is None:  # of few states all are in the picture
        np.testing.assert_array_equal(fit.framed_support(few), np.full(6, 2.0))
