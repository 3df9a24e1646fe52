"""The families of cases, in the order in which ``stress`` runs them; the file of each bears its name."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module

from lyra_petsc.errors import InputError
from lyra_petsc.nearest import nearest
from lyra_petsc.stress.case import Case, Family, Level

NAMES = (
    "stiff-steps",
    "membrane",
    "bending",
    "time-step",
    "density",
    "anisotropy",
    "damping",
    "wind",
    "gravity",
    "handles",
    "start",
    "elements",
    "free",
    "compression",
    "rigid-plate",
    "chain",
    "paper",
    "products",
)


def families() -> list[Family]:
    """All of them."""
    found: list[Family] = []
    for name in NAMES:
        family: Family = import_module(f"lyra_petsc.stress.cases.{name.replace('-', '_')}").FAMILY
        found.append(family)
    return found


def selected(only: Sequence[str], level: Level) -> list[tuple[Family, Case]]:
    """The cases of a level, or those of the families and cases named, of whatever level.

    Raises
    ------
    InputError
        For a name that is neither, with the nearest that is.
    """
    everything = [(family, case) for family in families() for case in family.cases]
    if not only:
        return [(family, case) for family, case in everything if case.level <= level]
    known = list(NAMES) + [case.name for _, case in everything if case.name not in NAMES]
    for name in only:
        if name not in known:
            raise InputError(f"unknown case or family, {nearest(name, known)}; --list names all", key=name)
    # a family brings those of its cases that the level has; a case that is named is run at any level
    found = [
        (family, case)
        for family, case in everything
        if case.name in only or (family.name in only and case.level <= level)
    ]
    for name in only:
        if not any(name in (family.name, case.name) for family, case in found):
            raise InputError("has cases only with --full", key=name)
    return found
