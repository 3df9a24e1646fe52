"""The augmented Lagrangian method of the note on contact: sticking and sliding by Coulomb's law."""

from __future__ import annotations

import math
from pathlib import Path
from types import ModuleType

import pytest
from module_of import module_of

from lyra_petsc.terms import registry

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "contact_trials.py"


@pytest.fixture(scope="module")
def trials() -> ModuleType:
    return module_of(SCRIPT)


@pytest.mark.parametrize("part", [0.9, 1.01])
def test_a_sheet_on_a_slope_with_multipliers(trials: ModuleType, part: float) -> None:
    known = list(registry.REGISTRY)
    with trials.in_use(10.0):
        found = trials.measure(trials.scene_of("slope", part))
    assert known == registry.REGISTRY
    assert found["reached"] == pytest.approx(trials.SLID)
    assert found["unsettled"] == 0
    assert found["solves"] > 1.0  # else it was the barrier
    assert found["gap"] == pytest.approx(trials.LEVEL, abs=0.1 * trials.LEVEL)
    if part > 1.0:
        assert found["creep"] < 1e-6
    else:
        seconds = (1.0 - trials.MEASURE_FROM) * trials.SLID
        exact = trials.G * (1.0 - part) * math.sin(math.radians(30.0)) * seconds
        assert found["change"] == pytest.approx(exact, rel=1e-4)
