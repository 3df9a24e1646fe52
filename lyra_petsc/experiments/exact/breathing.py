"""One equilateral triangle that breathes: a large, nonlinear oscillation in closed form.

With circumradius R, areal density ρ and c11 = c22, a start stretched by λ₀ in all directions stays
equilateral; the strain is (λ² − 1)/2 in every direction, the energy A (c11 + c12)(λ² − 1)²/4, the
kinetic energy ρ A R² λ'²/2 with lumped masses, hence (Duffing)::

    λ'' = −k (λ³ − λ),   k = (c11 + c12) / (ρ R²)
    λ = a dn(a √(k/2) t, m),   m = 2 − 2/a²,   a the largest stretch, 1 < a < √2

(dn: Jacobi's elliptic function; DLMF 22.13.15). Released at its smallest stretch it starts half a
period later.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.exact.body import SAME, Body
from lyra_petsc.experiments.exact.motion import Energies, Motion

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Breathing(Motion):
    """See the module.

    Attributes
    ----------
    centre : (3,) [m]
    first, largest : float
        Stretch at t = 0, and the largest ever.
    rate : float [1/s²]
        k.
    stiffness : float [J]
        A (c11 + c12).
    """

    centre: tuple[float, float, float]
    first: float
    largest: float
    rate: float
    stiffness: float

    def stretch(self, t: float) -> float:
        """λ at t [s]."""
        from scipy.special import ellipj, ellipk

        m = 2.0 - 2.0 / self.largest**2
        begin = 0.0 if self.first >= 1.0 else float(ellipk(m))
        return self.largest * float(ellipj(self.largest * math.sqrt(0.5 * self.rate) * t + begin, m)[2])

    def positions(self, start: Array, t: float) -> Array:
        """Scaled about the centre."""
        centre = np.asarray(self.centre)
        return np.asarray(centre + (start - centre) * (self.stretch(t) / self.first))

    def energies(self, t: float) -> Energies:
        """Kinetic energy from the conserved sum."""
        whole = 0.25 * self.stiffness * (self.first**2 - 1.0) ** 2
        membrane = 0.25 * self.stiffness * (self.stretch(t) ** 2 - 1.0) ** 2
        return Energies(whole - membrane, membrane, 0.0)


def obstacles(body: Body) -> list[str]:
    """What of a scene contradicts a breathing triangle, in words."""
    if body.mesh.n_triangles != 1:
        return [f"{body.mesh.n_triangles} triangles instead of one"]
    found = body.forced()
    if body.gravity.any():
        found.append("gravity")
    if body.has_wind:
        found.append("wind")
    if body.start_velocity.any():
        found.append("initial.velocity")
    shell = body.rest.shells[int(body.rest.shell_of[0])]
    if abs(shell.c11 - shell.c22) > SAME * shell.c11:
        found.append("c11 and c22 that differ")
    if shell.damping > 0.0:
        found.append("damping")
    sides = np.linalg.norm(body.mesh.triangle_uv[0] - np.roll(body.mesh.triangle_uv[0], -1, axis=0), axis=1)
    if np.ptp(sides) > SAME * sides.max():
        found.append("a triangle that is not equilateral")
    stretch = body.stretch[0]
    if np.ptp(stretch) > SAME * stretch.max():
        found.append("a start that is not stretched alike in all directions")
    elif not 0.0 < stretch[0] < math.sqrt(2.0) or abs(stretch[0] - 1.0) < SAME:
        found.append("a start stretched by a factor that is 1, or √2 or more")
    return found


def breathing(body: Body) -> Motion:
    """The oscillation of the triangle."""
    shell = body.rest.shells[int(body.rest.shell_of[0])]
    first = float(body.stretch[0].mean())
    radius2 = float(((body.mesh.triangle_uv[0] - body.mesh.triangle_uv[0].mean(axis=0)) ** 2).sum() / 3.0)
    area = float(body.rest.area[0])
    centre = body.mesh.positions.mean(axis=0)
    return _Breathing(
        centre=(float(centre[0]), float(centre[1]), float(centre[2])),
        first=first,
        largest=first if first > 1.0 else math.sqrt(2.0 - first**2),
        rate=(shell.c11 + shell.c12) / (shell.density * radius2),
        stiffness=area * (shell.c11 + shell.c12),
    )
