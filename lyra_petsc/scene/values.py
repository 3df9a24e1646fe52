"""Checked values that scene keys are made of: numbers, vectors, scales, names.

Each is strict: text is not taken for a number, nor a yes for a one, and nothing is NaN or
infinite. The messages say what is wrong and what is allowed; the key is added by
``scene.messages``.
"""

from __future__ import annotations

import math
import reprlib
import sys
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import GetJsonSchemaHandler, PlainValidator
from pydantic_core import CoreSchema, PydanticCustomError

Vec3 = tuple[float, float, float]

# Largest vertex number that every index type downstream can hold.
LARGEST_INDEX = 2**31 - 2

# Looks at a few entries only: a value made of YAML anchors can be larger than memory.
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxdict = 3, 6, 4
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = 60


def problem(message: str, *at: str | int) -> PydanticCustomError:
    """Error of a scene value; ``at`` is the key below the block that is being checked."""
    # braces in user text would be taken for a template
    return PydanticCustomError("scene", "{message}", {"message": message, "at": list(at), "problem": True})


def shown(value: object) -> str:
    """``value`` as one short piece of a message."""
    if value is None:
        return "empty"
    if isinstance(value, bool):
        return "true" if value else "false"
    try:
        text = _SHORT.repr(value)
    except ValueError:  # more digits than Python is willing to write
        return f"a very long {type(value).__name__}"
    return text if len(text) <= 60 else text[:57] + "..."


def one_line(text: str) -> str:
    """``text`` on one line, with what cannot be printed written as an escape."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in " ".join(text.split()))


def number(value: Any) -> float:
    """``value`` as a finite float; bool, text and NaN are refused."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        hint = ""
        if isinstance(value, str):
            hint = " (text; write it without quotes)" if _reads_as_number(value) else " (text)"
        raise problem(f"must be a number, not {shown(value)}{hint}")
    try:
        result = float(value)
    except OverflowError:
        raise problem("must be a number below 1.8e308") from None
    if not math.isfinite(result):
        raise problem(f"must be a finite number, not {shown(value)}")
    return result


def _reads_as_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _bounded(check: Callable[[float], bool], allowed: str) -> Callable[[Any], float]:
    def validate(value: Any) -> float:
        result = number(value)
        if not check(result):
            raise problem(f"must be {allowed}, not {shown(value)}")
        return result

    return validate


def _until(value: Any) -> float:
    # "never" may be said outright
    return math.inf if value == math.inf and isinstance(value, float) else number(value)


def vector(value: Any) -> Vec3:
    """``value`` as three finite floats."""
    if not isinstance(value, (list, tuple)) or len(value) != 3:
        raise problem(f"must be three numbers like [0, 0, 1], not {shown(value)}")
    x, y, z = (number(component) for component in value)
    return x, y, z


def _axis(value: Any) -> Vec3:
    axis = vector(value)
    if math.hypot(*axis) < 1e-150:
        raise problem("must be a direction, not a zero vector")
    return axis


def _scale(value: Any) -> float | Vec3:
    scale = vector(value) if isinstance(value, (list, tuple)) else number(value)
    if 0.0 in (scale if isinstance(scale, tuple) else (scale,)):
        raise problem("must not be 0")
    return scale


def _positive_scale(value: Any) -> float | Vec3:
    scale = _scale(value)
    if min(scale if isinstance(scale, tuple) else (scale,)) < 0:
        raise problem(f"must be > 0, not {shown(value)}")
    return scale


