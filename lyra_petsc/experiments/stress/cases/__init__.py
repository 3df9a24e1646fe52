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
    """The cases of a level; with ``only``, the named cases of any level and the families' cases of the level.

    Raises
    ------
    InputError
        For an unknown name; the message suggests the nearest known one.
    """
    everything = [case for family in FAMILIES.all() for case in family.cases]
    if not only:
        return [case for case in everything if case.level <= level]
    known = dict.fromkeys([*FAMILIES.modules, *(case.name for case in everything)])
    for name in only:
        if name not in known:
            raise InputError(f"unknown case or family, {suggest(name, known)}; --list names all", key=name)
    found = [
        case for case in everything if case.name in only or (case.family in only and case.level <= level)
    ]
    for name in only:
        if not any(name in (case.family, case.name) for case in found):
            raise InputError("has cases only with --full", key=name)
    return found
