"""Material library, and constants of materials for the kernels.

Conventions:

- measured cloths follow the original program, which multiplies its stretching tables by 2 and whose hinge
  energy k_e l² (θ − θ̄)² / (8 (A0 + A1)) gives a structured mesh the bending stiffness k_e/4:
  C11, C12, C22 = 2 × table, C33 (engineering shear) = table, B = k_e/4;
- an isotropic sheet is in plane stress: c11 = c22 = E h/(1 − ν²), c12 = ν c11,
  c33 = E h/(2 (1 + ν)), B = E h³/(12 (1 − ν²)), d11 = d22 = B, d12 = ν B, d33 = B (1 − ν)/2;
- B at 0°, 45°, 90° gives d11 = B0, d22 = B90, d12 = 0, 2 d33 = 2 B45 − (B0 + B90)/2, raised to at least
  0.2 √(d11 d22);
- explicit numbers are used unchanged;
- factors: density × density_scale × thicken, membrane × stretching_scale × thicken,
  bending × bending_scale × thicken³.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from lyra_petsc.errors import InputError
from lyra_petsc.scene.materials.measured_curves import Points, interpolation

if TYPE_CHECKING:
    from lyra_petsc.scene.material_block import Material, PlateStiffness

TABLE_LIBRARIES = ("wang2011.json", "original.json")
ISOTROPIC_LIBRARIES = ("engineering.json",)

# Smallest eigenvalue of a projected membrane stiffness over the largest: with a singular stiffness the sheet
# would stretch along one direction without force.
PROJECTION_FLOOR = 0.01

# Smallest stiffness in plastic bending over the elastic one: with none folds would open without a moment, and
# which part of a strip bends would depend on round-off.
MIN_HARDENING = 1e-4

Triple = tuple[float, float, float]
Plate = tuple[float, float, float, float]


@dataclass(frozen=True)
class ShellMaterial:
    """Constants of one shell material for the kernels.

    Attributes
    ----------
    density : float
        Areal density [kg/m²].
    c11, c12, c22, c33 : float
        Orthotropic St. Venant-Kirchhoff membrane stiffness [N/m]; energy per rest area is
        ½ (c11 E_uu² + 2 c12 E_uu E_vv + c22 E_vv² + c33 (2E_uv)²).
    bending : tuple of three floats
        Cylindrical bending stiffness B [N·m] of hinges whose rest edge is at 0°, 45°, 90° to the warp,
        interpolated linearly in the angle. All three zero: no bending stiffness.
    damping : float
        γ [s] of stiffness-proportional damping.
    warp_degrees : float
        Rotation of the warp direction in the material plane, anticlockwise [°].
    rest_curvature : tuple of three floats or None
        κ11, κ22, κ12 [1/m] in the material axes.
    law : str
        Name of the membrane law.
    cloth : str
        Name in the library, for laws with further constants of the cloth.
    stretching : float
        Factor on these constants, and on the forces of ``curves``.
    curves : tuple of three curves
        Strain and force [N/m] along warp and weft and in shear, for the law ``curves``.
    model : str
        Name of the bending model.
    plate : tuple of four floats
        d11, d12, d22, d33 [N·m] for ``midedge``; energy per rest area is
        ½ (d11 κ11² + 2 d12 κ11 κ22 + d22 κ22² + d33 (2 κ12)²).
    friction_moment : tuple of two floats
        Moment [N m/m] of internal friction against bending of warp and weft.
    friction_force : float
        Force [N/m] of internal friction against shear.
    stretch_limit : float
        Upper bound of the principal stretches; infinite without a limit.
    yield_curvature : float
        Curvature [1/m] at which a strip begins to bend plastically; infinite if it never does.
    hardening : float
        Stiffness in plastic bending over the elastic one.
    """

    density: float
    c11: float
    c12: float
    c22: float
    c33: float
    bending: Triple = (0.0, 0.0, 0.0)
    damping: float = 0.0
    warp_degrees: float = 0.0
    rest_curvature: Triple | None = None
    law: str = "stvk"
    cloth: str = ""
    stretching: float = 1.0
    curves: tuple[Points, ...] = ()
    model: str = "hinge"
    plate: Plate = (0.0, 0.0, 0.0, 0.0)
    friction_moment: tuple[float, float] = (0.0, 0.0)
    friction_force: float = 0.0
    stretch_limit: float = math.inf
    yield_curvature: float = math.inf
    hardening: float = 0.0

    @property
    def elastic_share(self) -> float:
        """Fraction of the bending stiffness that never yields."""
        return 1.0 if math.isinf(self.yield_curvature) else max(self.hardening, MIN_HARDENING)

    @property
    def strip_stiffness(self) -> float:
        """Moment per width over curvature [N·m] of a strip along the warp with free edges, by ``plate``."""
        d11, d12, d22, _ = self.plate
        return d11 - d12 * d12 / d22

    @property
    def plate_matrix(self) -> tuple[Triple, Triple, Triple]:
        """``plate`` as a matrix on (κ11, κ22, 2 κ12)."""
        d11, d12, d22, d33 = self.plate
        return (d11, d12, 0.0), (d12, d22, 0.0), (0.0, 0.0, d33)

    def bends_with(self, model: str) -> bool:
        """Whether the material has bending stiffness, of this bending model."""
        return self.model == model and max(*self.bending, self.plate[0]) > 0.0


@dataclass(frozen=True)
class ClothTable:
    """Numbers from the tables of a measured cloth that a St. Venant-Kirchhoff shell uses.

    Attributes
    ----------
    density : float
        Areal density [kg/m²].
    c11, c12, c22, c33 : float
        Small-strain row of the stretching table [N/m].
    bending : (3,)
        First column of the bending table, k_e [N·m], for edges at 0°, 45°, 90° to the warp.
    measured : bool
        Whether the numbers were measured at a fabric.
    """

    density: float
    c11: float
    c12: float
    c22: float
    c33: float
    bending: Triple
    measured: bool = False


def _read_library(library: str) -> dict[str, Any]:
    text = files(__package__).joinpath(library).read_text(encoding="utf-8")
    return json.loads(text)


@cache
def library_entries() -> dict[str, ClothTable | ShellMaterial]:
    """All materials of all libraries, by name."""
    entries: dict[str, ClothTable | ShellMaterial] = {}
    for library in TABLE_LIBRARIES:
        for name, row in _read_library(library)["tables"].items():
            entries[name] = ClothTable(
                **{key: row[key] for key in ("density", "c11", "c12", "c22", "c33")},
                bending=tuple(row["bending"]),
                measured=row.get("measured", True),
            )
    for library in ISOTROPIC_LIBRARIES:
        for name, row in _read_library(library)["isotropic"].items():
            areal = row["density"] * row["thickness"]
            entries[name] = isotropic_shell(row["young"], row["poisson"], row["thickness"], areal)
    return entries


def material_names() -> list[str]:
    """The values of the scene key ``cloth``, sorted."""
    return sorted(library_entries())


def measured_names() -> list[str]:
    """The names of fabrics whose stiffness was measured at several strains, sorted."""
    return [name for name in material_names() if getattr(library_entries()[name], "measured", False)]


def isotropic_names() -> list[str]:
    """The names of engineering materials, sorted."""
    return [name for name in material_names() if is_isotropic(name)]


def is_isotropic(name: object) -> bool:
    """Whether ``name`` is that of an engineering material of the library."""
    return isinstance(name, str) and isinstance(library_entries().get(name), ShellMaterial)


def resolve_material(
    material: Material, *, file: object | None = None, key: str = "material"
) -> tuple[ShellMaterial, list[str]]:
    """Constants of one material block, with all conventions and factors applied.

    Parameters
    ----------
    material : scene.material_block.Material
    file, key : optional
        File and key of the block, for messages.

    Returns
    -------
    ShellMaterial
    list of str
        Notes for the user, one line each, as on a stiffness that had to be changed.

    Raises
    ------
    InputError
        Numbers that overflow or underflow, or friction in bending without bending stiffness.
    """
    notes: list[str] = []
    name = key
    if material.cloth is not None:
        entry = library_entries()[material.cloth]
        if isinstance(entry, ClothTable):
            shell, notes = shell_of_table(entry, material.cloth)
        else:
            shell = entry
        name = material.cloth
    else:
        assert material.density is not None
        if (c := material.membrane) is not None:
            shell = ShellMaterial(material.density, c.c11, c.c12, c.c22, c.c33)
        elif material.young is None:  # the law is by curves, which set the membrane stiffness below
            shell = ShellMaterial(material.density, 1.0, 0.0, 1.0, 1.0)
        else:
            assert material.poisson is not None
            assert material.thickness is not None
            shell = isotropic_shell(material.young, material.poisson, material.thickness, material.density)
        shell = _with_bending(shell, material.bending)
    if material.bending_model == "midedge":
        shell, more = _with_plate(shell, name)
        notes += more
    if not isinstance(material.law, str):
        curves = material.law.warp, material.law.weft, material.law.shear
        c11, c22, c33 = (float(interpolation(points)[0, 2]) for points in curves)
        shell = replace(shell, c11=c11, c12=0.0, c22=c22, c33=c33, curves=curves)
        strain = max(points[-1][0] for points in curves)
        if strain > 1.0:
            notes.append(f"{key}.law: strains up to {strain:g}; if they are percent, give fractions")
    shell = _scaled(_with_friction(shell, material), material)
    if material.stretch_limit is not None:
        shell = replace(shell, stretch_limit=material.stretch_limit)
    if material.yield_curvature is not None:
        # a fibre yields at a strain, which is half the thickness times the curvature
        curvature = material.yield_curvature / material.thicken
        shell = replace(shell, yield_curvature=curvature, hardening=material.hardening)
    for present, name in (
        (max(shell.friction_moment) > 0.0, "friction_moment"),
        (math.isfinite(shell.yield_curvature), "yield_curvature"),
    ):
        if present and not shell.bends_with(shell.model):
            raise InputError(
                f"{name} needs a bending stiffness; give bending, too", file=file, key=f"{key}.{name}"
            )
    numbers = (shell.density, shell.c11, shell.c12, shell.c22, shell.c33, *shell.bending, *shell.plate)
    frictions = *shell.friction_moment, shell.friction_force
    if not all(math.isfinite(value) for value in (*numbers, *frictions)):
        raise InputError("numbers too large: stiffness or density is not finite", file=file, key=key)
    if min(shell.density, shell.c11, shell.c22, shell.c33) <= 0.0:
        raise InputError("numbers too small: stiffness or density vanishes", file=file, key=key)
    return shell, notes


def shell_of_table(table: ClothTable, name: str) -> tuple[ShellMaterial, list[str]]:
    """Constants of a measured cloth, and notes; see the module's conventions.

    If the stiffness is not positive definite, the eigenvalues of [[c11, c12], [c12, c22]] are raised to at
    least `PROJECTION_FLOOR` times the largest: the nearest such matrix in the Frobenius norm. Else a negative
    c12 is kept.
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


