"""Reference answer of the paper scene: 16 × 16 vertices of `paper` hung by two corners, released flat.

    python scripts/references/paper.py > tests/reference/paper.json      (three minutes)

The semi-discrete problem (St. Venant-Kirchhoff triangles, hinges with k = B l² / 2(A0 + A1), lumped masses,
no damping) integrated by explicit, symplectic steps of fourth order (PEFRL; Omelyan, Mryglod, Folk, Comput.
Phys. Commun. 146, 2002) below the stability limit. Independent of the package.

**The scene is chaotic**: compressed membrane without damping wrinkles, and a disturbance of the start grows
about ten times every 30 ms, so that a single vertex at t = 0.48 s is not defined (10⁻⁹ m at the start
become 0.1 m). What can be stated are means. The reference therefore is an ensemble: starts disturbed
normally to the sheet by random heights of 1e-12, 1e-9 and 1e-6 m; value = mean over all members, spread =
their standard deviation, which is the error bar of any single calculation of this scene. The positions of
the free corners are given as well; their spread shows until when they mean something.
"""

from __future__ import annotations

import argparse
import json
import re
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

CELLS, DENSITY, C11, C33, BENDING, GRAVITY = 15, 0.1, 1e6, 5e5, 1e-4, 9.81  # –, kg/m², N/m, N/m, N·m, m/s²
HELD = (CELLS * (CELLS + 1), (CELLS + 1) ** 2 - 1)  # corners at y = 1 m
TIMES = tuple(round(0.04 * i, 2) for i in range(1, 13))  # s
STEP = 1e-5  # s
DISTURBANCES = (1e-12, 1e-9, 1e-6)  # m

# coefficients of PEFRL: drifts ξ, χ, 1 − 2(χ + ξ), χ, ξ and kicks ½ − λ, λ, λ, ½ − λ
XI, LAMBDA, CHI = 0.1786178958448091, -0.2123418310626054, -0.06626458266981849


class Sheet:
    """The square with its triangles and hinges; arrays as the kernel wants them."""

    def __init__(self) -> None:
        row = CELLS + 1
        self.start = np.array([[i / CELLS, j / CELLS, 0.0] for j in range(row) for i in range(row)])
        low = [j * row + i for j in range(CELLS) for i in range(CELLS)]
        self.triangles = np.array(
            [t for a in low for t in ([a, a + 1, a + row + 1], [a, a + row + 1, a + row])]
        )
        corners = self.start[self.triangles][:, :, :2]
        sides = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
        self.inverse, self.area = np.linalg.inv(sides), 0.5 * np.linalg.det(sides)
        self.mass = np.bincount(self.triangles.ravel(), np.repeat(self.area * DENSITY / 3.0, 3))
        seen: dict[tuple[int, int], tuple[int, int]] = {}
        hinges, stiffness = [], []
        for face, (a, b, c) in enumerate(self.triangles):
            for tail, head, opposite in ((a, b, c), (b, c, a), (c, a, b)):
                if (head, tail) in seen:
                    other, beyond = seen[head, tail]
                    hinges.append([head, tail, beyond, opposite])
                    square = ((self.start[head] - self.start[tail]) ** 2).sum()
                    stiffness.append(BENDING * square / (2.0 * (self.area[face] + self.area[other])))
                seen[tail, head] = face, opposite
        self.hinges, self.stiffness = np.array(hinges), np.array(stiffness)
        self.free = np.ones(len(self.start))
        self.free[list(HELD)] = 0.0


@njit
def between(x, a, b):  # type: ignore[no-untyped-def]
    """Vector from vertex a to vertex b."""
    return x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]


@njit
def cross(p, q):  # type: ignore[no-untyped-def]
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]


@njit
def dot(p, q):  # type: ignore[no-untyped-def]
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@njit
def forces(x, triangles, inverse, area, hinges, stiffness, f):  # type: ignore[no-untyped-def]
    """Internal forces [N] into f (V, 3); returns the elastic energy [J]."""
    f[:] = 0.0
    energy = 0.0
    for e in range(triangles.shape[0]):
        a, b, c = triangles[e, 0], triangles[e, 1], triangles[e, 2]
        p, q = between(x, a, b), between(x, a, c)
        i00, i01, i10, i11 = inverse[e, 0, 0], inverse[e, 0, 1], inverse[e, 1, 0], inverse[e, 1, 1]
        u = p[0] * i00 + q[0] * i10, p[1] * i00 + q[1] * i10, p[2] * i00 + q[2] * i10
        v = p[0] * i01 + q[0] * i11, p[1] * i01 + q[1] * i11, p[2] * i01 + q[2] * i11
        e0, e1, shear = 0.5 * (dot(u, u) - 1.0), 0.5 * (dot(v, v) - 1.0), dot(u, v)
        energy += 0.5 * area[e] * (C11 * e0 * e0 + C11 * e1 * e1 + C33 * shear * shear)
        s0, s1, s2 = area[e] * C11 * e0, area[e] * C11 * e1, area[e] * C33 * shear
        for i in range(3):
            pu, pv = s0 * u[i] + s2 * v[i], s1 * v[i] + s2 * u[i]
            fb, fc = pu * i00 + pv * i01, pu * i10 + pv * i11
            f[b, i] -= fb
            f[c, i] -= fc
            f[a, i] += fb + fc
    for h in range(hinges.shape[0]):
        a, b, c, d = hinges[h, 0], hinges[h, 1], hinges[h, 2], hinges[h, 3]
        edge, p, q = between(x, a, b), between(x, a, c), between(x, a, d)
        n1, n2 = cross(edge, p), cross(q, edge)
        square = dot(edge, edge)
        length = np.sqrt(square)
        angle = np.arctan2(dot(cross(n1, n2), edge) / length, dot(n1, n2))
        energy += stiffness[h] * angle * angle
        moment = 2.0 * stiffness[h] * angle
        # gradient of the angle: −|e| n/|n|² at the opposite vertices, shared by the lever rule on the edge
        first, second = -moment * length / dot(n1, n1), -moment * length / dot(n2, n2)
        s, t = dot(p, edge) / square, dot(q, edge) / square
        for i in range(3):
            f[c, i] -= first * n1[i]
            f[d, i] -= second * n2[i]
            f[b, i] += s * first * n1[i] + t * second * n2[i]
            f[a, i] += (1.0 - s) * first * n1[i] + (1.0 - t) * second * n2[i]
    return energy


