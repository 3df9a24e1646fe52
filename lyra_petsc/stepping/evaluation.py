"""The stage of a step at given velocities."""

from __future__ import annotations

from dataclasses import dataclass

from lyra_petsc.arrays import Array


@dataclass(eq=False)
class Evaluation:
    """Positions and velocities of a step's stage, and what has been computed there.

    It holds for the step that it was made for: `StageEquations.version` says which.

    Attributes
    ----------
    x, v : (n_local, 3)
        Positions [m] and velocities [m/s], ghosts up to date.
    internal, damping : (n_owned, 3) or None
        Forces [N] of the sheet and of its damping, once they are known.
    objective : (float, float) or None
        Value of the function that the step minimises and the scale of its round-off [W], once they are known.
    """

    x: Array
    v: Array
    internal: Array | None = None
    damping: Array | None = None
    objective: tuple[float, float] | None = None
