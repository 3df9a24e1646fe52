"""Small vibrations of a stretched rectangular membrane."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lyra_petsc.verification.bench import Bench, data
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Converges
from lyra_petsc.verification.spectrum import lowest_modes

DATA = data("vibrations")["membrane"]
MODES = ("11", "21", "31", "12")
"""Half waves along and across, by ascending frequency."""


def stretched(n: float, time: dict[str, Any]) -> dict[str, Any]:
    """The scene of the membrane at rest, all its edges held; n × n/2 cells."""
    membrane = {name.lower(): DATA[name] for name in ("C11", "C22", "C12", "C33")}
    cells = {"nx": int(n), "ny": int(n) // 2, "pattern": "alternating"}
    return {
        "mesh": {"grid": {"width": DATA["A"], "height": DATA["B"], **cells}},
        "material": {"density": DATA["rho"], "membrane": membrane},
        "handles": [{"group": side} for side in ("left", "right", "bottom", "top")],
        "time": time,
    }


def _measure(bench: Bench, n: float) -> Sequence[Measured]:
    with bench.simulation(stretched(n, {"end": 1.0, "step": 1.0})) as trial:
        trial.set_state(x=trial.x * [DATA["lam1"], DATA["lam2"], 1.0])
        found, _ = lowest_modes(trial, len(MODES))
    return [
        Measured(f"ω of mode {mode}", float(omega), DATA["omega"][mode], "rad/s")
        for mode, omega in zip(MODES, found, strict=True)
    ]


CASE = Case(
    name="stretched-membrane",
    title="A stretched rectangular membrane: frequencies from the assembled K and M against the closed form",
    source="closed form ω = π √((S11 (m/A)² + S22 (n/B)²)/ρ)",
    resolutions=(16, 32, 64, 128),
    measure=_measure,
    claim=Converges(2.0, 1e-3),
    quick=3,
    counts="cells along the longer side",
)
