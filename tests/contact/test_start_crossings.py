"""The places where a start crosses: message, file and picture."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import Simulation, grid

from lyra_petsc.contact.start_crossings import StartCrossings, intersections
from lyra_petsc.errors import MarkedError
from lyra_petsc.show.crossing_places import vtk_text, write_places

TILTED: dict[str, Any] = {
    "mesh": [
        grid(1.0, 1.0, 6, 6)
        | {
            "name": "upper",
            "transform": {"rotate": {"axis": [1, 0, 0], "degrees": 6}, "translate": [0.1, 0.013, -0.05]},
        },
        grid(1.0, 1.0, 5, 5) | {"name": "lower"},
    ],
    "contact": {"gap": 0.01},
    "obstacles": {"floor": {"plane": {"point": [0.0, 0.0, -0.02], "normal": [0.0, 0.0, 1.0]}}},
}


def refused(scene: dict[str, Any], comm: MPI.Comm = MPI.COMM_SELF) -> MarkedError:
    with pytest.raises(MarkedError) as caught, Simulation(scene, comm):
        pass
    return caught.value


@pytest.mark.parallel(2)
def test_all_crossings_are_in_one_line_on_all_ranks(comm: MPI.Comm) -> None:
    text = str(refused(TILTED, comm))
    assert comm.allgather(text) == [text] * comm.size
    assert text.startswith("contact: at the start ")
    assert "between 'upper' and 'lower'" in text
    assert "obstacles.floor: " in text
    assert "of 'lower'" not in text
    assert "\n" not in text


def test_segments_are_where_the_planes_meet() -> None:
    start = refused(TILTED).places
    assert isinstance(start, StartCrossings)
    segments = start.crossings[0].segments
    np.testing.assert_allclose(segments[:, :, 2], 0.0, atol=1e-15)
    np.testing.assert_allclose(segments[:, :, 1], 0.013 + 0.05 / np.tan(np.radians(6.0)), atol=1e-12)
    # they cover the line on which both sheets lie, each part once
    assert np.abs(np.diff(segments[:, :, 0], axis=1)).sum() == pytest.approx(0.9, abs=1e-12)


def test_segments_of_random_triangles_lie_on_both() -> None:
    rng = np.random.default_rng(4)
    first, second = rng.normal(size=(2, 2000, 3, 3))
    segments = intersections(first, second)
    middle = segments.mean(axis=1)
    inside = np.ones(len(first), dtype=bool)
    for corners in (first, second):
        edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
        parts = np.array(
            [np.linalg.lstsq(e, m, rcond=None)[0] for e, m in zip(edges, middle - corners[:, 0], strict=True)]
        )
        inside &= (parts > -1e-9).all(axis=1) & (parts.sum(axis=1) < 1.0 + 1e-9)
    from lyra_petsc.contact.crossings import mutual_crossings

    for row in range(200):
        cells = np.array([[0, 1, 2]])
        crosses = len(mutual_crossings(first[row], cells, second[row], cells)) == 1
        if crosses:
            assert inside[row]


def test_the_file_is_read_by_vtk(tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista")
    start = refused(TILTED).places
    assert isinstance(start, StartCrossings)
    text = write_places(start, tmp_path)
    assert str(tmp_path / "crossings.vtk") in text
    stored = pyvista.read(tmp_path / "crossings.vtk")
    pairs, triangles = start.crossings[0], start.crossings[1].triangles
    assert stored.n_lines == len(pairs.triangles)
    assert stored.n_cells == 3 * len(pairs.triangles) + len(triangles)
    lines = np.arange(stored.n_lines)
    np.testing.assert_array_equal(stored.cell_data["triangle"][lines], pairs.triangles)
    np.testing.assert_array_equal(stored.cell_data["other_triangle"][lines], pairs.others)
    assert set(stored.cell_data["sheet"][lines]) == {0}
    assert set(stored.cell_data["other_sheet"][lines]) == {1}
    assert set(stored.cell_data["obstacle"].tolist()) == {-1, 0}
    np.testing.assert_array_equal(stored.points[: 2 * stored.n_lines].reshape(-1, 2, 3), pairs.segments)
    if "crossings.png" in text:
        from PIL import Image

        with Image.open(tmp_path / "crossings.png") as picture:
            red, green, _ = np.moveaxis(np.asarray(picture.convert("RGB"), dtype=int), -1, 0)
        assert ((red > 150) & (green < 80)).sum() > 500


def test_names_of_sheets_may_be_any(tmp_path: Path) -> None:
    scene = TILTED | {"mesh": [TILTED["mesh"][0] | {"name": "ärmel"}, TILTED["mesh"][1]]}
    start = refused(scene).places
    assert isinstance(start, StartCrossings)
    assert vtk_text(start).splitlines()[1].isascii()


@pytest.mark.parametrize("verb", ["check", "run"])
def test_the_verbs_write_the_files_and_no_run(tmp_path: Path, verb: str) -> None:
    (tmp_path / "two.yaml").write_text(
        """
mesh:
  - {grid: {width: 1, height: 1, nx: 2, ny: 2}}
  - grid: {width: 1, height: 1, nx: 1, ny: 1}
    transform: {rotate: {axis: [1, 0, 0], degrees: 90}, translate: [0, 0.6, -0.5]}
material: {cloth: gray-interlock}
contact: {gap: 0.02}
time: {end: 0.1, step: 0.01}
""",
        encoding="utf-8",
    )
    ended = subprocess.run(
        [sys.executable, "-m", "lyra_petsc", verb, "two.yaml"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert "between 'grid 1' and 'grid 2'" in line
    assert "see crossings.vtk" in line
    assert {path.name for path in tmp_path.iterdir()} - {"crossings.png"} == {"two.yaml", "crossings.vtk"}
