"""Stiffness of loads that follow the shape, by differences of each element's force."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.terms.term import Term

STEP = 1e-5
"""Displacement in the difference, over the size of the elements."""


def following_stiffness(
    term: Term, x: Array, force: Callable[[Term, Array, Array], None]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Symmetric and skew part of −∂f/∂x of each element [N/m], each (E, n, n, 3, 3), at x (n_local, 3).

    ``force`` adds the forces [N] of a term at positions to an array. The term's elements are pulled apart,
    so that each of their points can be moved in all at once.
    """
    n_elements, n = term.stencil.shape
    apart = copy.copy(term)
    numbers = np.arange(n_elements * n, dtype=np.int32).reshape(n_elements, n)
    apart.take(Elements(numbers, term.elements.data, term.n_owned))
    here = x[term.stencil]
    step = STEP * float(np.ptp(here, axis=1).max(initial=0.0)) or STEP
    out = np.empty((n_elements, n, n, 3, 3))
    for point in range(n):
        for axis in range(3):
            change = np.zeros((n_elements * n, 3))
            for sign in (1.0, -1.0):
                moved = here.copy()
                moved[:, point, axis] += sign * step
                forces = np.zeros_like(change)
                force(apart, moved.reshape(-1, 3), forces)
                change += sign * forces
            out[:, :, point, :, axis] = -change.reshape(n_elements, n, 3) / (2.0 * step)
    other = out.transpose(0, 2, 1, 4, 3)
    return 0.5 * (out + other), 0.5 * (out - other)