@njit
def advance(x, v, dt, steps, triangles, inverse, area, hinges, stiffness, mass, free):  # type: ignore[no-untyped-def]
    """So many steps in place."""
    drifts = dt * np.array([XI, CHI, 1.0 - 2.0 * (CHI + XI), CHI, XI])
    kicks = dt * np.array([0.5 - LAMBDA, LAMBDA, LAMBDA, 0.5 - LAMBDA])
    f = np.zeros_like(x)
    for _ in range(steps):
        for stage in range(5):
            for a in range(x.shape[0]):
                for i in range(3):
                    x[a, i] += drifts[stage] * v[a, i]
            if stage == 4:
                break
            forces(x, triangles, inverse, area, hinges, stiffness, f)
            for a in range(x.shape[0]):
                for i in range(3):
                    g = GRAVITY if i == 2 else 0.0
                    v[a, i] += kicks[stage] * free[a] * (f[a, i] / mass[a] - g)


def motion(disturbance: float = 0.0, seed: int = 0, step: float = STEP) -> Array:
    """Kinetic and elastic energy, total energy, mean (y, z), mean (y, z) of the edge y = 0, its corners.

    Returns
    -------
    (T, 13) float64
        One row for each time; [J] and [m].
    """
    sheet = Sheet()
    noise = np.random.default_rng(seed).standard_normal(len(sheet.start))
    x = sheet.start.copy()
    x[:, 2] += disturbance * noise * sheet.free
    v, f = np.zeros_like(x), np.zeros_like(x)
    elements = sheet.triangles, sheet.inverse, sheet.area, sheet.hinges, sheet.stiffness
    rows, t = [], 0.0
    for end in TIMES:
        steps = max(1, round((end - t) / step))
        advance(x, v, (end - t) / steps, steps, *elements, sheet.mass, sheet.free)
        t = end
        kinetic = 0.5 * float((sheet.mass[:, None] * v**2).sum())
        elastic = forces(x, *elements, f)
        total = kinetic + elastic + GRAVITY * float(sheet.mass @ x[:, 2])
        mean, edge = sheet.mass @ x / sheet.mass.sum(), x[: CELLS + 1].mean(axis=0)
        rows.append([kinetic, elastic, total, *mean[1:], *edge[1:], *x[0], *x[CELLS]])
    return np.array(rows)


COLUMNS = (
    "kinetic_energy",
    "elastic_energy",
    "total_energy",
    "mean_y",
    "mean_z",
    "edge_y",
    "edge_z",
    *(f"corner_{k}_{axis}" for k in (0, CELLS) for axis in "xyz"),
)


def results(seeds: int) -> dict[str, Any]:
    """All numbers, as they go into the file."""
    members = {d: np.array([motion(d, seed) for seed in range(seeds)]) for d in DISTURBANCES}
    everything = np.concatenate(list(members.values()))
    undisturbed, halved = motion(), motion(step=STEP / 2)
    early = int(np.searchsorted(TIMES, 0.2))
    return {
        "source": "Ensemble of explicit fourth-order calculations, scripts/references/paper.py",
        "what": "mean and standard deviation over disturbed starts; J and m; the edge is y = 0",
        "members": len(everything),
        "step": STEP,
        "energy_drift": float(f"{np.abs(undisturbed[:, 2]).max():.1e}"),
        "change_when_halved_until_0.2": float(f"{np.abs(undisturbed - halved)[: early + 1].max():.1e}"),
        "times": list(TIMES),
        "mean": {name: digits(everything[:, :, i].mean(axis=0)) for i, name in enumerate(COLUMNS)},
        "spread": {name: digits(everything[:, :, i].std(axis=0, ddof=1)) for i, name in enumerate(COLUMNS)},
        "at_the_end": {
            f"{d:g}": {
                name: [digits(rows[:, -1, i].mean()), digits(rows[:, -1, i].std(ddof=1))]
                for i, name in enumerate(COLUMNS)
            }
            for d, rows in members.items()
        },
    }


def digits(values: Any) -> Any:
    """To 1e-7."""
    return np.round(values, 7).tolist()


def main() -> None:
    parser = argparse.ArgumentParser(description="Reference answer of the paper scene, as JSON.")
    parser.add_argument("--seeds", type=int, default=6, help="members for each disturbance")
    text = json.dumps(results(parser.parse_args().seeds), indent=1, ensure_ascii=False)
    print(re.sub(r"\[\s+([^\[\]]*?)\s+\]", lambda row: f"[{' '.join(row[1].split())}]", text))


if __name__ == "__main__":
    main()
