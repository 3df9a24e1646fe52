"""The cases by name, in the order in which ``verify`` runs them; the file of each bears its name."""

from __future__ import annotations

from importlib import import_module

from lyra_petsc.errors import InputError
from lyra_petsc.nearest import nearest
from lyra_petsc.verification.case import Case

NAMES = (
    "patch-states",
    "free-fall",
    "oscillator",
    "rigid-rotation",
    "wind-drag",
    "uniaxial-pull",
    "hanging-strip-chain",
    "hanging-strip",
    "catenary",
    "catenary-unequal",
    "catenary-elastic",
    "circular-membrane",
    "stretched-membrane",
    "hanging-chain",
    "released-mode",
    "hinge-strip",
    "wide-strip",
    "hinge-sheet",
    "hinge-plate",
    "tip-load",
    "roll-up",
    "heavy-cantilever",
    "coiling-strip",
    "cloth-overhang",
    "strip-vibration",
)


def load(name: str) -> Case:
    """A case by its name.

    Raises
    ------
    InputError
        For a name that is not listed, with the nearest that is.
    """
    if name not in NAMES:
        raise InputError(f"unknown case, {nearest(name, NAMES)}", key=name)
    module = import_module(f"lyra_petsc.verification.cases.{name.replace('-', '_')}")
    case: Case = module.CASE
    return case
