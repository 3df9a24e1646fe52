"""Soft handles: springs of k N/m per vertex and axis towards the handle's moving target.

    energy = ½ k s(t) |x − x*(t)|²     over the held axes; s fades after release

(as in the original Lyra: k = 1000 N/m, implicit, undamped). An exact handle that fades is replaced by such a
spring while it fades.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.select import select_vertices
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.handles.motion import Motion, Window, motion_of
from lyra_petsc.terms.protocols import PullsHandles
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import UpcomingStep

ORIGINAL_STIFFNESS = 1000.0
"""Stiffness [N/m] of the original Lyra, which exact handles have while they fade."""


class HandleSprings(NamedTuple):
    """Springs in one step.

    Attributes
    ----------
    target : (E, 3)
        Target positions [m].
    stiffness : (E, 3)
        Stiffness per axis [N/m]; 0 where a spring does not act.
    """

    target: Array
    stiffness: Array


class Spring(PullsHandles):
    """Springs of all soft or fading handles.

    Parameters
    ----------
    elements : Elements
        Stencil (E, 1); data ``handle`` (E,) number of the handle, ``stiffness`` (E, 3) [N/m] per axis.
    handles : mapping of handle number → (Motion, Window, bool)
        The last tells whether the springs act only while the handle fades.
    """

    def __init__(self, elements: Elements, handles: dict[int, tuple[Motion, Window, bool]]) -> None:
        super().__init__(elements)
        self._handle = elements.data["handle"].astype(np.int64)
        self._handles = handles

    @property
    def reference_rows(self) -> NDArray[np.int64]:
        return self.stencil[:, 0].astype(np.int64)

    def freeze(self, step: UpcomingStep) -> HandleSprings:
        target, stiffness = np.zeros((self.n_elements, 3)), np.zeros((self.n_elements, 3))
        for number, (motion, window, fading_only) in self._handles.items():
            mine = self._handle == number
            holds = window.holds(step.start, step.end)
            strength = (
                0.0 if fading_only and holds else window.strength(step.start, step.end, step.target_time)
            )
            if strength > 0.0:
                stiffness[mine] = strength * self.elements.data["stiffness"][mine]
                start = step.reference(window.start, self.stencil[mine, 0].astype(np.int64))
                target[mine] = motion.moved(start, window.start, step.target_time)
        return HandleSprings(target, stiffness)

    def _elongation(self, x: Array, frozen: HandleSprings) -> Array:
        return x[self.stencil[:, 0]] - frozen.target

    def energies(self, x: Array, frozen: HandleSprings) -> Array:
        return 0.5 * (frozen.stiffness * self._elongation(x, frozen) ** 2).sum(axis=1)[: self.n_owned]

    def handle_forces(self, x: Array, frozen: HandleSprings, count: int) -> Array:
        forces = np.zeros((count, 3))
        n = self.n_owned
        np.add.at(forces, self._handle[:n], -(frozen.stiffness * self._elongation(x, frozen))[:n])
        return forces

    def add_gradient(self, x: Array, frozen: HandleSprings, out: Array) -> None:
        np.add.at(out, self.stencil[:, 0], frozen.stiffness * self._elongation(x, frozen))

    def hessians(
        self, x: Array, frozen: HandleSprings, lo: int, hi: int, convexity: float, out: Array
    ) -> None:
        out[:] = 0.0
        for axis in range(3):
            out[:, 0, 0, axis, axis] = frozen.stiffness[lo:hi, axis]

    def force_scale(self, size: float) -> Array:
        # not ``frozen.stiffness``, since the scale is needed before the first step
        return self.elements.data["stiffness"].max(axis=1) * size


def elements(rest: RestShape) -> Elements:
    """The vertices of all soft and all fading handles (rank 0)."""
    stencils, numbers, stiffnesses = [], [], []
    for number, handle in enumerate(rest.scene.handles):
        if handle.stiffness is None and handle.fade == 0.0:
            continue
        chosen = select_vertices(rest.mesh, handle, key=f"handles[{number}]", file=rest.scene.source)
        k = np.zeros(3)
        k[list(handle.axis_numbers)] = ORIGINAL_STIFFNESS if handle.stiffness is None else handle.stiffness
        stencils.append(chosen)
        numbers.append(np.full(len(chosen), float(number)))
        stiffnesses.append(np.tile(k, (len(chosen), 1)))
    data = {"handle": np.concatenate(numbers), "stiffness": np.concatenate(stiffnesses)}
    return Elements(np.concatenate(stencils)[:, None], data)


def make(elements: Elements, scene: Scene, mass: Array) -> Spring:
    """The term on one rank."""
    handles = {
        number: (motion_of(scene, number), Window.of(handle), handle.stiffness is None)
        for number, handle in enumerate(scene.handles)
        if handle.stiffness is not None or handle.fade > 0.0
    }
    return Spring(elements, handles)
