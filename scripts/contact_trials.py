"""The barrier of contact beside augmented Lagrangians without one, on drape, twist, stack and slope.

    OMP_NUM_THREADS=1 python scripts/contact_trials.py [--scene drape] [--method barrier] [--runs 3]

Prints a Markdown table of a run's Newton and linear iterations, of those of PETSc's solves for a step, of
steps repeated, CPU seconds (the median of the runs, after one in which kernels are compiled), and the
smallest gap.

The other method lives here. Pairs keep the distance c, half of that at which the barrier begins, by
multipliers λ ≥ 0, one for a vertex and each side of it or obstacle, one for each other pair. Newton's solve
with the energy max(0, λ − r (δ − c))² / 2 r is repeated with λ ← max(0, λ − r (δ − c)) until no distance is
less than c by more than a part of it (`LEFT`) and no multiplier changes by more than `SETTLED` of the
largest; multipliers are carried over from step to step. Search, geometry of pairs, continuous collision
detection and friction are the program's, friction with the multiplier for the barrier's force. The guard of
the energy is off, one rank.

Source: J. C. Simo & T. A. Laursen, Computers & Structures 42 (1992) 97-116.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.errors import SolverError
from lyra_petsc.experiments.verification.cases.contacts import SLID, G, sheet_on_slope
from lyra_petsc.kernels.element import kernel
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.stepping.stepper import Stepper
from lyra_petsc.terms import contact, contact_pairs, registry
from lyra_petsc.terms.contact import HALFWAY_CURVATURE, Barrier, ContactBarrier, ObstaclePositions
from lyra_petsc.terms.contact_pairs import EDGE_EDGE, VERTEX_INSIDE, VERTEX_TRIANGLE
from lyra_petsc.terms.term import UpcomingStep

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

LEVEL = 0.5
"""c over the gap."""

LEFT, SETTLED, MOST = 0.1, 0.05, 20
"""What of c may be missing, how far multipliers may change over the largest, and solves of a step at most."""

LATE = 2.0 / 3.0
"""Part of a run on the slope after which acceleration and creep are measured."""

CONFIGS = Path(__file__).resolve().parents[1] / "configs"


METHODS = {"barrier": 0.0} | {f"multipliers, r = {r:g} C": r for r in (1.0, 10.0, 100.0)}
"""r over the membrane stiffness C, which is about the diagonal of the sheet's Jacobian."""


@kernel()
def nearest(x, others, kind, points, at, parallel, beta, derivatives, weight):  # type: ignore[no-untyped-def]
    """Of pairs ``at`` (m,): β, the vector between their nearest points, and 1; 0 of parallel edges."""
    p, g = np.empty((4, 3)), np.empty(3)
    for n in range(len(at)):
        e = at[n]
        contact_pairs._load_points(x, others, points, e, p)
        beta[n, 0], beta[n, 1], beta[n, 2], beta[n, 3] = contact_pairs._nearest_coefficients(kind[e], p)
        contact_pairs._vector_between(x, others, kind, points, beta, e, n, p, g)
        weight[n] = 0.0 if kind[e] == EDGE_EDGE and contact_pairs._is_mollified(p, parallel) else 1.0
        for k in range(3):
            derivatives[n, k] = g[k]


