"""The JSON Schema for editors accepts what the loader accepts, and knows keys, types and ranges."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError
from test_scene_mistakes import scene_text

from lyra_petsc.scene.json_schema import schema_file, schema_text
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.text import parse_yaml

jsonschema = pytest.importorskip("jsonschema")

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def validator() -> Any:
    schema = json.loads(schema_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def judgement(validator: Any, data: Any) -> str:
    """``accepted``, ``refused`` by the loader, or what the schema alone refuses."""
    try:
        Scene.model_validate(data)
    except ValidationError:
        return "refused"
    return next((f"{error.message}: {data}" for error in validator.iter_errors(data)), "accepted")


def test_the_schema_file_for_editors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = schema_file()
    assert path.parent == tmp_path / "cache" / "lyra_petsc"
    assert path.read_text(encoding="utf-8") == schema_text()
    path.write_text("of an older checkout", encoding="utf-8")
    assert schema_file().read_text(encoding="utf-8") == schema_text()
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert schema_file() == Path("scene.schema.json")


def test_every_key_is_described() -> None:
    schema = json.loads(schema_text())
    for name, block in [("scene", schema), *schema["$defs"].items()]:
        assert block["description"], name
        for key, entry in block["properties"].items():
            assert len(entry["description"]) > 8, f"{name}.{key}"
            assert "None" not in entry["description"], f"{name}.{key}: a scene file knows no None"


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_scenes_are_accepted(path: Path, validator: Any) -> None:
    data = parse_yaml(path.read_text(encoding="utf-8"), file=path)
    assert [error.message for error in validator.iter_errors(data)] == []


@pytest.mark.parametrize(
    "part",
    [
        "gravity:",
        "output: {every: , fields: }",
        "mesh: [{grid: {width: 1, height: 1, nx: 2, ny: 2}, file: , size: }]",
        "handles: [{group: 3, until: .inf, from: -1}, {box: [[0, 0, 0], [1, 1, 1]], axes: [z, z]}]",
        "material: {density: 1, membrane: {c11: 1, c22: 1, c12: 0, c33: 1}, bending: [0, 1, 2]}",
        "time: {analysis: static}",
        "time: {analysis: static, end: 1, step: 1}",
        "time: {end: 1, step: auto, integrator: alpha2, spectral_radius: 0, tolerance: 0.1}",
        "loads: [{pressure: -3}, {traction: [0, 0, 1], group: a}, {force: [0, 0, 1], nodes: [0]}]",
        "contact: {friction: {static: 1, kinetic: 0}, self: false, gap: }",
        "obstacles:",
        "contact: {gap: 1}\nobstacles: {a: {box: {min: [0, 0, 0], max: [1, 1, 1]}, inside: true}}",
        "contact: {gap: 1}\nobstacles: {1: {mesh: {file: a.OBJ}, motion: [{time: 0, scale: [1, 1, 1]}]}}",
        "petsc: {ksp_monitor: , ksp_view: '::ascii_info', ksp_rtol: 1e-8, snes_lag_jacobian: -1}",
    ],
)
def test_unusual_scenes_are_accepted(part: str, validator: Any) -> None:
    assert judgement(validator, parse_yaml(scene_text(part), file=None)) == "accepted"


@pytest.mark.parametrize(
    "part",
    [
        "gravitty: [0, 0, -9.81]",
        "gravity: [0, 0]",
        "material: {cloth: grey-interlock}",
        "material: {density: 1, membrane: {c11: 0, c22: 1, c12: 0, c33: 1}}",
        "time: {end: 1, step: fast}",
        "time: {end: 1, step: 0.1, integrator: euler}",
        "output: {fields: [stres]}",
        "probes: {tip: {nodes: [-1]}}",
        "petsc: {ksp_type: [cg]}",
    ],
)
def test_unknown_keys_types_and_ranges_are_marked(part: str, validator: Any) -> None:
    assert not validator.is_valid(parse_yaml(scene_text(part), file=None))
