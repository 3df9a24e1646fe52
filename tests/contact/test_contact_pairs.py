"""Contact of single pairs: distances, derivatives and collisions, against sampling and differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lyra_petsc.arrays import unwritable
from lyra_petsc.contact import contact_pairs, pair_distances, pair_motion, surface_shares
from lyra_petsc.contact.pair_distances import (
    EDGE_EDGE,
    VERTEX_INSIDE,
    VERTEX_PLANE,
    VERTEX_TRIANGLE,
)
from lyra_petsc.contact.pair_motion import CCD_TOLERANCE

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

GAP, STIFFNESS, KEPT = 3.0, 2.0, 0.2
NOWHERE = 1e-9
"""A ``parallel`` so small that no edges are mollified."""


@dataclass(frozen=True)
class Pairs:
    """Pairs of one kind; their points are in ``x`` or, for obstacles, in ``obstacle_x``."""

    kind: Ints
    points: Ints
    x: Array
    obstacle_x: Array
    offset: Array

    def __len__(self) -> int:
        return len(self.kind)

    @property
    def places(self) -> Array:
        """Positions (n, 4, 3) of the points of the pairs."""
        at = self.points
        if not len(self.obstacle_x):
            return np.asarray(self.x[at])
        return np.where((at >= 0)[:, :, None], self.x[np.maximum(at, 0)], self.obstacle_x[np.maximum(~at, 0)])

    def part(self, at: NDArray[np.bool_] | slice) -> Pairs:
        """A subset of the pairs."""
        return replace(self, kind=self.kind[at], points=self.points[at], offset=self.offset[at])

    def distances(self, x: Array | None = None, obstacle_x: Array | None = None) -> Array:
        out = np.empty(len(self))
        x, obstacle_x = self.x if x is None else x, self.obstacle_x if obstacle_x is None else obstacle_x
        pair_distances.distances(x, obstacle_x, self.kind, self.points, out)
        return out

    def find_active(self, x: Array, parallel: float) -> tuple[NDArray[np.bool_], Array, Array]:
        """Find pairs nearer than the gap; returns β and energy of all, which are 0 for other pairs."""
        n = len(self)
        numbers = self.offset, np.full(n, GAP), np.full(n, STIFFNESS), parallel, np.zeros((n, 6))
        found = found_active(x, self.obstacle_x, self.kind, self.points, *numbers, counted=n)
        assert (found["weight"] == 1.0).all()
        near, beta, energy = np.zeros(n, dtype=np.bool_), np.zeros((n, 4)), np.zeros(n)
        at = found["at"]
        near[at], beta[at], energy[at] = True, found["beta"], found["energy"]
        return near, beta, energy

    def energies(self, x: Array, parallel: float = NOWHERE) -> Array:
        return self.find_active(x, parallel)[2]

    def _active(self, x: Array, parallel: float) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """Arguments of the kernels about pairs, and about active pairs."""
        n = len(self)
        of = self.kind, self.points, self.offset, np.full(n, GAP), np.full(n, STIFFNESS), parallel
        found = found_active(x, self.obstacle_x, *of, np.zeros((n, 6)), counted=n)
        return of, tuple(found[name] for name in ACTIVE_COLUMNS)

    def gradient(self, x: Array, parallel: float = NOWHERE) -> tuple[Array, Array]:
        out, obstacle_gradient = np.zeros_like(x), np.zeros_like(self.obstacle_x)
        of, active = self._active(x, parallel)
        contact_pairs.add_gradient(x, self.obstacle_x, *of, active, out, obstacle_gradient)
        return out, obstacle_gradient

    def hessians(self, parallel: float = NOWHERE, convexity: float = 0.0) -> Array:
        """Hessians (n, 12, 12) of the pairs."""
        of, active = self._active(self.x, parallel)
        each = blocks_of(self.x, self.obstacle_x, of, active, convexity)
        return each.transpose(0, 1, 3, 2, 4).reshape(-1, 12, 12)

    def largest_step(self, dx: Array, obstacle_dx: Array, e: int | None = None, most: float = 1.0) -> float:
        at = slice(None) if e is None else slice(e, e + 1)
        pairs = self.kind[at], self.points[at], self.offset[at], np.full(len(self), GAP)[at]
        return float(pair_motion.largest_step(self.x, self.obstacle_x, dx, obstacle_dx, *pairs, KEPT, most))


ACTIVE_COLUMNS = ["at", "weight", "beta", "derivatives"]
"""Results of `found_active` that the kernels need."""


def blocks_of(
    x: Array, obstacle_x: Array, of: tuple[Any, ...], active: tuple[Any, ...], convexity: float
) -> Array:
    """Hessians (n, 4, 4, 3, 3) of pairs, as the kernel adds them to blocks; every other block is added
    transposed.
    """
    n, (one, other) = len(of[0]), np.triu_indices(4)
    number = np.arange(10 * n, dtype=np.int32).reshape(n, 10)
    turned = number % 2
    values, out = np.zeros((10 * n, 3, 3)), np.empty((n, 4, 4, 3, 3))
    (at, weight, *rest), places = active, 2 * number + turned
    contact_pairs.add_hessians(x, obstacle_x, *of, (at, 1.0 * weight, *rest), convexity, places, values)
    values = values.reshape(n, 10, 3, 3)
    values = np.where(turned[:, :, None, None] == 1, values.transpose(0, 1, 3, 2), values)
    out[:, one, other], out[:, other, one] = values, values.transpose(0, 1, 3, 2)
    return out


def found_active(*given: Any, counted: int, capacity: int | None = None) -> dict[str, NDArray[Any]]:
    """The results of `contact_pairs.find_active` by name, read-only as those of `ActivePairs`."""
    n = len(given[2])
    capacity = n if capacity is None else capacity
    least, found = np.empty(n), {"at": np.empty(capacity, dtype=np.int64), "weight": np.empty(capacity)}
    found |= {"counted": np.empty(capacity), "beta": np.empty((capacity, 4)), "energy": np.empty(capacity)}
    found["derivatives"] = np.empty((capacity, 6))
    active = contact_pairs.find_active(*given, counted, least, tuple(found.values()))
    return dict(zip(found, unwritable(*(part[:active] for part in found.values())), strict=True))


def units(rng: np.random.Generator, n: int) -> Array:
    v = rng.normal(size=(n, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1)[:, None])


def among_sheets(kind: int, n: int, seed: int = 1) -> Pairs:
    x = np.random.default_rng(seed).normal(size=(4 * n, 3))
    none = np.zeros((0, 3))
    return Pairs(np.full(n, kind), np.arange(4 * n).reshape(n, 4), x, none, np.full(n, 0.05))


def nearly_parallel(n: int) -> Pairs:
    """Nearly parallel edges, whose directions differ by 1e-1 to 1e-4."""
    rng = np.random.default_rng(7)
    u, v, along = units(rng, n), units(rng, n), rng.uniform(-0.9, 0.9, size=n)
    turned = u + 10.0 ** rng.uniform(-4.0, -1.0, size=n)[:, None] * v
    first = rng.normal(size=(n, 3))
    away = np.cross(u, units(rng, n))
    second = first + along[:, None] * u + away / np.linalg.norm(away, axis=1)[:, None]
    x = np.stack([first, first + u, second, second + turned], axis=1).reshape(-1, 3)
    return replace(among_sheets(EDGE_EDGE, n), x=x)


def planes(n: int) -> Pairs:
    """Vertices in front of a plane, at most twice the gap away."""
    rng = np.random.default_rng(3)
    x, normals = rng.normal(size=(n, 3)), units(rng, n)
    across = np.cross(normals, units(rng, n))
    points = x - rng.uniform(0.1, 2.0 * GAP, size=n)[:, None] * normals + 3.0 * across
    number = np.arange(n)
    stencil = np.column_stack([number, ~(2 * number), ~(2 * number + 1), ~(2 * number)])
    obstacle_x = np.stack([points, normals], axis=1).reshape(-1, 3)
    return Pairs(np.full(n, VERTEX_PLANE), stencil, x, obstacle_x, np.full(n, 0.05))


def balls(n: int) -> Pairs:
    """Vertices inside spheres (the first half) and capsules."""
    rng = np.random.default_rng(4)
    ends = rng.normal(size=(n, 2, 3))
    ends[: n // 2, 1] = ends[: n // 2, 0]
    radius = rng.uniform(2.0, 4.0, size=n)
    middle = ends[:, 0] + rng.random((n, 1)) * (ends[:, 1] - ends[:, 0])
    x = middle + (radius * rng.uniform(0.2, 0.98, size=n))[:, None] * units(rng, n)
    number = np.arange(n)
    stencil = np.column_stack([number, ~(2 * number), ~(2 * number + 1), ~(2 * number)])
    inside = Pairs(np.full(n, VERTEX_INSIDE), stencil, x, ends.reshape(-1, 3), 0.05 - radius)
    return inside.part(inside.distances() - inside.offset > 0.01)


KINDS: dict[str, tuple[Callable[[], Pairs], float]] = {
    "vertex and triangle": (lambda: among_sheets(VERTEX_TRIANGLE, 1000), NOWHERE),
    "edges": (lambda: among_sheets(EDGE_EDGE, 1000), NOWHERE),
    "edges that fade": (lambda: among_sheets(EDGE_EDGE, 1000), 0.5),
    "edges nearly parallel": (lambda: nearly_parallel(1000), 0.1),
    "vertex and plane": (lambda: planes(500), NOWHERE),
    "vertex inside": (lambda: balls(500), NOWHERE),
}


def sampled_distance(kind: int, p: Array) -> float:
    """Smallest distance between sampled points of both simplices."""
    s = np.linspace(0.0, 1.0, 61)
    if kind == VERTEX_TRIANGLE:
        u, v = (c[np.add.outer(s, s) <= 1.0 + 1e-12] for c in np.meshgrid(s, s))
        found = p[1] + u[:, None] * (p[2] - p[1]) + v[:, None] * (p[3] - p[1])
        return float(np.linalg.norm(p[0] - found, axis=1).min())
    one, other = (p[i] + s[:, None] * (p[i + 1] - p[i]) for i in (0, 2))
    return float(np.linalg.norm(one[:, None] - other, axis=2).min())


@pytest.mark.parametrize("kind", [VERTEX_TRIANGLE, EDGE_EDGE])
def test_distances_of_simplices(kind: int) -> None:
    pairs = among_sheets(kind, 300, seed=6)
    found = pairs.distances()
    for p, distance in zip(pairs.places, found, strict=True):
        sampled, spacing = sampled_distance(kind, p), 2.0 * np.linalg.norm(p - p[0], axis=1).max() / 60
        assert distance - 1e-12 <= sampled <= np.hypot(distance, spacing) + 1e-12


def test_distances_of_planes_and_containers() -> None:
    pairs = planes(200)
    p = pairs.places
    expected = np.einsum("ij,ij->i", p[:, 0] - p[:, 1], p[:, 2])
    np.testing.assert_allclose(pairs.distances(), expected, atol=1e-13)
    behind = replace(pairs, x=pairs.x - 10.0 * p[:, 2])
    np.testing.assert_allclose(behind.distances(), expected - 10.0, atol=1e-12)
    assert (behind.energies(behind.x) == np.inf).all()
    pairs = balls(200)
    s = np.linspace(0.0, 1.0, 2001)[:, None]
    for p, distance in zip(pairs.places, pairs.distances(), strict=True):
        nearest = np.linalg.norm(p[0] - (p[1] + s * (p[2] - p[1])), axis=1).min()
        assert -distance == pytest.approx(nearest, abs=1e-6)


@pytest.mark.parametrize("name", KINDS)
def test_derivatives(name: str) -> None:
    make, parallel = KINDS[name]
    pairs = make()
    h, rng = 1e-6, np.random.default_rng(9)
    direction = rng.normal(size=pairs.x.shape)
    # elsewhere the barrier is too steep for differences, or they straddle where it begins
    left = pairs.distances() - pairs.offset
    usable = (left > 0.02) & (np.abs(left - GAP) > 1e-4)
    assert usable.sum() > 0.7 * len(pairs)
    assert (left[usable] < GAP).sum() > 0.4 * len(pairs)
    sheet = (pairs.points >= 0)[:, :, None]
    along = np.where(sheet, direction[np.maximum(pairs.points, 0)], 0.0).reshape(-1, 12)

    def of_pairs(gradient: Array) -> Array:
        return np.where(sheet, gradient[np.maximum(pairs.points, 0)], 0.0).reshape(-1, 12)

    ahead, behind = pairs.x + h * direction, pairs.x - h * direction
    slope = (of_pairs(pairs.gradient(pairs.x, parallel)[0]) * along).sum(axis=1)
    with np.errstate(invalid="ignore"):  # infinite where they overlap
        change = (pairs.energies(ahead, parallel) - pairs.energies(behind, parallel)) / (2.0 * h)
    error = np.abs(change - slope) / (1.0 + np.abs(slope))
    assert np.median(error[usable]) < 1e-8
    assert error[usable].max() < 1e-4
    turned = np.einsum("eij,ej->ei", pairs.hessians(parallel), along)
    gradients = (of_pairs(pairs.gradient(y, parallel)[0]) for y in (ahead, behind))
    change = (next(gradients) - next(gradients)) / (2.0 * h)
    error = np.abs(change - turned).max(axis=1) / (1.0 + np.abs(turned).max(axis=1))
    # second derivatives jump where another corner or edge becomes the nearest
    assert np.median(error[usable]) < 1e-7
    assert np.percentile(error[usable], 99) < 1e-4


@pytest.mark.parametrize("name", KINDS)
def test_regularised_hessians_are_positive_semidefinite(name: str) -> None:
    make, parallel = KINDS[name]
    pairs = make()
    exact, regular = pairs.hessians(parallel), pairs.hessians(parallel, convexity=1.0)
    for h in (exact, regular):
        np.testing.assert_allclose(h, h.transpose(0, 2, 1), atol=1e-11 * np.abs(h).max())
    least, most = np.linalg.eigvalsh(regular)[:, [0, -1]].T
    assert (least >= -1e-12 * most - 1e-300).all()
    assert (most > 0.0).sum() > 0.4 * len(pairs)
    mixed = pairs.hessians(parallel, convexity=0.25)
    if parallel == NOWHERE:
        np.testing.assert_allclose(mixed, 0.75 * exact + 0.25 * regular, atol=1e-11 * np.abs(exact).max())


@pytest.mark.parametrize("name", KINDS)
def test_forces_of_both_sides_balance(name: str) -> None:
    make, parallel = KINDS[name]
    pairs = make()
    pairs = pairs.part(pairs.distances() > pairs.offset)
    out, obstacle_gradient = pairs.gradient(pairs.x, parallel)
    total = np.abs(out.sum(axis=0) + obstacle_gradient.sum(axis=0)).max()
    assert total <= 1e-13 * (np.abs(out).sum() + np.abs(obstacle_gradient).sum())
    assert np.abs(out).sum() > 0.0


def test_barrier_is_smooth_at_the_gap_and_zero_beyond() -> None:
    pairs = planes(2)
    normal, foot = pairs.obstacle_x[1], pairs.obstacle_x[0]
    for beyond, energy, force in ((1e-3, 0.0, 0.0), (-1e-3, 1e-8, 1e-5)):
        x = pairs.x.copy()
        x[0] = foot + (GAP + 0.05 + beyond) * normal
        assert pairs.energies(x)[0] == pytest.approx(energy, abs=1e-8)
        assert np.linalg.norm(pairs.gradient(x)[0][0]) == pytest.approx(force, abs=1e-5)


def closest(pairs: Pairs, e: int, dx: Array, obstacle_dx: Array, end: float) -> tuple[float, float]:
    """Smallest distance less offset up to a fraction of the displacements, over that at the start or the gap
    if that is less; and the same ratio at this fraction.
    """
    left = [
        pairs.distances(pairs.x + t * dx, pairs.obstacle_x + t * obstacle_dx)[e] - pairs.offset[e]
        for t in np.linspace(0.0, end, 100)
    ]
    counts = min(left[0], GAP)
    return min(left) / counts, left[-1] / counts


@pytest.mark.parametrize("speed", [0.5, 2.0, 100.0])
@pytest.mark.parametrize("name", [name for name in KINDS if "fade" not in name])
def test_largest_steps_without_a_collision(name: str, speed: float) -> None:
    pairs = KINDS[name][0]()
    pairs = pairs.part(pairs.distances() > pairs.offset).part(slice(0, 120))
    rng = np.random.default_rng(11)
    dx, obstacle_dx = speed * rng.normal(size=pairs.x.shape), speed * rng.normal(size=pairs.obstacle_x.shape)
    if pairs.kind[0] == VERTEX_PLANE:
        obstacle_dx[1::2] = 0.0  # planes that do not turn
    limited, found = 0, []
    for e in range(len(pairs)):
        found.append(fraction := pairs.largest_step(dx, obstacle_dx, e))
        assert 0.0 < fraction <= 1.0
        least, last = closest(pairs, e, dx, obstacle_dx, fraction)
        assert least >= KEPT - 1e-12
        if fraction < 1.0:
            limited += 1
            assert last <= KEPT + (1.0 - KEPT) * CCD_TOLERANCE + 1e-12
    assert limited > 5 or speed < 1.0
    assert pairs.largest_step(dx, obstacle_dx) == min(found)
    assert pairs.largest_step(dx, obstacle_dx, most=0.5 * min(found)) == 0.5 * min(found)


def test_a_common_motion_of_both_is_free() -> None:
    for make in (lambda: among_sheets(VERTEX_TRIANGLE, 50), lambda: planes(50), lambda: balls(50)):
        pairs = make()
        pairs = pairs.part(pairs.distances() > pairs.offset)
        dx = np.tile([30.0, -20.0, 50.0], (len(pairs.x), 1))
        obstacle_dx = np.tile([30.0, -20.0, 50.0], (len(pairs.obstacle_x), 1))
        if len(pairs.obstacle_x) and pairs.kind[0] == VERTEX_PLANE:
            obstacle_dx[1::2] = 0.0
        assert pairs.largest_step(dx, obstacle_dx) == 1.0


def test_planes_that_turn() -> None:
    """The normal at a fraction of the displacement is interpolated linearly."""
    pairs = planes(200)
    rng = np.random.default_rng(12)
    obstacle_dx = np.zeros_like(pairs.obstacle_x)
    obstacle_dx[1::2] = units(rng, len(pairs)) - pairs.obstacle_x[1::2]
    dx = rng.normal(size=pairs.x.shape)
    limited = 0
    for e in range(len(pairs)):
        fraction = pairs.largest_step(dx, obstacle_dx, e)
        limited += fraction < 1.0
        for t in np.linspace(0.0, fraction, 50):
            point, normal = pairs.obstacle_x[2 * e], pairs.obstacle_x[2 * e + 1] + t * obstacle_dx[2 * e + 1]
            height = (pairs.x[e] + t * dx[e] - point) @ normal / np.linalg.norm(normal)
            assert height > pairs.offset[e]
    assert limited > 20


def before_a_surface(bent: float) -> tuple[Ints, Array, Ints, Array]:
    """Points of 4 × 4 cells, followed by five vertices in front of them; pairs of these and triangles, and
    shares.
    """
    rng = np.random.default_rng(5)
    n = 5
    flat = np.array([(i, j, 0.0) for j in range(n) for i in range(n)])
    flat[:, 2] = bent * rng.normal(size=len(flat))
    over = np.column_stack([rng.uniform(0.8, 3.2, size=(5, 2)), rng.uniform(0.1, 0.3, size=5)])
    over[0, :2], over[1, :2] = (2.0, 2.0), (1.5, 2.0)
    first = [i + n * j for j in range(n - 1) for i in range(n - 1)]
    triangles = np.array([(v, v + 1, v + n + 1) for v in first] + [(v, v + n + 1, v + n) for v in first])
    shares = surface_shares.shares(surface_shares.rings(triangles))
    pairs = np.array([[25 + v, *each] for v in range(5) for each in triangles])
    return pairs, np.concatenate([flat, over]), triangles, np.tile(shares, (5, 1))


def active_before(x: Array, pairs: Ints, shares: Array) -> tuple[dict[str, NDArray[Any]], Array, Array]:
    """The active pairs, their gradient and their Hessian."""
    n, none = len(pairs), np.empty((0, 3))
    of = np.full(n, VERTEX_TRIANGLE), pairs, np.zeros(n), np.full(n, 0.5), np.full(n, STIFFNESS), NOWHERE
    found = found_active(x, none, *of, shares, counted=n, capacity=999)
    out, hessian = np.zeros_like(x), np.zeros((len(x), len(x), 3, 3))
    taken = tuple(found[name] for name in ACTIVE_COLUMNS)
    contact_pairs.add_gradient(x, none, *of, taken, out, none)
    np.add.at(hessian, (pairs[:, :, None], pairs[:, None, :]), blocks_of(x, none, of, taken, 0.0))
    return found, out, hessian


def test_a_flat_surface_repels_a_vertex_once() -> None:
    """Also above an edge or a vertex of the surface."""
    pairs, x, _, shares = before_a_surface(0.0)
    found, gradient, _ = active_before(x, pairs, shares)
    height = x[25:, 2]
    expected = STIFFNESS * (0.5 - height) ** 3 / height
    of = pairs[found["at"], 0] - 25
    energies = np.bincount(of, found["weight"] * found["energy"], minlength=5)
    np.testing.assert_allclose(energies, expected, rtol=1e-12)
    assert len(found["at"]) == 5
    np.testing.assert_allclose(gradient[25:, :2], 0.0, atol=1e-14)


def test_force_in_front_of_a_bent_surface_is_smooth() -> None:
    pairs, x, _, shares = before_a_surface(0.04)
    rng = np.random.default_rng(3)
    found, gradient, hessian = active_before(x, pairs, shares)
    assert (found["weight"] < 0.0).any()  # somewhere it is hollow
    h, dx = 1e-6, rng.normal(size=x.shape)

    def energy(at: Array) -> float:
        active = active_before(at, pairs, shares)[0]
        return float(active["weight"] @ active["energy"])

    slope = (energy(x + h * dx) - energy(x - h * dx)) / (2 * h)
    assert np.vdot(gradient, dx) == pytest.approx(slope, rel=1e-6)
    change = (active_before(x + h * dx, pairs, shares)[1] - active_before(x - h * dx, pairs, shares)[1]) / (
        2 * h
    )
    np.testing.assert_allclose(
        np.einsum("abij,bj->ai", hessian, dx), change, atol=1e-5 * np.abs(change).max()
    )
    # along a way over vertices and edges it does not jump
    ahead = np.zeros_like(x)
    ahead[25:, :2] = rng.uniform(-0.7, 0.7, size=(5, 2))
    along = np.array([energy(x + t * ahead) for t in np.linspace(0.0, 1.0, 2001)])
    assert np.abs(np.diff(along)).max() < 20.0 * np.abs(np.diff(along)).mean()
    assert np.abs(np.diff(along, 2)).max() < 0.1 * np.abs(np.diff(along)).max()
