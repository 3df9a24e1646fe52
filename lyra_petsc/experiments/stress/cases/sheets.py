"""Scenes, start shapes and judgements of the cases of ``stress`` on single sheets, see ``cases.yaml``.

Functions that change a scene modify the content of a scene file in place.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.case import Verdict
from lyra_petsc.experiments.meshes import rectangle
from lyra_petsc.experiments.stress.stress_scenes import (
    CELLS,
    Content,
    Scope,
    Setting,
    hanging_sheet,
    move_handles,
    remove_handles,
    scale,
)
from lyra_petsc.experiments.stress.verdicts import RunRecord
from lyra_petsc.experiments.verification.verification_case import grid
from lyra_petsc.terms.stretch import SOFTENS_BELOW


def product(setting: Setting, bench: Bench, **factors: float) -> Content:
    """The base scene with several factors; the default base scene with a coarser mesh."""
    content = setting.content()
    if not setting.of_user:
        content |= {key: hanging_sheet(CELLS[Scope.QUICK])[key] for key in ("mesh", "handles")}
    return scale(content, **factors)


def products() -> dict[str, dict[str, Any]]:
    """The cases of the family ``products``."""
    cases: dict[str, dict[str, Any]] = {}
    for stretching, step, bending, density in itertools.product(
        ("1", "1e3", "1e6", "1e9"),
        ("1e-4", "5e-3", "4e-2", "1"),
        ("0", "1", "1e3", "1e6"),
        ("1e-3", "1", "1e3"),
    ):
        factors = {"stretching": float(stretching), "bending": float(bending), "density": float(density)}
        cases[f"all-{stretching}-{step}-{bending}-{density}"] = {
            "title": f"membrane × {stretching}, Δt {step} s, bending × {bending}, density × {density}",
            "level": "full",
            "steps": 5,
            "step": float(step),
            "scene": {"product": factors},
        }
    return cases


def noisy(x: Array, spacing: float) -> Array:
    # standard deviation of each coordinate over the mean edge length
    return np.asarray(x + 0.3 * spacing * np.random.default_rng(1).standard_normal(x.shape))


def crumpled(x: Array, spacing: float) -> Array:
    """Folded repeatedly along random planes near the middle of the present shape."""
    random = np.random.default_rng(2)
    y = x - x.mean(axis=0)
    for _ in range(12):
        normal = random.standard_normal(3)
        normal /= np.linalg.norm(normal)
        height = y @ normal
        height -= height.mean() + 0.1 * np.ptp(height) * random.uniform(-1.0, 1.0)
        y = y - 2.0 * np.maximum(height, 0.0)[:, None] * normal
    return np.asarray(y + x.mean(axis=0))


def folded(x: Array, spacing: float, degrees: float = 180.0) -> Array:
    """Folded by an angle at the vertex that is nearest to the middle of the longest side."""
    along, angle = int(np.argmax(np.ptp(x, axis=0))), np.radians(degrees)
    up = 2 if along != 2 else 0
    middle = 0.5 * (x[:, along].min() + x[:, along].max())
    # through a vertex: cells that are folded in their middle would lose all their area
    crease = x[np.argmin(np.abs(x[:, along] - middle)), along]
    y, beyond = x.copy(), x[:, along] > crease
    offset, height = x[beyond, along] - crease, x[beyond, up]
    y[beyond, along] = crease + np.cos(angle) * offset - np.sin(angle) * height
    y[beyond, up] = np.sin(angle) * offset + np.cos(angle) * height
    return y


def mirrored(x: Array, spacing: float) -> Array:
    """Mirrored at a horizontal plane, so that a curved shell is turned inside out."""
    y = x.copy()
    y[:, 2] = 2.0 * x[:, 2].min() - x[:, 2]
    return y


def dome(setting: Setting, bench: Bench) -> Content:
    """A dome held at its rim; for a given scene its own sheet without handles."""
    content = setting.content()
    if setting.of_user:
        return remove_handles(content)
    n = CELLS[setting.level]
    vertices, triangles = rectangle(n, n, 1.0, 1.0)
    u, v = 2.0 * vertices[:, 0] - 1.0, 2.0 * vertices[:, 1] - 1.0
    # height of the dome [m]
    vertices[:, 2] = 0.15 * (1.0 - u**2) * (1.0 - v**2)
    rim = np.flatnonzero(np.maximum(np.abs(u), np.abs(v)) > 1.0 - 1e-9)
    return content | {"mesh": bench.mesh(vertices, triangles), "handles": [{"nodes": rim.tolist()}]}


def spin(content: Content) -> Content:
    # angular velocity [rad/s]
    content["initial"] = {**(content.get("initial") or {}), "angular_velocity": [3.0, 20.0, 1.0]}
    return content


def slivers(setting: Setting, bench: Bench) -> Content:
    """A strip held at one end, two cells long and a hundred high, of triangles with sides as 1 to 1000."""
    nx, ny = 2, 100
    mesh = bench.mesh(*rectangle(nx, ny, 1.0, 1e-3 * ny / nx))
    return setting.content() | {"mesh": mesh, "handles": [{"nodes": [j * (nx + 1) for j in range(ny + 1)]}]}


def graded(setting: Setting, bench: Bench) -> Content:
    """A square held at two corners, with cells that grow from one corner on."""
    n = 24
    # ratio of the largest to the smallest element
    sizes = 1e4 ** (np.arange(n) / (n - 1.0))
    coordinates = np.concatenate([[0.0], np.cumsum(sizes)]) / sizes.sum()
    vertices, triangles = rectangle(n, n, float(n), float(n))
    vertices[:, :2] = coordinates[np.rint(vertices[:, :2]).astype(np.int64)]
    return setting.content() | {"mesh": bench.mesh(vertices, triangles), "handles": [{"nodes": [0, n]}]}


def one_triangle(setting: Setting, bench: Bench) -> Content:
    """A single triangle, hung by one corner and a thousand times as stiff as the base scene."""
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.3, 0.9, 0.0]])
    content = scale(setting.content(), stretching=1e3)
    return content | {"mesh": bench.mesh(vertices, np.array([[0, 1, 2]])), "handles": [{"nodes": [0]}]}


SIDES = [{"group": "left"}, {"group": "right"}]
STEPS = 40
"""Steps of the cases with moving handles."""


def jump(setting: Setting, bench: Bench) -> Content:
    # displacement of handles over the size of the sheet
    far = [part * setting.size for part in (0.15, 0.1, 0.2)]
    still = {"time": 2.0 * setting.step}
    return move_handles(
        setting.content(), [{"time": 0.0}, still, {"time": 3.0 * setting.step, "translate": far}]
    )


def turn_handles(content: Content) -> Content:
    # turns of handles per second
    turns = 10.0
    quarters = int(4.0 * turns * STEPS * float(content["time"]["step"])) + 2
    turn = [
        {"time": k / (4.0 * turns), "rotate": {"axis": [0.0, 0.0, 1.0], "degrees": 90.0 * k}}
        for k in range(quarters)
    ]
    return move_handles(content, turn)


def pull(setting: Setting, bench: Bench, to: float) -> Content:
    """Scale the positions of handles along x; in the default base scene both sides are held."""
    content = setting.content()
    if not setting.of_user:
        content["handles"] = [dict(side) for side in SIDES]
    end = 0.75 * STEPS * setting.step
    return move_handles(content, [{"time": 0.0}, {"time": end, "scale": [to, 1.0, 1.0]}])


def pressed(setting: Setting, bench: Bench) -> Content:
    content = setting.content() | {"handles": [dict(side) for side in SIDES]}
    # final width over the initial one; well below 1/√3
    move_handles(content, [{"time": 0.0}, {"time": STEPS * setting.step, "scale": [0.4, 1.0, 1.0]}])
    # the sheet cannot leave its plane
    content["handles"].append({"group": "sheet", "axes": ["z"]})
    return content


def compressed(setting: Setting, bench: Bench, record: RunRecord) -> Mapping[str, Verdict]:
    smallest = record.stretches[0]
    return {"compressed": Verdict(smallest < SOFTENS_BELOW, f"to {smallest:.3f} of its length")}


# -- sheets that bend by directors -----------------------------------------------------------------------

MOVED = 0.4
"""Time [s] in which ends and sides move."""


def strip(
    content: Content, degrees: float = 0.0, parts: int = 1, length: float = 1.0, integrator: str = "beuler"
) -> Content:
    """A strip, clamped at both ends, one of which turns in equal parts or comes closer to the other.

    ``length`` is the final distance of the ends over the initial one.
    """
    content["mesh"] = grid(1.0, 0.3, 40, 12, "alternating") | {"transform": {"translate": [0.0, -0.15, 0.0]}}
    content["time"] = {**content["time"], "integrator": integrator}
    content["handles"] = [{"group": "right", "clamp": True}]
    turns = [{"axis": [1.0, 0.0, 0.0], "degrees": degrees * k / parts} for k in range(parts + 1)]
    twist: list[dict[str, Any]] = [
        {"time": MOVED * k / parts, "rotate": turn} for k, turn in enumerate(turns)
    ]
    crush: list[dict[str, Any]] = [{"time": 0.0}, {"time": MOVED, "scale": [length, 1.0, 1.0]}]
    content = move_handles(content, twist if degrees else crush)
    content["handles"].append({"group": "left", "clamp": True})
    return content


def draw_together(content: Content) -> Content:
    """Move the four sides of the sheet towards its centre, to 0.3 of its width."""
    content["handles"] = [{"group": side} for side in ("left", "right", "bottom", "top")]
    return move_handles(content, [{"time": 0.0}, {"time": MOVED, "scale": [0.3, 0.3, 1.0]}])
