"""Derivatives of a simulation with respect to numbers of its scene, by the tangent equations.

Every integrator solves G(V; z_n, p) = 0 for the velocities V of a stage, with what a step begins with, z_n:
positions, velocities and the integrator's memory. Its end z_{n+1} is linear in V and z_n. Hence::

    ∂G/∂V V' = −(∂G/∂z z_n' + ∂G/∂p)        z_{n+1}' = ∂z_{n+1}/∂V V' + ∂z_{n+1}/∂z_n z_n'

∂G/∂V is the step's exact Jacobian, which stands with its preconditioner (in ``semi-implicit`` the regularised
one, by which V is found). The directional derivatives of G are differences of four *neighbours*: the same
discretised scene at p ± δ and p ± 2 δ, whose states are z_n ± δ z_n' and z_n ± 2 δ z_n'. They are exact for
polynomials of degree four in (z, p): for a St. Venant-Kirchhoff membrane whose numbers enter linearly, but
for round-off. What a step freezes (damping at x_n, normals of the wind, loads), accelerations at its start
and histories are so differentiated without a line of their own. What is left of the linear solve, and what
the Jacobian lacks (the stiffness of pressure in statics), goes by generalised conjugate residuals around it.

Sources: Michaleris, Tortorelli & Vidal, Int. J. Numer. Meth. Engng 37 (1994) 2471-2499 (tangent operators of
transient problems); Eisenstat, Elman & Schultz, SIAM J. Numer. Anal. 20 (1983) 345-357 (GCR).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.phases import Phases
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.energy_balance import Ledger
from lyra_petsc.stepping.equilibrium import MAX_GROWTH
from lyra_petsc.stepping.integrators.static import Static
from lyra_petsc.stepping.problem import Problem, build_problem
from lyra_petsc.stepping.simulation import SteppedScene, StepReport
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.midedge import MidEdge
from lyra_petsc.terms.midedge_shape import Frames, carried
from lyra_petsc.terms.term import Term

CENTRAL = {-2: 1.0 / 12.0, -1: -2.0 / 3.0, 1: 2.0 / 3.0, 2: -1.0 / 12.0}
FORWARD = {0: -25.0 / 12.0, 1: 4.0, 2: -3.0, 3: 4.0 / 3.0, 4: -0.25}
"""Offsets in δ and weights of a first derivative, exact up to degree four; where a number may not be less,
those of the neighbours at and above it.
"""

RELATIVE, RELATIVE_STATIC = 1e-4, 6e-4
"""δ over the size of the number. Small where damping may switch the sign of an eigenvalue between neighbours;
equilibria have no damping, but feel the round-off of forces more.
"""

MOST_CORRECTIONS = 60
"""Linear solves for one derivative in one step."""

LITTLE = 0.05
"""Part of the largest possible round-off of forces that is not corrected."""

ENOUGH = 1e-5
"""Residual over the right side that is taken for solved where corrections end."""


@dataclass(frozen=True)
class Number:
    """A number of a scene to differentiate by.

    Attributes
    ----------
    key : str
        Its path, as ``Scene.changed`` takes it.
    value : float
    size : float
        Of its usual changes, > 0: what δ is relative to.
    """

    key: str
    value: float
    size: float


@dataclass
class Tangent:
    """Derivatives of a state with respect to one number: positions, velocities (n_owned, 3), memory."""

    x: Array
    v: Array
    memory: dict[str, Array] = field(default_factory=dict)


@dataclass
class Neighbour:
    """The scene with one number changed, at a state beside the simulation's."""

    offset: float
    weight: float
    problem: Problem
    ledger: Ledger | None = None
    jacobian: Array | None = None

    @property
    def system(self) -> StageEquations:
        """Its equations."""
        return self.problem.system


@dataclass(frozen=True)
class _Before:
    """What a step began with."""

    time: float
    x: Array
    v: Array
    memory: dict[str, Array]
    numbers: dict[str, float]
    frames: list[Frames]


@dataclass(frozen=True)
class _Equilibrium:
    """Load factors of the equilibrium before and of this one, its positions (n_owned, 3) and frames."""

    before: float
    factor: float
    x: Array
    frames: list[Frames]


