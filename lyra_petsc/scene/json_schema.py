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
    """JSON Schema of a scene: the keys of all blocks with types, ranges and meaning.

    It accepts what the loader accepts; conditions between keys are checked by the loader alone.
    """
    content = Scene.model_json_schema()
    for key in ONE_OR_MANY:
        entry = content["properties"][key]
        many = {name: entry.pop(name) for name in ("type", "items")}
        entry["anyOf"] = [many["items"], many]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **content,
        "title": "Scene of lyra_petsc",
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
