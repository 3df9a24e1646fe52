"""Access to the PETSc options database: defaults, numbers, and unused options.

Precedence: program's defaults < scene ``petsc:`` < ``.petscrc`` < ``PETSC_OPTIONS`` < command line. PETSc
reads the last three before the scene is known, so that a scene and the defaults only set options that are not
set yet. The database is never cleared.
"""

from __future__ import annotations

import ctypes
import difflib
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path

from petsc4py import PETSc

from lyra_petsc.errors import InputError
from lyra_petsc.linear.reasons import error_message

Value = str | int | float | bool | None

READ_AT_THE_END = frozenset({"options_left", "options_view", "citations", "mpidump", "get_total_flops"})
"""Options that PETSc only reads in its finalisation."""

OWN_NAMES = ("contact_monitor", "pc_mg_w_from", "pc_mg_vertex_sweeps")
OWN_PREFIXES = ("loads_", "arcs_", "verify_", "no_")
"""Names and prefixes of options that PETSc's libraries do not contain as such; ``no_`` is PETSc's."""

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
    left = [names[i].decode() for i in range(count.value)]
    restore = library.PetscOptionsLeftRestore
    restore.argtypes = [ctypes.c_void_p] * 4
    restore(None, ctypes.byref(count), ctypes.byref(names), ctypes.byref(values))
    return sorted(set(left) - set(defaults) - READ_AT_THE_END)


def unknown(defaults: list[str]) -> list[str]:
    """A note on each unused option whose name neither PETSc nor this program has, with the nearest name.

    Names and prefixes of options stand as texts in PETSc's libraries: names with a dash before them, numbers
    as %d. A prefix with a number counts without it, too, as it then stands for all numbers.
    """
    if not (left := unused(defaults)):
        return []
    texts = b"".join(file.read_bytes() for file in _libraries()).decode("latin-1")
    names = set(re.findall(r"\0-([a-z][\w%]*)(?=\0)", texts))
    if not names:
        return []  # texts in another form
    names.update(OWN_NAMES)
    # a text may be the end of a longer one, as esteig_ of pc_gamg_esteig_
    whole = set(re.findall(r"\0(?:%s)?([a-z][\w%]*_)(?=\0)", texts))
    prefixes = {text[at.end() :] for text in whole for at in re.finditer("^|_(?=.)", text)} | {*OWN_PREFIXES}
    prefixes |= {prefix.removesuffix("%d_") for prefix in prefixes}

    def without_prefixes(name: str) -> Iterator[str]:
        yield name
        for mark in re.finditer("_", name):
            if any(re.sub(r"\d+", form, name[: mark.end()]) in prefixes for form in ("%d", "%s")):
                yield from without_prefixes(name[mark.end() :])

    notes = []
    for name in left:
        stems = list(without_prefixes(name.lower()))
        if not any(stem in names or re.sub(r"\d+", "%d", stem) in names for stem in stems):
            similar = [
                name.lower().removesuffix(stem) + other
                for stem in stems
                for other in difflib.get_close_matches(stem, names, n=1)
            ]
            for mark in re.finditer("_", name):
                head, stem = name[: mark.end()].lower(), name[mark.end() :].lower()
                if stem in names:
                    similar += [one + stem for one in difflib.get_close_matches(head, prefixes, n=1)]
            near = difflib.get_close_matches(name.lower(), similar, n=1)
            hint = f", did you mean -{near[0]}?" if near else ""
            notes.append(f"-{name}: PETSc has no option of this name{hint}")
    return notes


def _libraries() -> list[Path]:
    """petsc4py's extension, and PETSc's library if it is another file."""

    class Symbol(ctypes.Structure):
        _fields_ = (
            ("file", ctypes.c_char_p),
            ("base", ctypes.c_void_p),
            ("name", ctypes.c_char_p),
            ("address", ctypes.c_void_p),
        )

    extension, symbol = Path(PETSc.__file__), Symbol()
    try:
        function = ctypes.cast(ctypes.CDLL(PETSc.__file__).PetscOptionsLeftGet, ctypes.c_void_p)
        ctypes.CDLL(None).dladdr(function, ctypes.byref(symbol))
    except (AttributeError, OSError):
        return []
    return list({extension: 0, Path((symbol.file or b"").decode() or extension): 0})
