"""Compares the contact barrier with an augmented Lagrangian method on drape, twist, stack and slope.

    OMP_NUM_THREADS=1 python scripts/contact_trials.py [--scene drape] [--method barrier] [--runs 3]

Prints a Markdown table of the steps, repeated steps, nonlinear solves a step, Newton and linear iterations a
step, CPU seconds (the median of the runs, after one in which kernels are compiled), and the smallest gap.

The augmented Lagrangian method is only implemented here. Pairs keep the distance c, half of that at which the
barrier begins, by multipliers λ ≥ 0: one for a vertex and each of its sides or obstacles, one for each other
pair. Newton's solve with the energy max(0, λ − r (δ − c))² / 2 r is repeated with λ ← max(0, λ − r (δ − c))
until no distance is below (1 − `MAX_VIOLATION`) c and no multiplier changes by more than `MAX_CHANGE` of the
largest; the next step begins with the multipliers of the last one. Search, geometry of pairs, continuous
collision detection and friction are the program's, friction with the multiplier in place of the barrier's
force. Without the energy guard, on one rank.

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
from lyra_petsc.terms import registry
from lyra_petsc.terms.contact import barrier, contact_pairs
from lyra_petsc.terms.contact.barrier import HALFWAY_CURVATURE, Barrier, ContactBarrier
from lyra_petsc.terms.contact.contact_pairs import EDGE_EDGE, VERTEX_INSIDE, VERTEX_TRIANGLE
from lyra_petsc.terms.contact.obstacle_points import ObstaclePositions
from lyra_petsc.terms.term import UpcomingStep

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

LEVEL = 0.5
"""Distance c over the gap."""

MAX_VIOLATION, MAX_CHANGE, MAX_SOLVES = 0.1, 0.05, 20
"""Largest violation of the distance c, relative to it; largest change of a multiplier, relative to the
largest multiplier; maximum number of solves a step."""

MEASURE_FROM = 2.0 / 3.0
"""Fraction of a run on the slope after which acceleration and creep are measured."""

CONFIGS = Path(__file__).resolve().parents[1] / "configs"


METHODS = {"barrier": 0.0} | {f"multipliers, r = {r:g} C": r for r in (1.0, 10.0, 100.0)}
"""Penalty r over the membrane stiffness C, which is about the diagonal of the sheet's Jacobian."""


