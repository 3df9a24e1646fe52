"""Small vibrations of a stretched rectangular membrane."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lyra_petsc.verification.bench import Bench, data
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Converges
from lyra_petsc.verification.meshes import rectangle
from lyra_petsc.verification.spectrum import lowest_modes

DATA = data("vibrations")["membrane"]
MODES = ("11", "21", "31", "12")
"""Half waves along and across, by ascending frequency."""


def stretched(bench: Bench, n: int, time: dict[str, Any]) -> dict[str, Any]:
    """The scene of the membrane in its stretched state, all edges held there; n × n/2 cells."""
    vertices, triangles = rectangle(n, n // 2, DATA["A"], DATA["B"])
    number = np.arange(len(vertices)).reshape(n // 2 + 1, n + 1)
    edge = np.unique(np.concatenate([number[0], number[-1], number[:, 0], number[:, -1]]))
    mesh = bench.mesh(vertices * [DATA["lam1"], DATA["lam2"], 0.0], triangles, rest=vertices[:, :2])
    membrane = {name.lower(): DATA[name] for name in ("C11", "C22", "C12", "C33")}
    return {
        "mesh": mesh,
        "material": {"density": DATA["rho"], "membrane": membrane},
        "handles": [{"nodes": edge.tolist()}],
        "time": time,
    }


def _measure(bench: Bench, n: float) -> Sequence[Measured]:
    with bench.simulation(stretched(bench, int(n), {"end": 1.0, "step": 1.0})) as trial:
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
