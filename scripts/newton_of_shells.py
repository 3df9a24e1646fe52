"""Counts Newton iterations of published shell problems in fifteen load steps.

    python scripts/newton_of_shells.py [NAME[:CELLS,CELLS…]] …

NAME is annulus, hemisphere, open-cylinder, half-cylinder, diaphragms or channel (default all). The table has
the cells along a side (of the channel: across a flange), Newton and linear iterations, CPU time [s] and the
largest displacement of a vertex [m]. All meshes but that of the annulus have the pattern `alternating`.

Sources of the shells: Sze, Liu & Lo, Finite Elements in Analysis and Design 40 (2004) 1551-1569; of the
channel Chroscielewski, Makowski & Stumpf, Int. J. Numer. Meth. Engng 35 (1992) 63-94, with a load beyond its
limit.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from mpi4py import MPI

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.meshes import rectangle
from lyra_petsc.experiments.verification.cases.shells import (
    cylinder,
    open_cylinder_scene,
    plane_box,
    slit_annulus_scene,
    symmetric,
)
from lyra_petsc.experiments.verification.verification_case import STATIC, scene

LOAD_STEPS = 15


def _part_of_cylinder(bench: Bench, cells: tuple[int, int], radius: float, length: float) -> dict[str, Any]:
    """Mesh of a quarter of the circumference, from the crown (x = 0) on."""
    flat, faces = rectangle(*cells, 1.0, 1.0, alternating=True)
    vertices = np.column_stack(cylinder(radius, 0.5 * math.pi, length)(flat[:, 0], flat[:, 1]))
    return bench.mesh(vertices, faces)


def annulus(bench: Bench, n: int) -> dict[str, Any]:
    """Slit annular plate, lifted at one side of the slit."""
    return slit_annulus_scene(bench, n)[0]


def hemisphere(bench: Bench, n: int) -> dict[str, Any]:
    """Hemisphere with a hole of 18 degrees, pulled and pushed with 400 N at its edge; a quarter of it."""
    flat, faces = rectangle(n, n, 1.0, 1.0, alternating=True)
    along, up = 0.5 * math.pi * flat[:, 0], math.radians(72.0) * flat[:, 1]
    vertices = 10.0 * np.column_stack([np.cos(up) * np.cos(along), np.cos(up) * np.sin(along), np.sin(up)])
    return scene(
        bench.mesh(vertices, faces),
        {"young": 6.825e7, "poisson": 0.3, "thickness": 0.04, "density": 1.0},
        handles=[*symmetric("xy", 10.0), {"nodes": [n // 2], "axes": ["z"]}],
        loads=[{"nodes": [0], "force": [200.0, 0, 0]}, {"nodes": [n], "force": [0, -200.0, 0]}],
    )


def open_cylinder(bench: Bench, n: int) -> dict[str, Any]:
    """Open cylinder pulled apart in the middle with 40 kN; an eighth of it."""
    return open_cylinder_scene(bench, n, "alternating")[0]


def half_cylinder(bench: Bench, n: int) -> dict[str, Any]:
    """Half cylinder clamped at one end, pinched at the other with 2 kN; a half of it."""
    radius, length = 1.016, 3.048
    mesh = _part_of_cylinder(bench, (n, round(n * length / (0.5 * math.pi * radius))), radius, length)
    return scene(
        mesh,
        {"young": 2.0685e7, "poisson": 0.3, "thickness": 0.03, "density": 1.0},
        handles=[{"box": plane_box("y", length, radius), "clamp": True}, *symmetric("xz", radius)],
        loads=[{"nodes": [0], "force": [0, 0, -1000.0]}],
    )


def diaphragms(bench: Bench, n: int) -> dict[str, Any]:
    """Cylinder between rigid diaphragms, pinched in the middle with 12 kN; an eighth of it."""
    mesh = _part_of_cylinder(bench, (n, n), 100.0, 100.0)
    return scene(
        mesh,
        {"young": 30e3, "poisson": 0.3, "thickness": 1.0, "density": 1.0},
        handles=[{"box": plane_box("y", 100.0, 100.0), "axes": ["x", "z"]}, *symmetric("xyz", 100.0)],
        loads=[{"nodes": [0], "force": [0, 0, -3000.0]}],
    )


def channel(bench: Bench, n: int) -> dict[str, Any]:
    """Thin cantilever, twisted by 150 N at a corner of its free end until it snaps through."""
    length, flange, web = 36.0, 2.0, 6.0
    flat, faces = rectangle(
        round(0.5 * n * length / flange), 5 * n, length, 2.0 * flange + web, alternating=True
    )
    along, across = flat[:, 0], flat[:, 1] - flange
    up = np.clip(across, 0.0, web)
    vertices = np.column_stack([along, np.abs(across - up), up])
    corner = int(np.argmin(np.linalg.norm(vertices - [length, 0.0, web], axis=1)))
    return scene(
        bench.mesh(vertices, faces),
        {"young": 1e7, "poisson": 0.333, "thickness": 0.05, "density": 1.0},
        handles=[{"box": plane_box("x", 0.0, length), "clamp": True}],
        loads=[{"nodes": [corner], "force": [0, 0, -150.0]}],
    )


SHELLS: dict[str, tuple[Callable[[Bench, int], dict[str, Any]], tuple[int, ...]]] = {
    "annulus": (annulus, (6, 12)),
    "hemisphere": (hemisphere, (16,)),
    "open-cylinder": (open_cylinder, (16, 24)),
    "half-cylinder": (half_cylinder, (12, 16, 24)),
    "diaphragms": (diaphragms, (16, 24)),
    "channel": (channel, (2, 3)),
}


def main(arguments: list[str]) -> None:
    bench, step = Bench(MPI.COMM_WORLD, direct=False), 1.0 / LOAD_STEPS
    heads = ["shell", "cells", "Newton", "linear", "CPU [s]", "displacement [m]"]
    print("| " + " | ".join(heads) + " |\n" + "| --- " * len(heads) + "|")
    for argument in arguments or SHELLS:
        name, _, sizes = argument.partition(":")
        if name not in SHELLS:
            sys.exit(f"no such shell '{name}'; there are {', '.join(SHELLS)}")
        make, default_sizes = SHELLS[name]
        for n in map(int, sizes.split(",")) if sizes else default_sizes:
            content = make(bench, n) | {
                "gravity": [0, 0, 0],
                "time": STATIC | {"step": step},
                "solver": {"force_tolerance": 1e-6},
                "petsc": {"ts_adapt_dt_max": step},
            }
            begin, newton, linear = time.process_time(), 0, 0
            with bench.simulation(content) as trial:
                first = trial.x
                while not trial.simulation.finished:
                    report = trial.step()
                    newton += report.newton_iterations
                    linear += report.linear_iterations
                largest = float(np.linalg.norm(trial.x - first, axis=1).max())
            seconds = time.process_time() - begin
            print(f"| {name} | {n} | {newton} | {linear} | {seconds:.1f} | {largest:.3f} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
