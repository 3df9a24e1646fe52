"""Pressure: force p a n / 3 on each vertex of a triangle, along its current normal.

The current area a and normal n are those at the start of the step, as for wind, so that the Jacobian is
symmetric.
"""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.element import kernel
from lyra_petsc.kernels.vector3 import area_normal, scaled
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.select import select_triangles
from lyra_petsc.mesh.topology import connected_pieces, enclosed_volumes
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.time_curve import largest
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import UpcomingStep, WindowedLoad


@kernel()
def add_force(x, s, pressure, out):  # type: ignore[no-untyped-def]
    """Add the force [N] of ``pressure`` (E,) [Pa] to out (n_local, 3)."""
    for e in range(s.shape[0]):
        fx, fy, fz = scaled(pressure[e] / 6.0, area_normal(x, s, e))
        for k in range(3):
            i = s[e, k]
            out[i, 0] += fx
            out[i, 1] += fy
            out[i, 2] += fz


class Pressure(WindowedLoad):
    """The pressures of all loads: stencil (E, 3)."""

    is_follower = True

    def add_force(self, step: UpcomingStep, out: Array) -> None:
        add_force(step.x, self.stencil, self.values(step), out)


def elements(rest: RestShape) -> Elements:
    """The triangles under each pressure load (rank 0)."""
    stencils, loads = [], []
    for number, load in enumerate(rest.scene.loads):
        if load.pressure is not None:
            chosen = select_triangles(
                rest.mesh, load.group, key=f"loads[{number}].group", file=rest.scene.source
            )
            triangles = rest.mesh.triangles[chosen]
            volumes = enclosed_volumes(rest.mesh.positions, triangles, connected_pieces(triangles))
            pressure = largest(load.pressure)
            if pressure and volumes.min(initial=0.0) < 0.0:
                effect = "compress" if pressure > 0.0 else "inflate"
                rest.notes.append(
                    f"loads[{number}].pressure: the normals of a closed surface point inwards, so that "
                    f"{pressure:g} Pa {effect} it; {-pressure:g} would do the opposite"
                )
            stencils.append(triangles)
            loads.append(np.full(len(chosen), float(number)))
    return Elements(np.concatenate(stencils), {"load": np.concatenate(loads)})


def make(elements: Elements, scene: Scene, mass: Array) -> Pressure:
    """The load on one rank."""
    return Pressure(elements, scene, "pressure")