def isotropic_shell(young: float, poisson: float, thickness: float, density: float) -> ShellMaterial:
    """Constants of an isotropic sheet in plane stress; young [Pa], thickness [m], areal density [kg/m²]."""
    stretch = young * thickness / (1 - poisson**2)
    shear = young * thickness / (2 * (1 + poisson))
    bend = stretch * thickness * thickness / 12
    plate = (bend, poisson * bend, bend, 0.5 * (1 - poisson) * bend)
    return ShellMaterial(density, stretch, poisson * stretch, stretch, shear, (bend, bend, bend), plate=plate)


def _with_plate(shell: ShellMaterial, name: str) -> tuple[ShellMaterial, list[str]]:
    """``shell`` with the model ``midedge`` and a plate stiffness, if it has none from B; and notes."""
    shell = replace(shell, model="midedge")
    at_0, at_45, at_90 = shell.bending
    if shell.plate[0] > 0.0 or max(shell.bending) <= 0.0:
        return shell, []
    twist = at_45 - 0.25 * (at_0 + at_90)
    # smallest d33 of a measured cloth, a tenth of √(d11 d22)
    minimum = 0.1 * math.sqrt(at_0 * at_90)
    notes = []
    if twist < minimum:
        notes.append(
            f"{name}: B at 0°, 45°, 90° = {at_0:.4g}, {at_45:.4g}, {at_90:.4g} N·m make d33 = {twist:.4g} "
            f"N·m; raised to {minimum:.4g} N·m"
        )
        twist = minimum
    return replace(shell, plate=(at_0, 0.0, at_90, twist)), notes


