"""The families of cases of ``stress`` by name, in the order in which they run, and their modules."""

from __future__ import annotations

from collections.abc import Sequence

from lyra_petsc.errors import InputError, suggest
from lyra_petsc.experiments.case import Registry, member
from lyra_petsc.experiments.stress.stress_scenes import CaseFamily, Scope, StressCase

MODULES = {
    "stiff-steps membrane bending time-step density anisotropy damping wind gravity": "sheets",
    "handles start elements free compression": "sheets",
    "contact": "contact",
    "directors": "sheets",
    "rigid-plate chain paper": "limits",
    "products": "sheets",
}
"""Modules of the families."""


def _family(name: str, module: str) -> CaseFamily:
    family: CaseFamily = member(f"{__name__}.{module}", name)
    return family


FAMILIES = Registry({name: module for names, module in MODULES.items() for name in names.split()}, _family)


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
    known = dict.fromkeys([*FAMILIES.entries, *(case.name for case in everything)])
    for name in only:
        if name not in known:
            raise InputError(f"unknown case or family, {suggest(name, known)}; --list names all", key=name)
    cases = [
        case for case in everything if case.name in only or (case.family in only and case.level <= level)
    ]
    for name in only:
        if not any(name in (case.family, case.name) for case in cases):
            raise InputError("has cases only with --full", key=name)
    return cases
