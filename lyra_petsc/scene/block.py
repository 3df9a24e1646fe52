"""Base of every block of scene keys: unknown keys are errors, an empty key counts as absent."""

from __future__ import annotations

import math
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, GetJsonSchemaHandler, model_validator
from pydantic_core import CoreSchema

from lyra_petsc.nearest import nearest
from lyra_petsc.scene.describe import attributes, summary
from lyra_petsc.scene.values import problem, shown


class Block(BaseModel):
    """A block of keys; attribute names are the keys, but for ``from`` (attribute ``start``)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    # keys for which an explicit null is a value and not the same as leaving them out
    null_is_a_value: ClassVar[frozenset[str]] = frozenset()

    # keys that a scene may well try, and what to say of them
    not_yet: ClassVar[dict[str, str]] = {}

    # how keys depend on each other, as far as JSON Schema can say it (scene.rules)
    rules: ClassVar[tuple[dict[str, Any], ...]] = ()

    # keys that `complete` fills in only in some cases
    sometimes_filled: ClassVar[frozenset[str]] = frozenset()

    @classmethod
    def keys(cls) -> list[str]:
        """The keys as a scene file writes them."""
        return [field.alias or name for name, field in cls.model_fields.items()]

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: Any) -> Any:
        if isinstance(data, cls):
            return data
        if not isinstance(data, dict):
            raise problem(f"must be a block with keys ({', '.join(cls.keys())}), not {shown(data)}")
        known = cls.keys()
        for key in data:
            if key not in known:
                word = key if isinstance(key, str) else shown(key)
                if word in cls.not_yet:
                    raise problem(cls.not_yet[word], word)
                raise problem(f"unknown key, {nearest(word, known)}", word)
        kept = {key: value for key, value in data.items() if value is not None or key in cls.null_is_a_value}
        return cls.complete(kept)

    @classmethod
    def complete(cls, data: dict[str, Any]) -> dict[str, Any]:
        """Hook: defaults that depend on which other keys are given."""
        return data

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        schema = handler.resolve_ref_schema(handler(core))
        said = attributes(cls)
        keys = {}
        for name, field in cls.model_fields.items():
            key = field.alias or name
            content = {word: value for word, value in schema["properties"][key].items() if word != "title"}
            default = content.pop("default", None)
            optional = not field.is_required() or name in cls.sometimes_filled
            if "anyOf" in content and {"type": "null"} in content["anyOf"]:
                pass
            elif optional:  # an empty key counts as absent
                content = {"anyOf": [content, {"type": "null"}]}
            elif "$ref" in content:  # draft 7 ignores what stands beside a reference
                content = {"allOf": [content]}
            keys[key] = {"description": said[name].sentence, **content}
            if default not in (None, math.inf):
                keys[key]["default"] = default
        schema.pop("title", None)
        needed = [key for key in schema.get("required", ()) if key not in cls.sometimes_filled]
        schema["required"] = needed
        schema |= {"description": summary(cls), "properties": keys}
        return schema | ({"allOf": list(cls.rules)} if cls.rules else {})

    def given(self, *names: str) -> list[str]:
        """Those of ``names`` that have a value."""
        return [name for name in names if getattr(self, name) is not None]