class Multipliers(ContactBarrier):
    """Contact by multipliers: what `contact_pairs.find_active` finds, with other forces."""

    ratio = 1.0
    solving = False
    """Whether energies are those of a solve: between steps nothing is stored."""

    def set_up(self, barrier: Barrier, obstacles: Sequence[Any], *, self_contact: bool, static: bool) -> None:
        super().set_up(barrier, obstacles, self_contact=self_contact, static=static)
        self.r = self.ratio * HALFWAY_CURVATURE * barrier.stiffness
        self.keys, self.multipliers = np.empty(0, dtype=np.int64), np.empty(0)

    def freeze(self, step: UpcomingStep) -> ObstaclePositions:
        corners = step.x[self.surface]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._normals = np.zeros_like(step.x)
        for k in range(3):
            np.add.at(self._normals, self.surface[:, k], normals)
        self._remembered.forget()
        return super().freeze(step)

    def _key(self, at: Ints, apart: Array) -> Ints:
        """One number for what has one multiplier: a sheet's vertex and a side of it, or an obstacle; else a
        pair.
        """
        n, points = len(self._normals), self.points[at].astype(np.int64)
        p = np.where(points < 0, n + ~points, points)  # obstacles' points come after those of sheets
        count, base = 1 + len(self.obstacles.each), n + self.obstacles.n_points
        target = np.where(self.kind[at] == VERTEX_TRIANGLE, 1 + self.obstacle[at], count + p[:, 1])
        vertex = np.maximum(points[:, 0], 0)
        side = (np.einsum("ij,ij->i", apart, self._normals[vertex]) > 0.0) & (target == 0)
        pairs = ((p[:, 0] * base + p[:, 1]) * base + p[:, 2]) * base + p[:, 3]
        vertices = -1 - ((vertex * (count + base) + target) * 2 + side)
        key: Ints = np.where(self._alone[at], pairs, vertices)
        return key

    def _kept(self, key: Ints) -> Array:
        """The multipliers [N] of keys."""
        if not len(self.keys):
            return np.zeros(len(key))
        at = np.minimum(np.searchsorted(self.keys, key), len(self.keys) - 1)
        return np.where(self.keys[at] == key, self.multipliers[at], 0.0)

    def take(self, elements: Elements) -> None:
        super().take(elements)
        self._alone = (self.kind == EDGE_EDGE) | (self.points[:, 0] < 0)

    def _distance(self, at: Ints, derivatives: Array) -> Array:
        """Distances (m,) [m] of pairs, below 0 of what is inside of an obstacle."""
        inside = self.kind[at] == VERTEX_INSIDE
        return np.where(inside, -1.0, 1.0) * np.linalg.norm(derivatives[:, :3], axis=1)

    def _find_active(self, points: Array) -> tuple[NDArray[Any], ...]:
        least, at, weight, _, beta, _, derivatives = super()._find_active(points)
        # pairs of vertices are what they are; of others, each pair has its own multiplier
        vertices, pairs = ~self._alone[at], np.flatnonzero(self._alone & (least < self.gap))
        more = np.empty((len(pairs), 4)), np.zeros((len(pairs), 5)), np.empty(len(pairs))
        x, obstacle_x = np.split(points, [len(points) - self.obstacles.n_points])
        nearest(x, obstacle_x, self.kind, self.points, pairs, self.barrier.parallel, *more)
        at = np.concatenate([at[vertices], pairs])
        weight = np.concatenate([weight[vertices], more[2]])
        beta, derivatives = (
            np.concatenate([a[vertices], b]) for a, b in ((beta, more[0]), (derivatives, more[1]))
        )
        d = self._distance(at, derivatives)
        over = d - self.offset[at] - LEVEL * self.gap[at]
        pull = np.maximum(self._kept(self._key(at, derivatives[:, :3])) - self.r * over, 0.0)
        derivatives[:, 3], derivatives[:, 4] = -pull / d, np.where(pull > 0.0, self.r, 0.0) / (d * d)
        return least, at, weight, weight.copy(), beta, 0.5 * pull * pull / self.r, derivatives

    def energies(self, x: Array, frozen: ObstaclePositions) -> Array:
        return super().energies(x, frozen) if self.solving else np.zeros(self.n_owned)

    def find_contacts(self, x: Array, obstacle_x: Array, n_counted: int) -> tuple[NDArray[Any], ...]:
        active = self.active_pairs(x, obstacle_x)
        rows = np.flatnonzero((active.weight > 0.0) & (active.derivatives[:, 3] != 0.0))
        at, derivatives = active.pair[rows], active.derivatives[rows]
        d = self._distance(at, derivatives)
        return (
            active.beta[rows],
            derivatives[:, :3] / d[:, None],
            -active.weight[rows] * derivatives[:, 3] * d,
            at,
        )

    def renew(self, x: Array, frozen: ObstaclePositions) -> bool:
        """Take the multipliers that positions x (n, 3) give; whether they and the distances will do."""
        active = self.active_pairs(x, frozen.stage)
        at = active.pair
        d = self._distance(at, active.derivatives)
        level, pull = LEVEL * self.gap[at], -active.derivatives[:, 3] * d
        delta = np.where(active.weight > 0.0, (d - self.offset[at]) / level, np.inf)
        key = self._key(at, active.derivatives[:, :3])
        order = np.lexsort((-pull, key))
        order = order[np.concatenate([[True], key[order][1:] != key[order][:-1]])[: len(order)]]
        key, pull = key[order], pull[order]
        change = np.concatenate([pull - self._kept(key), self.multipliers[~np.isin(self.keys, key)]])
        self.keys, self.multipliers = key[pull > 0.0], pull[pull > 0.0]
        self._remembered.forget()
        settled = np.abs(change).max(initial=0.0) <= SETTLED * pull.max(initial=0.0)
        return bool(settled and 1.0 - delta.min(initial=1.0) <= LEFT)