@kernel()
def nearest(x, others, kind, points, at, parallel, beta, derivatives, weight):  # type: ignore[no-untyped-def]
    """β, vector between the nearest points, and weight (1; 0 for parallel edges) of pairs ``at`` (m,)."""
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
    """Contact by multipliers: the pairs of `contact_pairs.find_active` with other forces."""

    ratio = 1.0
    solving = False
    """Whether a solve is running; otherwise energies are zero, as nothing is stored between steps."""

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

    def _key(self, at: Ints, separation: Array) -> Ints:
        """Key (m,) of each pair's multiplier: of a vertex and its side or an obstacle, else of the pair."""
        n, points = len(self._normals), self.points[at].astype(np.int64)
        p = np.where(points < 0, n + ~points, points)  # points of obstacles follow those of sheets
        count, base = 1 + len(self.obstacles.each), n + self.obstacles.n_points
        target = np.where(self.kind[at] == VERTEX_TRIANGLE, 1 + self.obstacle[at], count + p[:, 1])
        vertex = np.maximum(points[:, 0], 0)
        side = (np.einsum("ij,ij->i", separation, self._normals[vertex]) > 0.0) & (target == 0)
        pairs = ((p[:, 0] * base + p[:, 1]) * base + p[:, 2]) * base + p[:, 3]
        vertices = -1 - ((vertex * (count + base) + target) * 2 + side)
        key: Ints = np.where(self._alone[at], pairs, vertices)
        return key

    def _multipliers_of(self, key: Ints) -> Array:
        """Multipliers [N] of keys; 0 for new ones."""
        if not len(self.keys):
            return np.zeros(len(key))
        at = np.minimum(np.searchsorted(self.keys, key), len(self.keys) - 1)
        return np.where(self.keys[at] == key, self.multipliers[at], 0.0)

    def set_elements(self, elements: Elements) -> None:
        super().set_elements(elements)
        self._alone = (self.kind == EDGE_EDGE) | (self.points[:, 0] < 0)

    def _distance(self, at: Ints, derivatives: Array) -> Array:
        """Distances (m,) [m] of pairs, negative inside an obstacle."""
        inside = self.kind[at] == VERTEX_INSIDE
        return np.where(inside, -1.0, 1.0) * np.linalg.norm(derivatives[:, :3], axis=1)

    def _find_active(self, points: Array) -> tuple[NDArray[Any], ...]:
        distance, at, weight, _, beta, _, derivatives = super()._find_active(points)
        # pairs of vertices are kept; of other pairs each has its own multiplier
        vertices, pairs = ~self._alone[at], np.flatnonzero(self._alone & (distance < self.gap))
        others = np.empty((len(pairs), 4)), np.ones((len(pairs), 6)), np.empty(len(pairs))
        x, obstacle_x = np.split(points, [len(points) - self.obstacles.n_points])
        nearest(x, obstacle_x, self.kind, self.points, pairs, self.barrier.parallel, *others)
        at = np.concatenate([at[vertices], pairs])
        weight = np.concatenate([weight[vertices], others[2]])
        beta, derivatives = (
            np.concatenate([a[vertices], b]) for a, b in ((beta, others[0]), (derivatives, others[1]))
        )
        d = self._distance(at, derivatives)
        excess = d - self.offset[at] - LEVEL * self.gap[at]
        force = np.maximum(self._multipliers_of(self._key(at, derivatives[:, :3])) - self.r * excess, 0.0)
        derivatives[:, 3], derivatives[:, 4] = -force / d, np.where(force > 0.0, self.r, 0.0) / (d * d)
        return distance, at, weight, weight.copy(), beta, 0.5 * force * force / self.r, derivatives

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

    def update(self, x: Array, frozen: ObstaclePositions) -> bool:
        """Update the multipliers from positions x (n, 3); returns whether they and distances converged."""
        active = self.active_pairs(x, frozen.stage)
        at = active.pair
        d = self._distance(at, active.derivatives)
        level, force = LEVEL * self.gap[at], -active.derivatives[:, 3] * d
        delta = np.where(active.weight > 0.0, (d - self.offset[at]) / level, np.inf)
        key = self._key(at, active.derivatives[:, :3])
        order = np.lexsort((-force, key))
        order = order[np.concatenate([[True], key[order][1:] != key[order][:-1]])[: len(order)]]
        key, force = key[order], force[order]
        change = np.concatenate(
            [force - self._multipliers_of(key), self.multipliers[~np.isin(self.keys, key)]]
        )
        self.keys, self.multipliers = key[force > 0.0], force[force > 0.0]
        self._remembered.forget()
        settled = np.abs(change).max(initial=0.0) <= MAX_CHANGE * force.max(initial=0.0)
        return bool(settled and 1.0 - delta.min(initial=1.0) <= MAX_VIOLATION)


elements = barrier.elements


def make(given: Any, scene: Scene, mass: Array) -> Multipliers:
    """Create the term, for the registry."""
    uv, marks = given.data["uv"].reshape(-1, 3, 2), given.data["marks"].reshape(-1, 5).astype(np.int64)
    return Multipliers(given.stencil.astype(np.int32), uv, marks)


@contextmanager
def in_use(ratio: float) -> Iterator[None]:
    """Within the context scenes use multipliers with this ratio r / C, or for 0 the barrier."""
    entries = list(registry.REGISTRY)
    if ratio:
        Multipliers.ratio = ratio
        registry.REGISTRY[:] = [
            dataclasses.replace(entry, module_name=__name__) if entry.name == "contact" else entry
            for entry in entries
        ]
    try:
        yield
    finally:
        registry.REGISTRY[:] = entries


