"""Hinges of collapsed triangles: the energy fades out smoothly, and results are finite."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from oracle import gradient as gradient_of
from oracle import hessian as hessian_of

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.terms.bending.hinge import Bending
from lyra_petsc.terms.bending.hinge_clamp import Clamp
from lyra_petsc.terms.bending.hinge_energy import FADES_BELOW, fading_limit
from lyra_petsc.terms.handles.motion import STILL, Window
from lyra_petsc.terms.registry import registration_of
from lyra_petsc.terms.term import Elastic, UpcomingStep

EDGE = np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0]])
FULL = np.array([[0.3, 0.8, 0.1], [0.6, -0.7, 0.3]])
"""Opposite vertices of the undeformed hinge."""


def areas(x: Array) -> Array:
    """Areas [m²] of the hinge's two triangles."""
    e = x[1] - x[0]
    return 0.5 * np.array([np.linalg.norm(np.cross(e, x[k] - x[0])) for k in (2, 3)])


def hinge(*left: float) -> Array:
    """Points (4, 3) whose two triangles have given fractions of their rest areas."""
    x = np.vstack([EDGE, FULL])
    e = x[1] - x[0]
    for row, part in zip((2, 3), left, strict=True):
        foot = x[0] + e * ((x[row] - x[0]) @ e) / (e @ e)
        x[row] = foot + part * (x[row] - foot)
    return x


REST_AREAS = areas(hinge(1.0, 1.0))


def bending(part_of_limit: float = 1.0) -> Bending:
    data = {
        "k": np.array([0.7]),
        "rest_angle": np.array([-0.4]),
        "limit": part_of_limit * fading_limit(REST_AREAS)[None],
        "rest_height": np.array([1.0]),
        "opposite_corners": np.array([[2.0, 2.0]]),
    }
    term = Bending(Elements(np.array([[0, 1, 2, 3]]), data))
    term.registration = registration_of("bending")
    return term


def clamp() -> Clamp:
    data = {
        "k": np.array([0.7]),
        "rest_angle": np.array([-0.4]),
        "limit": fading_limit(REST_AREAS[:1]),
        "height": np.array([1.0]),
        "handle": np.array([0.0]),
    }
    term = Clamp(Elements(np.array([[0, 1, 2]]), data), {0: (STILL, Window(0.0, np.inf))})
    term.registration = registration_of("clamp")
    return term


def turned() -> Array:
    """Start position of the clamp."""
    x = hinge(1.0, 1.0)
    x[2] += [0.1, 0.0, 0.5]
    return x


def frozen(term: Elastic, start: Array | None = None) -> Any:
    """Frozen data of a clamp that starts at ``start``; None for a hinge."""
    x = turned() if start is None else start
    return term.freeze(UpcomingStep(0.0, 1.0, 1.0, x, lambda time, rows: x[rows]))


def total(term: Elastic, start: Array | None = None) -> Callable[[Array], float]:
    return lambda x: float(term.energies(x, frozen(term, start)).sum())


def gradient(term: Elastic, x: Array, start: Array | None = None) -> Array:
    return gradient_of(term, x, frozen(term, start))


def hessian(term: Elastic, x: Array, convexity: float = 0.0, start: Array | None = None) -> Array:
    """Hessian (3 n, 3 n) of the single element."""
    n = 3 * term.stencil.shape[1]
    whole = hessian_of(term, x, frozen(term, start), convexity).reshape(x.size, x.size)
    assert not whole[n:].any()
    assert not whole[:, n:].any()
    return whole[:n, :n]


def differences(f: Callable[[Array], Array | float], x: Array, n: int, h: float) -> Array:
    """Derivative (3 n, …) of f with respect to the first n points, by fourth-order central differences."""
    rows = []
    for index in np.ndindex(n, 3):
        d = np.zeros_like(x)
        d[index] = h
        rows.append((8.0 * (f(x + d) - f(x - d)) - (f(x + 2 * d) - f(x - 2 * d))) / (12.0 * h))
    return np.array(rows)


def part(a: float) -> float:
    """Fraction of the rest area: √a times that at which fading starts."""
    return FADES_BELOW * float(np.sqrt(a))


CASES = {
    "first": (part(0.6), 1.0),
    "second, hardly": (0.7, part(0.9)),
    "both": (part(0.3), part(0.7)),
    "one faded, one collapsed": (part(0.4), part(0.01)),
}
both_terms = pytest.mark.parametrize("make", [bending, clamp])
every_case = pytest.mark.parametrize("left", CASES.values(), ids=CASES)


