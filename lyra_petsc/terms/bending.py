"""Bending: one hinge per interior edge.

Per hinge with rest edge length l, rest areas A0 and A1, rest angle θ̄::

    energy = k (θ − θ̄)²,   k = B l² / (2 (A0 + A1))

Source: Grinspun et al., Discrete Shells, SCA 2003, with the stiffness calibrated so that B [N·m] is
the cylindrical bending stiffness on meshes whose lines run along the bend (k ‖ē‖/h̄ with k = B/6).
"""

from __future__ import annotations

import numpy as np
from lyra_petsc.terms.kernel import kernel
from numpy.typing import NDArray

from lyra_petsc.terms.elements import Elements
from lyra_petsc.terms.hinge import angle, angle_gradient, angle_hessian, point
from lyra_petsc.terms.term import Elastic

Array = NDArray[np.float64]


@kernel()
def angles(x, s, n, out):  # type: ignore[no-untyped-def]
    """Dihedral angle [rad] of the first n hinges into out (n,)."""
    for e in range(n):
        out[e] = angle(point(x, s[e, 0]), point(x, s[e, 1]), point(x, s[e, 2]), point(x, s[e, 3]))


@kernel()
def add_gradient(x, s, k, rest, out):  # type: ignore[no-untyped-def]
    """Add the energy's gradient [N] to out (n_local, 3)."""
    g = np.empty((4, 3))
    for e in range(s.shape[0]):
        x0, x1, x2, x3 = point(x, s[e, 0]), point(x, s[e, 1]), point(x, s[e, 2]), point(x, s[e, 3])
        theta = angle_gradient(x0, x1, x2, x3, g)
        moment = 2.0 * k[e] * (theta - rest[e])
        for a in range(4):
            for i in range(3):
                out[s[e, a], i] += moment * g[a, i]


@kernel()
def hessians(x, s, lo, hi, exact, k, rest, out):  # type: ignore[no-untyped-def]
    """Hessian blocks [N/m] of hinges lo..hi into out (hi − lo, 4, 4, 3, 3)."""
    g = np.empty((4, 3))
    h = np.empty((4, 4, 3, 3))
    for e in range(lo, hi):
        x0, x1, x2, x3 = point(x, s[e, 0]), point(x, s[e, 1]), point(x, s[e, 2]), point(x, s[e, 3])
        theta = angle_gradient(x0, x1, x2, x3, g)
        stiffness = 2.0 * k[e]
        o = out[e - lo]
        for a in range(4):
            for b in range(4):
                for i in range(3):
                    for j in range(3):
                        o[a, b, i, j] = stiffness * g[a, i] * g[b, j]
        if exact:
            moment = stiffness * (theta - rest[e])
            angle_hessian(x0, x1, x2, x3, h)
            for a in range(4):
                for b in range(4):
                    for i in range(3):
                        for j in range(3):
                            o[a, b, i, j] += moment * h[a, b, i, j]


class Bending(Elastic):
    """The bending energy of all hinges.

    Parameters
    ----------
    elements : Elements
        Stencil (E, 4) as in ``hinge``; data ``k`` (E,) [N·m], ``rest_angle`` (E,) [rad],
        ``rest_height`` (E,) sum of the two heights on the edge [m], ``damping`` (E,) [s].
    """

    name = "bending"

    def __init__(self, elements: Elements) -> None:
        super().__init__(elements)
        self._k, self._rest = elements.data["k"], elements.data["rest_angle"]

    def angles(self, x: Array) -> Array:
        """Dihedral angles of the owned hinges [rad], (n_owned,)."""
        out = np.empty(self.n_owned)
        angles(x, self.stencil, self.n_owned, out)
        return out

    def energies(self, x: Array) -> Array:
        change: Array = self.angles(x) - self._rest[: self.n_owned]
        return self._k[: self.n_owned] * change * change

    def add_gradient(self, x: Array, out: Array) -> None:
        add_gradient(x, self.stencil, self._k, self._rest, out)

    def hessians(self, x: Array, lo: int, hi: int, exact: bool, out: Array) -> None:
        hessians(x, self.stencil, lo, hi, exact, self._k, self._rest, out)

    def force_scale(self) -> Array:
        scale: Array = self._k / self.elements.data["rest_height"]
        return scale
