"""The PETSc options database: who wins, and what was never used.

Precedence: our defaults < scene ``petsc:`` < ``.petscrc`` < ``PETSC_OPTIONS`` < command line. PETSc has
read the last three by the time a scene is known, so that a scene and our defaults only fill gaps. The
database is never cleared.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Mapping

from petsc4py import PETSc

from lyra_petsc.errors import InputError
from lyra_petsc.solvers.reasons import last_words

Value = str | int | float | bool | None

READ_AT_THE_END = frozenset({"options_left", "options_view", "citations", "mpidump", "get_total_flops"})
"""What PETSc asks for only while it leaves."""


BLIND = (
    "ksp_atol", "ksp_converged_reason", "ksp_initial_guess", "ksp_max_it", "ksp_monitor", "ksp_norm_type",
    "ksp_rtol", "ksp_type", "log_", "malloc", "mat_type", "memory_view", "mg_", "options_", "pc_mg",
    "pc_python_type", "pc_type", "snes_atol", "snes_converged_reason", "snes_force_iteration", "snes_lag",
    "snes_ksp_ew", "snes_linesearch", "snes_max", "snes_monitor", "snes_rtol", "snes_stol", "ts_",
)  # fmt: skip
"""What options begin with that let nobody but the solvers themselves look at a matrix."""


def shows_no_matrix() -> bool:
    """Whether no option may let PETSc look at a matrix beside what its solvers do with it."""
    return all(name.startswith(BLIND) for name in PETSc.Options().getAll())


def fill_gaps(options: Mapping[str, Value]) -> list[str]:
    """Set each option that nobody has set; returns the names that were set."""
    database = PETSc.Options()
    filled = []
    for name, value in options.items():
        if not database.hasName(name):
            database.setValue(name, _text(value))
            filled.append(name)
    return filled


def is_set(name: str) -> bool:
    """Whether an option stands in the database."""
    return bool(PETSc.Options().hasName(name))


def petsc_number(name: str, default: float) -> float:
    """A number from the options database, or ``default``.

    Raises
    ------
    InputError
        If something else stands there.
    """
    value = PETSc.Options().getString(name, "")
    if is_set(name) and not value:
        raise InputError("needs a number after it", key=f"-{name}")
    try:
        return float(PETSc.Options().getReal(name, default))
    except PETSc.Error:
        raise InputError(f"must be a number, not '{value}'", key=f"-{name}") from None


def refused(error: PETSc.Error) -> InputError:
    """What PETSc has against an option."""
    return InputError(f"PETSc refuses it: {last_words(error)}", key=culprits(error))


def culprits(error: PETSc.Error) -> str:
    """The options that an error is about: those whose value it quotes, as it does not tell their names."""
    told = re.split(r"[\s;:,]+", last_words(error))
    options = PETSc.Options().getAll()
    names = [f"-{name}" for name, value in options.items() if value and value.strip() in told]
    return " or ".join(sorted(names)) or "PETSc options"


def _text(value: Value) -> str:
    if value is None or value is True:
        return "" if value is None else "true"
    return "false" if value is False else str(value)


def unused(ours: list[str]) -> list[str]:
    """Options in the database that nothing has asked for, but for those of ``ours``.

    petsc4py has no call for this, the C library has: ``PetscOptionsLeftGet``.
    """
    try:
        library = ctypes.CDLL(PETSc.__file__)
        get = library.PetscOptionsLeftGet
    except (AttributeError, OSError):
        return []
    count = ctypes.c_int64(0)  # PetscInt is 32 or 64 bits wide; little end first
    names = ctypes.POINTER(ctypes.c_char_p)()
    values = ctypes.POINTER(ctypes.c_char_p)()
    get.argtypes = [ctypes.c_void_p] * 4
    if get(None, ctypes.byref(count), ctypes.byref(names), ctypes.byref(values)):
        return []
    found = [names[i].decode() for i in range(count.value)]
    restore = library.PetscOptionsLeftRestore
    restore.argtypes = [ctypes.c_void_p] * 4
    restore(None, ctypes.byref(count), ctypes.byref(names), ctypes.byref(values))
    return sorted(set(found) - set(ours) - READ_AT_THE_END)