elements = contact.elements


def make(given: Any, scene: Scene, mass: Array) -> Multipliers:
    """The term, as the registry asks for it."""
    uv, marks = given.data["uv"].reshape(-1, 3, 2), given.data["marks"].reshape(-1, 4).astype(np.int64)
    return Multipliers(given.stencil.astype(np.int32), uv, marks)


@contextmanager
def in_use(ratio: float) -> Iterator[None]:
    """Let scenes have contact by a method."""
    known = list(registry.REGISTRY)
    if ratio:
        Multipliers.ratio = ratio
        registry.REGISTRY[:] = [
            dataclasses.replace(entry, home=__name__) if entry.name == "contact" else entry for entry in known
        ]
    try:
        yield
    finally:
        registry.REGISTRY[:] = known


class Watch:
    """Counts the iterations of a stepper's solves, and repeats them until the multipliers have settled."""

    def __init__(self, simulation: SteppedScene) -> None:
        self.newton = self.linear = self.solves = self.unsettled = 0
        self._stepper, self._system = simulation.stepper, simulation.problem.system
        self._solve = self._stepper._solve
        self._stepper._solve = self._repeated  # type: ignore[method-assign]
        self._term = simulation.problem.terms["contact"]
        self._warm: Array | None = None

    def _guess(self, snes: PETSc.SNES, u: PETSc.Vec) -> None:
        if self._warm is None:
            Stepper._guess(self._stepper, snes, u)
        else:
            u.setArray(self._warm.ravel())

    def _repeated(self, t0: float) -> tuple[Array | None, str]:
        term, system, self._warm = self._term, self._system, None
        self._stepper.snes.setInitialGuess(self._guess)
        if not isinstance(term, Multipliers):
            return self._once(t0)
        before, term.solving = (term.keys, term.multipliers), True
        system.forget_forces()
        try:
            for _ in range(MOST):
                velocity, words = self._once(t0)
                if velocity is None:
                    term.keys, term.multipliers = before
                    break
                self._warm = velocity
                settled = term.renew(system.evaluate_at(velocity)[0], system.active.frozen[term])
                if settled:
                    break
                system.forget_forces()
            else:
                self.unsettled += 1
        finally:
            term.solving = False
            system.forget_forces()
        return velocity, words

    def _once(self, t0: float) -> tuple[Array | None, str]:
        found = self._solve(t0)
        self.solves += 1
        self.newton += self._stepper.snes.getIterationNumber()
        self.linear += self._stepper._newton.linear_iterations
        return found


