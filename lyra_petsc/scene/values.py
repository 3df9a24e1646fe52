"""Types of the values of scene keys: numbers, vectors, scales, names.

Checks are strict: text and booleans are no numbers, and no number is NaN or infinite. The messages say what
is wrong and what is allowed; `scene.messages` adds the key.
"""

from __future__ import annotations

import math
import reprlib
import sys
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationInfo
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from lyra_petsc.scene.rules import Condition, holds

Vec3 = tuple[float, float, float]
Direction = Literal["x", "y", "z"]
AXES: tuple[Direction, ...] = ("x", "y", "z")

# Largest vertex number that the index types of all libraries can hold.
LARGEST_INDEX = 2**31 - 2

# Shows few entries only: a value with YAML anchors can be larger than memory.
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxdict = 3, 6, 4
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = 60


def problem(message: str, *at: str | int) -> PydanticCustomError:
    """Error of a scene value; ``at`` is the path of the key relative to the block that is being checked."""
    # not in the template, as text of the user may contain braces; pydantic takes only characters of UTF-8
    return PydanticCustomError("scene", "{message}", {"message": one_line(message), "at": list(at)})


def shown(value: object) -> str:
    """``value`` as short text for a message."""
    if value is None:
        return "empty"
    if isinstance(value, bool):
        return "true" if value else "false"
    try:
        text = _SHORT.repr(value)
    except ValueError:  # an integer with more digits than Python converts
        return f"a very long {type(value).__name__}"
    return cut(text)


def cut(text: str) -> str:
    """``text``, or its beginning if it is too long to be quoted."""
    return text if len(text) <= 60 else text[:57] + "..."


def one_line(text: str) -> str:
    """``text`` on one line, with escapes for characters that cannot be printed."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in " ".join(text.split()))


def characters(text: str) -> str:
    """``text`` with pairs of surrogates, as JSON writes some characters, as these characters.

    A single surrogate, or a byte that is not UTF-8 in a file name, cannot be written to files.
    """
    try:
        return text.encode("utf-16", "surrogatepass").decode("utf-16")
    except UnicodeDecodeError:
        raise problem(f"must be text in UTF-8, not {shown(text)}") from None


def path_beside(value: Any, info: ValidationInfo) -> Path:
    """An absolute path; a relative ``value`` is relative to the scene file."""
    directory = (info.context or {}).get("directory", Path.cwd())
    path = Path(characters(str(value)))
    # symbolic links are not resolved: messages shall show the user's name
    return Path(directory, path) if path.is_absolute() else (Path(directory) / path).absolute()


def file_beside(kind: str, *endings: str) -> BeforeValidator:
    """Validator of the path of a ``kind`` with one of these endings (`path_beside`)."""

    def check(value: Any, info: ValidationInfo) -> Path:
        if not isinstance(value, (str, Path)) or not str(value).strip() or "\0" in str(value):
            raise problem(f"must be the path of a {kind}, not {shown(value)}")
        if Path(value).suffix.lower() not in endings:
            raise problem(f"{Path(value).name!r} must end in {', '.join(endings)}")
        return path_beside(value, info)

    return BeforeValidator(check)


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


def list_of(what: str = "", *, minimum: int = 0) -> BeforeValidator:
    """Validator of a list of at least ``minimum`` entries; ``what`` follows the word list in the message."""

    def check(value: Any) -> list[Any]:
        if not isinstance(value, (list, tuple)) or len(value) < minimum:
            block = isinstance(value, dict)
            hint = "; put '- ' before the entry" if block else f", not {shown(value)}"
            raise problem(f"must be a list{what}{hint}")
        return list(value)

    return BeforeValidator(check)


def block_of(what: str, *, minimum: int = 0) -> BeforeValidator:
    """Validator of a block of at least ``minimum`` keys."""

    def check(value: Any) -> dict[Any, Any]:
        if not isinstance(value, dict) or len(value) < minimum:
            raise problem(f"must be a block of {what}, not {shown(value)}")
        return value

    return BeforeValidator(check)


def axes(value: Any) -> tuple[Any, ...]:
    """``value`` as a tuple of "x", "y", "z", at least one."""
    if not isinstance(value, (list, tuple)) or not value or any(axis not in AXES for axis in value):
        raise problem(f"must be a list of x, y, z, not {shown(value)}")
    return tuple(value)


def _until(value: Any) -> float:
    # an explicit .inf means "to the end"
    return math.inf if value == math.inf and isinstance(value, float) else number(value)


def vector(value: Any) -> Vec3:
    """``value`` as three finite floats."""
    if not isinstance(value, (list, tuple)) or len(value) != 3:
        raise problem(f"must be three numbers like [0, 0, 1], not {shown(value)}")
    x, y, z = (number(component) for component in value)
    return x, y, z


def _pair(value: Any) -> tuple[float, float]:
    """One number, which is used twice, or two; none is negative."""
    values = value if isinstance(value, (list, tuple)) else (value, value)
    if len(values) != 2:
        raise problem(f"must be a number, or two (warp, weft), not {shown(value)}")
    one, two = (number(entry) for entry in values)
    if min(one, two) < 0.0:
        raise problem(f"must be >= 0, not {shown(value)}")
    return one, two


def _uv_scale(value: Any) -> tuple[float, float] | Literal["ignore"]:
    """``ignore``, or one number, which is used twice, or two; all above zero."""
    if value == "ignore":
        return "ignore"
    values = value if isinstance(value, (list, tuple)) else (value, value)
    if isinstance(value, str) or len(values) != 2:
        raise problem(f"must be ignore, a number, or two, not {shown(value)}")
    one, two = map(_POSITIVE.check, values)
    return one, two


def _axis(value: Any) -> Vec3:
    axis = vector(value)
    if math.hypot(*axis) < 1e-150:
        raise problem("must be a direction, not a zero vector")
    return axis


def integer(value: Any) -> int:
    """``value`` as a whole number; bool, text and 1.0 are refused."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise problem(f"must be a whole number, not {shown(value)}")
    return value


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise problem(f"must be text, not {shown(value)} (put it in quotes)")
    if "\0" in value:
        raise problem("must be text without null characters")
    return characters(value)


