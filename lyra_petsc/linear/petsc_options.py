"""Access to the PETSc options database: defaults, numbers, and unused options.

Precedence: program's defaults < scene ``petsc:`` < ``.petscrc`` < ``PETSC_OPTIONS`` < command line. PETSc
reads the last three before the scene is known, so that a scene and the defaults only set options that are not
set yet. The database is never cleared.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Collection, Iterable, Mapping

from petsc4py import PETSc

from lyra_petsc.errors import InputError
from lyra_petsc.linear.reasons import error_message

Value = str | int | float | bool | None

READ_AT_THE_END = frozenset({"options_left", "options_view", "citations", "mpidump", "get_total_flops"})
"""Options that PETSc only reads in its finalisation."""

PYTHON_SUFFIXES = ("python_type", "monitor_python")
"""Suffixes of options that make PETSc call Python."""

CHOICES = ("ksp_type", "pc_type", "mat_type", "snes_linesearch_type")
"""Options that most errors are about if they quote no option's value."""


def fill_gaps(options: Mapping[str, Value]) -> list[str]:
    """Set each option that is not set yet; returns the names that were set."""
    database = PETSc.Options()
    filled = []
    for name, value in options.items():
        if not database.hasName(name):
            database.setValue(name, _text(value))
            filled.append(name)
    return filled


def is_set(name: str) -> bool:
    """Whether an option is in the database."""
    return bool(PETSc.Options().hasName(name))


def petsc_number(name: str, default: float) -> float:
    """A number from the options database, or ``default``.

    Raises
    ------
    InputError
        If its value is no number.
    """
    value = PETSc.Options().getString(name, "")
    if is_set(name) and not value:
        raise InputError("needs a number after it", key=f"-{name}")
    try:
        return float(PETSc.Options().getReal(name, default))
    except PETSc.Error:
        raise InputError(f"must be a number, not '{value}'", key=f"-{name}") from None


def refused(error: Exception) -> InputError:
    """An input error for an option that PETSc rejects with ``error``."""
    return InputError(f"PETSc refuses it: {error_message(error)}", key=culprits(error))


def quoted(error: Exception) -> list[str]:
    """The options that an error of PETSc names, or whose value it quotes."""
    words = re.split(r"[\s;:,']+", error_message(error))
    options = {f"-{name}": (value or "").strip() for name, value in PETSc.Options().getAll().items()}
    named = [name for name in options if name in words]
    named = named or [name for name, value in options.items() if value and value in words]
    numbers = set(map(_number, words)) - {None}  # PETSc quotes -1 as -1. and 1e30 as 1e+30
    return named or [name for name, value in options.items() if _number(value) in numbers]


def of_user(names: Iterable[str], ours: Collection[str]) -> list[str]:
    """Those options, with or without values, that the program did not set itself (``ours``, without -)."""
    return [name for name in names if name.split()[0].removeprefix("-") not in ours]


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def culprits(error: Exception, ours: Collection[str] = ()) -> str:
    """The options that an error is probably about, for a message: those it quotes, else likely ones.

    Options that the program set itself (``ours``, without -) are named only if there are no others.
    """
    options = PETSc.Options().getAll()
    names = quoted(error) or [f"-{name}" for name in options if name.endswith(PYTHON_SUFFIXES)]
    names = names or [f"-{name} {value}" for name, value in options.items() if name in CHOICES]
    return " or ".join(sorted(of_user(names, ours) or names)) or "PETSc options"


def _text(value: Value) -> str:
    if value is None or value is True:
        return "" if value is None else "true"
    return "false" if value is False else str(value)


def unused(defaults: list[str]) -> list[str]:
    """Options in the database that were never read, without those in ``defaults``.

    Calls ``PetscOptionsLeftGet`` of the C library, which petsc4py does not offer.
    """
    try:
        library = ctypes.CDLL(PETSc.__file__)
        get = library.PetscOptionsLeftGet
    except (AttributeError, OSError):
        return []
    count = ctypes.c_int64(0)  # also holds a 32-bit PetscInt on little-endian machines
    names = ctypes.POINTER(ctypes.c_char_p)()
    values = ctypes.POINTER(ctypes.c_char_p)()
    get.argtypes = [ctypes.c_void_p] * 4
    if get(None, ctypes.byref(count), ctypes.byref(names), ctypes.byref(values)):
        return []
    found = [names[i].decode() for i in range(count.value)]
    restore = library.PetscOptionsLeftRestore
    restore.argtypes = [ctypes.c_void_p] * 4
    restore(None, ctypes.byref(count), ctypes.byref(names), ctypes.byref(values))
    return sorted(set(found) - set(defaults) - READ_AT_THE_END)
