"""From a scene's material block to the constants of the kernels.

Conventions, in one place:

- measured cloths follow the original program, which multiplies its stretching tables by 2 and
  whose hinge energy k_e l² (θ − θ̄)² / (8 (A0 + A1)) bends a structured mesh with k_e/4:
  C11, C12, C22 = 2 × table, C33 (engineering shear) = table, B = k_e/4;
- an isotropic sheet is in plane stress: c11 = c22 = E h/(1 − ν²), c12 = ν c11,
  c33 = E h/(2 (1 + ν)), B = E h³/(12 (1 − ν²));
- explicit numbers are used as they stand;
- then density × density_scale × thicken, membrane × stretching_scale × thicken,
  bending × bending_scale × thicken³.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Protocol

from lyra_petsc.errors import InputError
from lyra_petsc.materials.shell import ShellMaterial
from lyra_petsc.materials.tables import ClothTable, IsotropicSheet, entries, names
from lyra_petsc.nearest import nearest

__all__ = ["names", "resolve"]

# Smallest eigenvalue a projected membrane stiffness keeps, over the largest: an exactly singular
# one would let the sheet stretch along one direction without any force.
PROJECTION_FLOOR = 0.01

Triple = tuple[float, float, float]


class MembraneNumbers(Protocol):
    """c11, c12, c22, c33 [N/m]."""

    @property
    def c11(self) -> float: ...
    @property
    def c12(self) -> float: ...
    @property
    def c22(self) -> float: ...
    @property
    def c33(self) -> float: ...


class MaterialBlock(Protocol):
    """What a scene says of a material; units as in `lyra_petsc.scene.schema.Material`."""

    @property
    def cloth(self) -> str | None: ...
    @property
    def density(self) -> float | None: ...
    @property
    def membrane(self) -> MembraneNumbers | None: ...
    @property
    def bending(self) -> float | Triple | None: ...
    @property
    def young(self) -> float | None: ...
    @property
    def poisson(self) -> float | None: ...
    @property
    def thickness(self) -> float | None: ...
    @property
    def damping(self) -> float: ...
    @property
    def warp_degrees(self) -> float: ...
    @property
    def density_scale(self) -> float: ...
    @property
    def stretching_scale(self) -> float: ...
    @property
    def bending_scale(self) -> float: ...
    @property
    def thicken(self) -> float: ...
    @property
    def rest_curvature(self) -> Triple | None: ...


def resolve(
    material: MaterialBlock, *, file: object | None = None, key: str = "material"
) -> tuple[ShellMaterial, list[str]]:
    """Constants of one material block, all conventions and factors applied.

    Parameters
    ----------
    material : scene.schema.Material
    file, key : optional
        Where the block stands, for messages.

    Returns
    -------
    ShellMaterial
    list of str
        Notes for the user (a stiffness that had to be changed), one line each.

    Raises
    ------
    InputError
        Unknown library name, or numbers missing or so large that they overflow.
    """
    notes: list[str] = []
    if material.cloth is not None:
        entry = entries().get(material.cloth)
        if entry is None:
            raise InputError(
                f"unknown cloth {material.cloth!r}, {nearest(material.cloth, names())}",
                file=file,
                key=f"{key}.cloth",
            )
        if isinstance(entry, ClothTable):
            shell, notes = of_table(entry, material.cloth)
        else:
            shell = of_isotropic(entry)
    elif material.membrane is not None and material.density is not None:
        c = material.membrane
        shell = ShellMaterial(material.density, c.c11, c.c12, c.c22, c.c33, _triple(material.bending))
    elif (
        material.young is not None
        and material.poisson is not None
        and material.thickness is not None
        and material.density is not None
    ):
        sheet = IsotropicSheet(material.young, material.poisson, material.thickness, material.density)
        shell = of_isotropic(sheet)
    else:
        raise InputError(
            "needs cloth, or density + membrane, or young + poisson + thickness + density", file=file, key=key
        )
    shell = _scaled(shell, material)
    numbers = (shell.density, shell.c11, shell.c12, shell.c22, shell.c33, *shell.bending)
    if not all(math.isfinite(value) for value in numbers):
        raise InputError("numbers too large: stiffness or density is not finite", file=file, key=key)
    if min(shell.density, shell.c11, shell.c22, shell.c33) <= 0.0:
        raise InputError("numbers too small: stiffness or density vanishes", file=file, key=key)
    return shell, notes


def of_table(table: ClothTable, name: str) -> tuple[ShellMaterial, list[str]]:
    """Constants of a measured cloth, and notes; see the module's conventions.

    A negative c12 is kept where the stiffness is positive definite. Where it is not, the
    eigenvalues of [[c11, c12], [c12, c22]] are raised to at least `PROJECTION_FLOOR` of the
    largest, which is the nearest such matrix in the Frobenius norm.
    """
    c11, c12, c22 = 2 * table.c11, 2 * table.c12, 2 * table.c22
    notes: list[str] = []
    if c11 <= 0 or c11 * c22 <= c12 * c12:
        measured = (c11, c12, c22)
        c11, c12, c22 = _projected(*measured)
        was, now = (", ".join(f"{c:.4g}" for c in numbers) for numbers in (measured, (c11, c12, c22)))
        notes.append(
            f"{name}: measured c11, c12, c22 = {was} N/m are not positive definite; projected to {now} N/m"
        )
    at_0, at_45, at_90 = (k / 4 for k in table.bending)
    return ShellMaterial(table.density, c11, c12, c22, table.c33, (at_0, at_45, at_90)), notes


def of_isotropic(sheet: IsotropicSheet) -> ShellMaterial:
    """Constants of an isotropic sheet in plane stress."""
    stretch = sheet.young * sheet.thickness / (1 - sheet.poisson**2)
    shear = sheet.young * sheet.thickness / (2 * (1 + sheet.poisson))
    bend = stretch * sheet.thickness * sheet.thickness / 12
    return ShellMaterial(sheet.density, stretch, sheet.poisson * stretch, stretch, shear, (bend, bend, bend))


def _triple(bending: float | Triple | None) -> Triple:
    if isinstance(bending, tuple):
        return bending
    value = bending or 0.0
    return value, value, value


def _projected(c11: float, c12: float, c22: float) -> Triple:
    """[[c11, c12], [c12, c22]] with both eigenvalues at least the floor; (c11, c12, c22)."""
    mean, half_difference = (c11 + c22) / 2, (c11 - c22) / 2
    radius = math.hypot(half_difference, c12)
    largest = mean + radius
    smallest = max(mean - radius, PROJECTION_FLOOR * largest)
    new_mean, new_radius = (largest + smallest) / 2, (largest - smallest) / 2
    cosine, sine = half_difference / radius, c12 / radius
    return new_mean + new_radius * cosine, new_radius * sine, new_mean - new_radius * cosine


def _scaled(shell: ShellMaterial, material: MaterialBlock) -> ShellMaterial:
    thicken = material.thicken
    stretch = material.stretching_scale * thicken
    # a product and not a power: too large a factor becomes inf here and is refused above
    bend = material.bending_scale * thicken * thicken * thicken
    at_0, at_45, at_90 = (b * bend for b in shell.bending)
    return replace(
        shell,
        density=shell.density * material.density_scale * thicken,
        c11=shell.c11 * stretch,
        c12=shell.c12 * stretch,
        c22=shell.c22 * stretch,
        c33=shell.c33 * stretch,
        bending=(at_0, at_45, at_90),
        damping=material.damping,
        warp_degrees=material.warp_degrees,
        rest_curvature=material.rest_curvature,
    )