class Sensitivities:
    """Steps a simulation and, beside it, the derivatives of its state; every method is collective.

    Parameters
    ----------
    simulation : SteppedScene
        Not yet stepped, of a scene without contact and without friction.
    numbers : sequence of Number
    mesh : Mesh or None
        The scene's, on rank 0, where it is known.
    tolerance : float
        Residual of each step's tangent equations over their right side.
    reactions : bool
        Forces of handles are asked for.

    Raises
    ------
    InputError
        Where neighbours of a number are no scenes.
    """

    def __init__(
        self,
        simulation: SteppedScene,
        numbers: Sequence[Number],
        *,
        mesh: Mesh | None = None,
        tolerance: float = 1e-8,
        reactions: bool = False,
    ) -> None:
        self.simulation, self.numbers = simulation, list(numbers)
        self._tolerance = tolerance
        self._system = simulation.problem.system
        self._iterates = not self._system.integrator.lagged_loads
        self._static = isinstance(self._system.integrator, Static)
        self._semi = self._system.integrator.lagged_loads and not self._static
        relative = RELATIVE_STATIC if self._static else RELATIVE
        self._steps = [relative * number.size for number in self.numbers]
        self.tangents: list[Tangent] = []
        self._neighbours: list[list[Neighbour]] = []
        owner = self._owner()
        for number, step in zip(self.numbers, self._steps, strict=True):
            beside = [
                Neighbour(offset, weight, build_problem(simulation.comm, scene, Phases(), mesh, owner))
                for offset, weight, scene in _scenes(simulation.scene, number, step)
            ]
            self._neighbours.append(beside)
            self._begin(beside, step, reactions=reactions)
        if self._system.points.n_edges_global and not self._static:
            self._settle_edges()

    def destroy(self) -> None:
        """Free what the neighbours hold."""
        for beside in self._neighbours:
            for neighbour in beside:
                neighbour.problem.discretisation.destroy()
        self._neighbours = []

    def _owner(self) -> NDArray[np.int64] | None:
        """Rank of each vertex (V,), on rank 0: partitioners do not cut a mesh twice alike."""
        points = self._system.points
        pieces = points.comm.gather(points.mesh_vertices, root=0)
        if pieces is None:
            return None
        owner = np.empty(points.n_vertices_global, dtype=np.int64)
        for rank, original in enumerate(pieces):
            owner[original] = rank
        return owner

    # -- start -------------------------------------------------------------------------------------

    def _begin(self, beside: list[Neighbour], step: float, *, reactions: bool) -> None:
        """The derivatives at the start."""
        n, points = self._system.points.n_owned, self._system.points
        tangent = Tangent(np.zeros((n, 3)), np.zeros((n, 3)))
        for neighbour in beside:
            tangent.x += (neighbour.weight / step) * neighbour.system.x[:n]
            tangent.v += (neighbour.weight / step) * neighbour.system.v[:n]
        tangent.x[points.n_vertices :] = 0.0
        _drop_rounding(tangent.x, self._system.x[:n], step)
        _drop_rounding(tangent.v, self._system.v[:n], step)
        for neighbour in beside:
            system = neighbour.system
            if self._static:
                system.applied.factor = 0.0
                system.begin_step(0.0, 0.0)
                if self._system.applied.unbalanced is not None:
                    system.applied.unbalanced = -system.out_of_balance()[0]
            if reactions:
                neighbour.ledger = Ledger(system)
        self.tangents.append(tangent)

    def _settle_edges(self) -> None:
        """The derivatives of the edges' unknowns at the start, where their moments balance."""
        system, n = self._system, self._system.points.n_owned
        start, vertices = system.x[:n].copy(), self._system.points.n_vertices
        frames = [term.frames for term in _edged(system)]
        system.initial_edge_moments()
        system.begin_edge_solve(start)
        for tangent, beside, step in zip(self.tangents, self._neighbours, self._steps, strict=True):
            for each in beside:
                way = each.offset * step
                each.system.state.set(start + way * tangent.x, system.v[:n] + way * tangent.v)
                for term, own in zip(_edged(each.system), frames, strict=True):
                    term.frames = own
                each.system.initial_edge_moments()
                each.system.begin_edge_solve(start + way * tangent.x)
                self._use_frames(each.system, frames)
        still = np.zeros_like(start)
        with self._solver(still, set_up=True, keep=False) as solve:
            for tangent, beside, step in zip(self.tangents, self._neighbours, self._steps, strict=True):
                for each, ahead in self._at_their_stages(solve, beside, step, still):
                    each.system.end_edge_solve(ahead)
                    self._to_frames(each.system)
                change = _combined(beside, step, lambda each: each.system.x[:n])
                tangent.x[vertices:] = change[vertices:]
        system.end_edge_solve(still)

    # -- a step ------------------------------------------------------------------------------------

    def step(self) -> StepReport:
        """One accepted step of the simulation and of all derivatives.

        Raises
        ------
        SolverError
            If the step fails, or its tangent equations are singular.
        """
        simulation, system = self.simulation, self._system
        n = system.points.n_owned
        memory, numbers = system.integrator.memory()
        frames = [term.frames for term in _edged(system)]
        before = _Before(
            simulation.time, system.x[:n].copy(), system.v[:n].copy(), dict(memory), dict(numbers), frames
        )
        report = simulation.step()
        if self._static:
            self._follow_equilibrium(before)
        else:
            self._follow_motion(before, fresh=report.newton_iterations == 0)
        return report

    def _follow_motion(self, before: _Before, *, fresh: bool) -> None:
        system = self._system
        velocity, end = system.stage_velocity.copy(), self.simulation.time
        system.reopen(before.x)
        with self._solver(velocity, set_up=self._iterates, keep=not fresh) as solve:
            for tangent, beside, step in zip(self.tangents, self._neighbours, self._steps, strict=True):
                for each in beside:
                    self._put(each, before, tangent, step, end)
                for each, ahead in self._at_their_stages(solve, beside, step, velocity):
                    each.system.accept(ahead)
        if system.solves_edges_at_end:
            self._follow_edges(before)
        for tangent, beside, step in zip(self.tangents, self._neighbours, self._steps, strict=True):
            for each in beside:
                if each.ledger is not None:
                    each.ledger.record(before.x + each.offset * step * tangent.x)
            self._take(tangent, beside, step)
            for each in beside:
                each.system.set_references(end)

    def _put(self, each: Neighbour, before: _Before, tangent: Tangent, step: float, end: float) -> None:
        """Let a neighbour begin the step that the simulation has taken."""
        system, way = each.system, each.offset * step
        system.state.set(before.x + way * tangent.x, before.v + way * tangent.v)
        memory = {
            name: values + way * tangent.memory.get(name, 0.0) for name, values in before.memory.items()
        }
        system.integrator.restore(memory, before.numbers)
        for term, frames in zip(_edged(system), before.frames, strict=True):
            term.frames = frames
            term.begin(system.x)
        system.begin_step(before.time, end)
        self._use_frames(system, before.frames)
        if self._semi:
            start = np.zeros_like(before.x)
            system.prescribe(start)
            each.jacobian = system.discretisation.rows.zeros()
            system.jacobian(start, 1.0, each.jacobian)

    def _use_frames(self, system: StageEquations, started: Sequence[Frames]) -> None:
        """Let directors be measured from a neighbour's own frames, or from those that the simulation, which
        ``started`` with others, has turned to.
        """
        pairs = zip(_edged(system), _edged(self._system), started, strict=True)
        used = [(mine, self._system.frozen_in_step[theirs], start) for mine, theirs, start in pairs]
        found: dict[Term, Any] = {mine: mine.frames if now is start else now for mine, now, start in used}
        if found:
            system.active.refreeze(found)
            system.forget_forces()

    def _at_their_stages(
        self, solve: Callable[[Array], Array], beside: list[Neighbour], step: float, velocity: Array
    ) -> list[tuple[Neighbour, Array]]:
        """A number's neighbours with the velocities (n_owned, 3) of their stages; collective."""
        change = _combined(beside, step, lambda each: each.system.prescribed.velocity)
        prescribed = np.zeros_like(velocity)
        self._system.prescribed.overwrite(prescribed, change)
        of_stage = partial(self._change_of_stage, beside, step, velocity)
        way = self._solved(solve, of_stage, prescribed, step)
        found = []
        for each in beside:
            each.system.prescribe(ahead := velocity + each.offset * step * way)
            found.append((each, ahead))
        return found

    def _change_of_stage(self, beside: list[Neighbour], step: float, velocity: Array, way: Array) -> Array:
        """Derivative (n_owned, 3) of G where the stage's velocities change by ``way``."""

        def equations(each: Neighbour) -> Array:
            system, v = each.system, velocity + each.offset * step * way
            system.prescribe(v)
            out = np.zeros_like(v)
            if each.jacobian is None:
                system.residual(v, system.stage.sigma * (v - system.history), out)
                return out
            start = np.zeros_like(v)
            system.prescribe(start)
            system.residual(start, system.stage.sigma * (start - system.history), out)
            return out + _product(system, each.jacobian, v - start)

        return self._free(_combined(beside, step, equations))

    def _free(self, values: Array) -> Array:
        return np.where(self._system.prescribed.free, values, 0.0)

    def _take(self, tangent: Tangent, beside: list[Neighbour], step: float) -> None:
        """The derivatives of the state at which the neighbours have arrived."""
        n = self._system.points.n_owned
        for each in beside:
            self._to_frames(each.system)
        tangent.x = _combined(beside, step, lambda each: each.system.x[:n])
        tangent.v = _combined(beside, step, lambda each: each.system.v[:n])
        names = beside[0].system.integrator.memory()[0].keys()
        tangent.memory = {name: _combined(beside, step, partial(_remembered, name)) for name in names}

    def _to_frames(self, system: StageEquations) -> None:
        """Measure a neighbour's directors, past ones too, from the frames that the simulation's now have."""
        change = np.zeros((system.points.n_owned, 3))
        turns = False
        for mine, theirs in zip(_edged(system), _edged(self._system), strict=True):
            places, ends, length, _ = mine.of_edges
            old: Frames = system.active.frozen[mine]
            new = theirs.frames
            if old is new:
                continue
            across = system.x[ends[:, 1]] - system.x[ends[:, 0]]
            tangent = across / np.linalg.norm(across, axis=1, keepdims=True)
            one, other = carried(old, tangent), carried(new, tangent)
            side = np.sum(np.cross(tangent, one) * other, axis=1)
            turned = np.arctan2(side, np.sum(one * other, axis=1))
            own = places < 3 * system.points.n_owned
            change.reshape(-1)[places[own]] = -(length * turned)[own]
            turns = True
        if turns:
            system.x[: system.points.n_owned] += change
            system.state.update_ghosts()
            system.integrator.shift_past_positions(change)

    # -- edges whose unknowns are in equilibrium at the end of the step -------------------------------

    def _follow_edges(self, before: _Before) -> None:
        """Let the neighbours' edges be in equilibrium at the end of the step, as the simulation's are."""
        system, n = self._system, self._system.points.n_owned
        system.begin_edge_solve(before.x)
        rates = (system.x[:n] - before.x) / system.stage.c
        for tangent, beside, step in zip(self.tangents, self._neighbours, self._steps, strict=True):
            for each in beside:
                each.system.begin_edge_solve(before.x + each.offset * step * tangent.x)
                self._use_frames(each.system, before.frames)
        with self._solver(rates, set_up=True, keep=False) as solve:
            for beside, step in zip(self._neighbours, self._steps, strict=True):
                for each, ahead in self._at_their_stages(solve, beside, step, rates):
                    each.system.end_edge_solve(ahead)
        system.end_edge_solve(rates)

    # -- equilibria --------------------------------------------------------------------------------

    def _follow_equilibrium(self, before: _Before) -> None:
        system, n = self._system, self._system.points.n_owned
        integrator = system.integrator
        assert isinstance(integrator, Static)
        now = _Equilibrium(
            before.time, self.simulation.time, system.x[:n].copy(), [term.frames for term in _edged(system)]
        )
        pseudo = integrator.pseudo_dt
        integrator.pseudo_dt = math.sqrt(MAX_GROWTH) * self._slowest()
        system.begin_step(now.before, now.factor)
        reach = system.stage.c
        with self._solver(np.zeros_like(now.x), set_up=True, keep=False) as solve:
            for tangent, beside, step in zip(self.tangents, self._neighbours, self._steps, strict=True):
                self._change_of_force(now, beside, step, np.zeros_like(now.x))  # so that goals are known
                prescribed = np.zeros_like(now.x)
                change = _combined(beside, step, lambda each: each.system.prescribed.goal)
                system.prescribed.overwrite(prescribed, change)
                _drop_rounding(prescribed, now.x, step)
                forces = partial(self._change_of_force, now, beside, step)
                tangent.x = self._solved(lambda r: reach * solve(r), forces, prescribed, step)
                self._change_of_force(now, beside, step, tangent.x)
                for each in beside:
                    if each.ledger is not None:
                        each.system.evaluate_at_start()
                        each.ledger.record(now.x)
                    each.system.set_references(now.factor)
        integrator.pseudo_dt = pseudo
        system.begin_step(now.before, now.factor)
        system.evaluate_at_start()

    def _change_of_force(self, now: _Equilibrium, beside: list[Neighbour], step: float, way: Array) -> Array:
        """Derivative (n_owned, 3) [N] of what is out of balance where positions change by ``way``."""

        def against(each: Neighbour) -> Array:
            system = each.system
            system.state.set(now.x + each.offset * step * way, np.zeros_like(now.x))
            for term, frames in zip(_edged(system), now.frames, strict=True):
                term.frames = frames
            system.applied.factor = self._system.applied.factor
            system.begin_step(now.before, now.factor)
            return -system.out_of_balance()[0]

        return self._free(_combined(beside, step, against))

    def _slowest(self) -> float:
        """A time [s] in which sheets of this mass fall far."""
        system = self._system
        loads, mass = np.linalg.norm(system.applied.force), system.mass.sum()
        force, total = system.points.global_sum(float(loads) ** 2, float(mass))
        return math.sqrt(self.simulation.problem.outline.size * total / math.sqrt(force)) if force else 1.0

    # -- linear equations --------------------------------------------------------------------------

    @contextmanager
    def _solver(self, velocity: Array, *, set_up: bool, keep: bool) -> Iterator[Callable[[Array], Array]]:
        """Approximate solutions by the Jacobian at the velocities of the simulation's stage."""
        stepper, system = self.simulation.stepper, self._system
        ksp, linear = stepper.ksp, stepper.linear
        if set_up:
            system.set_iterate(None)
            linear.assemble(velocity, 0.0, keep=keep, convex=True)
        ksp.setOperators(linear.operator.mat, linear.preconditioner.mat)
        tolerances, guess = ksp.getTolerances(), ksp.getInitialGuessNonzero()
        ksp.setTolerances(rtol=max(0.3 * self._tolerance, 1e-13), atol=0.0, max_it=5000)
        ksp.setInitialGuessNonzero(False)
        right, left = stepper.velocity.duplicate(), stepper.velocity.duplicate()

        def solve(values: Array) -> Array:
            right.setArray(np.ascontiguousarray(values).ravel())
            ksp.solve(right, left)
            found = np.array(left.getArray(readonly=True)).reshape(values.shape)
            return self._free(found)

        try:
            yield solve
        finally:
            right.destroy()
            left.destroy()
            ksp.setTolerances(*tolerances)
            ksp.setInitialGuessNonzero(guess)

    def _dot(self, a: Array, b: Array) -> float:
        return float(self._system.points.global_sum(float(np.vdot(a, b)))[0])

    def _solved(
        self, solve: Callable[[Array], Array], change: Callable[[Array], Array], start: Array, step: float
    ) -> Array:
        """Where an affine function (n_owned, 3) of a way (n_owned, 3) vanishes, from ``start`` on.

        Not beyond the round-off of forces over δ = ``step``, where corrections lead nowhere.
        """
        way = start.copy()
        residual = change(way)
        first = norm = math.sqrt(self._dot(residual, residual))
        roundoff = self.simulation.roundoff / step
        directions: list[tuple[Array, Array]] = []
        for _ in range(MOST_CORRECTIONS):
            if norm <= max(self._tolerance * first, LITTLE * roundoff):
                return way
            direction = solve(-residual)
            image = change(way + direction) - residual
            for earlier, its_image in directions:
                part = self._dot(image, its_image)
                direction, image = direction - part * earlier, image - part * its_image
            size = math.sqrt(self._dot(image, image))
            if not (math.isfinite(size) and size > 0.0):
                break
            direction, image = direction / size, image / size
            directions.append((direction, image))
            part = self._dot(image, residual)
            way, residual, before = way - part * direction, residual - part * image, norm
            norm = math.sqrt(self._dot(residual, residual))
            if norm > 0.5 * before and norm <= roundoff:
                return way
        if norm <= max(ENOUGH * first, roundoff):
            return way
        raise SolverError(
            f"the tangent equations are not solved at {self.simulation.time:g}: their residual stays at "
            f"{norm / first:.2g} of their right side; the state is near a bifurcation, or not converged: "
            "give smaller steps, or a smaller solver.force_tolerance",
            collective=True,
        )

    # -- what comes out ----------------------------------------------------------------------------

    def derivatives(self, quantity: Callable[[Problem, Ledger | None], Array]) -> Array:
        """Of a quantity (m,) of the present state with respect to the numbers, (m, n).

        Parameters
        ----------
        quantity : callable
            Gets a problem at its state, and its ledger where reactions were asked for; collective.
        """
        n, columns = self._system.points.n_owned, []
        for tangent, beside, step in zip(self.tangents, self._neighbours, self._steps, strict=True):

            def value(each: Neighbour, tangent: Tangent = tangent, step: float = step) -> Array:
                way, system = each.offset * step, each.system
                system.state.set(self._system.x[:n] + way * tangent.x, self._system.v[:n] + way * tangent.v)
                return np.asarray(quantity(each.problem, each.ledger))

            columns.append(_combined(beside, step, value))
        return np.stack(columns, axis=1)