def integer(value: Any) -> int:
    """``value`` as a whole number; bool, text and 1.0 are refused."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise problem(f"must be a whole number, not {shown(value)}")
    return value


def _integer(lowest: int, highest: int) -> Callable[[Any], int]:
    def validate(value: Any) -> int:
        value = integer(value)
        if value < lowest:
            raise problem(f"must be a whole number >= {lowest}, not {shown(value)}")
        if value > highest:
            raise problem(f"must be a whole number <= {highest}, not {shown(value)}")
        return int(value)

    return validate


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise problem(f"must be text, not {shown(value)} (put it in quotes)")
    if "\0" in value:
        raise problem("must be text without null characters")
    return value


def _name(value: Any) -> str:
    # a gmsh group without a name is called by its number
    if isinstance(value, int) and not isinstance(value, bool):
        value = shown(value)
    name = _text(value)
    if not name.strip():
        raise problem("must be a name, not empty text")
    return name


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise problem(f"must be true or false, not {shown(value)}")
    return value


def _bending(value: Any) -> float | Vec3:
    """One stiffness, or one for hinge edges at 0°, 45° and 90° to the warp."""
    given = vector(value) if isinstance(value, (list, tuple)) else number(value)
    if min(given if isinstance(given, tuple) else (given,)) < 0:
        raise problem(f"must be >= 0 [N·m], not {shown(value)}")
    return given


def _step_length(value: Any) -> float | str:
    if value == "auto":
        return "auto"
    if isinstance(value, str) and not _reads_as_number(value):
        raise problem(f"must be a number or auto, not {shown(value)}")
    step = number(value)
    if step <= 0:
        raise problem(f"must be > 0, not {shown(value)}")
    return step


Schema = dict[str, Any]


@dataclass(frozen=True, eq=False)
class JsonSchema:
    """What JSON Schema says of a value; pydantic gets a copy, as some versions write into what they get."""

    schema: Schema

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> Schema:
        return deepcopy(self.schema)


# what JSON Schema can say of the values; .inf is a number to YAML
FINITE: Schema = {"type": "number", "minimum": -sys.float_info.max, "maximum": sys.float_info.max}
NAME: Schema = {"anyOf": [{"type": "string", "pattern": r"^[^\0]*\S[^\0]*$"}, {"type": "integer"}]}


def _triple(of: Schema) -> Schema:
    return {"type": "array", "items": of, "minItems": 3, "maxItems": 3}


def whole(lowest: int, highest: int) -> Schema:
    return {"type": "integer", "minimum": lowest, "maximum": highest}


POSITIVE: Schema = {"type": "number", "exclusiveMinimum": 0, "maximum": sys.float_info.max}
NON_NEGATIVE = FINITE | {"minimum": 0}
NONZERO = FINITE | {"not": {"const": 0}}
VECTOR = _triple(FINITE)

Number = Annotated[float, PlainValidator(number), JsonSchema(FINITE)]
Positive = Annotated[float, PlainValidator(_bounded(lambda x: x > 0, "> 0")), JsonSchema(POSITIVE)]
NonNegative = Annotated[float, PlainValidator(_bounded(lambda x: x >= 0, ">= 0")), JsonSchema(NON_NEGATIVE)]
Fraction = Annotated[
    float,
    PlainValidator(_bounded(lambda x: 0 <= x <= 1, "from 0 to 1")),
    JsonSchema({"type": "number", "minimum": 0, "maximum": 1}),
]
StepLength = Annotated[
    float | Literal["auto"],
    PlainValidator(_step_length),
    JsonSchema({"anyOf": [POSITIVE, {"const": "auto"}]}),
]
Poisson = Annotated[
    float,
    PlainValidator(_bounded(lambda x: -1 < x <= 0.5, "in (-1, 0.5]")),
    JsonSchema({"type": "number", "exclusiveMinimum": -1, "maximum": 0.5}),
]
Until = Annotated[float, PlainValidator(_until), JsonSchema({"type": "number"})]
Vector = Annotated[Vec3, PlainValidator(vector), JsonSchema(VECTOR)]
Axis = Annotated[Vec3, PlainValidator(_axis), JsonSchema(VECTOR | {"contains": {"not": {"const": 0}}})]
Scale = Annotated[float | Vec3, PlainValidator(_scale), JsonSchema({"anyOf": [NONZERO, _triple(NONZERO)]})]
PositiveScale = Annotated[
    float | Vec3, PlainValidator(_positive_scale), JsonSchema({"anyOf": [POSITIVE, _triple(POSITIVE)]})
]
Bending = Annotated[
    float | Vec3, PlainValidator(_bending), JsonSchema({"anyOf": [NON_NEGATIVE, _triple(NON_NEGATIVE)]})
]
Count = Annotated[int, PlainValidator(_integer(1, LARGEST_INDEX)), JsonSchema(whole(1, LARGEST_INDEX))]
Index = Annotated[int, PlainValidator(_integer(0, LARGEST_INDEX)), JsonSchema(whole(0, LARGEST_INDEX))]
Seed = Annotated[int, PlainValidator(_integer(0, 2**63 - 1)), JsonSchema(whole(0, 2**63 - 1))]
Text = Annotated[str, PlainValidator(_text), JsonSchema({"type": "string", "pattern": r"^[^\0]*$"})]
Name = Annotated[str, PlainValidator(_name), JsonSchema(NAME)]
Flag = Annotated[bool, PlainValidator(_flag), JsonSchema({"type": "boolean"})]
