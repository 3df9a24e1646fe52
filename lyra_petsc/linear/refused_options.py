"""PETSc options that this program does not support: refused with a message before a run starts.

Options that PETSc itself rejects become errors at that point (``petsc_options.refused``).
"""

from __future__ import annotations

import importlib
import math
import os
from pathlib import Path

from petsc4py import PETSc

from lyra_petsc.errors import InputError
from lyra_petsc.linear.petsc_options import is_set

SNES_TYPES = ("newtonls", "ksponly")
"""Newton's method with a line search, and one linear solve."""

JACOBIANS = "snes_mf", "snes_mf_operator", "snes_fd", "snes_fd_color"
WITHOUT_GRID = (
    *("snes_grid_sequence", "snes_convergence_estimate", "snes_monitor_fields", "snes_fd_function"),
    *("ts_convergence_estimate", "ksp_view_diagonal_scale"),
)
UNSUPPORTED = {
    **dict.fromkeys(WITHOUT_GRID, "PETSc crashes by it where it has no grid of its own"),
    **dict.fromkeys(JACOBIANS, "regularisation needs the entries of the exact Jacobian"),
}
"""Flags that are refused, and why: flags that need a DM, and flags that replace the assembled Jacobian."""

REQUIRED_OPTIONS = {"kaczmarz": "pc_kaczmarz_symmetric", "redistribute": "mat_type"}
"""Preconditioners that need a further option, as they would not converge (sweeps are not symmetric) or crash
(the operator has no entries) without it."""

MAX_DENSE = 3000
"""Largest number of unknowns for options that use dense matrices."""

FLAGS_AT_END = ("options_view", "mpidump", "get_total_flops")
FILES_AT_END = ("log", "log_view", "malloc_view", "citations")
"""Options that PETSc only reads in its finalisation."""

DENSE = ("pc_type svd", "snes_test_jacobian")
"""Options that use dense matrices."""


def check_options() -> None:
    """Check all options in the database, whatever their source.

    Raises
    ------
    InputError
        For numbers that are not finite, and for options that are not supported.
    """
    options = PETSc.Options()
    for name, value in options.getAll().items():
        if not all(map(_finite, (value or "").split(","))):
            raise InputError(f"must be a finite number, not {value}", key=f"-{name}")
        if name.endswith("_type") and not value:
            raise InputError("needs a type after it", key=f"-{name}")
        if name.endswith("monitor_python") and not value:
            raise InputError("needs a file after it, as monitor.py:function", key=f"-{name}")
        if name.endswith("python_type"):
            _check_class(name, value or "")
        elif name.endswith("_type") and value == "python":
            stem = name.removesuffix("type")
            # -pc_type python alone chooses the program's multigrid
            if name not in ("pc_type", "mat_type") and not is_set(f"{stem}python_type"):
                raise InputError(f"python needs -{stem}python_type package.module.Class", key=f"-{name}")
    _check_end()
    if is_set("ts_init_time"):
        raise InputError(
            "a run begins at 0, or with --resume where it stopped; leave it out", key="-ts_init_time"
        )
    if is_set("snes_convergence_test"):
        raise InputError(
            "is by solver.force_tolerance and solver.step_tolerance; leave it out",
            key="-snes_convergence_test",
        )
    for name, why in UNSUPPORTED.items():
        if _is_on(name):
            raise InputError(f"{why}; leave it out", key=f"-{name}")
    kind = options.getString("snes_type", "")
    if is_set("snes_type") and kind not in SNES_TYPES:
        allowed = " and ".join(SNES_TYPES)
        raise InputError(
            f"'{kind}' is not available: regularisation and convergence test belong to {allowed}",
            key="-snes_type",
        )
    kind = options.getString("pc_type", "")
    if kind in REQUIRED_OPTIONS and not is_set(REQUIRED_OPTIONS[kind]):
        raise InputError(f"'{kind}' needs -{REQUIRED_OPTIONS[kind]} as well here", key="-pc_type")


def check_size(unknowns: int) -> None:
    """Refuse options that would use dense matrices of more than `MAX_DENSE` unknowns.

    Raises
    ------
    InputError
    """
    for option in DENSE:
        name, _, value = option.partition(" ")
        is_used = PETSc.Options().getString(name, "") == value if value else _is_on(name)
        if is_used and unknowns > MAX_DENSE:
            raise InputError(
                f"works on a dense matrix, here of {unknowns} unknowns: none above {MAX_DENSE}; "
                "take a coarser mesh, or leave it out",
                key=f"-{option}",
            )


def _is_on(name: str) -> bool:
    """Whether an option is set, and not to false."""
    return is_set(name) and PETSc.Options().getString(name, "").lower() not in ("0", "false", "no", "off")


def _check_end() -> None:
    """Refuse wrong values of options that PETSc reads in its finalisation, and delete these options."""
    options = PETSc.Options()
    for name in (*FLAGS_AT_END, *FILES_AT_END):
        value = options.getString(name, "")
        if why := _error_at_end(name, value):
            options.delValue(name)
            raise InputError(why, key=f"-{name}")


def _error_at_end(name: str, value: str) -> str:
    """What is wrong with the value of such an option, or an empty text."""
    if name in FLAGS_AT_END:
        known = value.lower() in ("", "1", "0", "true", "false", "yes", "no", "on", "off")
        return "" if known else f"is true or false, not '{value}'"
    if name == "log_view":
        kind, _, value = value.partition(":")
        if kind not in ("", "ascii"):
            return f"is written as ascii, not as '{kind}'"
        value = value.partition(":")[0]
    folder = Path(value).parent
    return f"cannot write into '{folder}'" if value and not os.access(folder, os.W_OK) else ""


def _finite(text: str) -> bool:
    """Whether a text is a finite number, or no number at all."""
    try:
        return math.isfinite(float(text))
    except ValueError:
        return True


def _check_class(option: str, name: str) -> None:
    module, _, cls = name.rpartition(".")
    try:
        context = getattr(importlib.import_module(module), cls)
    except Exception as error:
        why = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise InputError(f"'{name}' cannot be imported ({why})", key=f"-{option}") from None
    if not callable(context):
        raise InputError(f"'{name}' is no class", key=f"-{option}")