class RepeatedSolves:
    """Counts the iterations of a stepper's solves, and repeats them until the multipliers have converged."""

    def __init__(self, simulation: SteppedScene) -> None:
        self.newton = self.linear = self.solves = self.unsettled = 0
        self._stepper, self._system = simulation.stepper, simulation.problem.system
        self._solve = self._stepper._solve
        self._stepper._solve = self._solve_repeatedly  # type: ignore[method-assign]
        self._term = simulation.problem.terms["contact"]
        self._previous: Array | None = None  # velocity of the previous solve of the step

    def _guess(self, snes: PETSc.SNES, u: PETSc.Vec) -> None:
        if self._previous is None:
            Stepper._guess(self._stepper, snes, u)
        else:
            u.setArray(self._previous.ravel())

    def _solve_repeatedly(self, t0: float) -> tuple[Array | None, str]:
        term, system, self._previous = self._term, self._system, None
        self._stepper.snes.setInitialGuess(self._guess)
        if not isinstance(term, Multipliers):
            return self._solve_once(t0)
        before, term.solving = (term.keys, term.multipliers), True
        system.forget_forces()
        try:
            for _ in range(MAX_SOLVES):
                velocity, message = self._solve_once(t0)
                if velocity is None:
                    term.keys, term.multipliers = before
                    break
                self._previous = velocity
                settled = term.update(system.evaluate_at(velocity)[0], system.active.frozen[term])
                if settled:
                    break
                system.forget_forces()
            else:
                self.unsettled += 1
        finally:
            term.solving = False
            system.forget_forces()
        return velocity, message

    def _solve_once(self, t0: float) -> tuple[Array | None, str]:
        found = self._solve(t0)
        self.solves += 1
        self.newton += self._stepper.snes.getIterationNumber()
        self.linear += self._stepper._newton.linear_iterations
        return found


def scene_of(name: str, friction: float = 0.9) -> Scene:
    """A scene of configs/ on a coarser mesh, or the sheet on a slope."""
    if name == "slope":
        return Scene.model_validate(sheet_on_slope(30.0, friction * math.tan(math.radians(30.0)), 2, SLID))
    coarse = [f"mesh[{sheet}].grid.{n}=3" for sheet in range(20) for n in ("nx", "ny")]
    config, settings = {
        "drape": ("ball", ["mesh.grid.nx=20", "mesh.grid.ny=20", "time.step=0.01", "time.end=1"]),
        "twist": ("twist", ["mesh.grid.nx=16", "mesh.grid.ny=8", "time.step=0.01", "time.end=1.5"]),
        "stack": ("stack", [*coarse, "time.step=0.01", "time.end=1"]),
    }[name]
    return load_scene(CONFIGS / f"{config}.yaml", settings)


def measure(scene: Scene) -> dict[str, float]:
    """Run a scene; returns its steps, iterations, CPU time and errors."""
    simulation = SteppedScene(MPI.COMM_SELF, scene)
    simulation.guard = None  # its balance does not know the energy that multipliers store
    solves, gap, begun, error = RepeatedSolves(simulation), math.inf, time.process_time(), 0.0
    system = simulation.problem.system
    late = system.x.copy(), system.v.copy()
    try:
        while not simulation.finished:
            simulation.step()
            gap = min(gap, simulation.energy_balance.columns()["smallest_gap"])
            if simulation.time < MEASURE_FROM * scene.time.end * (1.0 + 1e-9):
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
        "solves": solves.solves / steps, "newton": solves.newton / steps,
        "linear": solves.linear / steps, "gap": gap / term.barrier.gap, "seconds": seconds + error,
        "unsettled": solves.unsettled, "change": change, "creep": creep,
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
                note = ""
                if name == "slope":
                    exact = G * 0.1 * math.sin(math.radians(30.0)) * (1.0 - MEASURE_FROM) * SLID
                    sliding, held = found[0]["change"] / exact - 1.0, measure(scene_of(name, 1.01))["creep"]
                    note = f"acceleration off by {abs(sliding):.1g}, creeps {held:.1g} m"
            one, seconds = found[0], statistics.median(each["seconds"] for each in found)
            note += f"; ended at {one['reached']:.3g} s" if math.isnan(seconds) else ""
            note += f"; {one['unsettled']:g} steps not settled" if one["unsettled"] else ""
            click.echo(
                f"| {name} | {method} | {one['steps']:g} | {one['repeated']:g} | {one['solves']:.2f} "
                f"| {one['newton']:.1f} | {one['linear']:.0f} | {seconds:.1f} | {one['gap']:.2g} | {note} |"
            )


if __name__ == "__main__":
    main()
