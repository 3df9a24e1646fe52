"""The cases of ``verify`` by name, in the order in which they run, and the modules that they are in."""

from __future__ import annotations

from lyra_petsc.experiments.case import Registry, module_by_name
from lyra_petsc.experiments.verification.verification_case import VerificationCase

CASES: Registry[VerificationCase] = Registry(
    "lyra_petsc.experiments.verification.cases",
    module_by_name(
        ("membranes", "patch-states"),
        ("motions", "free-fall oscillator rigid-rotation wind-drag"),
        ("membranes", "uniaxial-pull"),
        ("hanging", "hanging-strip-chain hanging-strip catenary catenary-unequal catenary-elastic"),
        ("membranes", "circular-membrane stretched-membrane hanging-chain released-mode"),
        ("hinges", "hinge-strip wide-strip hinge-sheet hinge-plate"),
        ("plates", "plate"),
        ("shells", "sze-end-shear sze-end-moment clamped-disc supported-disc pressed-strip"),
        ("shells", "pinched-cylinder open-hemisphere hyperbolic-paraboloid twisted-beam open-cylinder"),
        ("shells", "slit-annulus scordelis-lo-roof hinged-roof"),
        ("sections", "frames sections"),
        ("plates", "plate-curvature plate-vibration"),
        ("cantilevers", "column post-buckling lateral-buckling elastica-tip elastica-weight"),
        ("cantilevers", "elastica-roll-up elastica-overhang tip-load roll-up heavy-cantilever"),
        ("cantilevers", "coiling-strip cloth-overhang"),
        ("hinges", "strip-vibration"),
        ("contacts", "incline sheets rest capstan collision layers"),
        ("drapes", "ruck pole table-edge cusick"),
    ),
)
