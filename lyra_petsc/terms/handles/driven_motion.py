"""A motion that a program continues step by step, instead of keyframes that are known from the start."""

from __future__ import annotations

from typing import Any

import numpy as np

from lyra_petsc.scene.schema import Keyframe
from lyra_petsc.terms.handles.motion import Motion

KEPT = 3
"""Latest poses that are kept besides the first: the velocity at the last one has two sides."""


class DrivenMotion(Motion):
    """A motion that is linear between the poses that a program sets one after the other, and then at rest.

    Parameters
    ----------
    motion : Motion
        The scene's own motion, which holds until the first pose is set.
    """

    def __init__(self, motion: Motion) -> None:
        vars(self).update(vars(motion))

    @property
    def velocity_jumps(self) -> list[float]:
        """Times [s] at which the velocity is discontinuous, of those that are known at the start."""
        return []

    def saved_state(self) -> dict[str, Any]:
        """All that `restore` returns to."""
        return dict(vars(self))

    def restore(self, saved: dict[str, Any]) -> None:
        """Return to a `saved_state`."""
        vars(self).update(saved)

    def go_to(self, target: Keyframe, now: float) -> bool:
        """Go from the pose ``now`` [s] to that of the keyframe in a straight line; returns whether the
        velocity changes now.
        """
        pose = Motion([target], "linear")._values[0]
        present, past = self._interpolate(now)[0], self._times < now
        times = np.concatenate(
            [self._times[past][:1], self._times[past][1:][-KEPT + 1 :], [now, target.time]]
        )
        values = np.concatenate(
            [self._values[past][:1], self._values[past][1:][-KEPT + 1 :], [present, pose]]
        )
        if values[-1, 6:] @ present[6:] < 0.0:
            values[-1, 6:] *= -1.0  # a quaternion and its negative are the same rotation
        self._times, self._values, self._tangents = times, values, np.zeros_like(values)
        self._linear, self._monotone, self._rotations = True, False, None
        rates = np.diff(values, axis=0)[-2:] / np.diff(times)[-2:, None]
        before = rates[0] if len(times) > 2 else np.zeros(10)
        return bool((np.abs(rates[-1] - before) > 1e-9 * np.abs(rates).max()).any())
