"""Small vibrations of clamped strips of hinges."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lyra_petsc.verification.bench import Bench
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.cases.hinge_strip import PATTERNS, expected
from lyra_petsc.verification.claims import Converges
from lyra_petsc.verification.flat_sheet import stiffness
from lyra_petsc.verification.strips import DENSITY, strip

BETA_L = (1.8751040687119611, 4.694091132974175, 7.854757438237613)
"""Roots of cos βL cosh βL = −1."""


def _measure(bench: Bench, n: float) -> Sequence[Measured]:
    found = []
    for pattern in PATTERNS:
        with bench.simulation(strip(pattern, n)) as trial:
            operator, mass = stiffness(trial), trial.mass
        root = np.sqrt(mass[~operator.held])
        squares = np.linalg.eigvalsh(operator.dense() / np.outer(root, root))
        for number, beta in enumerate(BETA_L):
            exact = beta**2 * np.sqrt(expected(pattern) / DENSITY)
            value = float(np.sqrt(squares[number]))
            found.append(Measured(f"ω{number + 1}, {pattern}", value, float(exact), "rad/s"))
    return found


CASE = Case(
    name="strip-vibration",
    title="Clamped strip: frequencies from the assembled K and M against the beam's with B_effective",
    source="Euler-Bernoulli beam, closed form: ω = (βL)² √(B/(ρ L⁴))",
    resolutions=(16, 32, 64),
    measure=_measure,
    claim=Converges(2.0, 2e-3),
    quick=3,
    counts="cells along the strip",
)
