"""All cases of ``verify`` pass, on one rank and on several."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from mpi4py import MPI

from lyra_petsc.experiments.verification.cases import CASES
from lyra_petsc.experiments.verification.verification_case import run_case

SOME = (
    "free-fall", "hinge-strip", "hinge-sheet", "hinge-plate", "strip-vibration", "wide-strip", "column",
    "frames",
)  # fmt: skip
"""Cases that are always run, as each takes a second or two at most."""

LONG = (
    "catenary", "catenary-unequal", "circular-membrane", "plate", "plate-vibration", "column",
    "post-buckling", "lateral-buckling", "elastica-tip", "elastica-weight", "elastica-roll-up",
    "elastica-overhang", "slit-annulus", "sze-end-moment", "pinched-cylinder", "open-cylinder",
    "hinged-roof", "incline", "sheets", "rest", "capstan", "collision", "layers", "ruck", "pole",
    "table-edge", "cusick", "clamped-disc", "twisted-beam", "released-mode", "open-hemisphere",
    "hyperbolic-paraboloid", "scordelis-lo-roof", "stretched-membrane", "roll-up", "plate-curvature",
    "heavy-cantilever", "tip-load", "catenary-elastic", "sze-end-shear", "uniaxial-pull", "wind-drag",
    "frames", "sections", "supported-disc", "pressed-strip", "hinge-plate",
)  # fmt: skip
"""Cases whose finest resolutions are slow."""

FEWER: dict[str, dict[str, object]] = {
    name: {"KINDS": ("criss-cross",)}
    for name in ("post-buckling", "lateral-buckling", "elastica-weight", "elastica-roll-up",
                 "elastica-overhang")
} | {
    "elastica-tip": {"KINDS": ("criss-cross", "gmsh")},
    "plate-vibration": {"KINDS": ("criss-cross", "gmsh")},
    "hinged-roof": {"PATTERNS": ("alternating",)},
    "incline": {"SLOPES": (5.0, 60.0)},
    "capstan": {"WRAPS": {0.5: (0.1,), 1.0: (0.3,), 1.5: (0.5,)}},
    "sheets": {"SLIDERS": ("bdf2",)},
    "cusick": {"MESHES": ("irregular",), "STARTS": 2},
}  # fmt: skip
"""Parameters omitted from cases that repeat others: further meshes, which `plate`, `column` and other shells
have; the middle slope; wraps between others; integrators, which `tests/stepping/test_friction.py` has; and
starts.
"""

TOGETHER = (
    *SOME, "patch-states", "rigid-rotation", "wind-drag", "hanging-strip", "hanging-chain",
    "stretched-membrane", "sze-end-shear", "pinched-cylinder", "roll-up", "plate-curvature", "rest",
    "collision",
)  # fmt: skip
"""Cases of each kind that also run on several ranks; `tests/stepping` tests the effects of ranks."""


@pytest.mark.parametrize("name", CASES.entries)
def test_a_case_has_a_description(name: str) -> None:
    case = CASES.load(name)
    assert case.name == name
    assert case.title
    assert case.source
    assert list(case.resolutions) == sorted(set(case.resolutions))
    assert 1 <= case.quick <= len(case.resolutions)


DOCS = Path(__file__).parents[3] / "docs"


@pytest.mark.parametrize("name", CASES.entries)
def test_a_case_is_in_the_docs(name: str) -> None:
    assert any(f"`{name}`" in page.read_text(encoding="utf-8") for page in DOCS.rglob("*.md"))


def marks(name: str) -> list[pytest.MarkDecorator]:
    """Whether a case is slow, and whether it also runs on two ranks."""
    return [pytest.mark.parallel(2)] * (name in TOGETHER) + [pytest.mark.slow] * (name not in SOME)


@pytest.mark.parametrize("name", [pytest.param(name, marks=marks(name)) for name in CASES.entries])
def test_a_case_passes(comm: MPI.Comm, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    case = CASES.load(name)
    for constant, fewer in FEWER.get(name, {}).items():
        monkeypatch.setattr(sys.modules[case.measure.__module__], constant, fewer)
    # on several ranks, the resolutions that suffice to compare them
    outcome = run_case(comm, case, quick=comm.size > 1 or name in LONG)
    words = "; ".join(f"{quantity}: {verdict.message}" for quantity, verdict in outcome.verdicts.items())
    assert outcome.passed, words
