"""Base class of all blocks of scene keys: unknown keys are errors, and an empty key counts as absent.

JSON Schema and the reference page are generated from the fields and the docstring of a block.
"""

from __future__ import annotations

import inspect
import math
import re
from dataclasses import dataclass
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Discriminator, GetJsonSchemaHandler, model_validator
from pydantic_core import CoreSchema
from typing_extensions import Self

from lyra_petsc.errors import suggest
from lyra_petsc.scene.sealed import refuse_change, sealed
from lyra_petsc.scene.values import problem, require, shown

_ENTRY = re.compile(r"(?P<names>\w+(?:, \w+)*)(?: : (?P<kind>.*))?")
_UNIT = re.compile(r"\[([^\]]*)\]")


class Block(BaseModel):
    """A block of a scene file; attributes have the names of the keys where these are Python names."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    # keys for which an explicit null is a value; else null means that the key is absent
    null_is_a_value: ClassVar[frozenset[str]] = frozenset()

    # keys that users may expect although they are not supported, with the message
    unsupported: ClassVar[dict[str, str]] = {}

    # required keys that `with_defaults` fills in in some cases
    conditional_defaults: ClassVar[frozenset[str]] = frozenset()

    @classmethod
    def keys(cls) -> list[str]:
        """The keys as a scene file writes them."""
        return [field.alias or name for name, field in cls.model_fields.items()]

    @model_validator(mode="before")
    @classmethod
    def _check_keys(cls, data: Any) -> Any:
        if isinstance(data, cls):
            return data
        if not isinstance(data, dict):
            raise problem(f"must be a block with keys ({', '.join(cls.keys())}), not {shown(data)}")
        known = cls.keys()
        for key in data:
            if key not in known:
                word = key if isinstance(key, str) else shown(key)
                if word in cls.unsupported:
                    raise problem(cls.unsupported[word], word)
                raise problem(f"unknown key, {suggest(word, known)}", word)
        kept = {key: value for key, value in data.items() if value is not None or key in cls.null_is_a_value}
        return cls.with_defaults(kept)

    @classmethod
    def with_defaults(cls, data: dict[str, Any]) -> dict[str, Any]:
        """Hook: add defaults that depend on which other keys are given."""
        return data

    def check(self) -> None:
        """Hook: raise a `problem` for values that do not go together."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        self.check()
        self.__dict__.update(sealed(self.__dict__))
        return self

    def __setattr__(self, name: str, value: Any) -> None:
        if not name.startswith("_"):
            refuse_change()
        super().__setattr__(name, value)

    def __delattr__(self, name: str) -> None:
        if not name.startswith("_"):
            refuse_change()
        super().__delattr__(name)

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        schema = handler.resolve_ref_schema(handler(core))
        described = attributes(cls)
        for name, field in cls.model_fields.items():
            key = field.alias or name
            content = schema["properties"][key]
            content.pop("title", None)
            if content.get("default") == math.inf:  # no number in JSON
                del content["default"]
            optional = not field.is_required() or name in cls.conditional_defaults
            if optional and {"type": "null"} not in content.get("anyOf", ()):
                # an empty key counts as absent
                default = {"default": content.pop("default")} if "default" in content else {}
                content = {"anyOf": [content, {"type": "null"}], **default}
            schema["properties"][key] = {"description": described[name].sentence, **content}
        schema["description"] = summary(cls)
        schema["required"] = [
            key for key in schema.get("required", ()) if key not in cls.conditional_defaults
        ]
        return schema

    def get(self, key: str) -> Any:
        """The value of a key, named as in `keys`; None if it is absent."""
        aliases = {field.alias: name for name, field in type(self).model_fields.items() if field.alias}
        return getattr(self, aliases.get(key, key))

    def present(self, *keys: str) -> list[str]:
        """Those of ``keys`` that have a value."""
        return [key for key in keys if self.get(key) is not None]

    def require_one(self, *keys: str) -> None:
        """Raise a `problem` unless exactly one of ``keys`` has a value."""
        require(len(self.present(*keys)) == 1, f"must have exactly one of {', '.join(keys)}")

    def require_with(self, key: str, condition: object, message: str) -> None:
        """Raise a `problem` at ``key`` if it has a value and the condition does not hold."""
        require(self.get(key) is None or condition, message, key)


BY_KIND = Discriminator(lambda value: "[block]" if isinstance(value, (dict, Block)) else "[plain]")
"""Discriminator of values that may be a block or plain values; messages omit the tags."""


@dataclass(frozen=True)
class Described:
    """One entry of the list of attributes in a docstring.

    Attributes
    ----------
    kind : str
        Type and shape, with the unit in brackets.
    text : str
    """

    kind: str
    text: str

    @property
    def unit(self) -> str:
        """The unit; empty if there is none."""
        unit = _UNIT.search(self.kind)
        return unit[1] if unit else ""

    @property
    def sentence(self) -> str:
        """The text, followed by the unit in brackets."""
        return " ".join(part for part in (self.text, f"[{self.unit}]" if self.unit else "") if part)


def summary(block: type) -> str:
    """The first paragraph of a class's docstring, on one line."""
    return " ".join((inspect.getdoc(block) or "").split("\n\n")[0].split())


def attributes(block: type) -> dict[str, Described]:
    """The entries under ``Attributes`` in the docstrings of a class and its bases, by name."""
    entries: dict[str, Described] = {}
    for parent in reversed(block.__mro__):
        entries |= _parse_attributes(inspect.cleandoc(parent.__dict__.get("__doc__") or ""))
    return entries


def _parse_attributes(doc: str) -> dict[str, Described]:
    _, _, section = doc.partition("Attributes\n----------\n")
    entries: dict[str, Described] = {}
    names: list[str] = []
    for line in section.splitlines():
        if line.startswith(" "):
            for name in names:
                text = f"{entries[name].text} {line.strip()}".strip()
                entries[name] = Described(entries[name].kind, text)
        elif entry := _ENTRY.fullmatch(line):
            # an entry without a type refers to another docstring
            names = entry["names"].split(", ") if entry["kind"] else []
            entries |= {name: Described(entry["kind"], "") for name in names}
        else:
            names = []
    return entries
