"""The cases of ``stress``: the table ``cases.yaml`` and the modules with their functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from importlib.resources import files
from typing import Any

from lyra_petsc.errors import InputError, suggest
from lyra_petsc.experiments.case import Registry
from lyra_petsc.experiments.stress import stress_scenes
from lyra_petsc.experiments.stress.stress_scenes import CaseFamily, Scope, StressCase, changed_base
from lyra_petsc.scene.text import parse_yaml


def _family(name: str, entry: dict[str, Any]) -> CaseFamily:
    module, cases = import_module(f"{__name__}.{entry['module']}"), entry["cases"]
    if isinstance(cases, str):
        cases = getattr(module, cases)()
    common = entry.get("each", {})
    return CaseFamily(
        name, entry["title"], tuple(_case(module, name, case, common | own) for case, own in cases.items())
    )


def _case(module: Any, family: str, name: str, entry: dict[str, Any]) -> StressCase:
    def function(named: str, arguments: dict[str, Any]) -> Callable[..., Any]:
        return partial(getattr(module, named, None) or getattr(stress_scenes, named), **arguments)

    changes = entry.pop("changes", {})
    for key in {"scene", "shape", "observe", "judge"} & entry.keys():
        named = entry[key]
        entry[key] = function(*(next(iter(named.items())) if isinstance(named, dict) else (named, {})))
    entry.setdefault("scene", changed_base([function(*change) for change in changes.items()]))
    level = Scope[entry.pop("level", "usual").upper()]
    return StressCase(name, family=family, level=level, **entry)


def _table() -> dict[str, dict[str, Any]]:
    path = files("lyra_petsc.experiments.stress") / "cases.yaml"
    table: dict[str, dict[str, Any]] = parse_yaml(path.read_text(encoding="utf-8"), file=path)
    return table


FAMILIES: Registry[CaseFamily] = Registry(_table(), _family)


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