@both_terms
@every_case
def test_derivatives_of_a_fading_hinge(make: Callable[[], Elastic], left: tuple[float, float]) -> None:
    term, x = make(), hinge(*left)
    n, h = term.stencil.shape[1], 1e-4 * min(left)
    force = gradient(term, x)
    numeric = differences(total(term), x, n, h)
    assert np.abs(force).max() > 0.0
    np.testing.assert_allclose(force[:n].ravel(), numeric, rtol=0.0, atol=1e-7 * np.abs(force).max())
    exact = hessian(term, x)
    numeric = differences(lambda y: gradient(term, y)[:n].ravel(), x, n, h)
    np.testing.assert_allclose(exact, numeric, rtol=0.0, atol=1e-7 * np.abs(exact).max())
    np.testing.assert_allclose(exact, exact.T, rtol=0.0, atol=1e-13 * np.abs(exact).max())


@both_terms
@every_case
def test_regularised_hessian_of_a_fading_hinge(
    make: Callable[[], Elastic], left: tuple[float, float]
) -> None:
    term, x = make(), hinge(*left)
    exact, regularised, mixed = (hessian(term, x, convexity) for convexity in (0.0, 1.0, 0.3))
    np.testing.assert_allclose(mixed, 0.7 * exact + 0.3 * regularised, atol=1e-12 * np.abs(exact).max())
    values = np.linalg.eigvalsh(regularised)
    assert values[0] >= -1e-12 * values[-1]
    # of rank one, 2 k ∇θ ∇θᵀ w w
    assert values[-1] > 0.0
    assert np.abs(values[:-1]).max() <= 1e-12 * values[-1]


def test_energy_is_that_of_the_angle_times_the_fading_factor() -> None:
    term = bending()
    k, rest = 0.7, -0.4
    for left in CASES.values():
        x = hinge(*left)
        change = float(term.angles(x)[0]) - rest
        a = np.minimum((areas(x) / (FADES_BELOW * REST_AREAS)) ** 2, 1.0)
        w = np.prod(a**3 * (10.0 - 15.0 * a + 6.0 * a**2))
        assert total(term)(x) == pytest.approx(k * change**2 * w, rel=1e-12)
        assert term.weights(x)[0] == pytest.approx(w, rel=1e-12)


@both_terms
def test_two_derivatives_are_continuous_where_fading_starts(make: Callable[[], Elastic]) -> None:
    term = make()
    just_below, just_above = hinge(part(1.0 - 1e-7), 1.0), hinge(part(1.0 + 1e-7), 1.0)
    for of in (total(term), lambda x: gradient(term, x), lambda x: hessian(term, x)):
        above = np.asarray(of(just_above))
        np.testing.assert_allclose(of(just_below), above, rtol=0.0, atol=1e-4 * np.abs(above).max())


def flattened() -> dict[str, Array]:
    """Shapes whose first triangle at least has no area, or nearly none."""
    shapes = {
        "no height": hinge(0.0, 1.0),
        "both": hinge(0.0, 0.0),
        "no edge": hinge(1.0, 1.0),
        "one point": np.ones((4, 3)),
        "opposite on a corner": hinge(1.0, 1.0),
        "next to none": hinge(1e-17, 1.0),
        "least of all": hinge(1.0, 1.0),
    }
    shapes["no edge"][1] = shapes["no edge"][0]
    shapes["opposite on a corner"][2] = shapes["opposite on a corner"][0]
    shapes["least of all"][:, 1:] *= 1e-160
    return shapes


@both_terms
@pytest.mark.parametrize("shape", flattened())
def test_a_triangle_without_area_has_no_energy_and_no_force(make: Callable[[], Elastic], shape: str) -> None:
    term, x = make(), flattened()[shape]
    assert total(term)(x) == 0.0
    assert not gradient(term, x).any()
    for convexity in (0.0, 0.5, 1.0):
        assert not hessian(term, x, convexity).any()
    if isinstance(term, Bending):
        assert np.isfinite(term.angles(x)).all()
        assert term.weights(x)[0] == 0.0


def test_the_force_of_a_compressed_triangle_decreases() -> None:
    # the angle's own gradient grows like one over the height
    term = bending()
    pushes = [np.abs(gradient(term, hinge(left, 1.0))).max() for left in np.geomspace(0.05, 1e-5, 20)]
    assert np.all(np.diff(pushes) < 0.0)
    assert pushes[-1] < 1e-12 * np.abs(gradient(term, hinge(1.0, 1.0))).max()


def test_the_rigid_mirror_of_a_clamp_does_not_fade() -> None:
    term = clamp()
    full, small = hinge(1.0, 1.0), hinge(1.0, 1.0)
    small[2] = hinge(0.02, 1.0)[2]
    change = 0.7 * (0.0 - -0.4) ** 2
    # a mirror image of 2 % of the rest area
    assert total(term, small)(full) == pytest.approx(change, rel=1e-12)
