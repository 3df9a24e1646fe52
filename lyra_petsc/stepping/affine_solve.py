"""Zeros of affine functions by generalised conjugate residuals around an approximate solver.

Source: Eisenstat, Elman & Schultz, SIAM J. Numer. Anal. 20 (1983) 345-357.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.points import Layout

MAX_CORRECTIONS = 60
"""Largest number of approximate solves."""

ROUNDOFF_FRACTION = 0.05
"""Residuals below this fraction of the largest possible round-off are not corrected."""

ACCEPTED = 1e-5
"""Residual over the one at the start that is accepted when corrections end."""


def solve_affine(
    solve: Callable[[Array], Array],
    function: Callable[[Array], Array],
    start: Array,
    layout: Layout,
    *,
    tolerance: float,
    roundoff: float,
) -> tuple[Array, float]:
    """The array (n_owned, 3) at which an affine ``function`` (n_owned, 3) is zero; collective.

    Parameters
    ----------
    solve : callable
        The approximate solution for a right side.
    start : (n_owned, 3)
        First guess.
    tolerance : float
        Residual over the one at the start.
    roundoff : float
        Round-off of the function's norm.

    Returns
    -------
    solution : (n_owned, 3)
    excess : float
        Residual over the one at the start, 0 if it is accepted.
    """

    def dot(a: Array, b: Array) -> float:
        return float(layout.global_sum(float(np.vdot(a, b)))[0])

    solution, residual = start.copy(), function(start)
    first = norm = math.sqrt(dot(residual, residual))
    directions: list[tuple[Array, Array]] = []
    for _ in range(MAX_CORRECTIONS):
        if norm <= max(tolerance * first, ROUNDOFF_FRACTION * roundoff):
            return solution, 0.0
        direction = solve(-residual)
        image = function(solution + direction) - residual
        for earlier, earlier_image in directions:
            factor = dot(image, earlier_image)
            direction, image = direction - factor * earlier, image - factor * earlier_image
        size = math.sqrt(dot(image, image))
        if not (math.isfinite(size) and size > 0.0):
            break
        direction, image = direction / size, image / size
        directions.append((direction, image))
        factor = dot(image, residual)
        solution, residual, before = solution - factor * direction, residual - factor * image, norm
        norm = math.sqrt(dot(residual, residual))
        if norm > 0.5 * before and norm <= roundoff:
            return solution, 0.0
    return solution, 0.0 if norm <= max(ACCEPTED * first, roundoff) else norm / first
