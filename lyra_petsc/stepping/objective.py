"""The function that a step minimises, whose gradient is the residual, and its round-off."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.state import kinetic_energy
from lyra_petsc.terms.term import Term

if TYPE_CHECKING:
    from lyra_petsc.stepping.stage_equations import StageEquations


class Objective:
    """Called with velocities v (n_owned, 3) of the stage; collective.

    The last two values are kept, because the end of a line search and the first guess are evaluated twice.
    """

    def __init__(self, system: StageEquations) -> None:
        self._system = system
        self._kept: list[tuple[Array, tuple[float, float]]] = []
        self._size = 0.0

    def begin_step(self) -> None:
        """Drop kept values, and take the largest coordinate from the state at the start of the step."""
        self.forget()
        self._size = float(np.abs(self._system.x).max(initial=0.0))

    def forget(self) -> None:
        """Drop kept values, after the equations have changed."""
        self._kept = []

    def __call__(self, v: Array) -> tuple[float, float]:
        """Value of the function, and the scale to which its round-off is relative, both [W]; collective.

        The scale is the sum of the absolute summands and of the geometric mean of each elastic energy and the
        energy at which strains are of order one: small strains are small differences of large coordinates.
        """
        if self._kept:
            same = np.array([int(np.array_equal(v, at)) for at, _ in self._kept])
            self._system.points.comm.Allreduce(MPI.IN_PLACE, same, MPI.MIN)
            if same.any():
                return self._kept[int(same.argmax())][1]
        result = self._computed(v)
        self._kept = [*self._kept[-1:], (v.copy(), result)]
        return result

    def _computed(self, v: Array) -> tuple[float, float]:
        of = self._system
        n, sigma, rate = of.points.n_owned, of.stage.sigma, 1.0 / of.stage.c
        x, vs = of.evaluate_at(v)
        parts, square = [sigma * kinetic_energy(of.mass, v - of.history)], 0.0
        for term in of.active.elastic:
            if not term.n_elements:
                continue
            each = term.energies(x, of.active.frozen[term])
            parts.append(rate * float(each.sum()))
            stiffness = self.stiffnesses.get(term)
            if stiffness is None:
                stiffness = term.stiffness(x, of.active.frozen[term])[: term.n_owned]
            sizes = term.coordinate_scale(self._size)
            of_size = rate * (sizes if isinstance(sizes, float) else sizes[: term.n_owned])
            # `**` would raise an error where the square is infinite
            square += 2.0 * float(np.vdot(each, stiffness * (of_size * of_size)))
        parts.append(-rate * float(np.vdot(of.applied.force, x[:n] - of.x[:n])))
        if of.applied.following is not None:
            parts.append(rate * of.applied.following.energy(x))
        if of.damping.active:
            parts.append(0.5 * float(np.vdot(v, of.damping.product(vs))))
        if not of.integrator.lagged_loads:
            parts += [float(wind.potentials(vs, of.active.frozen[wind]).sum()) for wind in of.active.viscous]
        value, size, square = of.points.global_sum(sum(parts), sum(abs(part) for part in parts), square)
        return float(value), float(size) + float(np.sqrt(square))

    @cached_property
    def stiffnesses(self) -> dict[Term, Array]:
        """Force over displacement [N/m] of the owned elements of each term whose stencils stay."""
        fixed = [term for term in self._system.active.elastic if not term.registration.of_contact]
        return {term: term.force_scale(1.0)[: term.n_owned] for term in fixed}
