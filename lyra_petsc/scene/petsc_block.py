"""The ``petsc`` block of a scene: options that are data, and none that run code or name a file.

PETSc can load Python classes and shared libraries, start debuggers, and write what it shows into files,
all by options. On the command line that is the user's affair; a scene, which may come from anywhere, does
not get to do it.
"""

from __future__ import annotations

import re
from typing import Annotated, Any

from pydantic import PlainValidator

from lyra_petsc.scene.values import FINITE, number, problem, shown

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")

_REFUSED = re.compile(
    r"(log|log_all|log_trace|history|tee|info|x|draw|dll|malloc|start|stop|on_error|debug|saws|mpe)(_.*)?"
    r"|options_(file|string).*"
    r"|.*(python|shell|trajectory|filename|dirname|tmpdir).*"
    r"|.*_(file|dir|vtk|draw|lg|hdf5|binary|matlab|socket|save|write|dump|load)(_.*)?"
)
_SHOWS = re.compile(r".*(view|monitor).*")
_SCREEN = re.compile(r"((ascii|stdout)?(::ascii\w*)?)")
_PLAIN = re.compile(r"[A-Za-z0-9_+,. -]*")


def _petsc_value(value: Any) -> Any:
    if value is None or isinstance(value, (str, bool)):
        return value
    if isinstance(value, int):
        number(value)  # it must not be beyond all numbers
        return value
    if isinstance(value, float):
        return number(value)
    raise problem(f"must be text, a number, true or false, not {shown(value)}")


PetscValue = Annotated[str | int | float | bool | None, PlainValidator(_petsc_value)]


def petsc_options(value: Any) -> Any:
    """Check the names of a ``petsc`` block, and that its values are data."""
    if not isinstance(value, dict):
        raise problem(f"must be a block of options like {{ksp_type: cg}}, not {shown(value)}")
    for key, given in value.items():
        if not isinstance(key, str) or not _NAME.fullmatch(key):
            word = key if isinstance(key, str) else shown(key)
            dash = " without the dash" if word.startswith("-") else ""
            raise problem(f"is not an option name; write it as in ksp_type: cg{dash}", word)
        if _reaches_out(key.lower(), given):
            raise problem(
                "may run code or name a file, which a scene must not; give it on the command line", key
            )
    return value


def _reaches_out(name: str, value: Any) -> bool:
    """Whether an option would make PETSc do more than compute and print."""
    if _REFUSED.fullmatch(name):
        return True
    if not isinstance(value, str):
        return False
    if _SHOWS.fullmatch(name):
        return not _SCREEN.fullmatch(value)
    if name == "pc_type" and value == "python":
        return False  # the program's own multigrid, as nothing else can be named
    return not _PLAIN.fullmatch(value) or (name.endswith("type") and value in ("python", "shell"))


def _of_any_case(pattern: re.Pattern[str]) -> str:
    """A pattern for lower-case names as JSON Schema, which knows no flags, needs it."""
    letters = re.sub(r"(?<!\\)[a-z]", lambda letter: f"[{letter[0]}{letter[0].upper()}]", pattern.pattern)
    return f"^({letters})$"


def _or_no_text(pattern: str) -> dict[str, Any]:
    return {"anyOf": [{"type": "string", "pattern": pattern}, FINITE, {"type": ["boolean", "null"]}]}


_SHOWING = _of_any_case(_SHOWS)
PETSC_BLOCK: dict[str, Any] = {
    "type": "object",
    "propertyNames": {"pattern": rf"^({_NAME.pattern})$", "not": {"pattern": _of_any_case(_REFUSED)}},
    "patternProperties": {
        _SHOWING: _or_no_text(rf"^{_SCREEN.pattern}$"),
        rf"^(?!{_SHOWING[1:]})": _or_no_text(rf"^{_PLAIN.pattern}$"),
        "[tT][yY][pP][eE]$": {"not": {"const": "shell"}},
        "^(?![pP][cC]_[tT][yY][pP][eE]$).*[tT][yY][pP][eE]$": {"not": {"const": "python"}},
    },
}
"""The same in words of JSON Schema."""
