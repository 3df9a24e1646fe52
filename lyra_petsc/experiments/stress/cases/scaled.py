"""The base scene with its stiffnesses, density, damping or Δt multiplied, one by one and all at once.

Gales, and a thousand times the weight.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from functools import partial

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.stress.stress_scenes import (
    CELLS,
    FULL,
    QUICK,
    USUAL,
    Content,
    Scope,
    Setting,
    StressCase,
    anisotropic,
    as_it_is,
    blow,
    changed,
    damp,
    family,
    scale,
    sheet,
    weigh,
)


def _times(what: str, parameter: str, levels: Mapping[str, Scope]) -> Iterator[StressCase]:
    """A case for each factor of a parameter of `scale`."""
    for factor, level in levels.items():
        scene = changed(scale, **{parameter: float(factor)})
        yield StressCase(f"{what}-{factor}", f"{what} × {factor}", scene, level=level)


# the goal: stiff sheets at steps of milliseconds and tens of milliseconds, solved in few iterations
stiff_steps = family(
    "stiff-steps",
    "membrane stiffness and Δt together, with bounds on iterations and wall time",
    *(
        StressCase(
            f"stiff-{factor}-{ms}ms", f"membrane × {factor}, Δt {ms} ms",
            changed(scale, stretching=float(factor)), step=1e-3 * ms, level=QUICK, swift=True,
        )
        for factor in ("1e3", "1e6")
        for ms in (5, 40)
    ),
)  # fmt: skip

membrane = family(
    "membrane",
    "membrane stiffness × 1e-3 to 1e9",
    *_times("membrane", "stretching", {"1e-3": QUICK, "1": USUAL, "1e3": USUAL, "1e6": USUAL, "1e9": QUICK}),
)

bending = family(
    "bending",
    "bending stiffness × 0 to 1e6",
    *_times("bending", "bending", {"0": QUICK, "1": FULL, "1e3": USUAL, "1e6": QUICK}),
)

time_step = family(
    "time-step",
    "Δt from 1e-5 s to 1 s",
    *(
        StressCase(f"step-{step}", f"Δt {step} s", as_it_is, steps=steps, step=float(step), level=level)
        for step, steps, level in (
            ("1e-5", 30, QUICK),
            ("1e-4", 30, USUAL),
            ("1e-3", 30, USUAL),
            ("1e-2", 20, USUAL),
            ("1e-1", 10, USUAL),
            ("1", 5, QUICK),
        )
    ),
)

density = family(
    "density",
    "density × 1e-3 to 1e3",
    *_times(
        "density",
        "density",
        {"1e-3": QUICK, "1e-2": FULL, "1e-1": FULL, "1e1": FULL, "1e2": FULL, "1e3": USUAL},
    ),
)

anisotropy = family(
    "anisotropy",
    "c11/c22 = 1e4, their mean staying",
    StressCase("stiff-warp", "c11/c22 = 1e4", changed(anisotropic, ratio=1e4), level=QUICK),
    StressCase("stiff-weft", "c11/c22 = 1e-4", changed(anisotropic, ratio=1e-4)),
)

damping = family(
    "damping",
    "γ 0 and 10 s",
    StressCase("damping-0", "no damping", changed(damp, seconds=0.0)),
    StressCase("damping-10s", "damping γ = 10 s", changed(damp, seconds=10.0), level=QUICK),
)


def _product(setting: Setting, bench: Bench, **factors: float) -> Content:
    """Without a scene of the user, of a coarser sheet."""
    content = setting.content()
    if not setting.given:
        content |= {key: sheet(CELLS[QUICK])[key] for key in ("mesh", "handles")}
    return scale(content, **factors)


products = family(
    "products",
    "stiffness × Δt × bending × density",
    *(
        StressCase(
            f"all-{stretching}-{step}-{bending}-{density}",
            f"membrane × {stretching}, Δt {step} s, bending × {bending}, density × {density}",
            partial(_product, stretching=float(stretching), bending=float(bending), density=float(density)),
            steps=5,
            step=float(step),
            level=FULL,
        )
        for stretching, step, bending, density in itertools.product(
            ("1", "1e3", "1e6", "1e9"),
            ("1e-4", "5e-3", "4e-2", "1"),
            ("0", "1", "1e3", "1e6"),
            ("1e-3", "1", "1e3"),
        )
    ),
)


wind = family(
    "wind",
    "wind of 50 and 200 m/s",
    StressCase("wind-50", "wind 50 m/s", changed(blow, speed=50.0)),
    StressCase("wind-200", "wind 200 m/s", changed(blow, speed=200.0), level=QUICK),
)

gravity = family(
    "gravity",
    "gravity × 1000",
    StressCase("gravity-1000", "gravity × 1000", changed(weigh, factor=1000.0), level=QUICK),
)
