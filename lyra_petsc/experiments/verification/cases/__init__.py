"""The cases of ``verify`` by name, in the order in which they run, and the modules that they are in."""

from __future__ import annotations

from lyra_petsc.experiments.case import Registry
from lyra_petsc.experiments.verification.answers import VerificationCase

CASES: Registry[VerificationCase] = Registry(
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
        "plate": "plates",
        "sze-end-shear": "shells",
        "sze-end-moment": "shells",
        "slit-annulus": "shells",
        "scordelis-lo-roof": "shells",
        "pinched-cylinder": "shells",
        "open-hemisphere": "shells",
        "plate-curvature": "plates",
        "plate-vibration": "vibrations",
        "column": "buckling",
        "post-buckling": "buckling",
        "lateral-buckling": "buckling",
        "elastica-tip": "cantilevers",
        "elastica-weight": "cantilevers",
        "elastica-roll-up": "cantilevers",
        "elastica-overhang": "cantilevers",
        "tip-load": "cantilevers",
        "roll-up": "cantilevers",
        "heavy-cantilever": "cantilevers",
        "coiling-strip": "cantilevers",
        "cloth-overhang": "cantilevers",
        "strip-vibration": "hinges",
        "incline": "contacts",
    },
)
