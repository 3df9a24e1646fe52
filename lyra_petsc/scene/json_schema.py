"""The JSON Schema of scene files, for editors: ``check --schema`` prints it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lyra_petsc.scene.overrides import ONE_OR_MANY
from lyra_petsc.scene.schema import Scene

SCHEMA_FILE = Path(__file__).with_name("scene.schema.json")
"""What `schema_text` gave when the package was made; editors can be pointed at it."""


def scene_schema() -> dict[str, Any]:
    """The schema (draft 7), made from the blocks of the scene.

    It refuses what the loader refuses as far as JSON Schema can say it. Beyond it are: files that do not
    exist, groups of the mesh, names of motions that are not there, a membrane that is not positive definite,
    and the order of times.
    """
    content = Scene.model_json_schema(ref_template="#/definitions/{model}")
    definitions = content.pop("$defs")
    keys = content["properties"]
    for key in ONE_OR_MANY:
        entry = keys[key].pop("items")
        many = {"type": keys[key].pop("type"), "items": entry, "minItems": 1}
        keys[key] = {**keys[key], "anyOf": [entry, many]}
    motions = keys["motions"]["anyOf"][0]
    motions["additionalProperties"]["minItems"] = 1
    for blocks_of_names in (motions, keys["probes"]["anyOf"][0]):
        blocks_of_names["propertyNames"] = {"pattern": r"\S"}
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "Scene of lyra_petsc",
        **content,
        "definitions": definitions,
    }


def schema_text() -> str:
    """The schema as the text of a file."""
    return json.dumps(scene_schema(), indent=2, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    SCHEMA_FILE.write_text(schema_text(), encoding="utf-8")
