"""The cases by name, in the order in which ``verify`` runs them, and the modules that they are in."""

from __future__ import annotations

from lyra_petsc.experiments.registry import Registry
from lyra_petsc.experiments.verification.case import Case

CASES: Registry[Case] = Registry(
    "lyra_petsc.experiments.verification.cases",
    {
        "patch-states": "patches",
        "free-fall": "motions",
        "oscillator": "motions",
        "rigid-rotation": "motions",
        "wind-drag": "motions",
        "uniaxial-pull": "patches",
        "hanging-strip-chain": "hanging",
        "hanging-strip": "hanging",
        "catenary": "hanging",
        "catenary-unequal": "hanging",
        "catenary-elastic": "hanging",
        "circular-membrane": "membranes",
        "stretched-membrane": "membranes",
        "hanging-chain": "membranes",
        "released-mode": "membranes",
        "hinge-strip": "hinges",
        "wide-strip": "hinges",
        "hinge-sheet": "hinges",
        "hinge-plate": "hinges",
        "tip-load": "cantilevers",
        "roll-up": "cantilevers",
        "heavy-cantilever": "cantilevers",
        "coiling-strip": "cantilevers",
        "cloth-overhang": "cantilevers",
        "strip-vibration": "hinges",
    },
)
