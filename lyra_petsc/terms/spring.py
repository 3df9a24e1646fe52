"""Soft handles: springs of k N/m per vertex and axis towards the handle's moving target.

    energy = ½ k s(t) |x − x*(t)|²     over the held axes; s fades after release

(the original Lyra's handles: k = 1000 N/m, implicit, undamped). A handle that is an exact constraint
and fades becomes such a spring while it fades.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.handles.motion import Motion, Window, motion_of
from lyra_petsc.meshing.select import select_vertices
from lyra_petsc.partition.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Pulling

Array = NDArray[np.float64]

ORIGINAL_STIFFNESS = 1000.0
"""[N/m], of the original program; what a fading exact handle takes."""


class Spring(Pulling):
    """Springs of all soft or fading handles.

    Parameters
    ----------
    elements : Elements
        Stencil (E, 1); data ``handle`` (E,) number of the handle, ``stiffness`` (E, 3) [N/m] per axis.
    handles : mapping of handle number → (Motion, Window, only while fading)
    """

    name = "spring"
    damped = False

    def __init__(self, elements: Elements, handles: dict[int, tuple[Motion, Window, bool]]) -> None:
        super().__init__(elements)
        self._handle = elements.data["handle"].astype(np.int64)
        self._handles = handles
        self._start = np.zeros((self.n_elements, 3))
        self._target = np.zeros((self.n_elements, 3))
        self._k = np.zeros((self.n_elements, 3))

    def begin(self, time: float, x: Array) -> None:
        for number, (_, window, _) in self._handles.items():
            if window.start == time:
                mine = self._handle == number
                self._start[mine] = x[self.stencil[mine, 0]]

    def prepare(self, t0: float, t1: float, at: float) -> None:
        for number, (motion, window, fading_only) in self._handles.items():
            mine = self._handle == number
            strength = 0.0 if fading_only and window.holds(t0, t1) else window.strength(t0, t1, at)
            self._k[mine] = strength * self.elements.data["stiffness"][mine]
            if strength > 0.0:
                self._target[mine] = motion.carried(self._start[mine], window.start, at)

    def _pull(self, x: Array) -> Array:
        change: Array = x[self.stencil[:, 0]] - self._target
        return change

    def energies(self, x: Array) -> Array:
        energy: Array = 0.5 * (self._k * self._pull(x) ** 2).sum(axis=1)[: self.n_owned]
        return energy

    def handle_forces(self, x: Array, count: int) -> Array:
        forces = np.zeros((count, 3))
        n = self.n_owned
        np.add.at(forces, self._handle[:n], -(self._k * self._pull(x))[:n])
        return forces

    def add_gradient(self, x: Array, out: Array) -> None:
        np.add.at(out, self.stencil[:, 0], self._k * self._pull(x))

    def hessians(self, x: Array, lo: int, hi: int, blend: float, out: Array) -> None:
        out[:] = 0.0
        for axis in range(3):
            out[:, 0, 0, axis, axis] = self._k[lo:hi, axis]

    def force_scale(self, size: float) -> Array:
        # of the full stiffness: the scale is asked for before the first step
        scale: Array = self.elements.data["stiffness"].max(axis=1) * size
        return scale


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
