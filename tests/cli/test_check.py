"""``check`` prints what a run would do, and has no effects."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from launch import Left, done, lyra, refused, write_scene

from lyra_petsc.mesh.gmsh_sandbox import supported_layers

MEMBRANE = """
mesh: {grid: {width: 1.0, height: 1.0, nx: 10, ny: 10}}
material: {density: 0.1, membrane: {c11: 100, c22: 100, c12: 20, c33: 40}}
time: {end: 1.0, step: 0.01}
output: {every: 0.1}
"""


@pytest.mark.parametrize("ranks", [1, 3])
def test_the_plan_of_a_run(tmp_path: Path, ranks: int) -> None:
    (tmp_path / "plain.yaml").write_text(MEMBRANE)
    result = done(["check", "plain.yaml"], tmp_path, ranks=ranks)
    plan = result.out
    assert "121 vertices, 200 triangles" in plan
    assert "100 of 0.01 s to t = 1 s, 11 states" in plan
    assert "363" in plan  # unknowns
    # a vertex couples with its neighbours along the 320 edges, twice, and with itself
    assert f"{9 * 761} in 761 blocks" in plan
    assert "load imbalance" in plan
    assert "ghost share" in plan
    table = [line.split() for line in plan.splitlines() if line.split()[:1] and line.split()[0].isdigit()]
    assert sum(int(row[1]) for row in table) == 121
    assert len(table) == ranks
    assert [path.name for path in tmp_path.iterdir()] == ["plain.yaml"]


def test_edges_with_unknowns_are_counted_separately(tmp_path: Path) -> None:
    """320 edges, three to a row of the matrix."""
    (tmp_path / "bends.yaml").write_text(MEMBRANE)
    bends = ["--set", "material.bending=1e-3", "--set", "material.bending_model=midedge"]
    result = done(["check", "bends.yaml", *bends], tmp_path, ranks=2)
    assert "683 (velocities)" in result.out
    table = [
        line.split() for line in result.out.splitlines() if line.split()[:1] and line.split()[0].isdigit()
    ]
    assert [sum(int(row[k]) for row in table) for k in (1, 2)] == [121, 320]


CONTACT = """
contact: {gap: 0.01, friction: {static: 0.4, kinetic: 0.3}}
obstacles:
  floor: {plane: {point: [0, 0, -1], normal: [0, 0, 1]}, friction: 0.5}
  ball: {sphere: {center: [0, 0, -0.5], radius: 0.3}, motion: roll}
  crate: {box: {min: [-2, -2, -2], max: [2, 2, 2]}, inside: true}
