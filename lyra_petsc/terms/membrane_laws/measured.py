"""Cloth that stiffens under tension, fitted to measured tables of stiffness at rest and under strain.

    W = ½ eᵀ C e + Σ_k a_k h(n_k · e) + barrier against compression (``compression``)

with e = (E_uu, E_vv, 2 E_uv), the library's stiffness C at rest, the strains n_k · e of fibres at 0°, 22.5°,
45°, 67.5° and 90° to the warp (on both sides) and of the area, and a_k ≥ 0. The second derivative of h is
min(s/s₁, 1) for stretched fibres, 0 for others, so that W is convex in E, with a continuous second
derivative. s₁ is the strain of the strained rows, the largest one measured. The a_k
were computed by non-negative least squares from the stresses of the tables, see `fit_errors`.

Sources: tables of Wang, O'Brien & Ramamoorthi, ACM TOG 30(4):71 (2011), read as by ARCSim (whose stresses do
not derive from an energy); energies of fibres for wovens Clyde, Teran & Tamstorf, SCA 2017.
"""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.element import inlined
from lyra_petsc.scene.materials.library import ShellMaterial
from lyra_petsc.terms.membrane_laws import compression

SOFTENS = False

MEASURED = 1.0 / 6.0
"""Largest strain of the tables."""

FULL_STRAIN = 0.5 * ((1.0 + MEASURED) ** 2 - 1.0)
"""s₁: Green strain above which the stiffness of fibres is constant."""

_COS, _SIN = np.cos(np.pi / 8.0) ** 2, np.sin(np.pi / 8.0) ** 2
_BOTH = np.sqrt(_COS * _SIN)

FIBRES: tuple[tuple[tuple[float, float, float], ...], ...] = (
    ((1.0, 0.0, 0.0),),
    ((_COS, _SIN, _BOTH), (_COS, _SIN, -_BOTH)),
    ((0.5, 0.5, 0.5), (0.5, 0.5, -0.5)),
    ((_SIN, _COS, _BOTH), (_SIN, _COS, -_BOTH)),
    ((0.0, 1.0, 0.0),),
    ((0.5, 0.5, 0.0),),
)
"""The vectors n_k of each coefficient a_k: fibres, on both sides of the warp, and lastly the area."""

_N = np.array([vector for vectors in FIBRES for vector in vectors])
_COEFFICIENT = np.repeat(np.arange(len(FIBRES)), [len(vectors) for vectors in FIBRES])


@inlined()
def _stiffening(s):  # type: ignore[no-untyped-def]
    """h at s > 0, and its first two derivatives."""
    if s < FULL_STRAIN:
        part = s / FULL_STRAIN
        return part * s * s / 6.0, 0.5 * part * s, part
    return 0.5 * s * (s - FULL_STRAIN) + FULL_STRAIN * FULL_STRAIN / 6.0, s - 0.5 * FULL_STRAIN, 1.0


@inlined()
def energy(e0, e1, e2, c, m):  # type: ignore[no-untyped-def]
    """Energy [J] per rest area [m²]."""
    s0, s1, s2 = c[m, 0] * e0 + c[m, 1] * e1, c[m, 1] * e0 + c[m, 2] * e1, c[m, 3] * e2
    total = 0.5 * (e0 * s0 + e1 * s1 + e2 * s2) + compression.energy(e0, e1, e2, c[m, 4])
    for k in range(len(_N)):
        s = _N[k, 0] * e0 + _N[k, 1] * e1 + _N[k, 2] * e2
        if s > 0.0:
            total += c[m, 5 + _COEFFICIENT[k]] * _stiffening(s)[0]
    return total


@inlined()
def stress(e0, e1, e2, c, m):  # type: ignore[no-untyped-def]
    """Second Piola-Kirchhoff stress (S_uu, S_vv, S_uv) [N/m]."""
    s0, s1, s2 = compression.stress(e0, e1, e2, c[m, 4])
    s0, s1, s2 = (
        s0 + c[m, 0] * e0 + c[m, 1] * e1,
        s1 + c[m, 1] * e0 + c[m, 2] * e1,
        s2 + c[m, 3] * e2,
    )
    for k in range(len(_N)):
        s = _N[k, 0] * e0 + _N[k, 1] * e1 + _N[k, 2] * e2
        if s > 0.0:
            force = c[m, 5 + _COEFFICIENT[k]] * _stiffening(s)[1]
            s0, s1, s2 = s0 + force * _N[k, 0], s1 + force * _N[k, 1], s2 + force * _N[k, 2]
    return s0, s1, s2


@inlined()
def tangent(e0, e1, e2, c, m):  # type: ignore[no-untyped-def]
    """c11, c12, c22, c33, c13, c23 [N/m]."""
    c11, c12, c22, c33, c13, c23 = compression.tangent(e0, e1, e2, c[m, 4])
    c11, c12, c22, c33 = c11 + c[m, 0], c12 + c[m, 1], c22 + c[m, 2], c33 + c[m, 3]
    for k in range(len(_N)):
        n0, n1, n2 = _N[k, 0], _N[k, 1], _N[k, 2]
        s = n0 * e0 + n1 * e1 + n2 * e2
        if s > 0.0:
            stiffness = c[m, 5 + _COEFFICIENT[k]] * _stiffening(s)[2]
            c11, c12, c22 = c11 + stiffness * n0 * n0, c12 + stiffness * n0 * n1, c22 + stiffness * n1 * n1
            c33, c13, c23 = c33 + stiffness * n2 * n2, c13 + stiffness * n0 * n2, c23 + stiffness * n1 * n2
    return c11, c12, c22, c33, c13, c23


@cache
def tables() -> dict[str, Any]:
    """For each cloth the ``strained`` rows (5, 4), the fitted ``stiffening`` a_k (6,) [N/m] and errors."""
    text = files(__package__).joinpath("wang2011.json").read_text(encoding="utf-8")
    return json.loads(text)["cloths"]


def fit_errors() -> dict[str, tuple[float, float]]:
    """Relative root mean square error of each cloth's stress against the tables, and that of C alone."""
    return {name: (row["error"], row["error_of_stvk"]) for name, row in tables().items()}


def parameters(shell: ShellMaterial) -> list[float]:
    """c11, c12, c22, c33, b and a_k [N/m]."""
    stiffening = tables()[shell.cloth]["stiffening"]
    largest = max(shell.c11, shell.c22, shell.c33)
    return [
        *(shell.c11, shell.c12, shell.c22, shell.c33),
        compression.STIFFNESS_RATIO * largest,
        *(shell.stretching * a for a in stiffening),
    ]


def stiffest(c: Array) -> Array:
    """Largest stiffness at rest [N/m], (n_materials,), for parameters c (n_materials, 11)."""
    return np.abs(c[:, :4]).max(axis=1)
