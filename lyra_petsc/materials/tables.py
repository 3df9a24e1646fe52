"""The library files as they stand: names and numbers, before any convention is applied."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

TABLE_LIBRARIES = ("wang2011.json", "original.json")
ISOTROPIC_LIBRARIES = ("engineering.json",)


@dataclass(frozen=True)
class ClothTable:
    """The part of a measured cloth's tables that a St. Venant-Kirchhoff shell uses.

    Attributes
    ----------
    density : float
        Areal density [kg/m²].
    c11, c12, c22, c33 : float
        Small-strain row of the stretching table [N/m].
    bending : (3,)
        First column of the bending table, k_e [N·m], edges at 0°, 45°, 90° to the warp.
    """

    density: float
    c11: float
    c12: float
    c22: float
    c33: float
    bending: tuple[float, float, float]


@dataclass(frozen=True)
class IsotropicSheet:
    """A sheet of an isotropic engineering material.

    Attributes
    ----------
    young : float [Pa]
    poisson : float
    thickness : float [m]
    density : float
        Areal density [kg/m²].
    """

    young: float
    poisson: float
    thickness: float
    density: float


def _read(library: str) -> dict[str, Any]:
    text = files(__package__).joinpath(library).read_text(encoding="utf-8")
    data: dict[str, Any] = json.loads(text)
    return data


@cache
def entries() -> dict[str, ClothTable | IsotropicSheet]:
    """Every material of every library, by name."""
    found: dict[str, ClothTable | IsotropicSheet] = {}
    for library in TABLE_LIBRARIES:
        for name, row in _read(library)["tables"].items():
            at_0, at_45, at_90 = row["bending"]
            found[name] = ClothTable(
                row["density"], row["c11"], row["c12"], row["c22"], row["c33"], (at_0, at_45, at_90)
            )
    for library in ISOTROPIC_LIBRARIES:
        for name, row in _read(library)["isotropic"].items():
            areal = row["density"] * row["thickness"]
            found[name] = IsotropicSheet(row["young"], row["poisson"], row["thickness"], areal)
    return found


def names() -> list[str]:
    """The names a scene's ``cloth`` may take, sorted."""
    return sorted(entries())
