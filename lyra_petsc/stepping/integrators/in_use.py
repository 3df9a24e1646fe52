"""The integrators of a run: the scene's, and those that take single steps in its place."""

from __future__ import annotations

from collections.abc import Mapping

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.stepping.integrators.integrator import Integrator


class IntegratorsInUse:
    """The integrators of a run and their histories.

    Parameters
    ----------
    usual : Integrator
    limited : bool
        Whether the scene has contact, other limits of steps, or parts to hold together.

    Attributes
    ----------
    present, usual, in_contact : Integrator
        That of the step, the scene's, and the one that takes the steps in which something touches
        or nears a limit, or parts that are to be held together are apart.
    """

    def __init__(self, usual: Integrator, *, limited: bool) -> None:
        self.present = self.usual = usual
        self.in_contact = usual.for_contact() if limited else usual

    def take(self, integrator: Integrator) -> None:
        """Let this one take the next step."""
        self.present = integrator

    @property
    def suits_contact(self) -> bool:
        """Whether the present one is for steps in which something touches."""
        return self.present is not self.usual or self.usual is self.in_contact

    def record_step(self, x: Array, v: Array, free: Mask, dt: float) -> None:
        """Add the accepted step of dt [s] from x, v (n_owned, 3) to the histories."""
        followers = {self.in_contact} if self.present is self.usual else set()
        for integrator in {self.present} | followers:
            integrator.record_step(x, v, free, dt)

    def follow_step(self, acceleration: Array) -> None:
        """Let those that did not take the step go on from its end, which had this mean acceleration (n_owned,
        3) [m/s²] of free unknowns.
        """
        for integrator in {self.usual, self.in_contact} - {self.present}:
            integrator.restart()
            if self.present.order == 1:  # velocities after an impact would give stiff damping huge forces
                integrator.set_acceleration(acceleration)
        self.present = self.usual

    def saved_state(self) -> tuple[dict[str, Array], dict[str, float]]:
        """Arrays (n_owned, 3) and numbers of the histories."""
        (arrays, numbers), (more, others) = self.in_contact.saved_state(), self.usual.saved_state()
        return arrays | more, numbers | others

    def restore(self, arrays: Mapping[str, Array], numbers: Mapping[str, float]) -> None:
        """Return to a `saved_state`."""
        for integrator in {self.usual, self.in_contact}:
            integrator.restore(arrays, numbers)
