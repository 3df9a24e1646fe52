"""Reference answers of the swing: a sheet of 1 m released flat with one edge held (uniform along that edge).

    python scripts/references/swing.py [--quick] > tests/reference/swing.json

The sheet without bending and with c12 = 0 moves like a string of St. Venant-Kirchhoff bars: energy per
width ``½ c11 E² h`` with ``E = (l²/h² − 1)/2``, lumped masses (ρh, half of it at the free end). That is what
a structured triangle mesh with n cells along the strip gives when nothing varies along the held edge, so
that the numbers for one n are those of a mesh (semi-discrete) and their limit is the continuum's.

Independent of the package: explicit, symplectic, fourth order (PEFRL; Omelyan, Mryglod, Folk, Comput. Phys.
Commun. 146, 2002), steps below the time a longitudinal wave needs for one cell, so that those waves are
resolved at every c11. The error in time is the change when the step is halved, the limit n → ∞ is
Aitken's of three meshes, each twice as fine as the one before, and its error the distance to the limit
of the meshes one coarser. A chain of rigid links (Runge-Kutta 8(5,3), angles as unknowns) is the limit
c11 → ∞ and cross-checks the 1e7 N/m result. Only times before the free edge is whipped round (at 0.45 s)
are given: up to then no bar is pressed by more than round-off, and z is −½ g t².
"""

from __future__ import annotations

import argparse
import json
import re
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import solve_banded

Array = NDArray[np.float64]

LENGTH, DENSITY, GRAVITY = 1.0, 0.2, 9.81  # m, kg/m², m/s²
STIFFNESSES = (1e3, 1e5, 1e7)  # c11, N/m
TIMES = (0.1, 0.2, 0.3, 0.4)  # s
ENDS = (50, 70, 100, 200, 400, 800)  # cells; three doublings for the limit, 70 for the 71 × 71 sheet
COARSE = (8, 16, 20, 24, 32, 40)

# coefficients of PEFRL: drifts ξ, χ, 1 − 2(χ + ξ), χ, ξ and kicks ½ − λ, λ, λ, ½ − λ
XI, LAMBDA, CHI = 0.1786178958448091, -0.2123418310626054, -0.06626458266981849


@njit(cache=False)
def accelerate(x, c11, ax):  # type: ignore[no-untyped-def]
    """Accelerations of nodes 1..n (x, z) into ax (n+1, 2); returns the smallest tension [N/m]."""
    n = x.shape[0] - 1
    h = LENGTH / n
    px = pz = 0.0
    least = np.inf
    for i in range(1, n + 1):
        dx, dz = (x[i, 0] - x[i - 1, 0]) / h, (x[i, 1] - x[i - 1, 1]) / h
        stress = c11 * 0.5 * (dx * dx + dz * dz - 1.0)
        least = min(least, stress)
        tx, tz = stress * dx, stress * dz
        if i > 1:
            ax[i - 1, 0], ax[i - 1, 1] = (tx - px) / (DENSITY * h), (tz - pz) / (DENSITY * h) - GRAVITY
        px, pz = tx, tz
    ax[n, 0], ax[n, 1] = -px / (0.5 * DENSITY * h), -pz / (0.5 * DENSITY * h) - GRAVITY
    return least


@njit(cache=False)
def advance(x, v, c11, dt, steps):  # type: ignore[no-untyped-def]
    """So many steps in place; returns the smallest tension met [N/m]."""
    drifts = dt * np.array([XI, CHI, 1.0 - 2.0 * (CHI + XI), CHI, XI])
    kicks = dt * np.array([0.5 - LAMBDA, LAMBDA, LAMBDA, 0.5 - LAMBDA])
    a = np.zeros_like(x)
    least = np.inf
    for _ in range(steps):
        for stage in range(5):
            for i in range(1, x.shape[0]):
                x[i, 0] += drifts[stage] * v[i, 0]
                x[i, 1] += drifts[stage] * v[i, 1]
            if stage == 4:
                break
            least = min(least, accelerate(x, c11, a))
            for i in range(1, x.shape[0]):
                v[i, 0] += kicks[stage] * a[i, 0]
                v[i, 1] += kicks[stage] * a[i, 1]
    return least


def energy(x: Array, v: Array, c11: float) -> float:
    """Kinetic, elastic and potential energy per width [J/m]; 0 at the start."""
    n = len(x) - 1
    h = LENGTH / n
    mass = np.full(n + 1, DENSITY * h)
    mass[[0, -1]] *= 0.5
    strain = 0.5 * ((np.diff(x, axis=0) ** 2).sum(axis=1) / h**2 - 1.0)
    kinetic = 0.5 * mass @ (v**2).sum(axis=1)
    return float(kinetic + 0.5 * c11 * h * (strain**2).sum() + GRAVITY * mass @ x[:, 1])


def swing(n: int, c11: float, cfl: float = 0.5) -> dict[str, Any]:
    """Free end (x, z) [m] of n bars at the times, with the smallest tension and the drift of the energy."""
    x = np.column_stack([np.linspace(0.0, LENGTH, n + 1), np.zeros(n + 1)])
    v = np.zeros_like(x)
    longest = cfl * (LENGTH / n) / np.sqrt(c11 / DENSITY)
    ends, least, t = [], np.inf, 0.0
    for end in TIMES:
        steps = int(np.ceil((end - t) / longest))
        least = min(least, advance(x, v, c11, (end - t) / steps, steps))
        t = end
        ends.append(x[-1].copy())
    return {"edge": np.array(ends), "tension": least, "drift": energy(x, v, c11)}


