"""Garment patterns: panels, curves, places and stitches of a file, and what of them cannot be used."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.pattern_panel import read_panel
from lyra_petsc.scene.pattern_file import expand_patterns, read_pattern


def trapezium(distance: float, turned: bool) -> dict[str, Any]:
    """Half of a skirt, 40 to 60 cm wide and 50 cm long, with a curved hem."""
    hem = {"endpoints": [0, 1], "curvature": [0.5, -0.1]}
    sides = [{"endpoints": [k, (k + 1) % 4]} for k in (1, 2, 3)]
    sides[1] |= {"label": "waist", "curvature": None}
    return {
        "vertices": [[-30, 0], [30, 0], [20, 50], [-20, 50]],
        "edges": [hem, *sides],
        "translation": [0, 0, distance],
        "rotation": [0, 180 if turned else 0, 0],
    }


SKIRT: dict[str, Any] = {
    "pattern": {
        "panels": {"front": trapezium(20, False), "back": trapezium(-20, True)},
        "stitches": [
            [{"panel": "front", "edge": 1}, {"panel": "back", "edge": 3}],
            [{"panel": "front", "edge": 3}, {"panel": "back", "edge": 1}],
        ],
        "panel_order": ["back", "front"],
    },
    "parameters": {},
    "properties": {"units_in_meter": 100, "curvature_coords": "relative"},
}


def written(folder: Path, change: Any = None) -> Path:
    content = copy.deepcopy(SKIRT)
    if change is not None:
        change(content["pattern"])
    path = folder / "skirt_specification.json"
    path.write_text(json.dumps(content))
    return path


def test_a_panel_is_flat_at_its_place_with_its_edges_as_groups(tmp_path: Path) -> None:
    sheet = read_panel(written(tmp_path), "back", 0.05)
    assert sheet.uv is not None
    sides = sheet.uv[:, 1:] - sheet.uv[:, :1]
    areas = 0.5 * (sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
    assert (areas > 0.0).all()
    # a parabola of height h on a chord l bounds 2/3 l h; its control point is at 2 h = 6 cm
    assert areas.sum() == pytest.approx(0.25 + 2.0 / 3.0 * 0.6 * 0.03, rel=1e-3)
    np.testing.assert_allclose(sheet.points[:, 2], -0.2, atol=1e-12)
    groups = {group.name: group for group in sheet.groups}
    assert set(groups) == {"cloth", "edge0", "edge1", "edge2", "edge3", "waist"}
    np.testing.assert_array_equal(groups["waist"].members, groups["edge2"].members)
    right = sheet.points[np.unique(groups["edge1"].members)]
    assert right[:, 0].max() < 0.0  # turned about y
    np.testing.assert_allclose(np.ptp(right[:, 1]), 0.5)
    assert len(groups["edge1"].members) == 11


def test_curves_go_through_their_points(tmp_path: Path) -> None:
    half = {"type": "circle", "params": [30, 0, 1]}
    wave = {"type": "cubic", "params": [[0.25, 0.2], [0.75, -0.2]]}

    def change(pattern: dict[str, Any]) -> None:
        pattern["panels"]["front"]["edges"][0]["curvature"] = half
        pattern["panels"]["front"]["edges"][2]["curvature"] = wave

    panel = read_pattern(written(tmp_path, change)).panels["front"]
    arc, cubic = panel.edges[0], panel.edges[2]
    np.testing.assert_allclose(np.linalg.norm(arc.parts, axis=1), 0.3, rtol=1e-12)
    np.testing.assert_allclose(arc.points(2)[1], [0.0, -0.3], atol=1e-5)
    assert arc.length == pytest.approx(0.3 * np.pi, rel=1e-5)
    np.testing.assert_allclose(cubic.points(2)[1], [0.0, 0.5], atol=1e-9)


def test_a_pattern_is_a_sheet_for_each_panel_and_a_seam_for_each_stitch(tmp_path: Path) -> None:
    path = written(tmp_path)
    own = {"between": ["back/edge3", "front/edge1"], "stiffness": 100}
    data = {"mesh": {"pattern": path.name, "size": 0.05}, "time": {"end": 0.5}, "seams": [own]}
    scene = expand_patterns(data, tmp_path, None)
    assert [entry["panel"] for entry in scene["mesh"]] == ["front", "back"]
    close = {"from": 0.0, "until": 0.5}
    other = {"between": ["front/edge3", "back/edge1"], "reverse": False, "close": close}
    assert scene["seams"] == [own, other]
    assert expand_patterns(scene, tmp_path, None) == scene


def test_a_stitch_of_the_wrong_side_runs_the_other_way(tmp_path: Path) -> None:
    path = written(tmp_path, lambda pattern: pattern["stitches"][0].append("right_wrong"))
    pattern = read_pattern(path)
    assert [pattern.is_reversed(stitch) for stitch in pattern.stitches] == [True, False]


def test_units_that_are_missing_are_told_once(tmp_path: Path) -> None:
    path = written(tmp_path)
    content = json.loads(path.read_text())
    del content["properties"]["units_in_meter"]
    path.write_text(json.dumps(content))
    notes = [note for name in ("front", "back") for note in read_panel(path, name, 0.2).notes]
    (told,) = [note for note in notes if "units_in_meter" in note]
    assert "centimetres" in told
    assert read_pattern(path).panels["front"].edges[2].length == pytest.approx(0.4)


def test_what_is_no_pattern_is_not_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"mesh\.pattern: 'passwd' must end in \.json"):
        expand_patterns({"mesh": {"pattern": "../passwd", "size": 0.1}}, tmp_path, None)


WRONG: dict[str, tuple[Any, str]] = {
    "open": (
        lambda p: p["panels"]["front"]["edges"].pop(2),
        "panel front: edge 2: begins at vertex 3, but edge 1 before it ends at vertex 2",
    ),
    "no vertex": (
        lambda p: p["panels"]["back"]["edges"][1].update(endpoints=[1, 9]),
        "panel back: edge 1: no vertex 9; the panel has vertices 0 to 3",
    ),
    "curve": (
        lambda p: p["panels"]["back"]["edges"][3].update(curvature={"type": "spline", "params": []}),
        "panel back: edge 3: unknown curvature 'spline'; known: quadratic, cubic, circle",
    ),
    "panel": (
        lambda p: p["stitches"][1][0].update(panel="frnt"),
        "stitch 1: no panel 'frnt'; did you mean 'front'",
    ),
    "edge": (lambda p: p["stitches"][0][1].update(edge=4), "stitch 0: no edge 4 in panel back"),
    "number": (
        lambda p: p["panels"]["front"]["vertices"][2].__setitem__(0, "x"),
        "panel front: vertex 2: must be a finite number, not 'x'",
    ),
    "huge": (
        lambda p: p["panels"]["front"]["vertices"][2].__setitem__(0, 1e300),
        "panel front: edge 1: is too long",
    ),
    "crossing": (
        lambda p: p["panels"]["front"].update(vertices=[[-30, 0], [30, 0], [-20, 50], [20, 50]]),
        "panel front: its outline crosses itself: edge 1 and edge 3",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_patterns_name_panel_and_edge(name: str, tmp_path: Path) -> None:
    change, message = WRONG[name]
    path = written(tmp_path, change)
    with pytest.raises(InputError) as caught:
        read_panel(path, "front", 0.05)
    assert str(caught.value).startswith(f"{path}: {message}")
