"""Types of the values of scene keys: numbers, vectors, scales, names.

Checks are strict: text and booleans are no numbers, and no number is NaN or infinite. The messages say what
is wrong and what is allowed; `scene.messages` adds the key.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationInfo, WithJsonSchema
from pydantic_core import PydanticCustomError

Vec3 = tuple[float, float, float]
Direction = Literal["x", "y", "z"]
AXES: tuple[Direction, ...] = ("x", "y", "z")

# Largest vertex number that the index types of all libraries can hold.
LARGEST_INDEX = 2**31 - 2

# Shows few entries only: a value with YAML anchors can be larger than memory.
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = 60


def problem(message: str, *at: str | int) -> PydanticCustomError:
    """Error of a scene value; ``at`` is the path of the key relative to the block that is being checked."""
    # not in the template, as text of the user may contain braces; pydantic takes only characters of UTF-8
    return PydanticCustomError("scene", "{message}", {"message": one_line(message), "at": list(at)})


def require(condition: object, message: str, *at: str | int) -> None:
    """Raise a `problem` unless the condition holds."""
    if not condition:
        raise problem(message, *at)


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


def list_of(content: str = "", *, minimum: int = 0) -> BeforeValidator:
    """Validator of a list of at least ``minimum`` entries; ``content`` follows "list" in the message."""

    def check(value: Any) -> list[Any]:
        if not isinstance(value, (list, tuple)) or len(value) < minimum:
            block = isinstance(value, dict)
            hint = "; put '- ' before the entry" if block else f", not {shown(value)}"
            raise problem(f"must be a list{content}{hint}")
        return list(value)

    return BeforeValidator(check)


def block_of(content: str, *, minimum: int = 0) -> BeforeValidator:
    """Validator of a block of at least ``minimum`` keys."""

    def check(value: Any) -> dict[Any, Any]:
        if not isinstance(value, dict) or len(value) < minimum:
            raise problem(f"must be a block of {content}, not {shown(value)}")
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


def _one_or_two(value: Any) -> tuple[float, float]:
    """One number, which is used twice, or two."""
    values = value if isinstance(value, (list, tuple)) else (value, value)
    require(len(values) == 2, f"must be a number, or two, not {shown(value)}")
    return number(values[0]), number(values[1])


def _between(low: float, high: float, unit: str = "") -> BeforeValidator:
    """Validator of a number from ``low`` to ``high``."""

    def check(value: Any) -> float:
        result = number(value)
        require(low <= result <= high, f"must be from {low:g} to {high:g}{unit}, not {shown(value)}")
        return result

    return BeforeValidator(check)


def _pair(value: Any) -> tuple[float, float]:
    pair = _one_or_two(value)
    require(min(pair) >= 0.0, f"must be >= 0, not {shown(value)}")
    return pair


def _uv_scale(value: Any) -> tuple[float, float] | Literal["ignore"]:
    if value == "ignore":
        return "ignore"
    require(not isinstance(value, str), f"must be ignore, a number, or two, not {shown(value)}")
    pair = _one_or_two(value)
    require(min(pair) > 0.0, f"must be > 0, not {shown(value)}")
    return pair


def _one_or_three(*checks: tuple[Callable[[float], bool], str]) -> BeforeValidator:
    """Validator of a number or three that satisfy the conditions, each given with its message."""

    def check(value: Any) -> float | Vec3:
        result = vector(value) if isinstance(value, (list, tuple)) else number(value)
        for condition, message in checks:
            entries = result if isinstance(result, tuple) else (result,)
            require(all(map(condition, entries)), message.replace("VALUE", shown(value)))
        return result

    return BeforeValidator(check)


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
    length = number(value)
    require(length > 0.0, f"must be > 0, not {shown(value)}")
    return length


def _schema_of(*kinds: str, numbers: int = 0) -> WithJsonSchema:
    """JSON Schema of a value of one of these types, or of a list of ``numbers``."""
    single: dict[str, Any] = {"type": list(kinds)}
    many = {"type": "array", "items": {"type": "number"}, "minItems": numbers, "maxItems": numbers}
    return WithJsonSchema({"anyOf": [single, many]} if numbers else single)


_NUMBER = BeforeValidator(number)
_WHOLE = BeforeValidator(integer)
_NONZERO: tuple[Callable[[float], bool], str] = (lambda one: one != 0.0, "must not be 0")

Number = Annotated[float, _NUMBER]
Positive = Annotated[float, Field(gt=0), _NUMBER]
NonNegative = Annotated[float, Field(ge=0), _NUMBER]
Fraction = Annotated[float, Field(ge=0, le=1), _between(0, 1)]
PartBelowOne = Annotated[float, Field(ge=0, lt=1), _NUMBER]
Poisson = Annotated[float, Field(gt=-1, le=0.5), _between(-1, 0.5)]
StretchRatio = Annotated[float, Field(gt=1), _NUMBER]
Angle = Annotated[float, Field(ge=1, le=120), _between(1, 120, " degrees")]
Share = Annotated[float, Field(ge=50, le=100), _between(50, 100, " percent")]
StepLength = Annotated[float | Literal["auto"], BeforeValidator(_step_length)]
Until = Annotated[float, BeforeValidator(_until)]
Vector = Annotated[Vec3, BeforeValidator(vector)]
Axis = Annotated[Vec3, BeforeValidator(_axis)]
Scale = Annotated[float | Vec3, _one_or_three(_NONZERO)]
PositiveScale = Annotated[
    float | Vec3, _one_or_three(_NONZERO, (lambda one: one > 0.0, "must be > 0, not VALUE"))
]
Bending = Annotated[float | Vec3, _one_or_three((lambda one: one >= 0.0, "must be >= 0 [N·m], not VALUE"))]
Pair = Annotated[tuple[float, float], BeforeValidator(_pair), _schema_of("number", numbers=2)]
UvScale = Annotated[
    tuple[float, float] | Literal["ignore"],
    BeforeValidator(_uv_scale),
    _schema_of("number", "string", numbers=2),
]
Count = Annotated[int, Field(ge=1, le=LARGEST_INDEX), _WHOLE]
Index = Annotated[int, Field(ge=0, le=LARGEST_INDEX), _WHOLE]
Seed = Annotated[int, Field(ge=0, le=2**63 - 1), _WHOLE]
Text = Annotated[str, BeforeValidator(_text)]
Name = Annotated[str, BeforeValidator(_name), _schema_of("string", "integer")]
Flag = Annotated[bool, BeforeValidator(_flag)]