def _name(value: Any) -> str:
    # gmsh groups without name have a number instead
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


def _step_length(value: Any) -> float | str:
    if value == "auto":
        return "auto"
    if isinstance(value, str) and not _reads_as_number(value):
        raise problem(f"must be a number or auto, not {shown(value)}")
    return _POSITIVE.check(value)


@dataclass(frozen=True, eq=False)
class JsonSchema:
    """JSON Schema of a value; pydantic gets a copy, as some versions modify it."""

    schema: Condition

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> Condition:
        return deepcopy(self.schema)


@dataclass(frozen=True, eq=False)
class Value(JsonSchema):
    """JSON Schema of a value, and the function that checks and converts it."""

    check: Callable[[Any], Any]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.check)


def _constrained(schema: Condition, convert: Callable[[Any], Any], *allowed: tuple[Condition, str]) -> Value:
    """A value whose numbers satisfy the conditions ``allowed``, each given with its message."""

    def check(value: Any) -> Any:
        result = convert(value)
        for condition, message in allowed:
            if not all(holds(condition, one) for one in (result if isinstance(result, tuple) else [result])):
                raise problem(message.replace("VALUE", shown(value)))
        return result

    return Value(schema, check)


def _real(allowed: str, **bounds: float) -> Value:
    """A number within bounds, given as keywords of JSON Schema; ``allowed`` is their text in messages."""
    schema = FINITE | bounds
    if "exclusiveMinimum" in bounds:
        del schema["minimum"]
    return _constrained(schema, number, (bounds, f"must be {allowed}, not VALUE"))


def _one_or_three(*allowed: tuple[Condition, str]) -> Value:
    schema = FINITE | allowed[-1][0]
    return _constrained({"anyOf": [schema, _triple(schema)]}, _number_or_vector, *allowed)


