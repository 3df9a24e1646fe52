"""Splits a command line into arguments of this program and PETSc options, and starts PETSc.

Options of this program begin with two dashes; an option with one dash and a letter goes to PETSc together
with its value, as in every PETSc program. A scene that follows a PETSc flag is not taken for its value.
"""

from __future__ import annotations

import ctypes
import itertools
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

_PETSC = re.compile(r"-[A-Za-z_]")
_SCENE = re.compile(r".*\.(ya?ml|json)$", re.IGNORECASE)
_TAKES_FILE = ("options_file", "options_file_yaml", "options_string", "options_string_yaml")


def split(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Arguments of this program, and PETSc options, each in order.

    A word after a PETSc option is its value unless it is an option itself; a negative number is a value. A
    word that names a scene (.yaml, .yml, .json) belongs to this program, except after ``-options_file`` and
    similar options; so does all that follows ``--``.
    """
    ours: list[str] = []
    petsc: list[str] = []
    words = list(arguments)
    while words:
        word = words.pop(0)
        if word == "--":
            return ours + [word, *words], petsc
        if word.startswith("--"):
            ours.append(word)
            # in ``--name value`` the value is a separate word, and may begin with a dash and a digit
            continue
        if not _PETSC.match(word):
            ours.append(word)
            continue
        petsc.append(word)
        if words and _is_value(word, words[0]):
            petsc.append(words.pop(0))
    return ours, petsc


def _is_value(option: str, word: str) -> bool:
    if word.startswith("--") or _PETSC.match(word):
        return False
    return not _SCENE.match(word) or option.lstrip("-") in _TAKES_FILE


def move_help(ours: list[str], petsc: list[str]) -> tuple[list[str], list[str]]:
    """Both kinds of arguments, with ``-help`` turned into ``--help`` of this program.

    With a scene to run it stays a PETSc option, by which PETSc objects list their options when created.
    """
    runs = ours[:1] == ["run"] and any(_SCENE.match(word) for word in ours[1:])
    if "-help" not in petsc or runs:
        return ours, petsc
    return [*ours[:1], "--help"], [word for word in petsc if word != "-help"]


def start_error(options: Sequence[str]) -> str:
    """Message if PETSc would fail or crash when it reads these options, PETSC_OPTIONS and option files."""
    all_options = [*os.environ.get("PETSC_OPTIONS", "").split(), *options]
    files = [os.path.expanduser("~/.petscrc"), ".petscrc", "petscrc"]
    for path in filter(os.path.isfile, [] if "-skip_petscrc" in all_options else files):
        with suppress(OSError, ValueError):
            if why := _options_error(_read_words(Path(path).read_text("utf-8")), [os.path.realpath(path)]):
                return f"{path}: {why}"
    return _options_error(all_options, [])


def _options_error(options: Sequence[str], files: list[str]) -> str:
    """Message if PETSc would not start with these options; ``files`` are the files that include them."""
    for option, value in itertools.pairwise([*options, ""]):
        if not option.startswith("-"):
            continue
        name = option.lstrip("-").lower()
        if name in ("options_file", "options_file_yaml"):
            try:
                text = Path(value).read_text(encoding="utf-8")
            except (OSError, ValueError) as error:
                why = getattr(error, "strerror", None) or "it is no text"
                return f"-{name}: cannot read '{value}': {why}"
            path = os.path.realpath(value)
            if path in files:
                return f"-{name}: '{value}' includes itself"
            if name == "options_file":
                why = _syntax_error(text) or _options_error(_read_words(text), [*files, path])
                if why:
                    return f"-{name}: {value}: {why}"
        if name == "python":
            return "-python: starts a program of Python's own; leave it out"
        if name == "history":
            folder = Path(value).parent if value and not value.startswith("-") else Path.home()
            if not os.access(folder, os.W_OK):
                return f"-history: cannot write into '{folder}'"
        if name == "fp_trap" and value.lower() not in ("0", "false", "no", "off"):
            return "-fp_trap: ends Python at numbers that overflow, which here make a step fail; leave it out"
    return ""


def _read_words(text: str) -> list[str]:
    """Words of an options file without its comments."""
    lines = (line.split("#")[0].split() for line in text.splitlines())
    return [word for words in lines if words and words[0][0] not in "!%" for word in words]


def start_petsc(words: Sequence[str]) -> str:
    """Start PETSc with its options; returns an error message, empty if it starts.

    PETSc's own message of some twenty lines is replaced by that of ``PetscErrorMessage``.
    """
    import petsc4py
    import petsc4py.lib

    library = ctypes.CDLL(petsc4py.lib.ImportPETSc().__file__)
    printing = ctypes.c_void_p.in_dll(library, "PetscErrorPrintf")
    usual, silent = printing.value, ctypes.cast(library.PetscErrorPrintfNone, ctypes.c_void_p).value
    printing.value = silent
    try:
        petsc4py.init(words)
    except RuntimeError as error:  # PETSc.Error does not exist before PETSc has started
        texts = ctypes.c_char_p(), ctypes.c_char_p()
        library.PetscErrorMessage(error.args[0], *map(ctypes.byref, texts))
        reason = "; ".join(text.value.decode("utf-8", "replace") for text in texts if text.value)
        return f"PETSc does not start with its options: {reason}"
    finally:
        if printing.value == silent:  # unless an option has changed it
            printing.value = usual
    return ""


def _syntax_error(text: str) -> str:
    """Message about the first line of an options file that PETSc does not understand, if any."""
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#")[0].split()
        if words and not (words[0][0] in "-!%" or words[0].lower() in ("alias", "mpi")):
            return f"line {number}: '{words[0]}' is no option; one begins with a dash, a comment with #"
    return ""
