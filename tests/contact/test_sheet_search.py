"""The search for near simplices of sheets against a comparison of all with all."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lyra_petsc.contact.pair_distances import EDGE_EDGE, VERTEX_TRIANGLE, distances
from lyra_petsc.contact.sheet_search import SheetSearch

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

RADIUS = 0.4
"""Search radius, over an edge of the grid."""


def grid(n: int, m: int) -> tuple[Array, Ints]:
    """Points (V, 2) and triangles of n × m unit cells."""
    uv = np.array([(i, j) for j in range(m + 1) for i in range(n + 1)], dtype=np.float64)
    first = [i + j * (n + 1) for j in range(m) for i in range(n)]
    triangles = [(v, v + 1, v + n + 2) for v in first] + [(v, v + n + 2, v + n + 1) for v in first]
    return uv, np.array(triangles)


def sheet(name: str) -> tuple[Ints, Array]:
    """Triangles (F, 3) and the material coordinates (F, 3, 2) of their corners."""
    uv, triangles = grid(9, 6)
    if name == "jittered":
        within = ((uv > 0.0) & (uv < uv.max(axis=0))).all(axis=1)
        uv = uv + 0.15 * within[:, None] * np.random.default_rng(2).uniform(-1.0, 1.0, uv.shape)
    elif name == "slit":
        # the cells right of x = 5 have vertices of their own there, but for the lowest rows
        at = np.flatnonzero((uv[:, 0] == 5.0) & (uv[:, 1] > 2.0))
        right = uv[triangles].mean(axis=1)[:, 0] > 5.0
        new = np.arange(len(uv))
        new[at] = len(uv) + np.arange(len(at))
        triangles = np.where(right[:, None], new[triangles], triangles)
        uv = np.concatenate([uv, uv[at]])
    elif name == "two layers":
        triangles = np.concatenate([triangles, triangles + len(uv)])
        uv = np.concatenate([uv, uv])
    elif name == "spiral":
        # a ring gone round one and a half times: its ends lie over each other in the plane
        angle, radius = uv[:, 0] * np.pi / 3.0, 4.0 + 0.5 * uv[:, 1]
        uv = np.column_stack([radius * np.sin(angle), radius * np.cos(angle)])
    corners = uv[triangles]
    if name == "seams":
        corners = corners + np.arange(len(triangles))[:, None, None] % 2
    return triangles, corners


SHEETS = ["plain", "jittered", "slit", "two layers", "spiral", "seams"]


def moved(name: str, corners: Array, triangles: Ints, rng: np.random.Generator) -> Array:
    """Positions (V, 3) of the vertices."""
    uv = np.zeros((triangles.max() + 1, 2))
    uv[triangles.ravel()] = corners.reshape(-1, 2)
    x, y = uv.T
    if name == "flat":
        out = np.column_stack([x, y, 0.0 * x])
    elif name == "rolled":
        out = np.column_stack([np.sin(x / 1.2) * (1.2 + 0.02 * x), y, np.cos(x / 1.2) * (1.2 + 0.02 * x)])
    elif name == "folded":
        out = np.column_stack([np.abs(x - 4.3), y, 0.15 * np.sign(x - 4.3)])
    elif name == "sheared":
        out = np.column_stack([1.1 * x + 0.4 * y, 0.8 * y, 0.3 * np.sin(0.5 * x)])
    else:
        out = np.column_stack([x, y, 0.0 * x]) + rng.normal(size=(len(x), 3))
    # separate vertices, as of a slit or of layers
    return out + np.array([0.0, 0.0, 1e-3]) * np.arange(len(out))[:, None] / len(out)


def brute(x: Array, dx: Array, triangles: Ints) -> tuple[set[tuple[int, ...]], set[tuple[int, ...]]]:
    """All pairs without common vertices, and those within `RADIUS` at any point of the displacements."""
    edges = np.unique(np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    v, t = (each.ravel() for each in np.indices((len(x), len(triangles))))
    rows = np.column_stack([v, triangles[t]])
    rows = rows[(rows[:, :1] != rows[:, 1:]).all(axis=1)]
    a, b = np.array(list(itertools.combinations(range(len(edges)), 2))).T
    across = np.concatenate([edges[a], edges[b]], axis=1)
    across = across[(across[:, :2, None] != across[:, None, 2:]).all(axis=(1, 2))]
    points = np.concatenate([rows, across])
    kind = np.repeat([VERTEX_TRIANGLE, EDGE_EDGE], [len(rows), len(across)])
    out, least = np.empty(len(points)), np.full(len(points), np.inf)
    for part in np.linspace(0.0, 1.0, 5):
        distances(x + part * dx, np.empty((0, 3)), kind, points, out)
        least = np.minimum(least, out)
    named = [name(k, p) for k, p in zip(kind.tolist(), points.tolist(), strict=True)]
    near = least < RADIUS
    return set(named), {row for row, found in zip(named, near, strict=True) if found}


def name(kind: int, points: list[int]) -> tuple[int, ...]:
    if kind == EDGE_EDGE:
        one, other = sorted([tuple(sorted(points[:2])), tuple(sorted(points[2:]))])
        return kind, *one, *other
    return kind, points[0], *sorted(points[1:])


@pytest.mark.parametrize("how", ["flat", "rolled", "folded", "sheared", "crumpled"])
@pytest.mark.parametrize("which", SHEETS)
def test_no_pair_that_comes_near_is_missed(which: str, how: str) -> None:
    rng = np.random.default_rng(3)
    triangles, corners = sheet(which)
    x = moved(how, corners, triangles, rng)
    search, numbers = SheetSearch(triangles, corners), np.arange(len(x))
    for dx in (np.zeros_like(x), np.array([3.0, 1.0, 2.0]) + 0.1 * rng.normal(size=x.shape)):
        every, near = brute(x, dx, triangles)
        search.set_triangles(x, numbers, triangles)
        rows = search.pairs(x, dx, numbers, RADIUS)
        found = [name(row[0], row[2:6]) for row in rows.tolist()]
        assert len(found) == len(set(found)), "pairs are named once"
        assert near <= set(found) <= every
        assert (rows[:, 1] == -1).all()


def turned(x: Array, angle: float) -> Array:
    """Positions (V, 3) rotated about an oblique axis."""
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    across = np.cross(axis, x)
    out: Array = x + np.sin(angle) * across + (1.0 - np.cos(angle)) * np.cross(axis, across)
    return out


@pytest.mark.parametrize("how", ["rolled", "folded"])
@pytest.mark.parametrize("which", ["jittered", "slit"])
def test_bounds_of_earlier_steps_hide_no_pair(which: str, how: str) -> None:
    rng = np.random.default_rng(5)
    triangles, corners = sheet(which)
    flat, bent = (moved(name, corners, triangles, rng) for name in ("flat", how))
    search, numbers, counts = SheetSearch(triangles, corners), np.arange(len(flat)), []
    search.set_triangles(flat, numbers, triangles)
    parts = [0.0, 0.02, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0, 0.7, 1.0]
    places = [turned((1.0 - part) * flat + part * bent, 0.2 * n) for n, part in enumerate(parts)]
    for x, there in itertools.pairwise(places):
        dx = there - x + 0.02 * rng.normal(size=x.shape)  # not the displacement that follows
        every, near = brute(x, dx, triangles)
        found = {name(row[0], row[2:6]) for row in search.pairs(x, dx, numbers, RADIUS).tolist()}
        assert near <= found <= every
        counts.append(len(near))
    assert max(counts) > 0


def test_rigid_motion_of_a_bent_sheet_takes_no_new_comparison(monkeypatch: pytest.MonkeyPatch) -> None:
    triangles, corners = sheet("plain")
    along, y, _ = moved("flat", corners, triangles, np.random.default_rng(0)).T
    x = np.column_stack([3.0 * np.sin(along / 3.0), y, 3.0 * np.cos(along / 3.0)])
    search, compared = SheetSearch(triangles, corners), []
    search.set_triangles(x, np.arange(len(x)), triangles)
    among = search._bounds.select

    def noted(*given: Any) -> Any:
        compared.append(len((found := among(*given))[0]))
        return found

    monkeypatch.setattr(search._bounds, "select", noted)
    for step in range(4):
        here, there = (turned(x, 0.05 * at) + [0.0, 0.3 * at, 0.0] for at in (step, step + 1))
        search.pairs(here, there - here, np.arange(len(x)), 0.5 * RADIUS)
    assert compared[0] > 0
    assert compared[1:] == [0, 0, 0]


def test_triangles_of_other_ranks_are_compared_one_by_one() -> None:
    triangles, corners = sheet("two layers")
    x = moved("folded", corners, triangles, np.random.default_rng(0))
    own = len(triangles) // 2
    search, numbers = SheetSearch(triangles[:own], corners[:own]), np.arange(len(x))
    search.set_triangles(x, numbers, triangles)
    rows = search.pairs(x, np.zeros_like(x), numbers, RADIUS)
    _, near = brute(x, np.zeros_like(x), triangles)
    mine = set(triangles[:own].ravel())
    touching = {pair for pair in near if mine & set(pair[1:])}  # other ranks find the rest
    assert touching
    assert touching <= {name(row[0], row[2:6]) for row in rows.tolist()}
