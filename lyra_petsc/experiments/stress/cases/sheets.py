"""Changes of the base scene: stiffnesses, density, damping, Δt, wind and weight, one by one and all at once.

Also sheets with bad elements, extreme start shapes, without handles, with violent handles; and sheets that
bend by directors on edges: stiff, at large steps, folded, twisted, crushed, crumpled.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.case import Verdict
from lyra_petsc.experiments.meshes import rectangle
from lyra_petsc.experiments.stress.stress_scenes import (
    CELLS,
    FULL,
    QUICK,
    STEP,
    USUAL,
    Content,
    Scope,
    Setting,
    StressCase,
    anisotropic,
    base_scene,
    base_with,
    family,
    hanging_sheet,
    move_handles,
    remove_handles,
    scale,
    scale_gravity,
    set_material,
    set_wind,
)
from lyra_petsc.experiments.stress.verdicts import RunRecord
from lyra_petsc.experiments.verification.verification_case import grid
from lyra_petsc.terms.stretch import SOFTENS_BELOW


def _scaled(what: str, parameter: str, levels: Mapping[str, Scope]) -> Iterator[StressCase]:
    """One case per factor on a parameter of `scale`."""
    for factor, level in levels.items():
        scene = base_with(scale, **{parameter: float(factor)})
        yield StressCase(f"{what}-{factor}", f"{what} × {factor}", scene, level=level)


# a main goal of the program: stiff sheets at Δt of 5 to 40 ms, solved in few iterations
stiff_steps = family(
    "stiff-steps",
    "membrane stiffness and Δt together, with bounds on iterations and wall time",
    *(
        StressCase(
            f"stiff-{factor}-{ms}ms", f"membrane × {factor}, Δt {ms} ms",
            base_with(scale, stretching=float(factor)), step=1e-3 * ms, level=QUICK, is_timed=True,
        )
        for factor in ("1e3", "1e6")
        for ms in (5, 40)
    ),
)  # fmt: skip

membrane = family(
    "membrane",
    "membrane stiffness × 1e-3 to 1e9",
    *_scaled("membrane", "stretching", {"1e-3": QUICK, "1": USUAL, "1e3": USUAL, "1e6": USUAL, "1e9": QUICK}),
)

bending = family(
    "bending",
    "bending stiffness × 0 to 1e6",
    *_scaled("bending", "bending", {"0": QUICK, "1": FULL, "1e3": USUAL, "1e6": QUICK}),
)

time_step = family(
    "time-step",
    "Δt from 1e-5 s to 1 s",
    *(
        StressCase(f"step-{step}", f"Δt {step} s", base_scene, steps=steps, step=float(step), level=level)
        for step, steps, level in (
            ("1e-5", 30, QUICK),
            ("1e-4", 30, USUAL),
            ("1e-3", 30, USUAL),
            ("1e-2", 20, USUAL),
            ("1e-1", 10, USUAL),
            ("1", 5, QUICK),
        )
    ),
)

density = family(
    "density",
    "density × 1e-3 to 1e3",
    *_scaled(
        "density",
        "density",
        {"1e-3": QUICK, "1e-2": FULL, "1e-1": FULL, "1e1": FULL, "1e2": FULL, "1e3": USUAL},
    ),
)

anisotropy = family(
    "anisotropy",
    "c11/c22 = 1e4, their mean staying",
    StressCase("stiff-warp", "c11/c22 = 1e4", base_with(anisotropic, ratio=1e4), level=QUICK),
    StressCase("stiff-weft", "c11/c22 = 1e-4", base_with(anisotropic, ratio=1e-4)),
)

damping = family(
    "damping",
    "γ 0 and 10 s",
    StressCase("damping-0", "no damping", base_with(set_material, damping=0.0)),
    StressCase("damping-10s", "damping γ = 10 s", base_with(set_material, damping=10.0), level=QUICK),
)


def _product(setting: Setting, bench: Bench, **factors: float) -> Content:
    """The base scene with several factors; the default base scene with a coarser mesh."""
    content = setting.content()
    if not setting.given:
        content |= {key: hanging_sheet(CELLS[QUICK])[key] for key in ("mesh", "handles")}
    return scale(content, **factors)


products = family(
    "products",
    "stiffness × Δt × bending × density",
    *(
        StressCase(
            f"all-{stretching}-{step}-{bending}-{density}",
            f"membrane × {stretching}, Δt {step} s, bending × {bending}, density × {density}",
            partial(_product, stretching=float(stretching), bending=float(bending), density=float(density)),
            steps=5,
            step=float(step),
            level=FULL,
        )
        for stretching, step, bending, density in itertools.product(
            ("1", "1e3", "1e6", "1e9"),
            ("1e-4", "5e-3", "4e-2", "1"),
            ("0", "1", "1e3", "1e6"),
            ("1e-3", "1", "1e3"),
        )
    ),
)


wind = family(
    "wind",
    "wind of 50 and 200 m/s",
    StressCase("wind-50", "wind 50 m/s", base_with(set_wind, speed=50.0)),
    StressCase("wind-200", "wind 200 m/s", base_with(set_wind, speed=200.0), level=QUICK),
)

gravity = family(
    "gravity",
    "gravity × 1000",
    StressCase("gravity-1000", "gravity × 1000", base_with(scale_gravity, factor=1000.0), level=QUICK),
)


def _noisy(x: Array, spacing: float) -> Array:
    # standard deviation of each coordinate over the mean edge length
    return np.asarray(x + 0.3 * spacing * np.random.default_rng(1).standard_normal(x.shape))


def _crumpled(x: Array, spacing: float) -> Array:
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


def _folded(x: Array, spacing: float, degrees: float = 180.0) -> Array:
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


def _mirrored(x: Array, spacing: float) -> Array:
    """Mirrored at a horizontal plane, so that a curved shell is turned inside out."""
    y = x.copy()
    y[:, 2] = 2.0 * x[:, 2].min() - x[:, 2]
    return y


def _dome(setting: Setting, bench: Bench) -> Content:
    """A dome held at its rim; for a given scene its own sheet without handles."""
    content = setting.content()
    if setting.given:
        return remove_handles(content)
    n = CELLS[setting.level]
    vertices, triangles = rectangle(n, n, 1.0, 1.0)
    u, v = 2.0 * vertices[:, 0] - 1.0, 2.0 * vertices[:, 1] - 1.0
    # height of the dome [m]
    vertices[:, 2] = 0.15 * (1.0 - u**2) * (1.0 - v**2)
    rim = np.flatnonzero(np.maximum(np.abs(u), np.abs(v)) > 1.0 - 1e-9)
    return content | {"mesh": bench.mesh(vertices, triangles), "handles": [{"nodes": rim.tolist()}]}


start = family(
    "start",
    "start shapes: noise, a crumpled ball, a flat fold, a shell turned inside out",
    StressCase("noise", "random noise of 0.3 elements, no handle", base_with(remove_handles), shape=_noisy),
    StressCase("crumpled", "crumpled into a ball", base_with(remove_handles), shape=_crumpled),
    StressCase(
        "folded", "folded flat, a crease of 180°", base_with(remove_handles), shape=_folded, level=QUICK
    ),
    StressCase("inside-out", "a shell turned inside out", _dome, shape=_mirrored),
)


def _with_spin(content: Content) -> Content:
    # angular velocity [rad/s]
    content["initial"] = {**(content.get("initial") or {}), "angular_velocity": [3.0, 20.0, 1.0]}
    return content


free = family(
    "free",
    "no handle: falling, and tumbling",
    StressCase("falling", "no handle, released at rest", base_with(remove_handles), level=QUICK),
    StressCase("tumbling", "no handle, thrown with 20 rad/s", base_with(remove_handles, _with_spin)),
)


ASPECT, RATIO = 1e3, 1e4
"""Aspect ratio of slivers, and ratio of the largest to the smallest element of the graded mesh."""


def _slivers(setting: Setting, bench: Bench) -> Content:
    """A strip held at one end, two cells long and a hundred high."""
    nx, ny = 2, 100
    mesh = bench.mesh(*rectangle(nx, ny, 1.0, ny / nx / ASPECT))
    return setting.content() | {"mesh": mesh, "handles": [{"nodes": [j * (nx + 1) for j in range(ny + 1)]}]}


def _graded(setting: Setting, bench: Bench) -> Content:
    """A square held at two corners, with cells that grow from one corner on."""
    n = 24
    sizes = RATIO ** (np.arange(n) / (n - 1.0))
    coordinates = np.concatenate([[0.0], np.cumsum(sizes)]) / sizes.sum()
    vertices, triangles = rectangle(n, n, float(n), float(n))
    vertices[:, :2] = coordinates[np.rint(vertices[:, :2]).astype(np.int64)]
    return setting.content() | {"mesh": bench.mesh(vertices, triangles), "handles": [{"nodes": [0, n]}]}


def _one_triangle(setting: Setting, bench: Bench) -> Content:
    """A single triangle, hung by one corner and a thousand times as stiff as the base scene."""
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.3, 0.9, 0.0]])
    content = scale(setting.content(), stretching=1e3)
    return content | {"mesh": bench.mesh(vertices, np.array([[0, 1, 2]])), "handles": [{"nodes": [0]}]}


elements = family(
    "elements",
    "slivers, elements of very different sizes, a single one",
    StressCase("slivers", "triangles with sides as 1 to 1000", _slivers, own_scene=True, level=QUICK),
    StressCase("graded", "elements whose sizes differ by 1e4", _graded, own_scene=True),
    StressCase(
        "one-triangle", "a single stiff triangle", _one_triangle, steps=40, own_scene=True, level=QUICK
    ),
)


SIDES = [{"group": "left"}, {"group": "right"}]
STEPS = 40


def _jump(setting: Setting, bench: Bench) -> Content:
    # displacement of handles over the size of the sheet
    far = [part * setting.size for part in (0.15, 0.1, 0.2)]
    still = {"time": 2.0 * setting.step}
    return move_handles(
        setting.content(), [{"time": 0.0}, still, {"time": 3.0 * setting.step, "translate": far}]
    )


def _turning(content: Content) -> Content:
    # turns of handles per second
    turns = 10.0
    quarters = int(4.0 * turns * STEPS * float(content["time"]["step"])) + 2
    turn = [
        {"time": k / (4.0 * turns), "rotate": {"axis": [0.0, 0.0, 1.0], "degrees": 90.0 * k}}
        for k in range(quarters)
    ]
    return move_handles(content, turn)


def _pull(setting: Setting, bench: Bench, to: float) -> Content:
    """Scale the positions of handles along x; in the default base scene both sides are held."""
    content = setting.content()
    if not setting.given:
        content["handles"] = [dict(side) for side in SIDES]
    end = 0.75 * STEPS * setting.step
    return move_handles(content, [{"time": 0.0}, {"time": end, "scale": [to, 1.0, 1.0]}])


handles = family(
    "handles",
    "handles that jump, spin, squeeze and stretch",
    StressCase("jump", "handles jump by a quarter of the sheet in one step", _jump, level=QUICK),
    StressCase("spin", "handles turn ten times a second", base_with(_turning), steps=STEPS),
    StressCase("squeeze", "handles come together to a tenth", partial(_pull, to=0.1), steps=STEPS),
    StressCase("stretch", "handles go apart threefold", partial(_pull, to=3.0), steps=STEPS, level=QUICK),
)

# -- a membrane that cannot buckle, compressed into the softening range of its model ----------------------


def _pressed(setting: Setting, bench: Bench) -> Content:
    content = setting.content() | {"handles": [dict(side) for side in SIDES]}
    # final width over the initial one; well below 1/√3
    move_handles(content, [{"time": 0.0}, {"time": STEPS * setting.step, "scale": [0.4, 1.0, 1.0]}])
    # the sheet cannot leave its plane
    content["handles"].append({"group": "sheet", "axes": ["z"]})
    return content


def _judge_compression(setting: Setting, bench: Bench, record: RunRecord) -> Mapping[str, Verdict]:
    smallest = record.stretches[0]
    return {"compressed": Verdict(smallest < SOFTENS_BELOW, f"to {smallest:.3f} of its length")}


compression = family(
    "compression",
    "a membrane pressed in its plane beyond a stretch of 1/√3",
    StressCase(
        "pressed", "pressed in its plane to 0.4 of its width", _pressed, steps=STEPS, own_scene=True,
        judge=_judge_compression, level=QUICK,
    ),
)  # fmt: skip


CRUSHED, CRUMPLED = 0.02, 0.3
"""Final length of a crushed strip and final width of a crumpled sheet, over the initial ones."""

MANY, FEW, LONG = 80, 20, 0.02
"""Numbers of steps of slow and fast cases, and Δt [s] of the fast ones."""


def _stiffer(content: Content) -> Content:
    return scale(content, stretching=8.0, bending=10.0)


def _strip(content: Content, frames: list[dict[str, Any]], integrator: str = "beuler") -> Content:
    """A strip, clamped at both ends, one of which moves."""
    content["mesh"] = grid(1.0, 0.3, 40, 12, "alternating") | {"transform": {"translate": [0.0, -0.15, 0.0]}}
    content["time"] = {**content["time"], "integrator": integrator}
    content["handles"] = [{"group": "right", "clamp": True}]
    content = move_handles(content, frames)
    content["handles"].append({"group": "left", "clamp": True})
    return content


def _drawn_together(content: Content) -> Content:
    """Move the four sides of the sheet towards its centre."""
    content["handles"] = [{"group": side} for side in ("left", "right", "bottom", "top")]
    return move_handles(content, [{"time": 0.0}, {"time": MANY * STEP, "scale": [CRUMPLED, CRUMPLED, 1.0]}])


def _twist(degrees: float, seconds: float, parts: int) -> list[dict[str, Any]]:
    """Keyframes of a rotation about x in equal parts."""
    turns = [{"axis": [1.0, 0.0, 0.0], "degrees": degrees * k / parts} for k in range(parts + 1)]
    return [{"time": seconds * k / parts, "rotate": turn} for k, turn in enumerate(turns)]


CRUSH: list[dict[str, Any]] = [{"time": 0.0}, {"time": MANY * STEP, "scale": [CRUSHED, 1.0, 1.0]}]


def _directors(
    name: str, title: str, *changes: Callable[..., Content], case: Any = (), **numbers: Any
) -> StressCase:
    """A case with directors on edges and further changes; ``case`` holds arguments of `StressCase`."""
    # as the first change, since the last one receives the numbers
    scene = base_with(partial(set_material, bending_model="midedge"), *changes, **numbers)
    return StressCase(f"directors-{name}", title, scene, **dict(case))


SLOW = {"steps": MANY, "own_scene": True}
FAST = {"steps": FEW, "step": LONG, "own_scene": True}
CREASED = {"shape": partial(_folded, degrees=179.0)}
TWICE, THRICE = _twist(720.0, MANY * STEP, 16), _twist(1080.0, FEW * LONG, FEW)

directors = family(
    "directors",
    "bending_model: midedge",
    _directors("plain", "as it is", case={"level": QUICK}),
    _directors("1e6-5ms", "membrane × 1e6, Δt 5 ms", scale, stretching=1e6, case={"step": 0.005}),
    _directors("1e6-40ms", "membrane × 1e6, Δt 40 ms", scale, stretching=1e6, case={"step": 0.04}),
    _directors("bending-1e6", "bending × 1e6", scale, bending=1e6),
    _directors("wind-200", "wind 200 m/s", set_wind, speed=200.0),
    _directors("spin", "handles turn ten times a second", _turning, case={"steps": FEW, "level": FULL}),
    _directors(
        "folded",
        "a crease of 179°, no handle",
        remove_handles,
        case={"shape": partial(_folded, degrees=179.0)},
    ),
    _directors("twist", "a stiff strip twisted by 720°", _stiffer, _strip, frames=TWICE, case=SLOW),
    _directors("twist-20ms", "a soft strip twisted by 1080°, Δt 20 ms", _strip, frames=THRICE, case=FAST),
    _directors("twist-bdf2", "the same with bdf2", _strip, frames=THRICE, integrator="bdf2", case=FAST),
    _directors("crush", "a stiff strip crushed to 2 %", _stiffer, _strip, frames=CRUSH, case=SLOW),
    _directors("crumpled", "all sides come together to 0.3", _drawn_together, case=SLOW),
)