def _combined(beside: Sequence[Neighbour], step: float, of: Callable[[Neighbour], Array]) -> Array:
    """The derivative of what each neighbour gives."""
    total: Array | float = 0.0
    for each in beside:
        total = total + (each.weight / step) * of(each)
    return np.asarray(total)


def _remembered(name: str, each: Neighbour) -> Array:
    """An array of the integrator's memory."""
    return each.system.integrator.memory()[0][name]


def _drop_rounding(values: Array, base: Array, step: float) -> None:
    """Let derivatives of what does not depend on the number be 0, which differences leave at round-off."""
    values[np.abs(values) * step <= 1e-14 * (1.0 + np.abs(base))] = 0.0


def _edged(system: StageEquations) -> list[MidEdge]:
    return [term for term in system.active.with_edges if isinstance(term, MidEdge)]


def _product(system: StageEquations, values: Array, v: Array) -> Array:
    """Block rows times v (n_owned, 3); collective."""
    rows, points = system.discretisation.rows, system.points
    local = np.zeros((points.n_local, 3))
    local[: len(v)] = v
    points.update_ghosts(local)
    return rows.product(values, local)


def _scenes(scene: Scene, number: Number, step: float) -> Iterator[tuple[float, float, Scene]]:
    """Offsets, weights and scenes of a number's neighbours.

    Raises
    ------
    InputError
        If there are none on one side and the other.
    """

    def changed(weights: Mapping[int, float]) -> list[tuple[float, float, Scene]]:
        return [
            (float(offset), weight, scene.changed({number.key: number.value + offset * step}))
            for offset, weight in weights.items()
        ]

    backward = {-offset: -weight for offset, weight in FORWARD.items()}
    problem: InputError | None = None
    for weights in (CENTRAL, FORWARD, backward):
        try:
            yield from changed(weights)
        except InputError as error:
            problem = problem or error
        else:
            return
    assert problem is not None
    raise problem
