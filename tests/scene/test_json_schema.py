"""The JSON Schema accepts every scene that the loader accepts, and refuses others as far as it can."""

from __future__ import annotations

import json
import re
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError
from test_scene_mistakes import CASES, scene_text

from lyra_petsc.scene.json_schema import schema_file, schema_text
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.text import parse_yaml

jsonschema = pytest.importorskip("jsonschema")

ROOT = Path(__file__).parents[2]
BEYOND_SCHEMA = (
    "positive definite",
    "is too small",
    "must be later than",
    "must be at most static",
    "another point than from",
    "must be above min",
    "an obstacle is rigid",
    "unknown motion",
    "a second material",
    "earlier sheet",
    "lower corner first",
    r"must be (a whole number|text), not -?\d+(\.0|(\.\d+)?e\+\d+)\b",
    "must be a finite number, not nan",
    "must be a direction, not a zero vector",  # of components below 1e-150
)
"""Messages on rules that JSON Schema cannot express: comparisons of keys, other files, integers such as 2.0.

"""


@pytest.fixture(scope="module")
def validator() -> Any:
    schema = json.loads(schema_text())
    jsonschema.Draft7Validator.check_schema(schema)
    return jsonschema.Draft7Validator(schema)


def with_text_keys(value: Any) -> bool:
    """Whether a value has text keys only, as in JSON."""
    if isinstance(value, dict):
        return all(isinstance(key, str) and with_text_keys(entry) for key, entry in value.items())
    return all(map(with_text_keys, value)) if isinstance(value, list) else True


def judgement(validator: Any, data: Any) -> str:
    """``accepted``, ``refused``, ``beyond`` the schema, or a text on how schema and loader differ."""
    valid = validator.is_valid(data)
    try:
        Scene.model_validate(data)
    except ValidationError as error:
        if not valid:
            return "refused"
        words = error.errors()[0]["msg"]
        return (
            "beyond"
            if any(re.search(known, words) for known in BEYOND_SCHEMA)
            else f"too lax: {words}: {data}"
        )
    return "accepted" if valid else f"too strict: {next(validator.iter_errors(data)).message}: {data}"


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
    for name, block in [("scene", schema), *schema["definitions"].items()]:
        assert block["description"], name
        for key, entry in block["properties"].items():
            assert len(entry["description"]) > 8, f"{name}.{key}"
            assert "None" not in entry["description"], f"{name}.{key}: a scene file knows no None"


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_scenes_are_accepted(path: Path, validator: Any) -> None:
    data = parse_yaml(path.read_text(encoding="utf-8"), file=path)
    assert [error.message for error in validator.iter_errors(data)] == []


def test_known_mistakes_are_refused(validator: Any) -> None:
    seen: Counter[str] = Counter()
    for part, _, _ in CASES:
        try:
            data = parse_yaml(scene_text(part), file=None)
        except Exception:  # no YAML at all
            continue
        if with_text_keys(data) and "no such file" not in part and "none.obj" not in part:
            seen[judgement(validator, data)] += 1
    assert set(seen) <= {"refused", "beyond"}, [words for words in seen if words.startswith("too")]
    assert seen["refused"] > 80


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
        "petsc: {-ksp_type: cg}",
        "petsc: {LOG_VIEW: x.txt}",
        "petsc: {ksp_view: /tmp/x}",
        "petsc: {pc_type: shell}",
        "petsc: {ksp_type: [cg]}",
        "petsc: {snes_rtol: .inf}",
        "petsc: {ksp_monitor: -.inf}",
        "time: {end: 1, step: auto, tolerance: 1e-30}",
        "mesh: {file: a.OBJ, size: 1}",
        "loads: [{pressure: 1, nodes: [0]}]",
        "loads: [{force: [0, 0, 1]}]",
        "probes: {' ': {nodes: [0]}}",
        "motions: {swing: []}",
        "obstacles: {' ': {sphere: {center: [0, 0, 0], radius: 1}}}\ncontact: {gap: 1}",
        "obstacles: {}",
    ],
)
def test_further_mistakes_are_refused(part: str, validator: Any) -> None:
    assert judgement(validator, parse_yaml(scene_text(part), file=None)) == "refused"


@pytest.mark.slow
def test_schema_and_loader_agree_on_random_scenes(validator: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    hypothesis = pytest.importorskip("hypothesis")
    with suppress(ImportError):
        # it also draws constants of all imported modules
        from hypothesis.internal.conjecture import providers

        fixed = providers.GLOBAL_CONSTANTS
        monkeypatch.setattr(providers, "_get_local_constants", lambda: fixed, raising=False)
    for folder in ("fuzz", "cli"):
        monkeypatch.syspath_prepend(str(ROOT / "tests" / folder))
    from odd_values import document
    from scene_cases import mutated, scenes

    seen: Counter[str] = Counter()

    @hypothesis.seed(6)
    @hypothesis.settings(
        max_examples=150,
        deadline=None,
        database=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(mutated() | scenes())
    def draw(blocks: dict[str, Any]) -> None:
        try:
            data = parse_yaml(document(blocks), file=None)
        except Exception:  # no YAML
            return
        if with_text_keys(data):
            seen[judgement(validator, data)] += 1

    draw()
    assert set(seen) == {"accepted", "refused", "beyond"}, [
        words for words in seen if words.startswith("too")
    ]
