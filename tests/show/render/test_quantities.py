"""Quantities shown as colours, compared with values computed by hand."""

from __future__ import annotations

import numpy as np
import pytest
from written_run import REST, TRIANGLES, position, scene, stress, velocity, written

from lyra_petsc.errors import InputError
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.schema import Scene
from lyra_petsc.show.render.colour_quantities import (
    ColourQuantity,
    ColourRange,
    quantity,
    round_numbers,
)
from lyra_petsc.show.render.sheet_geometry import HeldVertices


@pytest.fixture
def run(tmp_path) -> StoredRun:
    return StoredRun(written(tmp_path / "run", vt="none"))


def test_speed_and_displacement(run):
    speed = quantity(run, "speed")
    assert speed.label == "speed [m/s]"
    np.testing.assert_allclose(speed.values(2), np.linalg.norm(velocity(2), axis=1))
    moved = quantity(run, "displacement")
    assert moved.label == "displacement [m]"
    np.testing.assert_allclose(moved.values(2), np.linalg.norm(position(2) - position(0), axis=1))


@pytest.mark.parametrize("vt", ["none", "seam"])
def test_strain_is_the_largest_principal_green_strain(tmp_path, vt):
    run = StoredRun(written(tmp_path, vt=vt))
    strain = quantity(run, "strain")
    assert strain.label == "largest principal strain [%]"
    assert strain.on_triangles
    # positions are rest + (a x, 0, b x) with x in metres; material coordinates are a third of those
    a, b = 0.1 * np.sin(2.0) / 3.0, np.sin(2.0) / 3.0
    along_x, along_y = 9.0 * ((1.0 + a) ** 2 + b**2), 9.0
    expected = 100.0 * (max(along_x, along_y) - 1.0) / 2.0
    np.testing.assert_allclose(strain.values(2), expected)


def test_written_fields(run):
    shown = quantity(run, "stress")
    assert shown.label == "largest principal stress [N/m]"
    assert shown.on_triangles
    tensors = [np.array([[uu, uv], [uv, vv]]) for uu, vv, uv in stress(1)]
    np.testing.assert_allclose(shown.values(1), [np.linalg.eigvalsh(t).max() for t in tensors], atol=1e-12)
    assert quantity(run, "velocity").label == "velocity [m/s]"


def test_missing_fields_are_reported(run, tmp_path):
    with pytest.raises(InputError, match="no field 'spede', did you mean 'speed'"):
        quantity(run, "spede")
    bare = StoredRun(written(tmp_path / "bare", fields=False))
    with pytest.raises(
        InputError, match=r"speed needs the velocities, .* add velocity to the scene's output.fields"
    ):
        quantity(bare, "speed")


def ranges(values: list[np.ndarray], asked: str | None = None, signed: bool = False) -> tuple[float, float]:
    made = ColourQuantity("made up", lambda i: values[i], signed=signed)
    found = np.array([made.percentiles(i) for i in range(len(values))])
    return made.limits(found, ColourRange.parse(asked) if asked else None)


def test_a_violent_start_does_not_determine_the_colours():
    """A tenth of the states are a hundred times faster; the range is that of the others."""
    calm = np.linspace(0.0, 1.0, 1001)
    low, high = ranges([100.0 * calm] * 2 + [calm] * 18)
    assert (low, high) == pytest.approx((0.02, 0.98))
    assert ranges([100.0 * calm] * 2 + [calm] * 18, "0%,100%") == pytest.approx((0.0, 100.0))
    assert ranges([calm] * 3, "10%,60%") == pytest.approx((0.1, 0.6), abs=2e-3)
    assert ranges([calm - 0.2] * 3, signed=True) == pytest.approx((-0.78, 0.78))
    assert ranges([calm] * 3, "-3,7") == (-3.0, 7.0)
    assert ranges([np.full(4, np.nan)]) == (0.0, 1e-12)
    assert ranges([np.r_[calm, np.nan, np.inf]]) == pytest.approx((0.02, 0.98))


@pytest.mark.parametrize(
    "text", ["", "1", "2,1", "1%,2", "-1%,50%", "0%,101%", "nan,1", "0,inf", "a,b", "1,2,3"]
)
def test_invalid_ranges_are_refused(text):
    with pytest.raises(InputError, match="--range: must be"):
        ColourRange.parse(text)


def test_vertex_values_are_means_weighted_by_area(run):
    raw = quantity(run, "stress")
    smooth = raw.on_vertices(run)
    assert not smooth.on_triangles
    rest, triangles = run.rest, run.triangles
    edges = rest[triangles[:, 1:]] - rest[triangles[:, :1]]
    areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    for vertex in range(len(rest)):
        around = (triangles == vertex).any(axis=1)
        expected = areas[around] @ raw.values(1)[around] / areas[around].sum()
        assert smooth.values(1)[vertex] == pytest.approx(expected)
    assert quantity(run, "speed").on_vertices(run).label == "speed [m/s]"
    ranks = ColourQuantity("rank", lambda i: np.zeros(len(triangles)), on_triangles=True, averages=False)
    assert ranks.on_vertices(run) is ranks


def test_held_vertices_follow_the_windows_of_handles(tmp_path):
    folder = written(tmp_path)
    data = scene().model_dump(exclude_none=True, by_alias=True)
    data["handles"] = [{"nodes": [0, 2, 6], "until": 0.1}, {"box": [[0, 3, 0], [3, 3, 0]]}]
    (folder / "scene.yaml").write_text(dump_scene(Scene.model_validate(data)), encoding="utf-8")
    held = HeldVertices(StoredRun(folder))

    vertices, edges = held.at(0.05)
    assert vertices.tolist() == [0, 1, 2, 3, 6]
    assert sorted(map(tuple, edges)) == [(0, 2), (0, 3), (0, 6), (1, 2), (1, 3), (2, 6)]
    vertices, edges = held.at(0.2)
    assert vertices.tolist() == [1, 3]
    assert edges.tolist() == [[1, 3]]
    assert {tuple(edge) for edge in edges} <= {
        tuple(sorted(t[[i, i - 1]])) for t in TRIANGLES for i in range(3)
    }
    assert len(REST) == 8


@pytest.mark.parametrize(
    ("low", "high"),
    [(0.0, 6.12), (-0.371, 0.371), (0.046, 0.718), (1.2e-9, 7e-7), (-3e6, 1e5), (100.0, 101.3)],
)
def test_the_ticks_of_the_colours_are_round(low, high):
    ticks = round_numbers(low, high)
    steps = np.diff(ticks)
    assert 3 <= len(ticks) <= 7
    assert low <= ticks[0]
    assert ticks[-1] <= high
    np.testing.assert_allclose(steps, steps[0])
    digits = steps[0] / 10 ** np.floor(np.log10(steps[0]) + 1e-9)
    assert np.isclose(digits, [1, 2, 2.5, 5]).any()
    np.testing.assert_allclose(ticks / steps[0], np.round(ticks / steps[0]), atol=1e-9)