GF_PER_CM = 0.980665
"""N/m"""


def _with_friction(shell: ShellMaterial, material: Material) -> ShellMaterial:
    """``shell`` with friction, and with the numbers of a KES report."""
    # smallest friction moment of warp or weft over that of the other, if only one is given
    min_friction = 1e-3
    moment, force = material.friction_moment or (0.0, 0.0), material.friction_force or 0.0
    if (kes := material.kes) is not None:
        if kes.B is not None:
            warp, weft = (1e-4 * GF_PER_CM * b for b in kes.B)
            mean = 0.5 * (warp + weft)
            # a hinge whose edge is along the warp bends the weft
            shell = replace(shell, bending=(weft, mean, warp))
            if shell.model == "midedge":
                shell = replace(shell, plate=(warp, 0.0, weft, 0.5 * mean))
        if kes.width_of_bending is not None:
            warp, weft = (0.5e-2 * GF_PER_CM * m for m in kes.width_of_bending)
            moment = warp, weft
        if kes.G is not None:
            shell = replace(shell, c33=math.degrees(0.5 * sum(kes.G)) * GF_PER_CM)
        if kes.width_of_shear is not None:
            force = 0.25 * sum(kes.width_of_shear) * GF_PER_CM
    if (moment[0] > 0.0) != (moment[1] > 0.0):
        moment = max(moment[0], min_friction * moment[1]), max(moment[1], min_friction * moment[0])
    return replace(shell, friction_moment=moment, friction_force=force)


