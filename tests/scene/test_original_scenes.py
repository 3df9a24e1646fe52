"""The original Lyra's conf.json, read as a scene."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.build import build_scene_mesh
from lyra_petsc.mesh.obstacles import build_obstacles
from lyra_petsc.scene.load import dump_scene, load_scene
from lyra_petsc.scene.materials.library import resolve_material
from lyra_petsc.terms.handles.motion import Motion

SHIPPED = """\
{
    "frame_time": 0.04,   // "quoted" comment, }
    "frame_steps": 8,
    "end_time": 15, /* over
    two lines */
    "cloths": [{
        "mesh": "meshes/square.obj",
        "transform": {"translate": [-0.5, -1, 0.5]},
        "materials": [{"data": "materials/gray-interlock.json",
            "damping": 0.03}],
        "texture":"textures//rainbow.jpg"
    }],
    "handles": [{"nodes": [2,3], "motion":0,"end_time":10}],
    "motions": [[
        {"time": 1, "transform": {"rotate": [0,0,0,1]}},
        {"time": 2, "transform": {"rotate": [-45,0,0,2], "translate": [0, 0, 1], "scale": 2}},
    ]],
    "gravity": [0, 0, -9.8]
    //"wind":{"density":1,"velocity":[0,2,0],"drag":1}
}
"""

SQUARE = "v 0 0 0\nv 1 0 0\nnl 3\nv 0 1 0\nv 1 1 0\nnl 3\nf 1 2 4\nf 1 4 3\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "conf").mkdir()
    (tmp_path / "meshes" / "square.obj").write_text(SQUARE)
    (tmp_path / "meshes" / "textured.obj").write_text(SQUARE + "vt 0 0\n")
    return tmp_path


def write(folder: Path, **changes: Any) -> Path:
    """Write a minimal scene with ``changes``; None removes a key."""
    scene: dict[str, Any] = {
        "frame_time": 0.04,
        "frame_steps": 8,
        "end_time": 1,
        "cloths": [{"mesh": "meshes/square.obj", "materials": [{"data": "materials/isotropic.json"}]}],
    }
    scene.update(changes)
    path = folder / "conf.json"
    path.write_text(json.dumps({key: value for key, value in scene.items() if value is not None}))
    return path


@pytest.mark.parametrize("name", ["conf.json", "conf/conf.json", "conf/spin.txt"])
def test_shipped_scene(folder: Path, name: str) -> None:
    path = folder / name
    path.write_text(SHIPPED)
    scene = load_scene(path)
    assert scene.source == path
    assert scene.time.step == pytest.approx(0.005, rel=1e-15)
    assert scene.time.end == 15.0
    assert scene.time.integrator == "semi-implicit"
    assert scene.output.every == 0.04
    assert scene.gravity == (0.0, 0.0, -9.8)
    assert scene.wind is None
    (sheet,) = scene.mesh
    assert sheet.file == folder / "meshes" / "square.obj"
    assert sheet.name is None
    assert sheet.transform.translate == (-0.5, -1.0, 0.5)
    assert sheet.transform.rotate is None
    (material,) = scene.material
    assert material.group is None
    assert material.damping == 0.03
    assert material.density == 0.187
    assert material.membrane is not None
    # twice the table's first row; its c12 = -14.69599 counts as 0
    assert material.membrane.c11 == pytest.approx(33.187664)
    assert material.membrane.c22 == pytest.approx(68.954246)
    assert material.membrane.c12 == 0.0
    assert material.membrane.c33 == pytest.approx(36.860302)
    assert material.bending == pytest.approx((2.3191698e-05 / 4, 2.4749964e-05 / 4, 1.4267624e-05 / 4))
    (handle,) = scene.handles
    assert handle.nodes == [2, 3]
    assert (handle.start, handle.until, handle.fade, handle.stiffness) == (0.0, 10.0, 0.0, 1000.0)
    assert (handle.motion, handle.interpolation) == ("motion0", "hermite")
    first, second = scene.motions["motion0"]
    assert first.rotate is None
    assert second.rotate is not None
    assert second.rotate.degrees == -45.0
    assert second.rotate.axis == (0.0, 0.0, 2.0)
    assert second.translate == (0.0, 0.0, 1.0)
    assert second.scale == 2.0


def test_import_survives_dump_and_takes_overrides(folder: Path) -> None:
    path = folder / "conf.json"
    path.write_text(SHIPPED)
    understood = folder / "understood.yaml"
    understood.write_text(dump_scene(load_scene(path)))
    assert load_scene(understood) == load_scene(path)
    scene = load_scene(path, ["time.integrator=beuler", "handles[0].until=", "material.damping=0"])
    assert scene.time.integrator == "beuler"
    assert scene.handles[0].until == math.inf
    assert scene.material[0].damping == 0.0


def test_defaults_of_the_original(folder: Path) -> None:
    scene = load_scene(write(folder, frame_steps=None))
    assert scene.time.step == 0.04
    assert scene.gravity is None
    assert scene.wind is None
    assert scene.handles == []
    assert scene.material[0].damping == 0.0
    scene = load_scene(write(folder, frame_time=None, frame_steps=None))
    assert scene.time.step == pytest.approx(0.005, rel=1e-15)
    assert load_scene(write(folder, end_time=None, end_frame=50)).time.end == pytest.approx(2.0)
    handle = {"nodes": [0], "motion": -1, "label": -1}
    assert load_scene(write(folder, handles=[handle])).handles[0].motion is None
    assert load_scene(write(folder, wind={"velocity": [0, 2, 0]})).wind is None
    wind = load_scene(write(folder, wind={"velocity": [0, 2, 0], "density": 1})).wind
    assert wind is not None
    assert (wind.velocity, wind.density, wind.drag) == ((0.0, 2.0, 0.0), 1.0, 0.0)
    assert load_scene(write(folder, wind={"drag": 1})).wind is not None


def test_factors_stay_factors(folder: Path) -> None:
    material = {
        "data": "isotropic", "density_mult": 2, "stretching_mult": 3, "bending_mult": 4, "thicken": 5
    }  # fmt: skip
    scene = load_scene(write(folder, cloths=[{"mesh": "meshes/square.obj", "materials": [material]}]))
    (ours,) = scene.material
    assert (ours.density_scale, ours.stretching_scale, ours.bending_scale, ours.thicken) == (2, 3, 4, 5)
    assert ours.membrane is not None
    assert (ours.density, ours.membrane.c11, ours.membrane.c33) == (0.1, 80.0, 40.0)


def test_several_cloths_labels_and_offsets(folder: Path) -> None:
    cloth = {"mesh": "meshes/square.obj", "materials": [{"data": "paper"}]}
    handles = [{"nodes": [1], "cloth": 1}, {"label": 3}, {"label": 3, "cloth": 1}]
    scene = load_scene(write(folder, cloths=[cloth, cloth], handles=handles))
    assert [sheet.name for sheet in scene.mesh] == ["cloth0", "cloth1"]
    assert [material.group for material in scene.material] == ["cloth0", "cloth1"]
    assert [handle.nodes for handle in scene.handles] == [[5], [1, 3], [5, 7]]


def test_material_file_beside_the_scene(folder: Path) -> None:
    row = [10, -1, 20, 5]
    table = {"density": 0.3, "stretching": [row] * 6, "bending": [[4e-5] * 5, [-1e-5] * 5, [8e-5] * 5]}
    (folder / "mine.json").write_text("// measured by hand\n" + json.dumps(table))
    cloth = {"mesh": "meshes/square.obj", "materials": [{"data": "mine.json"}]}
    (material,) = load_scene(write(folder, cloths=[cloth])).material
    assert material.density == 0.3
    assert material.membrane is not None
    assert (material.membrane.c11, material.membrane.c12) == (20.0, 0.0)
    assert (material.membrane.c22, material.membrane.c33) == (40.0, 5.0)
    assert material.bending == (1e-5, 0.0, 2e-5)


ONE = {"mesh": "meshes/square.obj", "materials": [{"data": "paper"}]}

BAD = [
    ({"gravty": [0, 0, 1]}, "gravty", "did you mean 'gravity'"),
    ({"obstacles": [{"mesh": "meshes/none.obj"}]}, "obstacles[0].mesh", "no such file: meshes/none.obj"),
    ({"obstacles": [{"mesh": "meshes/square.obj", "motion": 0}]}, "obstacles[0].motion", "no motion 0"),
    ({"obstacles": "meshes/part%d.obj"}, "obstacles", "no such file: meshes/part0.obj"),
    ({"obstacles": "meshes/square.obj"}, "obstacles", "a name with a number"),
    ({"obstacles": [{"mesh": "meshes/square.obj", "motion": 0}],
      "motions": [[{"time": 0}, {"time": 1, "transform": {"scale": 0.5}}]]},
     "obstacles[0].motion", "scales from 0.5 to 1, but an obstacle is rigid"),
    ({"cloths": None}, "cloths", "missing"),
    ({"cloths": []}, "cloths", "at least one"),
    ({"cloths": 3}, "cloths", "must be a list"),
    ({"cloths": [{**ONE, "mesh": "meshes/none.obj"}]}, "cloths[0].mesh", "no such file: meshes/none.obj"),
    ({"cloths": [{**ONE, "mesh": "conf.json"}]}, "cloths[0].mesh", ".obj"),
    ({"cloths": [{**ONE, "textur": "a"}]}, "cloths[0].textur", "'texture'"),
    ({"cloths": [{**ONE, "materials": []}]}, "cloths[0].materials", "one material"),
    ({"cloths": [{**ONE, "materials": [{"data": "materials/grey-interlock.json"}]}]},
     "cloths[0].materials[0].data", "did you mean 'gray-interlock'"),
    ({"cloths": [{**ONE, "materials": [{"thickness": 1e-4, "density": 800}]}]},
     "cloths[0].materials[0].elastic_modulus", "missing"),
    ({"magic": {"repulsion": 1}}, "magic.repulsion", "unknown key"),
    ({"cloths": [{**ONE, "transform": {"rotate": [45, 0, 0]}}]}, "cloths[0].transform.rotate", "[degrees,"),
    ({"cloths": [{**ONE, "transform": {"rotate": [45, 0, 0, 0]}}]}, "cloths[0].transform.rotate", "axis"),
    ({"handles": [{"motion": 0, "nodes": [1]}]}, "handles[0].motion", "no motion 0"),
    ({"handles": [{"nodes": [1], "cloth": 1}]}, "handles[0].cloth", "no cloth 1"),
    ({"handles": [{"nodes": [-1]}]}, "handles[0].nodes[0]", ">= 0"),
    ({"handles": [{}]}, "handles[0]", "nodes or label"),
    ({"handles": [{"label": 9}]}, "handles[0].label", "no vertex has label 9"),
    ({"handles": [{"type": "glue", "nodes": [1, 2]}]}, "handles[0].type", "'node'"),
    ({"handles": [{"nodes": [1], "start_time": 2, "end_time": 1}]}, "handles[0].until", "later than"),
    ({"motions": [[]]}, "motions[0]", "list of keyframes"),
    ({"motions": [[{"time": 1, "velocity": {"scale": 2}}]]}, "motions[0][0].velocity", "translate only"),
    ({"motions": [[{"time": 2}, {"time": 1}]]}, "motions.motion0[1].time", "later than"),
    ({"end_time": None}, "time.end", "missing"),
    ({"frame_steps": 0}, "frame_steps", ">= 1"),
    ({"frame_time": "0.04"}, "frame_time", "must be a number"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "key", "message"), BAD, ids=[case[1] for case in BAD])
def test_mistakes_are_refused(folder: Path, changes: dict[str, Any], key: str, message: str) -> None:
    path = write(folder, **changes)
    with pytest.raises(InputError) as caught:
        load_scene(path)
    assert caught.value.key == key
    assert message in caught.value.message
    assert caught.value.file == str(path)
    assert "\n" not in str(caught.value)


# a cloth on a moving ball, with the blocks that ARCSim's own scenes have
ARCSIM = {
    "end_time": None,
    "duration": 2,
    "cloths": [
        {
            "mesh": "meshes/square.obj",
            "materials": [
                {"data": "isotropic", "thicken": 2, "bending_mult": 3, "strain_limits": [0.9, 1.1]},
            ],
            "remeshing": {"refine_angle": 0.3, "size": [0.01, 0.2]},
            "velocity": {"linear": [1, 0, 0]},
        }
    ],
    "handles": [{"nodes": [2]}],
    "motions": [
        [
            {"time": 0, "transform": {"scale": 0.1, "translate": [0, 0, 1]}},
            {"time": 1, "transform": {"scale": 0.1, "translate": [2, 0, 1], "rotate": [90, 0, 0, 1]}},
        ]
    ],
    "obstacles": [
        {"mesh": "meshes/square.obj", "motion": 0, "transform": {"translate": [5, 0, 0], "scale": 3}},
        {"mesh": "meshes/square.obj", "end_time": 3, "transform": {"translate": [0, 0, -4]}},
    ],
    "gravity": [0, 0, -9.8],
    "disable": ["popfilter", "plasticity"],
    "magic": {"repulsion_thickness": 5e-3, "collision_stiffness": 1e6, "handle_stiffness": 500},
}


def test_a_scene_of_arcsim(folder: Path) -> None:
    """Contact, still air, bending in proportion to the thickness, and notes on what has no effect."""
    scene = load_scene(write(folder, **ARCSIM))
    assert (scene.time.end, scene.time.step, scene.output.every) == (2.0, 0.005, 0.04)
    assert scene.wind is not None
    assert (scene.wind.velocity, scene.wind.density, scene.wind.drag) == ((0.0, 0.0, 0.0), 1.0, 0.0)
    assert scene.initial is not None
    assert scene.initial.velocity == (1.0, 0.0, 0.0)
    assert scene.handles[0].stiffness == 500.0
    assert scene.contact is not None
    assert (scene.contact.friction, scene.contact.gap) == (0.6, 5e-3)
    thick, _ = resolve_material(scene.material[0])
    thin, _ = resolve_material(load_scene(write(folder)).material[0])
    assert thick.bending == pytest.approx([6.0 * b for b in thin.bending])
    assert (thick.density, thick.c11) == pytest.approx((2.0 * thin.density, 2.0 * thin.c11))
    assert [note.partition(":")[0] for note in scene.notes] == [
        "magic.collision_stiffness",
        "obstacles[1].end_time",
        "cloths[0].remeshing",
        "cloths[0].materials[0].strain_limits",
    ]
    assert all("no effect here" in note for note in scene.notes)
    assert scene.changed({"time.end": 3.0}).notes == scene.notes


def test_an_obstacle_of_arcsim_is_where_its_motion_puts_it(folder: Path) -> None:
    """A motion there is the whole transform of an obstacle, after that in which it is placed."""
    scene = load_scene(write(folder, **ARCSIM))
    mesh = build_scene_mesh(scene)
    moving, still = build_obstacles(scene, mesh.obstacles, Motion)
    corner = np.array([3.0, 3.0, 0.0]) + [5.0, 0.0, 0.0]  # of the square, scaled and moved
    assert moving.motion is not None
    for time, turned in ((0.0, corner), (1.0, [-corner[1], corner[0], corner[2]])):
        matrix, shift = moving.motion(time)
        expected = 0.1 * np.asarray(turned) + [2.0 * time, 0.0, 1.0]
        assert (moving.points @ matrix.T + shift)[3] == pytest.approx(expected)
    assert still.motion is None
    assert still.points[3] == pytest.approx([1.0, 1.0, -4.0])
    assert moving.friction == (0.3, 0.3)
    assert scene.obstacles is not None
    assert scene.obstacles["obstacle0"].interpolation == "hermite"


def test_numbers_of_a_material_and_a_time_step_of_arcsim(folder: Path) -> None:
    paper = {
        "thickness": 1e-4, "density": 800, "elastic_modulus": 4e9, "poisson_ratio": 0.2, "bending_mult": 5,
        "toughness": 1e7, "yield_curv": 200,
    }  # fmt: skip
    cloth = {"mesh": "meshes/textured.obj", "transform": {"scale": 0.2}, "materials": [paper]}
    scene = load_scene(
        write(folder, cloths=[cloth], frame_time=None, frame_steps=None, end_time=None, timestep=0.001,
              save_frames=5, save_every=2, duration=4, disable=["collision"])
    )  # fmt: skip
    assert (scene.time.step, scene.output.every, scene.time.end) == (0.001, 0.01, 4.0)
    shell, _ = resolve_material(scene.material[0])
    assert (shell.density, shell.c11) == pytest.approx((0.08, 4e5 / 0.96))
    assert shell.bending[0] == pytest.approx(5.0 * 4e9 * 1e-12 / 12.0 / 0.96)
    assert shell.model == "hinge"
    assert scene.contact is None
    assert scene.mesh[0].uv == (0.2, 0.2)
    assert any("plasticity is not simulated" in note for note in scene.notes)


def test_obstacles_of_arcsim_by_number(folder: Path) -> None:
    for number in range(3):
        (folder / "meshes" / f"part{number:02d}.obj").write_text(SQUARE)
    motions = [[{"time": 0}, {"time": 1, "transform": {"translate": [0, 0, -number]}}] for number in (1, 2)]
    scene = load_scene(write(folder, obstacles="meshes/part%02d.obj", motions=motions))
    assert scene.obstacles is not None
    ends = [
        scene.keyframes(each)[-1].translate[2] if each.motion else 0.0 for each in scene.obstacles.values()
    ]
    assert ends == [-1.0, -2.0, 0.0]


BROKEN = [
    ('{"frame_time": 0.04,\n "frame_steps": }', "line 2"),
    ('{"a": NaN}', "NaN"),
    ('{"a": 1e999}', "1e999"),
    ('{"a": 1, "a": 2}', "given twice"),
    ('{"a": "unclosed', "is not JSON"),
    ('{"a": 1} /* unclosed', "unknown key"),
    ("// nothing but a comment", "is not JSON"),
    ("[1, 2]", "must be a block"),
    ('"text"', "must be a block"),
    ("[" * 100_000, "nested too deeply"),
]


@pytest.mark.parametrize(("text", "message"), BROKEN, ids=[case[0][:20] for case in BROKEN])
def test_broken_json_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "conf.json"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_scene(path)
    assert message in str(caught.value)


BAD_TABLES = [
    ({"density": 1, "stretching": [[1, 0, 1, 1]] * 5, "bending": [[1] * 5] * 3}, "stretching", "6 rows of 4"),
    ({"density": 0.1, "stretching": [[1, 0, 1, 1]] * 6, "bending": [[1] * 4] * 3}, "bending", "3 rows of 5"),
    ({"density": 0.1, "stretching": [[1, 0, 1, -1]] * 6, "bending": [[1] * 5] * 3}, "stretching[0]", "defin"),
    ({"density": 0, "stretching": [[1, 0, 1, 1]] * 6, "bending": [[1] * 5] * 3}, "density", "> 0"),
    ({"densty": 1}, "densty", "'density'"),
    ([1], None, "must be a block"),
]  # fmt: skip


@pytest.mark.parametrize(("table", "key", "message"), BAD_TABLES, ids=[str(case[1]) for case in BAD_TABLES])
def test_bad_material_files_are_refused(folder: Path, table: object, key: str | None, message: str) -> None:
    (folder / "mine.json").write_text(json.dumps(table))
    cloth = {"mesh": "meshes/square.obj", "materials": [{"data": "mine.json"}]}
    with pytest.raises(InputError) as caught:
        load_scene(write(folder, cloths=[cloth]))
    assert caught.value.file == str(folder / "mine.json")
    assert caught.value.key == key
    assert message in caught.value.message


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ([0, 72, 144, 216, 288, 360], [0, 72, 144, 216, 288, 360]),
        ([0, 450, 0], [0, 90, 0]),
        ([0, 270, 360], [0, -90, 0]),
        ([0, 3600, 180], [0, 0, 180]),
        ([90, 180, 270, 0], [90, 180, 270, 360]),
    ],
)
def test_rotations_between_keyframes_are_at_most_180_degrees(
    given: list[float], expected: list[float], folder: Path
) -> None:
    points = [{"time": i, "transform": {"rotate": [angle, 0, 0, 1]}} for i, angle in enumerate(given)]
    scene = load_scene(write(folder, motions=[points]))
    found = [k.rotate.degrees if k.rotate is not None else 0.0 for k in scene.motions["motion0"]]
    assert found == expected
