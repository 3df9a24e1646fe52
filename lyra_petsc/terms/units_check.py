"""Figures that show whether the numbers of a scene are in the right units, and notes where they cannot be.

A homogeneous sheet of thickness h has the stiffnesses C = E h/(1 − ν²) and B = C h²/12, hence h = √(12 B/C),
the modulus C/h and the density ρ/h, with ρ per area. Cloths are softer in bending than such a sheet. All
materials of the library have 90 to 8,500 kg/m³ and 10 kPa to 0.2 TPa; the limits are far wider.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

import numpy as np

from lyra_petsc.scene.material_block import Material
from lyra_petsc.scene.materials.library import ShellMaterial
from lyra_petsc.scene.time_curve import acts, largest
from lyra_petsc.terms.rest import RestShape

LIGHTEST, LIGHTEST_CLOTH, DENSEST = 10.0, 22.0, 25e3
"""Density [kg/m³] of light foams, below that of the airiest knits, and above that of osmium."""

SOFTEST, STIFFEST = 500.0, 1e14
"""Modulus [Pa] below those of gels, and a hundred times that of diamond."""

HEAVY = 20.0
"""Areal density [kg/m²] above that of textiles."""

LARGEST = 100.0
"""Size [m] above which few sheets are made."""

STRETCHED = 2.0
"""Strain by its own weight that no sheet bears."""

STANDARD_GRAVITY = 9.81


@dataclass(frozen=True)
class Figures:
    """Figures of one material of a scene.

    Attributes
    ----------
    density : float [kg/m²]
    membrane, bending : float
        C [N/m] and B [N·m], geometric means of warp and weft.
    gravity : float [m/s²]
        Of the scene, or the standard one if it has none.
    yield_curvature : float [1/m]
        From which on the material bends plastically.
    """

    density: float
    membrane: float
    bending: float
    gravity: float
    yield_curvature: float = math.inf

    @classmethod
    def of(cls, shell: ShellMaterial, gravity: float) -> Figures:
        """The figures of a material."""
        warp, _, weft = shell.bending
        if shell.model == "midedge" and shell.plate[0] > 0.0:
            warp, _, weft, _ = shell.plate
        membrane, bending = math.sqrt(shell.c11) * math.sqrt(shell.c22), math.sqrt(warp) * math.sqrt(weft)
        return cls(shell.density, membrane, bending, gravity, shell.yield_curvature)

    @property
    def thickness(self) -> float:
        """Thickness [m] of a homogeneous sheet of these stiffnesses; 0 without bending stiffness."""
        return math.sqrt(12.0 * self.bending / self.membrane)

    @property
    def bending_length(self) -> float:
        """(B/w)^(1/3) [m], w the weight per area: the length over which the sheet bends by its weight."""
        weight = max(self.density * self.gravity, sys.float_info.min)
        return float((self.bending / weight) ** (1.0 / 3.0))

    def __str__(self) -> str:
        text = f"{self.density:.4g} kg/m²"
        if h := self.thickness:
            text += f", {self.density / h:.3g} kg/m³ if {1e3 * h:.3g} mm thick"
        text += f", bending length {1e3 * self.bending_length:.3g} mm"
        if math.isfinite(self.yield_curvature):
            text += f", keeps folds of less than {1e3 / self.yield_curvature:.3g} mm radius"
        return text

    def doubt(self, block: Material, size: float, *, weighs: bool) -> str:
        """What cannot be right, with the likely mistake; empty if nothing is wrong.

        Parameters
        ----------
        block : Material
            The material in the scene.
        size : float [m]
        weighs : bool
            Whether the mass has an effect.
        """
        h, isotropic = self.thickness, block.young is not None
        volume = self.density / h if h else math.inf
        if weighs and volume > DENSEST and (isotropic or self.density > HEAVY):
            text = f"{self.density:g} kg/m²" + (f" in {1e3 * h:.3g} mm" if h else "")
            if isotropic:
                return (
                    f"{text} is denser than any metal: density is per area; {self.density:g} kg/m³ times the "
                    f"thickness is {self.density * h:.3g} kg/m²"
                )
            return f"{text} is heavier than any cloth: {self.density:g} g/m² is {1e-3 * self.density:g} kg/m²"
        units = "bending in N·mm (1e-3 N·m) or gf·cm²/cm (1e-4 N·m), or membrane in N/mm (1e3 N/m)"
        if isotropic:
            units = "young in GPa or MPa (1e9 or 1e6 Pa), or thickness in mm (1e-3 m)"
        if weighs and volume < (LIGHTEST if isotropic else LIGHTEST_CLOTH):
            lighter = "foam" if isotropic else "cloth"
            return (
                f"{volume:.2g} kg/m³, if {1e3 * h:.3g} mm thick, is lighter than any {lighter}: is {units}?"
            )
        if h and self.membrane < SOFTEST * h:
            return f"a modulus of {self.membrane / h:.2g} Pa is softer than any gel: is {units}?"
        if h and self.membrane > STIFFEST * h:
            return (
                f"a modulus of {self.membrane / h:.2g} Pa is far stiffer than diamond: membrane is a modulus "
                "times the thickness [N/m], young is in Pa and thickness in m"
            )
        strain = self.density * self.gravity * size / self.membrane
        if weighs and strain > STRETCHED and size <= LARGEST:
            return f"it would stretch to {1.0 + strain:.2g} times its length by its own weight: is {units}?"
        return ""


def figures(rest: RestShape) -> list[Figures]:
    """The figures of all materials of a scene."""
    gravity = float(np.linalg.norm(largest(rest.scene.gravity))) or STANDARD_GRAVITY
    return [Figures.of(shell, gravity) for shell in rest.shells]


def unit_notes(rest: RestShape) -> list[str]:
    """Notes on numbers that are far outside of what materials and sheets have."""
    scene, notes = rest.scene, []
    size = float(np.linalg.norm(np.ptp(rest.mesh.positions, axis=0)))
    if size > LARGEST:
        notes.append(
            f"mesh: the sheet is {size:.4g} m large; if its file is in millimetres, give it "
            "transform: {scale: 0.001}"
        )
    weighs = not scene.time.static or acts(scene.gravity)
    for number, (block, figure) in enumerate(zip(scene.material, figures(rest), strict=True)):
        if doubt := figure.doubt(block, size, weighs=weighs):
            notes.append(f"material[{number}]: {doubt}" if len(scene.material) > 1 else f"material: {doubt}")
    return notes
