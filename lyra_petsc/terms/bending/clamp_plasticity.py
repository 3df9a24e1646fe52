"""Plastic bending of the half hinges at clamped edges, as of the hinges between triangles."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.element import kernel
from lyra_petsc.kernels.vector3 import point
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.bending.dihedral_angle import angle
from lyra_petsc.terms.bending.hinge_clamp import Clamp, Mirrors, clamping_handles, whole_clamps
from lyra_petsc.terms.bending.hinge_plasticity import PlasticAngles, yielding
from lyra_petsc.terms.handles.motion import Motion, Window
from lyra_petsc.terms.rest import RestShape


@kernel()
def angles(x, s, mirror, out):  # type: ignore[no-untyped-def]
    """Write the angles [rad] between the triangles of edges and their mirror images into out (E,)."""
    for e in range(out.shape[0]):
        x0, x1, x2, x3 = point(x, s[e, 0]), point(x, s[e, 1]), point(x, s[e, 2]), point(mirror, e)
        out[e] = angle(x0, x1, x2, x3)[0]


class ClampPlasticity(PlasticAngles, Clamp):
    """The clamped edges that may yield; parameters as of `Clamp` and `PlasticAngles`."""

    def __init__(self, elements: Elements, handles: dict[int, tuple[Motion, Window]]) -> None:
        super().__init__(elements, handles)
        self._start(elements)

    def angles_at(self, x: Array, frozen: Mirrors) -> Array:
        out = np.empty(self.n_elements)
        angles(x, self.stencil, frozen.mirror, out)
        return np.where(frozen.k > 0.0, out, self.bent)

    def law(self, x: Array, frozen: Mirrors, convexity: float | None = None) -> tuple[Array, Array]:
        return self.law_at(self.angles_at(x, frozen), convexity)

    def initialise(self, x: Array) -> None:
        """Handles begin at the start shape: nothing has yielded."""


def elements(rest: RestShape) -> Elements:
    """The clamped edges whose material yields (rank 0)."""
    clamps, triangle = whole_clamps(rest)
    return yielding(clamps, triangle, rest, 2.0 * clamps.data["height"])


def make(elements: Elements, scene: Scene, mass: Array) -> ClampPlasticity:
    """The term on one rank."""
    return ClampPlasticity(elements, clamping_handles(scene))