def _number_or_vector(value: Any) -> float | Vec3:
    return vector(value) if isinstance(value, (list, tuple)) else number(value)


def _whole(lowest: int, highest: int) -> Value:
    return _constrained(
        {"type": "integer", "minimum": lowest, "maximum": highest},
        integer,
        ({"minimum": lowest}, f"must be a whole number >= {lowest}, not VALUE"),
        ({"maximum": highest}, f"must be a whole number <= {highest}, not VALUE"),
    )


def _triple(of: Condition) -> Condition:
    return {"type": "array", "items": of, "minItems": 3, "maxItems": 3}


# JSON Schema of values; the bounds exclude .inf, a number in YAML
FINITE: Condition = {"type": "number", "minimum": -sys.float_info.max, "maximum": sys.float_info.max}
VECTOR = _triple(FINITE)
ANY_AXES: Condition = {"type": "array", "items": {"enum": list(AXES)}, "minItems": 1}
_ANY_NAME: Condition = {"anyOf": [{"type": "string", "pattern": r"^[^\0]*\S[^\0]*$"}, {"type": "integer"}]}
_NONZERO = {"not": {"const": 0}}, "must not be 0"
_ABOVE_ZERO = {"exclusiveMinimum": 0}, "must be > 0, not VALUE"
_POSITIVE = _real("> 0", exclusiveMinimum=0)

Number = Annotated[float, Value(FINITE, number)]
Positive = Annotated[float, _POSITIVE]
NonNegative = Annotated[float, _real(">= 0", minimum=0)]
Fraction = Annotated[float, _real("from 0 to 1", minimum=0, maximum=1)]
Poisson = Annotated[float, _real("in (-1, 0.5]", exclusiveMinimum=-1, maximum=0.5)]
Angle = Annotated[float, _real("from 1 to 120 degrees", minimum=1, maximum=120)]
Share = Annotated[float, _real("from 50 to 100 percent", minimum=50, maximum=100)]
StepLength = Annotated[
    float | Literal["auto"], Value({"anyOf": [_POSITIVE.schema, {"const": "auto"}]}, _step_length)
]
Until = Annotated[float, Value({"type": "number"}, _until)]
Vector = Annotated[Vec3, Value(VECTOR, vector)]
Axis = Annotated[Vec3, Value(VECTOR | {"contains": {"not": {"const": 0}}}, _axis)]
Scale = Annotated[float | Vec3, _one_or_three(_NONZERO)]
PositiveScale = Annotated[float | Vec3, _one_or_three(_NONZERO, _ABOVE_ZERO)]
_ENTRY: Condition = FINITE | {"minimum": 0}
Pair = Annotated[
    tuple[float, float],
    Value({"anyOf": [_ENTRY, {"type": "array", "items": _ENTRY, "minItems": 2, "maxItems": 2}]}, _pair),
]
_ABOVE: Condition = FINITE | {"exclusiveMinimum": 0}
UvScale = Annotated[
    tuple[float, float] | Literal["ignore"],
    Value(
        {
            "anyOf": [
                {"const": "ignore"},
                _ABOVE,
                {"type": "array", "items": _ABOVE, "minItems": 2, "maxItems": 2},
            ]
        },
        _uv_scale,
    ),
]
Bending = Annotated[float | Vec3, _one_or_three(({"minimum": 0}, "must be >= 0 [N·m], not VALUE"))]
Count = Annotated[int, _whole(1, LARGEST_INDEX)]
INDEX = _whole(0, LARGEST_INDEX)
Index = Annotated[int, INDEX]
Seed = Annotated[int, _whole(0, 2**63 - 1)]
Text = Annotated[str, Value({"type": "string", "pattern": r"^[^\0]*$"}, _text)]
Name = Annotated[str, Value(_ANY_NAME, _name)]
Flag = Annotated[bool, Value({"type": "boolean"}, _flag)]
