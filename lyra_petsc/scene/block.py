"""Base of every block of scene keys: unknown keys are errors, an empty key counts as absent."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, model_validator

from lyra_petsc.nearest import nearest
from lyra_petsc.scene.values import problem, shown


class Block(BaseModel):
    """A block of keys; attribute names are the keys, but for ``from`` (attribute ``start``)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    # keys for which an explicit null is a value and not the same as leaving them out
    null_is_a_value: ClassVar[frozenset[str]] = frozenset()

    # keys that a scene may well try, and what to say of them
    not_yet: ClassVar[dict[str, str]] = {}

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

    def given(self, *names: str) -> list[str]:
        """Those of ``names`` that have a value."""
        return [name for name in names if getattr(self, name) is not None]
