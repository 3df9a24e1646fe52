"""Rules of a scene, each stated once: in words of JSON Schema (draft 7), by which the loader checks, too."""

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
    """A condition on the keys of a block, and the message where it is violated.

    Attributes
    ----------
    condition : dict
        Words of JSON Schema.
    message : str or callable
        A template for ``str.format`` with the keys of the block, or what makes the message of the block.
    at : str
        The key below the block that is to be changed, dotted; without, the block itself.
    """

    condition: Condition
    message: str | Callable[[Any], str]
    at: str = ""


def holds(condition: Condition, value: Any) -> bool:
    """Whether a value obeys a condition.

    Parameters
    ----------
    condition : dict
        Those words of JSON Schema that rules are made of.
    value : number, text, path, list, or what has keys (a dictionary, a block)
        A key that is None is absent.
    """
    return all(_obeys(value, word, said, condition) for word, said in condition.items())


def _obeys(value: Any, word: str, said: Any, condition: Condition) -> bool:
    match word:
        case "type":
            kinds = said if isinstance(said, list) else [said]
            return any(
                hasattr(value, "get") if k == "object" else isinstance(value, _TYPES[k]) for k in kinds
            )
        case "const":
            return bool(value == said)
        case "enum":
            return value in said
        case "pattern":
            return re.search(said, str(value)) is not None
        case "items":
            return all(holds(said, entry) for entry in value)
        case "required":
            return all(value.get(key) is not None for key in said)
        case "properties":
            entries = [(value.get(key), part) for key, part in said.items()]
            return all(holds(part, entry) for entry, part in entries if entry is not None)
        case "not":
            return not holds(said, value)
        case "allOf":
            return all(holds(part, value) for part in said)
        case "anyOf":
            return any(holds(part, value) for part in said)
        case "oneOf":
            return sum(holds(part, value) for part in said) == 1
        case "if":
            return not holds(said, value) or holds(condition["then"], value)
        case "then":
            return True
    return bool(_BOUNDS[word](value, said))


def given(*keys: str, **values: Condition) -> Condition:
    """Holds if all ``keys`` have a value, and those of ``values`` one that fits."""
    something = {"not": {"type": "null"}}
    return {"required": [*keys, *values], "properties": {**dict.fromkeys(keys, something), **values}}


def absent(*keys: str) -> Condition:
    """Holds if none of ``keys`` has a value."""
    return {"properties": {key: {"type": "null"} for key in keys}}


def any_of(*keys: str) -> Condition:
    """Holds if any of ``keys`` has a value."""
    return {"anyOf": [given(key) for key in keys]}


def one_of(*keys: str) -> Condition:
    """Holds if exactly one of ``keys`` has a value."""
    return {"oneOf": [given(key) for key in keys]}


def when(condition: Condition, then: Condition) -> Condition:
    """``then`` where ``condition`` holds."""
    return {"if": condition, "then": then}


def exactly_one(*keys: str) -> Rule:
    """Of several ways to say something, one."""
    return Rule(one_of(*keys), f"must have exactly one of {', '.join(keys)}")
