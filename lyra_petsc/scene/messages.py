"""Conversion of pydantic's errors to one line, which names the key as the user wrote it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from lyra_petsc.errors import InputError
from lyra_petsc.scene.values import one_line, shown

Model = TypeVar("Model", bound=BaseModel)

_BOUNDS = {"greater_than": ">", "greater_than_equal": ">=", "less_than": "<", "less_than_equal": "<="}
"""pydantic's kinds of errors for numbers out of bounds."""


def dotted(path: Sequence[str | int], data: Any = None) -> str:
    """``path`` written like ``handles[1].group``.

    The index 0 is left out where ``data`` has a single block instead of a list.
    """
    key = ""
    for part in path:
        if isinstance(part, int):
            if not isinstance(data, dict):
                key += f"[{part}]"
                data = data[part] if isinstance(data, (list, tuple)) and part < len(data) else None
        else:
            key += f".{part}" if key else part
            data = data.get(part) if isinstance(data, dict) else None
    return key


def input_error(
    error: ValidationError, data: Any, *, file: object | None, overridden: Sequence[str] = ()
) -> InputError:
    """The first of pydantic's errors as an `InputError`, with the number of further errors.

    Parameters
    ----------
    error : pydantic.ValidationError
    data : dict
        The validated values, which determine how keys are written.
    file : path
        The scene file.
    overridden : keys
        Keys set on the command line, for which the message says so.
    """
    findings = error.errors(include_url=False)
    first = findings[0]
    context: dict[str, Any] = first.get("ctx", {})
    # pydantic adds parts in brackets, for names in mappings and kinds of values
    parts = [part for part in first["loc"] if not str(part).startswith("[")]
    path = parts + list(context.get("at", ()))
    key = one_line(dotted(path, data))
    message = one_line(_message(first["type"], first["msg"], first.get("input"), context))
    if any(key == name or key.startswith((f"{name}.", f"{name}[")) for name in overridden):
        message += " (from --set)"
    if len(findings) > 1:
        message += f" (and {len(findings) - 1} more)"
    return InputError(message, file=file, key=key or None)


def validated(
    kind: type[Model],
    data: Any,
    *,
    file: object | None,
    overridden: Sequence[str] = (),
    context: dict[str, Any] | None = None,
) -> Model:
    """The block of this kind with these plain values.

    Raises
    ------
    InputError
        As `input_error` makes it.
    """
    try:
        return kind.model_validate(data, context=context)
    except ValidationError as error:
        raise input_error(error, data, file=file, overridden=overridden) from None


def _message(kind: str, message: str, value: Any, context: dict[str, Any]) -> str:
    if kind == "scene":
        return message
    if kind == "missing":
        return "missing"
    if kind in _BOUNDS:
        (bound,) = (limit for name, limit in context.items() if name != "error")
        noun = "a whole number " if isinstance(bound, int) else ""
        return f"must be {noun}{_BOUNDS[kind]} {bound:.10g}, not {value:.10g}"
    if kind == "literal_error":
        known = context["expected"].replace("'", "").replace(" or ", ", ")
        return f"must be one of {known}, not {shown(value)}"
    if kind == "list_type":
        return f"must be a list, not {shown(value)}"
    if kind == "recursion_loop":
        return "refers to itself"
    return f"{message[:1].lower()}{message[1:]}, not {shown(value)}"
