"""The ``petsc`` block of a scene: options that are data; options that run code or name a file are refused.

Options can make PETSc load Python classes and shared libraries, start debuggers, and write files. Users may
give such options on the command line, but a scene, which may come from anywhere, may not.
"""

from __future__ import annotations

import re
from typing import Annotated, Any

from pydantic import BeforeValidator

from lyra_petsc.scene.values import number, problem, shown

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
        number(value)  # refuses integers too large for a float
        return value
    if isinstance(value, float):
        return number(value)
    raise problem(f"must be text, a number, true or false, not {shown(value)}")


PetscValue = Annotated[str | int | float | bool | None, BeforeValidator(_petsc_value)]


def petsc_options(value: Any) -> Any:
    """Check the names and values of a ``petsc`` block."""
    if not isinstance(value, dict):
        raise problem(f"must be a block of options like {{ksp_type: cg}}, not {shown(value)}")
    for key, argument in value.items():
        if not isinstance(key, str) or not _NAME.fullmatch(key):
            word = key if isinstance(key, str) else shown(key)
            dash = " without the dash" if word.startswith("-") else ""
            raise problem(f"is not an option name; write it as in ksp_type: cg{dash}", word)
        if _is_unsafe(key.lower(), argument):
            raise problem(
                "may run code or name a file, which a scene must not; give it on the command line", key
            )
    return value


def _is_unsafe(name: str, value: Any) -> bool:
    """Whether an option may make PETSc do more than compute and print."""
    if _REFUSED.fullmatch(name):
        return True
    if not isinstance(value, str):
        return False
    if _SHOWS.fullmatch(name):
        return not _SCREEN.fullmatch(value)
    if name == "pc_type" and value == "python":
        return False  # means the multigrid of this program: a scene cannot name another class
    return not _PLAIN.fullmatch(value) or (name.endswith("type") and value in ("python", "shell"))
