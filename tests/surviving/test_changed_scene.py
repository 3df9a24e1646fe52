"""Resuming with a changed scene: another mesh is refused, changed parameters are reported."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from launch import DIRECT, done, lyra, read_json, write_scene
from leftovers import SHEET, announced, steps
from physics import CLOTH, grid, scene_of

from lyra_petsc.output.continuation import used_groups

SCENE = SHEET % 0.04


@pytest.fixture(scope="module")
def halted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("halted")
    done(["run", write_scene(folder, SCENE), "--out", "out", "-ts_max_steps", "5", *DIRECT], folder)
    return folder / "out"


@pytest.fixture
def run(halted: Path, tmp_path: Path) -> Path:
    """A folder with a run that stopped after 5 of its 8 steps."""
    shutil.copytree(halted, tmp_path / "out")
    return tmp_path / "out"


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("nx: 4", "nx: 5", "it has 30 vertices and 40 triangles, not 25 and 32"),
        ("width: 1.0", "width: 1.1", "another shape at rest"),
        ("ny: 4}", "ny: 4, pattern: alternating}", "other triangles"),
        ("ny: 4}", "ny: 4}, transform: {rotate: {axis: [1, 0, 0], degrees: 20}}", "at the start"),
        ("damping: 0.005", "damping: 0.005, warp_degrees: 0", None),
        ("end: 0.04, step: 0.005", "analysis: static", "does not go on as a static analysis"),
        ("output:", "probes: {a: {nodes: [1]}}\noutput:", None),
    ],
)
def test_runs_that_cannot_be_continued_are_refused_without_changes(
    run: Path, old: str, new: str, words: str | None
) -> None:
    before = content(run)
    assert old in SCENE
    scene = write_scene(run.parent, SCENE.replace(old, new))
    left = lyra(["run", scene, "--out", "out", "--resume", *DIRECT], run.parent)
    if words is None:
        assert left.code == 0, left.err
        return
    assert left.code == 2, left.err
    (line,) = left.ours
    assert words in line
    assert "run without --resume" in line
    assert content(run) == before


def test_other_columns_are_refused_without_changes(run: Path) -> None:
    done(["run", "--out", "out", "--resume", "--set", "probes.a.nodes=[1]", "-ts_max_steps", "6"], run.parent)
    before = content(run)
    left = lyra(["run", "--out", "out", "--resume", "--set", "probes.b.nodes=[2]"], run.parent)
    assert left.code == 2
    assert "probes.csv: has the columns step, time, a_x" in left.ours[0]
    assert content(run) == before


def test_changed_parameters_are_reported(run: Path) -> None:
    settings = ["wind={velocity: [0, 3, 0], density: 1.2}", "gravity=[0, 0, -5]", "time.end=0.05"]
    words = [word for setting in settings for word in ("--set", setting)]
    left = done(["run", "--out", "out", "--resume", *words, *DIRECT], run.parent)
    notes = [line for line in left.err.splitlines() if line.startswith("note: ")]
    assert notes == [
        "note: changed since the run was begun: gravity: [0.0, 0.0, -9.81] → [0.0, 0.0, -5.0]",
        "note: time.end: 0.04 → 0.05",
        "note: changed since the run was begun: wind: absent → "
        '{"velocity": [0.0, 3.0, 0.0], "density": 1.2, "drag": 0.0}',
    ]
    (entry,) = read_json(run / "summary.json")["resumed"]
    assert (entry["step"], entry["ranks"]) == (5, 1)
    assert entry["changes"][1] == {"key": "time.end", "old": "0.04", "new": "0.05"}
    # the folder's scene is the one that counts now: going on again tells nothing new
    again = done(["run", "--out", "out", "--resume", "--set", "time.end=0.06"], run.parent)
    assert [line for line in again.err.splitlines() if line.startswith("note: ")] == [
        "note: time.end: 0.05 → 0.06"
    ]
    assert len(read_json(run / "summary.json")["resumed"]) == 2
    assert steps(run) == list(range(13))
    assert announced(run) == pytest.approx([0, 0.02, 0.025, 0.04, 0.05, 0.06])


@pytest.mark.parametrize("integrator", ["bdf2", "alpha2", "midpoint", "semi-implicit"])
def test_another_integrator_starts_without_past_states(run: Path, integrator: str) -> None:
    left = done(["run", "--out", "out", "--resume", "--set", f"time.integrator={integrator}"], run.parent)
    assert f"time.integrator: beuler → {integrator} (begins without memory of earlier steps)" in left.err
    assert steps(run) == list(range(9))


@pytest.mark.parametrize("step", ["auto", "0.0025", "0.01"])
def test_another_step_length_is_used(run: Path, step: str) -> None:
    done(["run", "--out", "out", "--resume", "--set", f"time.step={step}"], run.parent)
    assert steps(run) == list(range(len(steps(run))))
    assert announced(run) == pytest.approx([0, 0.02, 0.025, 0.04])


def test_a_missing_scene_yaml_is_no_obstacle(run: Path) -> None:
    (run / "scene.yaml").unlink()
    left = done(["run", write_scene(run.parent, SCENE), "--out", "out", "--resume"], run.parent)
    assert "scene.yaml: no such file; what has changed since the run was begun is not known" in left.err
    assert (run / "scene.yaml").exists()


def test_lost_rows_are_reported(run: Path) -> None:
    table = run / "history.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:4]))
    left = done(["run", "--out", "out", "--resume"], run.parent)
    assert "history.csv: the rows of steps 3 to 5 are lost" in left.err


GROUPS = """\
$MeshFormat
2.2 0 8
$EndMeshFormat
$PhysicalNames
2
0 1 "pole"
2 2 "cloth"
$EndPhysicalNames
$Nodes
4
1 0 0 0
2 1 0 0
3 0 1 0
4 1 1 0
$EndNodes
$Elements
3
1 15 2 1 1 {held}
2 2 2 2 1 1 2 3
3 2 2 2 1 2 4 3
$EndElements
"""


def test_another_member_of_a_group_is_refused(tmp_path: Path) -> None:
    scene = SCENE.replace("grid: {width: 1.0, height: 1.0, nx: 4, ny: 4}", "file: mesh.msh")
    scene = write_scene(tmp_path, scene.replace("nodes: [0, 4]", "group: pole"))
    (tmp_path / "mesh.msh").write_text(GROUPS.format(held=1))
    done(["run", scene, "--out", "out", "-ts_max_steps", "2"], tmp_path)
    (tmp_path / "mesh.msh").write_text(GROUPS.format(held=2))
    left = lyra(["run", scene, "--out", "out", "--resume"], tmp_path, 2)
    assert left.code == 2
    assert "group 'pole' has other members" in left.ours[0]
    (tmp_path / "mesh.msh").write_text(GROUPS.format(held=1))
    done(["run", scene, "--out", "out", "--resume"], tmp_path, 2)


def test_the_groups_that_a_scene_uses_are_found_in_all_its_blocks() -> None:
    """Where one of them has other vertices, the run cannot be continued."""
    blocks = {
        "material": [{"group": "m", "density": 0.1, "membrane": CLOTH["membrane"]}],
        "handles": [{"group": "h"}, {"nodes": [0]}],
        "loads": [{"gas": {"group": ["g", "g2"], "pressure": 1.0}}, {"group": "l", "pressure": 1.0}],
        "seams": [{"between": ["s", "s2"]}],
        "creases": [{"group": "c", "angle": 90.0, "stiffness": 1.0}],
        "attachments": [{"from": {"group": "f"}, "to": {"group": "t"}, "stiffness": 1.0}],
        "probes": {"group": {"group": "p"}},
    }
    scene = scene_of({"mesh": grid(1, 1, 2, 2)} | blocks)
    assert used_groups(scene) == {"m", "h", "g", "g2", "l", "s", "s2", "c", "f", "t", "p"}
