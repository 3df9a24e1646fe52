"""Energy guard: rejects steps in which the integrator creates energy.

The gain of a step is ::

    G = Δ(T + U + V) + D − W

with the kinetic energy T of the free coordinates, all elastic energies U (springs and clamps too), the
potential V of gravity, the heat D of material damping and the work W of handles, loads and wind.

W is computed by the trapezoidal rule: half the sum of the forces at both ends of the step, wind and pressure
with the geometry there, times the displacement. (With the integrator's own forces, at its stage, a run that
blows up balances, too.) If the velocity of the integrator's stage is not Δx/Δt, D
is the heat of uniform motion between the ends, with the geometry at its middle. It is the smallest heat that
any motion makes; after a start from rest, the heat at the stage is several times as large. G is compared with
the scale ::

    S = largest value so far of T + U + |V − V₀| + Σ|W| + ΣD

whose T includes the coordinates that handles drive: if these start gently, little else moves at first. T, V
and W are those of an observer who moves with the scene's initial velocity: a sheet whose surroundings drift
along with it is judged as one at rest. (Another observer finds another G, as the trapezoidal rule does not
give the change of momentum.) G < 0 is numerical dissipation, which is allowed and summed up.

Of loads that change in time by Δf at fixed positions and velocities, the trapezoidal rule leaves
Δt |Δf · Δv|/12 open, the difference to the integral for a velocity that is linear in time: at the start of a
ramp half of W. A gain within that is none.

Backward Euler has an identity instead, in which W is the work of the forces at the end of the step::

    Δ(T + U + V) + D − W = −½ ‖Δv‖²_M + bracket        bracket = U(x_{n+1}) − U(x_n) − ∇U(x_{n+1})·Δx

so that it gains energy only where U is not convex. Its steps are judged by the smaller of the two gains: if
air brakes a sheet within a step, the force at its start times the displacement exceeds the work by far.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.end_forces import EndForces, Gain
from lyra_petsc.stepping.energy_balance import EnergyBalance
from lyra_petsc.stepping.stage_equations import StageEquations

LARGEST_GAIN = 0.01
"""Gain of a step over S above which the step is repeated."""

LARGEST_SUM = 0.05
"""Sum of the gains since the start, or of the last `RECENT` steps, over S, above which a step is repeated."""

IMPACT_GAIN, IMPACT_SUM = 1e-3, 0.01
"""The same bounds for integrators of second order during contact, where backward Euler can take over."""

RECENT = 20
"""Number of last steps whose gains are summed."""

ALTERNATIVES = {"midpoint": "bdf2", "alpha2": "bdf2", "bdf2": "beuler", "semi-implicit": "beuler"}
"""The integrator to recommend in place of one that creates energy."""


@dataclass(frozen=True)
class GuardState:
    """State of the guard between steps; energies in J.

    Attributes
    ----------
    start : float or None
        V₀; None before the first step.
    scale : float
        S.
    total : float
        Sum of the gains since the start.
    lost, won : float
        Sums of the negative gains, as a positive number, and of the positive ones.
    work, heat : float
        Σ|W|, ΣD.
    inertia, bracket : float
        Sums Σ ½ ‖Δv‖²_M and of the brackets in backward Euler's identity.
    recent : list of float
        Gains of the last steps, the newest last, after `_append_gain`.
    repeated : int
        Number of rejected attempts.
    noise : float
        Sum of the round-off of the gains.
    """

    start: float | None = None
    scale: float = 0.0
    total: float = 0.0
    lost: float = 0.0
    won: float = 0.0
    work: float = 0.0
    heat: float = 0.0
    inertia: float = 0.0
    bracket: float = 0.0
    recent: list[float] = field(default_factory=list)
    repeated: int = 0
    noise: float = 0.0


class EnergyGuard:
    """Judges the steps of a motion; collective, and the same on all ranks.

    Parameters
    ----------
    equations : StageEquations
    drift : (3,)
        The scene's initial velocity [m/s].
    """

    def __init__(self, equations: StageEquations, drift: Sequence[float]) -> None:
        self._equations = equations
        self._forces = EndForces(equations, drift)
        self.gains = GuardState()

    def accept(self, x0: Array, v0: Array, ledger: EnergyBalance) -> bool:
        """Whether the step just taken from x0, v0 (n_local, 3), whose account the ledger has, is accepted; if
        so, it is recorded.
        """
        return self.judge(self._forces.gain(x0, v0, ledger))

    def forget_end(self) -> None:
        """The next step does not start where the last has ended."""
        self._forces.forget()

    def judge(self, step: Gain) -> bool:
        """Whether a step with this gain is accepted; if so, it is recorded."""
        new = self._updated(step)
        over = self._equations.integrator.gain_window
        # a step without a gain of its own would not improve the mean if it were shorter
        of_step = min(math.fsum(new.recent[-over:]) / min(over, len(new.recent)), new.recent[-1])
        of_steps = max(new.total, math.fsum(new.recent))
        self._judged = of_step, of_steps, new.scale
        impact = self._equations.has_active_pairs and self._equations.integrator.order > 1
        max_gain, max_sum = (IMPACT_GAIN, IMPACT_SUM) if impact else (LARGEST_GAIN, LARGEST_SUM)
        accepted = of_step <= max(max_gain * new.scale, step.noise)
        # repeating a step without a gain would not reduce the sum
        accepted &= of_steps <= max(max_sum * new.scale, new.noise) or new.recent[-1] <= step.noise
        accepted = not any(self._equations.points.global_max(not accepted))  # the same on all ranks
        if accepted:
            self.gains = new
            self._forces.keep_end()
        else:
            self.gains = replace(self.gains, repeated=self.gains.repeated + 1)
        return accepted

    @property
    def _is_backward_euler(self) -> bool:
        """Whether the integrator is backward Euler, which has the identity."""
        return self._equations.integrator.name == "beuler"

    def _updated(self, step: Gain) -> GuardState:
        """State of the guard after accepting a step."""
        old = self.gains
        start = step.potential_before if old.start is None else old.start
        judged = step.gain - min(max(step.gain, 0.0), step.doubt)
        if self._is_backward_euler:
            judged = min(judged, step.bracket - step.inertia)
        work, heat = old.work + abs(step.work), old.heat + step.heat
        return GuardState(
            start=start,
            scale=max(
                old.scale,
                step.stored_before + abs(step.potential_before - start),
                step.stored + abs(step.potential - start) + work + heat,
            ),
            total=old.total + judged,
            lost=old.lost + max(0.0, -step.gain),
            won=old.won + max(0.0, step.gain),
            work=work,
            heat=heat,
            inertia=old.inertia + step.inertia,
            bracket=old.bracket + step.bracket,
            recent=_append_gain(old.recent, judged, self._equations.integrator.gain_window)[-RECENT:],
            repeated=old.repeated,
            noise=old.noise + step.noise,
        )

    @property
    def message(self) -> str:
        """The gain of the step judged last."""
        of_step, of_steps, scale = self._judged
        if not (math.isfinite(scale) and math.isfinite(of_step)):
            return "makes energy without bounds"
        share, period = of_step / scale, ""
        if share <= LARGEST_GAIN and of_steps > of_step:
            share, period = of_steps / scale, " in the steps so far"
        return f"makes {100.0 * share:.2g} % of the energy at work out of nothing{period}"

    @property
    def remedy(self) -> str:
        """Advice for a message: another integrator, or a change of steps, damping or mesh."""
        name = self._equations.integrator.name
        other = ALTERNATIVES.get(name)
        if other:
            return f"time.integrator: {other}"
        return "a smaller time.step, more material.damping, or a finer mesh where the sheet buckles"

    def content(self) -> dict[str, Any]:
        """Entry of summary.json: energies as fractions of the scale, which is in J."""
        gains, scale = self.gains, self.gains.scale or 1.0
        content: dict[str, Any] = {
            "scale": gains.scale,
            "numerical_dissipation": gains.lost / scale,
            "numerical_gain": gains.won / scale,
            "repeated": gains.repeated,
        }
        if self._is_backward_euler:
            content["identity"] = {
                "velocity_changes": gains.inertia / scale,
                "bracket": gains.bracket / scale,
            }
        return content

    def saved_state(self) -> dict[str, Any]:
        """Entry of a checkpoint."""
        return asdict(self.gains)

    def restore(self, saved: Mapping[str, Any], *, same: bool) -> None:
        """Restore a `saved_state`; without its gains if the integrator is another (not ``same``)."""
        self.gains = GuardState(**saved)
        if not same:
            self.gains = replace(self.gains, total=0.0, recent=[])


def _append_gain(recent: list[float], gain: float, window: int) -> list[float]:
    """Gains of the last steps and a new one, balanced against the losses of the last ``window`` steps.

    Schemes of several steps give back in one step what they have taken in others; both must leave the list of
    recent gains together.
    """
    gains = list(recent)
    for i in range(len(gains) - 1, max(len(gains) - window, -1), -1):
        returned = min(max(gain, 0.0), max(-gains[i], 0.0))
        gains[i], gain = gains[i] + returned, gain - returned
    return [*gains, gain]
