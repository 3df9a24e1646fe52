"""What the terms need to know of a material, with every convention already applied."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ShellMaterial:
    """Constants of one shell material, ready for the kernels.

    Attributes
    ----------
    density : float
        Areal density [kg/m²].
    c11, c12, c22, c33 : float
        Orthotropic St. Venant-Kirchhoff membrane stiffness [N/m]; energy per rest area is
        ½ (c11 E_uu² + 2 c12 E_uu E_vv + c22 E_vv² + c33 (2E_uv)²).
    bending : tuple of three floats
        Cylindrical bending stiffness B [N·m] for hinges whose rest edge lies at 0°, 45°, 90° to
        the warp; interpolated linearly in the angle. All three zero: no bending.
    damping : float
        γ [s] of stiffness-proportional damping.
    warp_degrees : float
        Rotation of the warp direction in the material plane, anticlockwise [°].
    rest_curvature : tuple of three floats or None
        κ11, κ22, κ12 [1/m] in the material axes.
    """

    density: float
    c11: float
    c12: float
    c22: float
    c33: float
    bending: tuple[float, float, float] = (0.0, 0.0, 0.0)
    damping: float = 0.0
    warp_degrees: float = 0.0
    rest_curvature: tuple[float, float, float] | None = None