motions: {roll: [{time: 0}, {time: 1, rotate: {axis: [0, 0, 1], degrees: 90}}]}
"""


def test_contact_and_obstacles_are_shown(tmp_path: Path) -> None:
    (tmp_path / "floor.yaml").write_text(MEMBRANE + CONTACT)
    result = done(["check", "floor.yaml"], tmp_path)
    lines = [" ".join(line.split()) for line in result.out.splitlines()]
    assert lines[lines.index("handles 0") + 1 :][:4] == [
        "contact gap 0.01 m, thickness 0 m, friction 0.4 (sliding 0.3)",
        "obstacle floor plane, friction 0.5",
        "obstacle ball sphere, moves by 'roll', friction 0.4 (sliding 0.3)",
        "obstacle crate inside of a box, friction 0.4 (sliding 0.3)",
    ]


def test_pieces_and_the_gap_that_follows_the_mesh(tmp_path: Path) -> None:
    one = "{grid: {width: 1.0, height: 1.0, nx: 10, ny: 10}"
    two = f"mesh: [{one}}}, {one}, transform: {{translate: [0, 0, 1]}}}}]"
    (tmp_path / "two.yaml").write_text(MEMBRANE.replace(f"mesh: {one}}}", two) + "contact: {}\n")
    plan = done(["check", "two.yaml"], tmp_path).out
    assert "242 vertices, 400 triangles, 2 pieces" in plan
    assert "gap 0.02845 m by the mesh, thickness 0 m" in plan


SQUARE = """
Point(1) = {0, 0, 0, 0.5}; Point(2) = {1, 0, 0, 0.5}; Point(3) = {1, 1, 0, 0.5}; Point(4) = {0, 1, 0, 0.5};
Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4}; Plane Surface(1) = {1};
"""


def test_mesh_scripts_are_guarded_and_trusted_on_request_only(tmp_path: Path) -> None:
    if "Landlock" not in supported_layers():
        pytest.skip("the kernel has no Landlock")
    (tmp_path / "scenes").mkdir()
    mesh = MEMBRANE.replace("{grid: {width: 1.0, height: 1.0, nx: 10, ny: 10}}", "{file: m.geo}")
    (tmp_path / "scenes" / "scene.yaml").write_text(mesh)
    script = tmp_path / "scenes" / "m.geo"
    script.write_text(SQUARE + 'SystemCall "touch mark";\n')
    refused(
        ["check", "scenes/scene.yaml", "--trust-mesh"], tmp_path, "m.geo: the script tried to start a program"
    )
    script.write_text(SQUARE)
    plain = lyra(["check", "scenes/scene.yaml"], tmp_path)
    assert "scripts start no programs, write no files, and read their folder" in " ".join(plain.out.split())
    script.write_text('Include "../outside.geo";\n' + SQUARE)
    (tmp_path / "outside.geo").write_text("a = 1;\n")
    study = ["study", "scenes/scene.yaml", "--vary", "dt=0.01", "--set", "time.end=0.02", "--repeats", "1"]
    for words in (
        ["check", "scenes/scene.yaml"],
        ["new", "starter", "--mesh", "scenes/m.geo"],
        study,
    ):
        refused(words, tmp_path, "outside.geo")
        trusted = lyra([*words, "--trust-mesh"], tmp_path)
        assert trusted.code == 0, trusted.err
    refused(["study", "--out", "studies/scene", "--resume"], tmp_path, "outside.geo")


def test_titles_are_plain_text_and_all_numbers_of_steps_are_printed(tmp_path: Path) -> None:
    (tmp_path / "plain.yaml").write_text(
        'title: "[/red] :smile: \\e[31m"\n' + MEMBRANE.replace("0.01", "1e-7")
    )
    result = lyra(["check", "plain.yaml"], tmp_path)
    assert result.code == 0, result.err
    assert "[/red] :smile: \\x1b[31m" in result.out
    assert "10000000 of 1e-07 s to t = 1 s, 11 states" in result.out
    refused(
        ["check", "plain.yaml", "--set", "petsc.ts_dt=1e-310"], tmp_path, "-ts_dt: 1e-310 s makes inf steps"
    )


@pytest.mark.parametrize(
    ("settings", "plan"),
    [
        (["time.step=1"], "10 of at most 1 s to t = 1 s, 11 states; steps end at states and events"),
        (["time.step=1", "output.every=1"], "1 of 1 s to t = 1 s, 2 states"),
        (["time.step=0.04"], "30 of at most 0.04 s to t = 1 s, 11 states; steps end at states and events"),
        (["petsc.ts_max_steps=7"], "the first 7 (-ts_max_steps) of 100 of 0.01 s to t = 1 s, 11 states"),
    ],
    ids=["cut at states", "one", "cut unevenly", "a part"],
)
def test_the_steps_that_a_run_takes_are_counted(tmp_path: Path, settings: list[str], plan: str) -> None:
    words = ["check", write_scene(tmp_path, MEMBRANE), *(w for text in settings for w in ("--set", text))]
    lines = [" ".join(line.split()) for line in done(words, tmp_path).out.splitlines()]
    assert f"steps {plan}" in lines


def test_the_figures_that_show_wrong_units_are_printed(tmp_path: Path) -> None:
    """Two sheets of 10 m² and 1 m²; 1.6 mN·m over 0.2 N/m² is (200 mm)³."""
    scene = """
mesh:
  - {name: a, grid: {width: 2, height: 5, nx: 2, ny: 2}}
  - {name: b, grid: {width: 1, height: 1, nx: 2, ny: 2}, transform: {translate: [0, 0, 3]}}
material:
  - {density: 2, membrane: {c11: 1200, c22: 1200, c12: 0, c33: 400}, bending: 0.0016}
  - {density: 150, membrane: {c11: 800, c22: 800, c12: 0, c33: 400}, group: b}
