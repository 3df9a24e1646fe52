"""Energy of clamps, whose planes move with their handles and so work on the sheet."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.terms.term import Elastic


def clamped_energy(elastic: Sequence[Elastic], x: NDArray[np.float64]) -> float:
    """Energy [J] of this rank's clamps at positions x (n_local, 3), where they stand now."""
    return sum(float(term.energies(x).sum()) for term in elastic if term.name == "clamp")