def _with_bending(shell: ShellMaterial, bending: float | Triple | PlateStiffness | None) -> ShellMaterial:
    """``shell`` with the bending stiffness of a scene, if that has one."""
    if bending is None:
        return shell
    if isinstance(bending, float):
        bending = bending, bending, bending
    if isinstance(bending, tuple):
        return replace(shell, bending=bending)
    return replace(shell, plate=(bending.d11, bending.d12, bending.d22, bending.d33))


def _projected(c11: float, c12: float, c22: float) -> Triple:
    """c11, c12, c22 with both eigenvalues of [[c11, c12], [c12, c22]] at least the floor."""
    mean, half_difference = (c11 + c22) / 2, (c11 - c22) / 2
    radius = math.hypot(half_difference, c12)
    largest = mean + radius
    smallest = max(mean - radius, PROJECTION_FLOOR * largest)
    new_mean, new_radius = (largest + smallest) / 2, (largest - smallest) / 2
    cosine, sine = half_difference / radius, c12 / radius
    return new_mean + new_radius * cosine, new_radius * sine, new_mean - new_radius * cosine


def _scaled(shell: ShellMaterial, material: Material) -> ShellMaterial:
    thicken = material.thicken
    stretch = material.stretching_scale * thicken
    # a power would raise OverflowError; a product becomes inf, which `resolve_material` refuses
    bend = material.bending_scale * thicken * thicken * thicken
    at_0, at_45, at_90 = (b * bend for b in shell.bending)
    d11, d12, d22, d33 = (d * bend for d in shell.plate)
    return replace(
        shell,
        density=shell.density * material.density_scale * thicken,
        law=material.law if isinstance(material.law, str) else "curves",
        cloth=material.cloth or "",
        stretching=stretch,
        c11=shell.c11 * stretch,
        c12=shell.c12 * stretch,
        c22=shell.c22 * stretch,
        c33=shell.c33 * stretch,
        bending=(at_0, at_45, at_90),
        plate=(d11, d12, d22, d33),
        friction_moment=(shell.friction_moment[0] * bend, shell.friction_moment[1] * bend),
        friction_force=shell.friction_force * stretch,
        damping=material.damping,
        warp_degrees=material.warp_degrees,
        rest_curvature=material.rest_curvature,
    )
