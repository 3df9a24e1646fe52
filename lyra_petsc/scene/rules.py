"""Words of JSON Schema (draft 7) for keys that depend on each other; a key that is empty counts as absent."""

from __future__ import annotations

from typing import Any

Rule = dict[str, Any]


def given(*keys: str, **values: Rule) -> Rule:
    """Holds if all ``keys`` have a value, and those of ``values`` one that fits."""
    something = {"not": {"type": "null"}}
    return {"required": [*keys, *values], "properties": {**dict.fromkeys(keys, something), **values}}


def absent(*keys: str) -> Rule:
    """Holds if none of ``keys`` has a value."""
    return {"properties": {key: {"type": "null"} for key in keys}}


def only(keys: tuple[str, ...], *, unless: tuple[str, ...]) -> Rule:
    """Holds if all ``keys`` have a value and none of ``unless``."""
    return {"allOf": [given(*keys), absent(*unless)]}


def one_of(*keys: str) -> Rule:
    """Holds if exactly one of ``keys`` has a value."""
    return {"oneOf": [given(key) for key in keys]}


def when(condition: Rule, then: Rule, otherwise: Rule | None = None) -> Rule:
    """``then`` where ``condition`` holds, else ``otherwise``."""
    rule = {"if": condition, "then": then}
    return rule if otherwise is None else {**rule, "else": otherwise}
