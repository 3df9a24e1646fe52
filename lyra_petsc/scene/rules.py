"""Rules between the keys of a scene, written as JSON Schema (draft 7), by which the loader checks, too."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Condition = dict[str, Any]

_BOUNDS = {
    "minimum": operator.ge,
    "maximum": operator.le,
    "exclusiveMinimum": operator.gt,
    "exclusiveMaximum": operator.lt,
}
_TYPES: dict[str, tuple[type, ...]] = {
    "null": (),
    "number": (int, float),
    "string": (str, Path),
    "array": (list, tuple),
}


@dataclass(frozen=True)
class Rule:
    """A condition on the keys of a block, and the message if it is violated.

    Attributes
    ----------
    condition : dict
        JSON Schema.
    message : str or callable
        A template for ``str.format`` with the keys of the block, or a function of the block.
    at : str
        Path of the key that the message names, relative to the block; empty: the block itself.
    """

    condition: Condition
    message: str | Callable[[Any], str]
    at: str = ""


def holds(condition: Condition, value: Any) -> bool:
    """Whether a value satisfies a condition.

    Parameters
    ----------
    condition : dict
        JSON Schema, of the keywords that `_satisfies` knows.
    value : number, text, path, list, dictionary or block
        A key that is None is absent.
    """
    return all(_satisfies(value, keyword, expected, condition) for keyword, expected in condition.items())


def _satisfies(value: Any, keyword: str, expected: Any, condition: Condition) -> bool:
    """Whether a value satisfies one ``keyword`` of ``condition``, which has the value ``expected``."""
    match keyword:
        case "type":
            kinds = expected if isinstance(expected, list) else [expected]
            return any(
                hasattr(value, "get") if k == "object" else isinstance(value, _TYPES[k]) for k in kinds
            )
        case "const":
            return bool(value == expected)
        case "enum":
            return value in expected
        case "pattern":
            return re.search(expected, str(value)) is not None
        case "items":
            return all(holds(expected, entry) for entry in value)
        case "required":
            return all(value.get(key) is not None for key in expected)
        case "properties":
            entries = [(value.get(key), part) for key, part in expected.items()]
            return all(holds(part, entry) for entry, part in entries if entry is not None)
        case "not":
            return not holds(expected, value)
        case "allOf":
            return all(holds(part, value) for part in expected)
        case "anyOf":
            return any(holds(part, value) for part in expected)
        case "oneOf":
            return sum(holds(part, value) for part in expected) == 1
        case "if":
            return not holds(expected, value) or holds(condition["then"], value)
        case "then":
            return True
    return bool(_BOUNDS[keyword](value, expected))


def given(*keys: str, **values: Condition) -> Condition:
    """Condition: all ``keys`` have a value, and each key of ``values`` one that satisfies its condition."""
    something = {"not": {"type": "null"}}
    return {"required": [*keys, *values], "properties": {**dict.fromkeys(keys, something), **values}}


def absent(*keys: str) -> Condition:
    """Condition: none of ``keys`` has a value."""
    return {"properties": {key: {"type": "null"} for key in keys}}


def any_of(*keys: str) -> Condition:
    """Condition: at least one of ``keys`` has a value."""
    return {"anyOf": [given(key) for key in keys]}


def one_of(*keys: str) -> Condition:
    """Condition: exactly one of ``keys`` has a value."""
    return {"oneOf": [given(key) for key in keys]}


def when(condition: Condition, then: Condition) -> Condition:
    """Condition: if ``condition`` holds, ``then`` must hold."""
    return {"if": condition, "then": then}


def exactly_one(*keys: str) -> Rule:
    """Rule that exactly one of ``keys`` has a value."""
    return Rule(one_of(*keys), f"must have exactly one of {', '.join(keys)}")
