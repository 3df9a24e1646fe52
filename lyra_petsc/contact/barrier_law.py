"""The barrier, and the mollifier of two edges (`contact_pairs`)."""

from __future__ import annotations

import math

from lyra_petsc.kernels.element import kernel, leaf


@kernel(forceinline=True)  # not `inlined`, as δ may be an array
def barrier(delta, gap):  # type: ignore[no-untyped-def]
    """b / k for 0 < δ < gap and its first two derivatives."""
    left, part = gap - delta, gap / delta
    return left**3 / delta, left * left * (-2.0 - part) / delta, 2.0 * (part**3 - 1.0)


@leaf()
def distance_of_force(force, gap):  # type: ignore[no-untyped-def]
    """δ at which −b′ / k is ``force`` [m] > 0: u = gap / δ is the largest root of u³ − p u + 2."""
    p = 3.0 + force / gap
    return gap / (2.0 * math.sqrt(p / 3.0) * math.cos(math.acos(-((3.0 / p) ** 1.5)) / 3.0))


@leaf()
def edge_products(p):  # type: ignore[no-untyped-def]
    """u·u, u·v and v·v for the edges u = p0 p1 and v = p2 p3."""
    uu = uv = vv = 0.0
    for k in range(3):
        u, v = p[1, k] - p[0, k], p[3, k] - p[2, k]
        uu, uv, vv = uu + u * u, uv + u * v, vv + v * v
    return uu, uv, vv


@leaf()
def mollifier_of(p, parallel, slope):  # type: ignore[no-untyped-def]
    """m of edges p0 p1 and p2 p3, and m′, m″ with respect to sin² θ, whose gradient is written to slope
    (12,).
    """
    uu, uv, vv = edge_products(p)
    square = uu * vv
    if not square > 0.0:
        return 0.0, 0.0, 0.0
    c = (square - uv * uv) / (square * parallel)
    if c >= 1.0:
        return 1.0, 0.0, 0.0
    factor = -2.0 * uv / square
    for k in range(3):
        u, v = p[1, k] - p[0, k], p[3, k] - p[2, k]
        to_u, to_v = factor * (v - uv / uu * u), factor * (u - uv / vv * v)
        slope[k], slope[3 + k], slope[6 + k], slope[9 + k] = -to_u, to_u, -to_v, to_v
    return c * (2.0 - c), 2.0 * (1.0 - c) / parallel, -2.0 / (parallel * parallel)


@leaf()
def is_mollified(p, parallel):  # type: ignore[no-untyped-def]
    """Whether the edges p0 p1 and p2 p3 are so nearly parallel that m < 1."""
    uu, uv, vv = edge_products(p)
    return not uu * vv - uv * uv >= uu * vv * parallel
