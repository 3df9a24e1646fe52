"""JSON Schema of scene files, for editors; generated from the blocks of the scene."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import lyra_petsc
from lyra_petsc.scene.overrides import ONE_OR_MANY
from lyra_petsc.scene.schema import Scene

FILE = f"lyra_petsc-{lyra_petsc.__version__}.schema.json"


def scene_schema() -> dict[str, Any]:
    """JSON Schema (draft 7) of a scene.

    It refuses what the loader refuses, except what JSON Schema cannot express: files that do not exist,
    unknown groups and motions, a membrane stiffness that is not positive definite, and the order of times.
    """
    content = Scene.model_json_schema(ref_template="#/definitions/{model}")
    definitions = content.pop("$defs")
    keys = content["properties"]
    for key in ONE_OR_MANY:
        entry = keys[key].pop("items")
        many = {"type": keys[key].pop("type"), "items": entry, "minItems": 1}
        keys[key] = {**keys[key], "anyOf": [entry, many]}
    for key in ("motions", "obstacles", "probes"):
        keys[key]["anyOf"][0]["propertyNames"] = {"pattern": r"\S"}
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "Scene of lyra_petsc",
        **content,
        "definitions": definitions,
    }


def schema_text() -> str:
    """The schema as JSON text, as ``check --schema`` prints it."""
    return json.dumps(scene_schema(), indent=2, ensure_ascii=False) + "\n"


def schema_file() -> Path:
    """A file with the schema in the user's cache folder, written if it is missing or different.

    If it cannot be written: ``scene.schema.json``, which users can make by ``check --schema``.
    """
    try:
        path = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lyra_petsc" / FILE
        text = schema_text()
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
    except (OSError, RuntimeError):  # a full disk, a folder of another user, or no home at all
        return Path("scene.schema.json")
    return path
