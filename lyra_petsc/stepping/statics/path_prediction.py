"""First guesses of a load step from the equilibria before it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.newton.extrapolation import Extrapolation
from lyra_petsc.stepping.stage_equations import StageEquations

if TYPE_CHECKING:
    from lyra_petsc.stepping.statics.whole_stiffness import WholeStiffness

HANDLE_STEP = 1e-6
"""Displacement of handles, over the mean edge length, in a finite difference of forces."""


class PathPrediction:
    """Extrapolation of the last equilibria, and the tangent dx/dλ of the path of equilibria; collective.

    Parameters
    ----------
    equations : StageEquations
    tangent : callable
        As `Stepper.tangent`.
    whole_stiffness : WholeStiffness or None
        That of loads which follow the shape, if there are any.
    spacing : float
        Mean edge length [m].
    """

    def __init__(
        self,
        equations: StageEquations,
        tangent: Callable[[Array], tuple[Array | None, int]],
        whole_stiffness: WholeStiffness | None,
        spacing: float,
    ) -> None:
        self._equations, self._response, self._spacing = equations, tangent, spacing
        self._whole_stiffness = whole_stiffness
        self.forget()
        # load factor λ of the last equilibrium, change of the loads over that of λ [N], and dx/dλ [m]
        self._last_factor, self._load_rate = 0.0, np.zeros((equations.points.n_owned, 3))

    def forget(self) -> None:
        """Predict nothing from the equilibria so far."""
        self._extrapolation = Extrapolation(self._equations.points.comm)
        self._tangent: Array | None = None

    def record(self, factor: float) -> None:
        """Note that the present state is the equilibrium at a load factor, its tangent not yet known."""
        self._last_factor, self._tangent = factor, None

    def extrapolated(self, before: float, factor: float) -> Array:
        """Positions (n_owned, 3) [m] extrapolated to a load factor from the equilibrium at ``before``."""
        owned = self._equations.x[: self._equations.points.n_owned].copy()
        return self._extrapolation.extrapolate(factor, before, owned)

    def along_tangent(self, before: float, factor: float) -> list[Array]:
        """Displacements (n_owned, 3) [m] along the tangent, at the start of a load step."""
        if before != self._last_factor or factor == before:
            return []
        self._load_rate = self._equations.out_of_balance() / (factor - before)
        if self._tangent is None:
            return []
        return self._extrapolation.tangent_predictions(factor, self._tangent)

    def linear_displacement(self, before: float, factor: float) -> Array | None:
        """Displacement (n_owned, 3) [m] by the tangent alone, if it is known."""
        return None if self._tangent is None else (factor - before) * self._tangent

    def compute_tangent(self, start: Array, before: float, factor: float) -> int:
        """Compute the tangent of the equilibrium just found; returns linear iterations.

        Loads are assumed to change further as in this load step, and handles to move further as from
        positions ``start`` (n_owned, 3) [m].
        """
        equations, n, step = self._equations, len(start), factor - before
        if equations.near or step == 0.0:
            return 0  # the first guess is another
        moved = np.where(equations.step.prescribed.free, 0.0, equations.x[:n] - start)
        (largest,) = equations.points.global_max(float(np.abs(moved).max(initial=0.0)))
        rate = self._load_rate
        if largest > 0.0:
            x, v, part = equations.x[:n], equations.v[:n], HANDLE_STEP * self._spacing / largest
            here = equations.out_of_balance()
            equations.state.set(x + part * moved, v)
            equations.change()
            rate = rate + (equations.out_of_balance() - here) / (part * step)
            equations.state.set(x, v)
            equations.change()
        if self._whole_stiffness is None:
            self._tangent, iterations = self._response(rate)
        else:
            loads = self._whole_stiffness.linearise_loads(before, factor)
            self._tangent, iterations = self._whole_stiffness.tangent(rate, loads)
        if self._tangent is not None:
            self._tangent += moved / step
        return iterations

    def saved_state(self, factor: float) -> tuple[dict[str, Array], dict[str, Any]]:
        """Arrays (n_owned, 3) and numbers of a checkpoint at the equilibrium at ``factor``."""
        equations = self._equations
        self._extrapolation.record(factor, equations.x[: equations.points.n_owned].copy())
        arrays, numbers = self._extrapolation.saved_state()
        return arrays if self._tangent is None else arrays | {"rate": self._tangent}, numbers

    def restore(self, arrays: Mapping[str, Array], numbers: Mapping[str, float], factor: float) -> None:
        """Restore a `saved_state`."""
        self._last_factor = factor
        self._tangent = np.array(arrays["rate"]) if "rate" in arrays else None
        x = self._equations.x[: self._equations.points.n_owned].copy()
        self._extrapolation.restore(arrays, numbers, factor, x)
