"""The families of cases of ``stress`` by name, in the order in which they run, and their modules."""

from __future__ import annotations

from collections.abc import Sequence

from lyra_petsc.errors import InputError, suggest
from lyra_petsc.experiments.case import Registry, module_by_name
from lyra_petsc.experiments.stress.stress_scenes import CaseFamily, Scope, StressCase

FAMILIES: Registry[CaseFamily] = Registry(
    "lyra_petsc.experiments.stress.cases",
    module_by_name(
        ("sheets", "stiff-steps membrane bending time-step density anisotropy damping wind gravity"),
        ("sheets", "handles start elements free compression"),
        ("contact", "contact"),
        ("sheets", "directors"),
        ("limits", "rigid-plate chain paper"),
        ("sheets", "products"),
    ),
)


def selected(only: Sequence[str], level: Scope) -> list[StressCase]:
    """The cases of a level, or those of the families and cases named, of whatever level.

    Raises
    ------
    InputError
        For a name that is neither, with the nearest that is.
    """
    everything = [case for family in FAMILIES.all() for case in family.cases]
    if not only:
        return [case for case in everything if case.level <= level]
    known = dict.fromkeys([*FAMILIES.modules, *(case.name for case in everything)])
    for name in only:
        if name not in known:
            raise InputError(f"unknown case or family, {suggest(name, known)}; --list names all", key=name)
    # a family brings those of its cases that the level has; a case that is named is run at any level
    found = [
        case for case in everything if case.name in only or (case.family in only and case.level <= level)
    ]
    for name in only:
        if not any(name in (case.family, case.name) for case in found):
            raise InputError("has cases only with --full", key=name)
    return found