def scene_of(name: str, friction: float = 0.9) -> Scene:
    """A reduced scene."""
    if name == "slope":
        return Scene.model_validate(sheet_on_slope(30.0, friction * math.tan(math.radians(30.0)), 2, SLID))
    coarse = [f"mesh[{sheet}].grid.{n}=3" for sheet in range(20) for n in ("nx", "ny")]
    config, settings = {
        "drape": ("ball", ["mesh.grid.nx=20", "mesh.grid.ny=20", "time.step=0.01", "time.end=1"]),
        "twist": ("wring", ["mesh.grid.nx=16", "mesh.grid.ny=8", "time.step=0.01", "time.end=1.5"]),
        "stack": ("stack", [*coarse, "time.step=0.01", "time.end=1"]),
    }[name]
    return load_scene(CONFIGS / f"{config}.yaml", settings)


def measure(scene: Scene) -> dict[str, float]:
    """What a run took."""
    simulation = SteppedScene(MPI.COMM_SELF, scene)
    simulation.guard = None  # what multipliers give back of a step that has not settled is in no balance
    watch, gap, begun, error = Watch(simulation), math.inf, time.process_time(), 0.0
    system = simulation.problem.system
    late = system.x.copy(), system.v.copy()
    try:
        while not simulation.finished:
            simulation.step()
            gap = min(gap, simulation.ledger.columns()["smallest_gap"])
            if simulation.time < LATE * scene.time.end * (1.0 + 1e-9):
                late = system.x.copy(), system.v.copy()
    except SolverError as trouble:
        click.echo(f"t = {simulation.time:g} s: {trouble}", err=True)
        error = math.nan
    seconds, steps = time.process_time() - begun, simulation.step_number
    change = float(np.linalg.norm((system.v - late[1]).mean(axis=0)))
    creep = float(np.linalg.norm(system.x - late[0], axis=1).max())
    term: Any = simulation.problem.terms["contact"]
    found = {
        "reached": simulation.time, "steps": steps, "repeated": simulation.totals["rejected"],
        "solves": watch.solves / steps, "newton": watch.newton / steps,
        "linear": watch.linear / steps, "gap": gap / term.barrier.gap, "seconds": seconds + error,
        "unsettled": watch.unsettled, "change": change, "creep": creep,
    }  # fmt: skip
    simulation.destroy()
    return found


@click.command(help=__doc__)
@click.option("--scene", "scenes", multiple=True, default=("drape", "twist", "stack", "slope"))
@click.option("--method", "methods", multiple=True, type=click.Choice(list(METHODS)), default=list(METHODS))
@click.option("--runs", default=3, show_default=True)
def main(scenes: Sequence[str], methods: Sequence[str], runs: int) -> None:
    """Measure and print."""
    click.echo(
        "| scene | method | steps | repeated | solves | Newton | linear | s | smallest gap / gap | |\n"
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
    )
    for name in scenes:
        for method in methods:
            with in_use(METHODS[method]):
                found = [measure(scene_of(name)) for _ in range(runs + 1)][1:] if runs else []
                words = ""
                if name == "slope":
                    exact = G * 0.1 * math.sin(math.radians(30.0)) * (1.0 - LATE) * SLID
                    sliding, held = found[0]["change"] / exact - 1.0, measure(scene_of(name, 1.01))["creep"]
                    words = f"acceleration off by {abs(sliding):.1g}, creeps {held:.1g} m"
            one, seconds = found[0], statistics.median(each["seconds"] for each in found)
            words += f"; ended at {one['reached']:.3g} s" if math.isnan(seconds) else ""
            words += f"; {one['unsettled']:g} steps not settled" if one["unsettled"] else ""
            click.echo(
                f"| {name} | {method} | {one['steps']:g} | {one['repeated']:g} | {one['solves']:.2f} "
                f"| {one['newton']:.1f} | {one['linear']:.0f} | {seconds:.1f} | {one['gap']:.2g} | {words} |"
            )


if __name__ == "__main__":
    main()
