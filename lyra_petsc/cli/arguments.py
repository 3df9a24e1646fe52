"""Splits a command line into arguments of this program and PETSc options.

Options of this program begin with two dashes; an option with one dash and a letter goes to PETSc together
with its value, as in every PETSc program. A scene that follows a PETSc flag is not taken for its value.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from lyra_petsc.startup import PETSCRC

_PETSC = re.compile(r"-[A-Za-z_]")
_SCENE = re.compile(r".*\.(ya?ml|json)$", re.IGNORECASE)
_TAKES_FILE = ("options_file", "options_file_yaml", "options_string", "options_string_yaml")


def split(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Arguments of this program, and PETSc options with ``--petscrc=FILE``, each in order.

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
        if word.startswith(PETSCRC) or (word == PETSCRC[:-1] and words):
            petsc.append(word if word.startswith(PETSCRC) else PETSCRC + words.pop(0))
            continue
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