def links(state: Array, mass: Array) -> Array:
    """Rates of angles and angular velocities of n rigid links; angle 0 is along x, positive upwards."""
    n = len(mass)
    h, inverse = LENGTH / n, 1.0 / mass
    angle, rate = state[:n], state[n:]
    along = np.stack([np.cos(angle), np.sin(angle)])
    # (a_i − a_{i−1})·e_i = −h ω_i² with m_i a_i = T_{i+1} e_{i+1} − T_i e_i + m_i g: tridiagonal in T
    beside = -inverse[:-1] * (along[:, 1:] * along[:, :-1]).sum(axis=0)
    matrix = np.stack(
        [np.append(0.0, beside), inverse + np.append(0.0, inverse[:-1]), np.append(beside, 0.0)]
    )
    right = h * rate**2
    right[0] -= GRAVITY * along[1, 0]  # the held end does not fall
    pull = solve_banded((1, 1), matrix, right) * along
    acceleration = inverse * np.diff(pull, axis=1, append=0.0)
    acceleration[1] -= GRAVITY
    x, z = np.diff(acceleration, axis=1, prepend=0.0)
    return np.concatenate([rate, (z * along[0] - x * along[1]) / h])


def rigid(n: int) -> Array:
    """Free end (x, z) [m] of n rigid links at the times."""
    mass = np.full(n, DENSITY * LENGTH / n)
    mass[-1] *= 0.5
    solution = solve_ivp(
        lambda t, y: links(y, mass),
        (0.0, TIMES[-1]),
        np.zeros(2 * n),
        method="DOP853",
        t_eval=TIMES,
        rtol=1e-10,
        atol=1e-12,
    )
    assert solution.success, solution.message
    angle = solution.y[:n]
    return LENGTH / n * np.column_stack([np.cos(angle).sum(axis=0), np.sin(angle).sum(axis=0)])


def limit(coarse: Array, middle: Array, fine: Array) -> Array:
    """Aitken's limit of a sequence with one leading error term; the finest where that is all round-off."""
    first, second = middle - coarse, fine - middle
    curved = np.abs(first - second) > 1e-9
    return np.asarray(fine - np.where(curved, second**2 / np.where(curved, second - first, 1.0), 0.0))


def extrapolated(series: list[Array]) -> tuple[Array, Array]:
    """Limit of four meshes, each twice as fine, and its error from the three coarser ones."""
    best = limit(*series[-3:])
    return best, np.abs(best - limit(*series[-4:-1]))


def results(quick: bool) -> dict[str, Any]:
    """All numbers, as they go into the file."""
    cells = (*COARSE, *(ENDS[:-1] if quick else ENDS))
    out: dict[str, Any] = {
        "source": "Converged one-dimensional calculation, scripts/references/swing.py",
        "what": "Free edge (x, z); continuum: n → ∞ with its uncertainty [m]; cells: n along the strip",
        "problem": {"length": LENGTH, "density": DENSITY, "gravity": GRAVITY, "c12": 0.0, "bending": 0.0},
        "columns": ["t [s]", "x [m]", "z [m]"],
        "stiffness": {},
    }
    for c11 in STIFFNESSES:
        coarser = {n: swing(n, c11, cfl=1.0)["edge"] for n in cells}
        runs = {n: swing(n, c11) for n in cells}
        ends = {n: run["edge"] for n, run in runs.items()}
        doubled = [n for n in cells if n in ENDS and n != 70]
        best, error = extrapolated([ends[n] for n in doubled[-4:]])
        out["stiffness"][f"{c11:g}"] = {
            "continuum": rows(best),
            "uncertainty": float(f"{error.max():.1e}"),
            "time_error": float(f"{max(np.abs(ends[n] - coarser[n]).max() for n in cells):.1e}"),
            "energy_drift": float(f"{max(abs(run['drift']) for run in runs.values()):.1e}"),
            "smallest_tension": float(f"{min(run['tension'] for run in runs.values()):.1e}"),
            "cells": {str(n): rows(ends[n]) for n in cells},
        }
    chain = {n: rigid(n) for n in (25, 50, 100, 200)}
    best, error = extrapolated(list(chain.values()))
    out["rigid_links"] = {
        "continuum": rows(best),
        "uncertainty": float(f"{error.max():.1e}"),
        "cells": {str(n): rows(end) for n, end in chain.items()},
    }
    return out


def rows(ends: Array) -> list[list[float]]:
    """Times with positions, to 1e-7 m."""
    return [[t, *(round(float(value), 7) for value in end)] for t, end in zip(TIMES, ends, strict=True)]


def main() -> None:
    parser = argparse.ArgumentParser(description="Reference answers of the swing, as JSON.")
    parser.add_argument("--quick", action="store_true", help="leave out 800 cells: seconds, larger error")
    arguments = parser.parse_args()
    text = json.dumps(results(arguments.quick), indent=1, ensure_ascii=False)
    print(re.sub(r"\[\s+([^\[\]]*?)\s+\]", lambda row: f"[{' '.join(row[1].split())}]", text))


if __name__ == "__main__":
    main()
