"""A sheet on equal springs: the linear oscillator by backward Euler."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.verification.bench import Bench, Trial, data, farthest
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Exact
from lyra_petsc.verification.spring_sheet import OMEGA, sprung_sheet

DATA = data("oscillator")
STEPS = 3


def _scene(n: float) -> dict[str, Any]:
    return sprung_sheet({"end": STEPS / (n * OMEGA), "step": 1.0 / (n * OMEGA)})


def _measure(bench: Bench, n: float) -> Sequence[Measured]:
    row = next(row for row in DATA["rows"] if abs(row[0] * n - 1.0) < 1e-9)
    with bench.simulation(_scene(n)) as trial:
        for _ in range(STEPS):
            before = _states(trial)
            trial.step()
        # z and v/ω turn and shrink together
        ratios = _states(trial) / before
    size, turn = np.abs(ratios), -np.angle(ratios)
    return [
        Measured("amplification per step", farthest(size, row[1]), row[1]),
        Measured("phase per step", farthest(turn, row[2]), row[2], "rad"),
    ]


def _states(trial: Trial) -> NDArray[np.complex128]:
    return np.asarray(trial.x[:, 2] + 1j * trial.v[:, 2] / OMEGA)


CASE = Case(
    name="oscillator",
    title="A sheet on springs, backward Euler: amplification 1/√(1 + ω²Δt²) and phase atan ωΔt of a step",
    source=DATA["source"],
    resolutions=(0.1, 1, 10, 100, 1000),
    measure=_measure,
    claim=Exact(1e-10),
    quick=3,
    counts="1/(ωΔt)",
)
