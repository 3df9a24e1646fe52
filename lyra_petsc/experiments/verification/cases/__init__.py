"""The cases of ``verify``: the table ``cases.yaml`` and the modules with their measurements."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from typing import Any

from lyra_petsc.experiments.case import Registry, member
from lyra_petsc.experiments.verification.verification_case import Claim, VerificationCase, load_data
from lyra_petsc.scene.text import parse_yaml


def _case(name: str, entry: dict[str, Any]) -> VerificationCase:
    source = entry.get("source")
    if source is None:
        table, *keys = entry["source_of"]
        data = load_data(table)
        for key in keys:
            data = data[key]
        source = data["source"]
    claims = {pattern: Claim(**claim) for pattern, claim in entry["claims"].items()}
    counts = entry.get("n", VerificationCase.counts)
    quick = entry.get("quick", VerificationCase.quick)
    measure: Callable[..., Any] = member(f"{__name__}.{entry['module']}", name)
    return VerificationCase(
        name, entry["title"], measure, source, entry["resolutions"], claims, quick, counts
    )


def _table() -> dict[str, dict[str, Any]]:
    path = files("lyra_petsc.experiments.verification") / "cases.yaml"
    table: dict[str, dict[str, Any]] = parse_yaml(path.read_text(encoding="utf-8"), file=path)
    return table


CASES: Registry[VerificationCase] = Registry(_table(), _case)
