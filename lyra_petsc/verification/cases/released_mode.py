"""The first mode of a stretched membrane, released and followed in time."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.verification.bench import Bench
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.cases.stretched_membrane import DATA, stretched
from lyra_petsc.verification.claims import Converges, Exact
from lyra_petsc.verification.spectrum import lowest_modes

CELLS = 16
AMPLITUDE = 1e-5
"""m: small enough for a linear motion, large enough for its forces to stand above round-off"""

INTEGRATORS = ("beuler", "midpoint", "alpha2", "bdf2")
PERIOD = 2.0 * math.pi / DATA["omega"]["11"]
"""s"""


def _measure(bench: Bench, n: float) -> Iterator[Measured]:
    for integrator in INTEGRATORS:
        omega, states = _followed(bench, n, integrator)
        turn, dt = -np.unwrap(np.angle(states)), PERIOD / n
        per_step = float(turn[-1] - turn[0]) / (len(states) - 1)
        yield Measured(f"ω, {integrator}", per_step / dt, omega, "rad/s")
        x = omega * dt
        if integrator == "beuler":
            shrunk = float(abs(states[-1] / states[-2]))
            yield Measured("phase of a step, beuler", per_step, math.atan(x), "rad")
            yield Measured("amplification of a step, beuler", shrunk, 1.0 / math.hypot(1.0, x))
        if integrator == "midpoint":
            shrunk = float(abs(states[-1] / states[-2]))
            yield Measured("phase of a step, midpoint", per_step, 2.0 * math.atan(0.5 * x), "rad")
            yield Measured("amplification of a step, midpoint", shrunk, 1.0)


def _followed(bench: Bench, n: float, integrator: str) -> tuple[float, NDArray[np.complex128]]:
    """The mode's ω from K and M, and q + i q̇/ω of its coordinate q after every step of one period."""
    time = {"end": PERIOD, "step": PERIOD / n, "integrator": integrator}
    content = stretched(bench, CELLS, time)
    # only the rounding floor ends Newton: the stretched sheet's forces are large, the motion is small
    content["solver"] = {"force_tolerance": 1e-15, "step_tolerance": 1e-15}
    with bench.simulation(content) as trial:
        equilibrium = trial.start
        frequencies, shapes = lowest_modes(trial, 1)
        omega, shape = float(frequencies[0]), shapes[0]
        trial.set_state(x=equilibrium + AMPLITUDE / np.abs(shape).max() * shape)
        weights = trial.mass[:, None] * shape
        states = []
        for count in range(round(n) + 1):
            if count:
                trial.step()
            q, rate = np.sum(weights * (trial.x - equilibrium)), np.sum(weights * trial.v)
            states.append(complex(q, rate / omega))
    return omega, np.array(states)


CASE = Case(
    name="released-mode",
    title="A membrane's first mode followed in time: ω against that of K and M, and the schemes' own phase",
    source="closed forms: phase of a step atan ωΔt (beuler), 2 atan ωΔt/2 (midpoint)",
    resolutions=(20, 40, 80),
    measure=_measure,
    claim=Converges(2.0, 5e-3),
    claims={
        f"{what} of a step, {integrator}": Exact(1e-7)
        for what in ("phase", "amplification")
        for integrator in ("beuler", "midpoint")
    },
    counts="steps per period",
    size=lambda n: PERIOD / n,
)