gravity: [0, 0, -0.1]
time: {end: 1, step: 1}
"""
    left = done(["check", write_scene(tmp_path, scene)], tmp_path, ranks=2)
    lines = [" ".join(line.split()) for line in left.out.splitlines()]
    at = lines.index("size 2 x 5 x 3 m")
    assert lines[at + 1 : at + 4] == [
        "mass 170 kg",
        "material 2 kg/m², 500 kg/m³ if 4 mm thick, bending length 200 mm",
        "material b 150 kg/m², bending length 0 mm",
    ]
    assert notes(left) == ["material[1]: 150 kg/m² is heavier than any cloth: 150 g/m² is 0.15 kg/m²"]


def notes(left: Left) -> list[str]:
    return [line.removeprefix("note: ") for line in left.out.splitlines() if line.startswith("note: ")]


HELD = MEMBRANE + "handles: [{group: left}]\n"
MOVED = HELD.replace("}]", ", motion: m}]") + "motions: {m: [{time: 0}, {time: 1, translate: [0, 0, %s]}]}\n"


@pytest.mark.parametrize(
    ("scene", "idle"),
    [
        (MEMBRANE, True),
        (HELD + "gravity: [0, 0, 0]\nwind: {velocity: [0, 0, 0], density: 1.2}\n", True),
        (HELD + "loads: [{force: [0, 0, 1], nodes: [60], from: 2}]\n", True),
        (MEMBRANE + "contact: {}\nobstacles: {p: {plane: {point: [0, 0, -1], normal: [0, 0, 1]}}}\n", True),
        (MOVED % "0", True),
        (MOVED % "0.1", False),
        (MEMBRANE + "gravity: [0, 0, -9.81]\n", False),
        (HELD + "loads: [{force: [0, 0, 1], nodes: [60], from: 0.5}]\n", False),
        (MEMBRANE + "initial: {velocity: [0, 0, 1]}\n", False),
        (MEMBRANE + "initial: {noise: 1.0e-3}\n", False),
        (HELD + "wind: {velocity: [0, 1, 0], density: 1.2}\n", False),
        (HELD.replace("c33: 40}", "c33: 40}, bending: 1e-5, rest_curvature: [1, 0, 0]"), False),
        (MEMBRANE + CONTACT, False),
    ],
)
def test_a_scene_in_which_nothing_acts_is_noted(tmp_path: Path, scene: str, *, idle: bool) -> None:
    found = notes(done(["check", write_scene(tmp_path, scene)], tmp_path))
    assert [note.startswith("nothing acts on the sheet") for note in found] == [True] * idle


TWO = """
mesh:
  - {name: a, grid: {width: 1.0, height: 1.0, nx: 4, ny: 4}}
  - {name: b, grid: {width: 1.0, height: 1.0, nx: 4, ny: 4}, transform: {translate: [0, 0, 1]}}
material: {density: 0.1, membrane: {c11: 100, c22: 100, c12: 20, c33: 40}}
gravity: [0, 0, -10]
time: {analysis: static}
"""


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("", ["the piece of vertex 0 along z against loads of 1 N", "the piece of vertex 25 along z"]),
        ("handles: [{nodes: [0, 4]}]\n", ["the piece of vertex 25 along z against loads of 1 N"]),
        ("handles: [{group: a}, {group: b, axes: [x, y]}]\n", ["the piece of vertex 25 along z"]),
        ("handles: [{group: a}, {group: b, stiffness: 10}]\n", []),
        ("handles: [{group: a}]\ncontact: {}\n", []),
        (
            "handles: [{group: a}]\nloads: [{moment: 1e-4, group: right}]\n"
            "material: {young: 1e6, poisson: 0.3, thickness: 1e-3, density: 0.1}\n",
            ["the piece of vertex 25 along z"],
        ),
    ],
)
def test_what_nothing_holds_in_a_static_analysis_is_noted(
    tmp_path: Path, more: str, words: list[str]
) -> None:
    scene = "".join(line for line in TWO.splitlines(True) if not ("material" in more and "material" in line))
    found = notes(done(["check", write_scene(tmp_path, scene + more)], tmp_path, ranks=2))
    assert len(found) == len(words)
    assert all(f"nothing holds {word}" in note for word, note in zip(words, found, strict=True))


def test_what_of_another_program_has_no_effect_is_noted(tmp_path: Path) -> None:
    (tmp_path / "square.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 4\nf 1 4 3\n")
    cloth = {"mesh": "square.obj", "materials": [{"data": "paper"}], "remeshing": {"size": [0.01, 0.1]}}
    floor = {"mesh": "square.obj", "transform": {"scale": 5, "translate": [-2, -2, -1]}}
    scene = {
        "frame_time": 0.01,
        "end_time": 0.02,
        "cloths": [cloth],
        "obstacles": [floor],
        "gravity": [0, 0, -9.8],
    }
    (tmp_path / "conf.json").write_text(json.dumps(scene))
    found = notes(done(["check", "conf.json"], tmp_path))
    assert [note.partition(",")[0] for note in found] == [
        "cloths[0].remeshing: no effect here: the triangles stay those of the mesh file"
    ]
    left = done(["run", "conf.json", "--out", "out"], tmp_path)
    assert "note: cloths[0].remeshing: no effect here" in left.err
    assert "obstacle0" in (tmp_path / "out" / "obstacles.csv").read_text()
