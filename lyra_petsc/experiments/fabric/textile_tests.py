"""The standard tests of textiles: KES-F 1 and 2, ASTM D1388, heart loop, Cusick's drape test.

Lengths are in m and forces in N; results are converted to the units of the tests.

KES-F: S. Kawabata, The standardization and analysis of hand evaluation, 2nd ed., Osaka 1980. Heart loop and
bending length: F. T. Peirce, The "handle" of cloth as a measurable quantity, Journal of the Textile Institute
21 (1930) T377-T416; ASTM D1388. Drape: BS 5058, of a whole cloth with several starts.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError, SolverError, suggest
from lyra_petsc.experiments.bench import Bench, failure_message
from lyra_petsc.experiments.case import Launcher, Watch
from lyra_petsc.experiments.drape import (
    CLOTH,
    MARGIN,
    STARTS,
    STEP,
    count_folds,
    drape_cloth,
    drape_coefficient,
    drape_scene,
    shadow,
)
from lyra_petsc.experiments.fabric.fabric_report import (
    Curve,
    FabricCase,
    FabricNumber,
    FabricOutcome,
    Record,
    outcome_of,
)
from lyra_petsc.experiments.fabric.specimens import Fabric, G
from lyra_petsc.experiments.meshes import irregular_rectangle, rectangle, square_to_disc
from lyra_petsc.experiments.verification.rods import loop_height
from lyra_petsc.extras import install_hint
from lyra_petsc.scene.material_block import KES_ANGLE, KES_CURVATURE
from lyra_petsc.scene.materials.library import GF_PER_CM, ShellMaterial
from lyra_petsc.scene.materials.measured_curves import force_at
from lyra_petsc.stepping.simulation import SteppedScene

TOLERANCES = {"force_tolerance": 1e-8, "step_tolerance": 1e-8}


def _scene(mesh: dict[str, Any], material: dict[str, Any], **more: Any) -> dict[str, Any]:
    static = {"time": {"analysis": "static"}, "solver": TOLERANCES}
    return static | {"mesh": mesh, "material": material, **more}


def _grid(width: float, height: float, nx: int, ny: int) -> dict[str, Any]:
    """Mesh of a specimen. One row of cells bends along mesh lines, where flat triangles do not lock."""
    return {"grid": {"width": width, "height": height, "nx": nx, "ny": ny, "pattern": "alternating"}}


def _shape(name: str, line: Array) -> Curve:
    """Curve of the middle line (n, 2) [m] of a strip."""
    return Curve(name, "x [cm]", "z [cm]", *(1e2 * line).T.tolist())


def _path(values: Sequence[float]) -> dict[str, Any]:
    """Keys of a static scene with equal load steps, one for each value except the first."""
    share = 1.0 / (len(values) - 1)
    return {"time": {"analysis": "static", "step": share}, "petsc": {"ts_adapt_dt_max": share}}


@contextmanager
def _load_path_simulation(
    bench: Bench, content: dict[str, Any], values: Sequence[float]
) -> Iterator[Iterator[SteppedScene]]:
    """The simulation of a scene at each of these values except the first, even if it takes shorter steps."""
    factors = [k / (len(values) - 1) for k in range(1, len(values))]
    with bench.simulation(content | _path(values), stops=factors[:-1]) as trial:
        yield trial.run_through(factors)


def _cycle(largest: float, steps: int, *, closed: bool) -> list[float]:
    """Path from 0 to ``largest`` to −``largest`` and, if ``closed``, back to ``largest``."""
    up = [largest * k / steps for k in range(steps + 1)]
    down = [largest * (1.0 - k / steps) for k in range(1, 2 * steps + 1)]
    return up + down + ([-value for value in down] if closed else [])


def _branches(x: Sequence[float], y: Sequence[float], steps: int) -> tuple[Any, Any]:
    """y as functions of x on the rising and falling branch of the last loop of a path `_cycle`."""
    xs, ys = np.array(x), np.array(y)
    down = slice(steps, 3 * steps + 1)
    up = slice(3 * steps, 5 * steps + 1) if len(xs) > 3 * steps + 1 else down
    falling, rising = (xs[down][::-1], ys[down][::-1]), (xs[up], ys[up])
    if up == down:
        rising = falling
    return (lambda at: np.interp(at, *rising)), (lambda at: np.interp(at, *falling))


def _add_loop_width(
    record: Record, name: str, up: Any, down: Any, at: float, unit: str, known: float
) -> None:
    """Add the mean width of a hysteresis loop at ±``at``, and the verdict on it."""
    width = 0.5 * float((up(at) - down(at)) + (up(-at) - down(-at)))
    record.numbers.append(FabricNumber(name, width, unit))
    record.claim(name, width, known, 0.01)


# -- KES-F 1 ---------------------------------------------------------------------------------------------

CLAMPED, GAUGE = 0.2, 0.05
"""Width of the clamps and distance between them [m]"""

FULL_LOAD = 500.0 * GF_PER_CM
"""Largest force of a tensile test [N/m]"""


PULLS = 30
"""Number of steps of a tensile test"""

TENSION = 10.0 * GF_PER_CM
"""Tension in a shear test [N/m]"""

SHEARED, SHEARS = KES_ANGLE, 16
"""Largest shear angle [°], and number of steps to it"""

WIDE = 15 * CLAMPED
"""Width [m] of a shear specimen, so large that its free sides do not matter"""

FAR = 100.0 * GAUGE
"""Length [m] of the springs that exert a nearly constant tension"""


def _tensile_force(shell: ShellMaterial, strain: float) -> float:
    """Force [N/m] of a strip without lateral contraction, by its curve or St. Venant-Kirchhoff."""
    if shell.curves:
        return shell.stretching * force_at(shell.curves[0], strain)
    return shell.c11 * (1.0 + strain) * 0.5 * ((1.0 + strain) ** 2 - 1.0)


def tensile(bench: Bench, fabric: Fabric, degrees: float) -> Record:
    """Tensile test: 20 cm × 5 cm between clamps, pulled to 500 gf/cm; EMT, WT, LT."""
    shell, record = fabric.shell(degrees), Record()
    strain = 0.01
    while _tensile_force(shell, strain) < FULL_LOAD and strain < 1.0:
        strain *= 1.02
    path = [1.1 * strain * (k / PULLS) ** 1.5 for k in range(PULLS + 1)]
    frames = [{"time": k / PULLS, "translate": [e * GAUGE, 0.0, 0.0]} for k, e in enumerate(path)]
    content = _scene(
        _grid(GAUGE, CLAMPED, 4, 12),
        fabric.turned(degrees),
        handles=[
            {"group": "left"},
            {"group": "right", "motion": "pull", "interpolation": "linear"},
            {"group": "sheet", "axes": ["z"]},
        ],
        motions={"pull": frames},
    )
    strains, forces = [0.0], [0.0]
    with _load_path_simulation(bench, content, path) as steps:
        for simulation in steps:
            strains.append(path[len(strains)])
            forces.append(abs(simulation.energy_balance.handle_forces(3)[0][0]) / CLAMPED)
            if forces[-1] >= FULL_LOAD:
                break
    percent, converted = [100.0 * e for e in strains], [f / GF_PER_CM for f in forces]
    record.curves = [Curve("tensile", "strain [%]", "force [gf/cm]", percent, converted)]
    if forces[-1] < FULL_LOAD:
        record.numbers = [
            FabricNumber(f"force at {percent[-1]:.3g} % (less than 500)", converted[-1], "gf/cm")
        ]
        return record
    emt = float(np.interp(FULL_LOAD, forces, strains))
    e = np.linspace(0.0, emt, 400)
    pulls = np.interp(e, strains, forces)
    work = float(0.5 * np.sum((pulls[1:] + pulls[:-1]) * np.diff(e)))
    record.numbers = [
        FabricNumber("EMT", 100.0 * emt, "%"),
        FabricNumber("WT", work / GF_PER_CM, "gf·cm/cm²"),
        FabricNumber("LT", work / (0.5 * FULL_LOAD * emt), "1"),
    ]
    return record


def shear(bench: Bench, fabric: Fabric, degrees: float) -> Record:
    """Shear test: 20 cm × 5 cm between clamps, ±8° under 10 gf/cm; G, 2HG at 0.5°, 2HG5 at 5°.

    The force is measured in the middle of a much wider specimen, since free sides shear less. The tension
    keeps its direction and contributes T tan φ; G and the widths of the loop are those of the remaining
    force.
    """
    record, shell = Record(), fabric.shell()
    rubs, rise, cells = shell.friction_force > 0.0, SHEARS, 40
    path = [0.0, *_cycle(SHEARED, rise, closed=rubs)]  # the first step applies the tension
    share, width = 1.0 / (len(path) - 1), WIDE / cells
    frames = [
        {"time": k * share, "translate": [GAUGE * math.tan(math.radians(a)), 0.0, 0.0]}
        for k, a in enumerate(path)
    ]
    middle = range(cells // 2 - 2, cells // 2 + 3)
    content = _scene(
        _grid(WIDE, GAUGE, cells, 2),
        fabric.turned(degrees),
        handles=[
            {"nodes": list(middle)},
            {"nodes": [node for node in range(cells + 1) if node not in middle]},
            {"group": "top", "axes": ["x", "z"], "motion": "shear", "interpolation": "linear"},
            {"group": "sheet", "axes": ["z"]},
            # long springs, as loads would grow until the end of a static analysis
            {
                "group": "top",
                "axes": ["y"],
                "motion": "tension",
                "stiffness": TENSION * width / FAR,
                "interpolation": "linear",
            },
        ],
        motions={
            "shear": frames,
            "tension": [{"time": 0.0}, {"time": share, "translate": [0.0, FAR, 0.0]}],
        },
    )
    forces = [0.0]
    with _load_path_simulation(bench, content, path) as steps:
        for simulation in steps:
            force = simulation.energy_balance.handle_forces(5)[0][0]
            forces.append(-float(force) / (len(middle) * width))
    angles, converted = path[1 : len(forces)], [f / GF_PER_CM for f in forces[1:]]
    record.curves = [Curve("shear", "angle [°]", "force [gf/cm]", angles, converted)]
    pull = TENSION / GF_PER_CM
    sheared = [f - pull * math.tan(math.radians(angle)) for f, angle in zip(converted, angles, strict=True)]
    up, down = _branches(angles, sheared, rise)
    stiffness = 0.5 * sum((f(2.5 * s) - f(0.5 * s)) / (2.0 * s) for f, s in ((up, 1), (down, -1)))
    record.numbers = [FabricNumber("G", stiffness, "gf/(cm·°)")]
    if shell.law != "measured" and not shell.curves:
        record.claim("G", stiffness, math.radians(shell.c33) / GF_PER_CM, 0.01)
    if rubs:
        known = 2.0 * shell.friction_force / GF_PER_CM
        for name, at in (("2HG", 0.5), ("2HG5", 5.0)):
            _add_loop_width(record, name, up, down, at, "gf/cm", known)
    return record


# -- KES-F 2 ---------------------------------------------------------------------------------------------

LENGTH = 0.01
"""Length of a bending specimen [m]"""

CURVED, TURNS = 100.0 * KES_CURVATURE, 10
"""Largest curvature [1/m], and number of steps to it"""


def _end_of_arc(curvature: float) -> Array:
    """Position (3,) [m] of the end of a strip that is bent to a circular arc."""
    half = 0.5 * curvature * LENGTH
    chord = LENGTH * np.sinc(half / math.pi)
    return np.array([chord * math.cos(half), 0.0, chord * math.sin(half)])


def _chuck(curvature: float) -> dict[str, Any]:
    """Keyframe of the chuck that moves and rotates the end of the strip as the arc."""
    angle = curvature * LENGTH
    turned = LENGTH * np.array([math.cos(angle), 0.0, math.sin(angle)])
    return {
        "rotate": {"axis": [0.0, 1.0, 0.0], "degrees": -math.degrees(angle)},
        "translate": (_end_of_arc(curvature) - turned).tolist(),
    }


def _chuck_rate(curvature: float) -> Array:
    """Derivative (3,) [m²] of the position of the chuck with respect to the curvature."""
    before, after = (_end_of_arc(curvature + change) for change in (-1e-3, 1e-3))
    return (after - before) / 2e-3


def bending(bench: Bench, fabric: Fabric, degrees: float) -> Record:
    """Bending test: 1 cm between chucks, wide, to ±2.5 cm⁻¹; B from 0.5 to 1.5 cm⁻¹, 2HB at both.

    The moment is the power of the chuck over its rate of rotation. This excludes the effect of the force
    along the sheet, which arises as the polygon of the mesh is slightly longer than the arc.
    """
    shell, record, cells, rise = fabric.shell(degrees), Record(), 20, TURNS
    limit = shell.friction_moment[0]
    path = _cycle(CURVED, rise, closed=limit > 0.0)
    share, width = 1.0 / (len(path) - 1), LENGTH / cells
    content = _scene(
        _grid(LENGTH, width, cells, 1),
        fabric.turned(degrees),
        handles=[
            {"group": "left", "clamp": True},
            {"group": "right", "clamp": True, "motion": "chuck", "interpolation": "linear"},
            *({"group": side, "symmetry": "y"} for side in ("bottom", "top")),  # as in the middle of 20 cm
        ],
        motions={"chuck": [{"time": k * share, **_chuck(kappa)} for k, kappa in enumerate(path)]},
    )
    moments = [0.0]
    with _load_path_simulation(bench, content, path) as steps:
        for simulation in steps:
            energy_balance, kappa = simulation.energy_balance, path[len(moments)]
            force, moment = energy_balance.handle_forces(4)[1], float(energy_balance.handle_moments()[1][1])
            moments.append((np.dot(force, _chuck_rate(kappa)) / LENGTH - moment) / width)
    converted = [float(m) / (1e-2 * GF_PER_CM) for m in moments]  # gf·cm/cm
    curvature = [1e-2 * kappa for kappa in path]
    record.curves = [Curve("bending", "curvature [1/cm]", "moment [gf·cm/cm]", curvature, converted)]
    up, down = _branches(curvature, converted, rise)
    stiffness = 0.5 * ((up(1.5) - up(0.5)) + (down(-0.5) - down(-1.5)))
    record.numbers = [FabricNumber("B", stiffness, "gf·cm²/cm")]
    record.claim("B", stiffness, shell.plate[0] / (1e-4 * GF_PER_CM), 0.01)
    if limit > 0.0:
        for at in (0.5, 1.5):
            known = 2.0 * limit / (1e-2 * GF_PER_CM)
            _add_loop_width(record, f"2HB at {at:g} cm⁻¹", up, down, at, "gf·cm/cm", known)
    return record


# -- cantilever ------------------------------------------------------------------------------------------


CELLS = 60
"""Cells along the overhanging strip"""


def _cantilever(bench: Bench, fabric: Fabric, degrees: float, length: float) -> tuple[float, Array]:
    """Simulate an overhanging strip; returns the angle [°] of its chord and its middle line (n, 2) [m]."""
    content = _scene(
        _grid(length, length / CELLS, CELLS, 1),
        fabric.turned(degrees),
        handles=[{"group": "left", "clamp": True}],
        gravity=[0.0, 0.0, -G],
    )
    with bench.simulation(content) as trial:
        x = trial.run().x
    line = 0.5 * (x[: CELLS + 1] + x[CELLS + 1 : 2 * (CELLS + 1)])[:, ::2]
    return math.degrees(math.atan2(-line[-1, 1], line[-1, 0])), line


def cantilever(bench: Bench, fabric: Fabric, degrees: float) -> Record:
    """Cantilever test: the overhang whose chord falls by 41.5°; bending length c, rigidity w c³."""
    from scipy.optimize import newton

    # prescribed angle of the chord [°]
    overhang = 41.5
    shell, record = fabric.shell(degrees), Record()
    weight = G * shell.density
    known = fabric.rigidity(degrees)
    line = np.empty((0, 2))

    def off(log_length: float) -> float:
        """In logarithms, as the angle is nearly a power of the length."""
        nonlocal line
        angle, line = _cantilever(bench, fabric, degrees, math.exp(log_length))
        return math.log(angle / overhang)

    first = math.log(2.0 * (known / weight) ** (1.0 / 3.0))
    # without a derivative this is the secant method
    length = math.exp(newton(off, first - 0.03, x1=first, tol=1e-4, disp=False))
    half = 0.5 * length
    rigidity = weight * half**3
    record.numbers = [
        FabricNumber("overhang", 1e2 * length, "cm"),
        FabricNumber("bending length c", 1e2 * half, "cm"),
        FabricNumber("flexural rigidity", 1e3 * rigidity / (1e-4 * GF_PER_CM), "mgf·cm"),
        FabricNumber("B", 1e6 * rigidity, "µN·m"),
    ]
    record.curves = [_shape("strip", line)]
    if not max(shell.friction_moment) > 0.0:
        record.claim("B", rigidity, known, 0.005)
    return record


# -- heart loop ------------------------------------------------------------------------------------------


def loop_length(height: float, strip: float) -> float:
    """Bending length c of a heart loop by Peirce's formula, in the unit of ``height`` and ``strip``.

    NaN for loops that are not longer than one without weight, or longer than any: as friction holds them.
    """
    # height of a weightless loop over the length of its strip, in Peirce's formula
    first = 0.1337 * strip
    angle = math.radians(32.85 * (height - first) / first)
    if not 0.0 < angle < 0.5 * math.pi:
        return math.nan
    return float(first * (math.cos(angle) / math.tan(angle)) ** (1.0 / 3.0))


def _start_loop(cells: int, half: float) -> Array:
    """Start shape of half a loop (cells + 1, 2) [m]: an arc of 270° with straight end, without stretch."""
    size, s = half / cells, (np.arange(cells) + 0.5) / cells

    def line(radius: float) -> Array:
        angle = np.clip((s - 1.0 / cells) / radius, 0.0, 1.5 * math.pi)
        sides = size * np.column_stack([np.sin(angle), np.cos(angle)])
        return np.concatenate([np.zeros((1, 2)), np.cumsum(sides, axis=0)])

    from scipy.optimize import brentq

    shortest = 0.5 / (1.5 * math.pi + 1.0)  # radius over half the length
    return line(brentq(lambda radius: line(radius)[-1, 0], shortest, 4.0 * shortest))


def loop(bench: Bench, fabric: Fabric, degrees: float) -> Record:
    """Heart loop: a strip whose ends are clamped together, pointing up; heights, bending length by Peirce."""
    shell, record, cells = fabric.shell(degrees), Record(), 64
    known = (fabric.rigidity(degrees) / (G * shell.density)) ** (1.0 / 3.0)
    strips, heights, shapes = [4.0 * known, 6.0 * known, 8.0 * known], [], []
    for strip in strips:
        half = 0.5 * strip
        flat, faces = rectangle(cells, 1, half, half / cells)
        line = _start_loop(cells, half)[np.rint(flat[:, 0] * cells / half).astype(int)]
        x, z = np.where(flat[:, 0] > half - 1e-9, 0.0, line[:, 0]), line[:, 1]
        nodes = np.arange(len(flat))
        content = _scene(
            bench.mesh(np.column_stack([x, flat[:, 1], z]), faces, rest=flat[:, :2]),
            fabric.turned(degrees),
            handles=[
                {"nodes": nodes[flat[:, 0] < 1e-12].tolist(), "clamp": True},
                {"nodes": nodes[flat[:, 0] > half - 1e-9].tolist(), "symmetry": "x"},
                {"nodes": nodes.tolist(), "axes": ["y"]},
            ],
            gravity=[0.0, 0.0, -G],
        )
        with bench.simulation(content) as trial:
            shapes.append(trial.run().x[: cells + 1, ::2])
        heights.append(-float(shapes[-1][-1, 1]))
    lengths = [loop_length(h, strip) for h, strip in zip(heights, strips, strict=True)]
    record.numbers = [
        FabricNumber(f"height of {1e2 * strip:.3g} cm", 1e2 * h, "cm")
        for h, strip in zip(heights, strips, strict=True)
    ]
    record.numbers.append(FabricNumber("bending length c, by Peirce's formula", 1e2 * lengths[1], "cm"))
    record.curves = [_shape(f"{1e2 * s:.3g} cm", shape) for s, shape in zip(strips, shapes, strict=True)]
    if not max(shell.friction_moment) > 0.0:
        for strip, height in zip(strips, heights, strict=True):
            name = f"height of {1e2 * strip:.3g} cm, against the elastica"
            record.claim(name, height, strip * loop_height(known / strip), 0.01)
    return record


def _disc(cells: int, seed: int) -> tuple[Array, Ints]:
    """A disc of radius 1: a square of irregular cells, so that folds have no preferred direction."""
    flat, faces = irregular_rectangle(cells, cells, 2.0, 2.0, seed)
    return square_to_disc(flat - [1.0, 1.0, 0.0]), faces


def cells_across(fabric: Fabric) -> int:
    """Cells along the diameter of the cloth: `ACROSS`, or as many as make them shorter than the bending
    length (B / w)^⅓ of warp and weft.
    """
    weight = G * fabric.shell().density
    shortest = min((fabric.rigidity(degrees) / weight) ** (1.0 / 3.0) for degrees in DIRECTIONS.values())
    # least number of cells along the diameter of the cloth
    return max(24, math.ceil(2.0 * CLOTH / shortest))


def cusick(bench: Bench, fabric: Fabric, degrees: float, folder: Path | None = None) -> Record:
    """Drape test: 30 cm on a disc of 18 cm; drape coefficient and folds, mean and scatter of five starts.

    The run of the first start is kept in a folder.
    """
    record, coefficients, counts = Record(), [], []
    dark = np.zeros((1, 1), dtype=np.bool_)
    for start in range(STARTS):
        flat, faces = _disc(cells_across(fabric), start)
        scene = drape_scene(bench, CLOTH * flat, faces, CLOTH * flat[:, :2], fabric.turned(degrees), start)
        if record.drape is None and folder is not None:
            title = {"title": f"Drape of {fabric.name}", "output": {"every": 2.0 * STEP}}
            x = bench.run(scene | title, folder)
        else:
            x = drape_cloth(bench, scene)
        if record.drape is None:
            record.drape, record.triangles = x, faces
        dark = shadow(x, faces)
        coefficients.append(100.0 * drape_coefficient(dark))
        counts.append(float(count_folds(dark)))
    record.numbers = [
        FabricNumber(name, float(np.mean(values)), unit, float(np.std(values, ddof=1)))
        for name, values, unit in (("drape coefficient", coefficients, "%"), ("folds", counts, "1"))
    ]
    record.shadow, record.extent = dark.astype(int).tolist(), 100.0 * MARGIN * CLOTH
    if not all(map(math.isfinite, coefficients)):
        record.stopped = "no shadow"
    return record


DIRECTIONS = {"warp": 0.0, "weft": 90.0}

Measure = Callable[..., Record]


@dataclass(frozen=True)
class TextileTest:
    """A textile test.

    Attributes
    ----------
    title : str
    measure : callable (bench, fabric, degrees) → Record
        With ``keeps_run``, also the folder of a run that is kept, or None.
    both : bool
        Run for warp and weft.
    direct : bool
        Use a direct linear solver.
    bends : bool
        Needs a bending stiffness.
    keeps_run : bool
    """

    title: str
    measure: Measure
    both: bool = True
    direct: bool = True
    bends: bool = True
    keeps_run: bool = False


TESTS = {
    "tensile": TextileTest("KES-F 1, 20 cm × 5 cm pulled to 500 gf/cm", tensile, bends=False),
    "shear": TextileTest("KES-F 1, 20 cm × 5 cm sheared to ±8°", shear, both=False, bends=False),
    "bending": TextileTest("KES-F 2, 1 cm bent to ±2.5 cm⁻¹", bending),
    "cantilever": TextileTest("ASTM D1388, overhang at 41.5°", cantilever),
    "loop": TextileTest("Peirce's heart loop", loop),
    "cusick": TextileTest(
        "BS 5058, 30 cm on a disc of 18 cm", cusick, both=False, direct=False, keeps_run=True
    ),
}
ALL = "all"


def cases_of(test: str) -> list[FabricCase]:
    """The cases of a test, or of all.

    Raises
    ------
    InputError
        For an unknown test.
    """
    if test != ALL and test not in TESTS:
        raise InputError(f"unknown test, {suggest(test, [*TESTS, ALL])}", key=test)
    cases = []
    for name in TESTS if test == ALL else [test]:
        title = TESTS[name].title
        if not TESTS[name].both:
            cases.append(FabricCase(name, title, name, 0.0))
            continue
        for thread, degrees in DIRECTIONS.items():
            cases.append(FabricCase(f"{name}-{thread}", f"{title}, {thread}", name, degrees))
    return cases


def run_case(
    comm: MPI.Comm, case: FabricCase, fabric: Fabric, watch: Watch, folder: Path | None = None
) -> FabricOutcome:
    """Run a test; collective, the same outcome on all ranks. A run that it keeps is in ``folder / NAME``."""
    began, test = time.perf_counter(), TESTS[case.test]
    with Bench(comm, watch, direct=test.direct) as bench:
        bench.watch()
        try:
            kept = [folder and folder / case.name] if test.keeps_run else []
            record = test.measure(bench, fabric, case.degrees, *kept)
        except SolverError as error:
            record = Record(stopped=failure_message(comm, error))
        except ArithmeticError as error:  # in formulas for numbers that all ranks have
            record = Record(stopped=f"no number: {error}")
        except ModuleNotFoundError as error:  # on all ranks
            record = Record(stopped=install_hint([str(error.name)]))
    record.seconds = comm.bcast(time.perf_counter() - began)
    return outcome_of(case, record)


def launched(launcher: Launcher, case: FabricCase, arguments: Sequence[str], watch: Watch) -> FabricOutcome:
    """Run a test in processes of its own; ``arguments`` are the material and options.

    Raises
    ------
    InputError
        If the launched program rejects its arguments.
    """
    record, message = launcher.run_case([case.test, *arguments, "--only", case.name], watch, Record)
    return outcome_of(case, record or Record(stopped=message))
