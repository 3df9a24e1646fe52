"""The command ``new`` writes scenes that run unchanged, and never overwrites a file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from launch import ROOT, done

from lyra_petsc.scene.json_schema import FILE
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.text import parse_yaml

SHORT = ("--set", "time.end=0.02", "--set", "time.step=0.01")
GEO = """\
SetFactory("Built-in");
Point(1) = {0, 0, 0, 0.3}; Point(2) = {1, 0, 0, 0.3}; Point(3) = {0, 0, 1, 0.3};
Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 1};
Curve Loop(1) = {1, 2, 3}; Plane Surface(1) = {1};
"""
MSH_GROUPS = (
    'Physical Surface("sail") = {1}; Physical Curve("the mast") = {3}; Physical Point("head") = {3};\n'
)


def uncommented(text: str) -> str:
    """The starter scene with its commented blocks activated."""
    lines = []
    offered = ("# wind", "# motions", "#   ", "# loads", "# petsc")
    _, _, body = text.partition("\ntitle:")
    for line in ("title:" + body).splitlines():
        # a group's line in the list of groups is no key
        lines.append(line[2:] if line.startswith(offered) else line)
    return "\n".join(lines).replace("    # motion: swing", "    motion: swing") + "\n"


def test_the_starter_scene_runs_unchanged(tmp_path: Path) -> None:
    left = done(["new", "kite"], tmp_path, extra={"XDG_CACHE_HOME": str(tmp_path)})
    assert "kite.yaml written" in left.out
    done(["check", "kite.yaml"], tmp_path)
    done(["run", "kite.yaml", *SHORT, "--out", "kite"], tmp_path, ranks=2)
    assert (tmp_path / "kite" / "states.xdmf").is_file()
    text = (tmp_path / "kite.yaml").read_text(encoding="utf-8")
    schema = tmp_path / "lyra_petsc" / FILE
    assert text.startswith(f"# yaml-language-server: $schema={schema}\n")
    assert schema.is_file()


def test_blocks_in_its_comments_are_valid(tmp_path: Path) -> None:
    done(["new", "kite"], tmp_path)
    text = (tmp_path / "kite.yaml").read_text(encoding="utf-8")
    scene = Scene.model_validate(parse_yaml(uncommented(text), file=None))
    assert scene.handles[0].motion == "swing"
    assert len(scene.motions["swing"]) == 2
    assert scene.wind is not None
    assert scene.loads[0].pressure == 5
    assert scene.petsc == {"ksp_rtol": 1e-8}


def test_the_starter_scene_fits_the_schema(tmp_path: Path) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    done(["new", "kite"], tmp_path)
    schema = json.loads(done(["check", "--schema"], tmp_path).out)
    data = parse_yaml((tmp_path / "kite.yaml").read_text(encoding="utf-8"), file=None)
    jsonschema.validate(data, schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**data, "gravitty": [0, 0, -9.81]}, schema)


def test_groups_of_a_mesh_are_listed_and_one_is_held(tmp_path: Path) -> None:
    (tmp_path / "my mesh.geo").write_text(GEO + MSH_GROUPS, encoding="utf-8")
    (tmp_path / "scenes").mkdir()
    done(["new", "scenes/sail", "--mesh", "my mesh.geo"], tmp_path)
    text = (tmp_path / "scenes" / "sail.yaml").read_text(encoding="utf-8")
    assert '  #   "the mast"  curve, ' in text
    assert '  #   "head"  point, vertices: 1\n' in text
    assert '  #   "sail"  surface, ' in text
    scene = load_scene(tmp_path / "scenes" / "sail.yaml")
    assert scene.mesh[0].file == tmp_path / "scenes" / ".." / "my mesh.geo"
    assert scene.handles[0].group == "the mast"
    done(["run", "scenes/sail.yaml", *SHORT], tmp_path)


def test_a_mesh_without_groups_is_held_by_its_upper_end(tmp_path: Path) -> None:
    (tmp_path / "bare.geo").write_text(GEO, encoding="utf-8")
    done(["new", "bare", "--mesh", "bare.geo"], tmp_path)
    assert load_scene(tmp_path / "bare.yaml").handles[0].box is not None
    done(["check", "bare.yaml"], tmp_path)
    done(["new", "square", "--mesh", str(ROOT / "meshes" / "square.obj")], tmp_path)  # surface groups only
    done(["run", "square.yaml", *SHORT], tmp_path)


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("lyra-petsc ch", "plain,check"),
        ("lyra-petsc run -ksp_type cg --res", "plain,--resume"),
        ("lyra-petsc run kit", "file,kit"),
        ("lyra-petsc nonsense --f", ""),
    ],
)
def test_completion_in_the_shell(words: str, offered: str, tmp_path: Path) -> None:
    asked = {"_LYRA_PETSC_COMPLETE": "bash_complete", "COMP_WORDS": words}
    left = done([], tmp_path, extra={**asked, "COMP_CWORD": str(len(words.split()) - 1)})
    assert left.out.strip() == offered
    assert left.err == ""
