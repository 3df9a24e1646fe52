"""The kinds of fuzz cases by name, each with its percentage."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from contextlib import suppress

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded
from hypothesis import strategies as st
from judge import Case
from mesh_cases import geo_cases, mesh_cases
from original_cases import original_cases
from scene_cases import scene_cases, text_bombs

KINDS: dict[str, tuple[int, st.SearchStrategy[Case]]] = {
    "scenes": (48, scene_cases()),
    "bombs": (3, text_bombs()),
    "originals": (15, original_cases()),
    "meshes": (30, mesh_cases()),
    "scripts": (4, geo_cases()),
}


def for_each(
    strategy: st.SearchStrategy[Case], number: int, seed: int, run: Callable[[Case], object]
) -> None:
    """Call ``run`` with ``number`` cases, which depend on the seed only.

    Constants of loaded modules, which Hypothesis draws, too, are excluded: they depend on earlier tests.
    """
    with suppress(ImportError, AttributeError):
        providers = importlib.import_module("hypothesis.internal.conjecture.providers")
        none = type(providers._local_constants)()
        providers._get_local_constants = lambda: none

    @seeded(seed)
    @settings(
        max_examples=number,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(case=strategy)
    def draw(case: Case) -> None:
        run(case)

    draw()
