"""The small interfaces of terms and the properties of their registrations.

What each promises is checked for every registered term that has it; and the program must ask a term that does
nothing for it without another answer.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from examples import example
from mpi4py import MPI
from oracle import differences, frozen_by, gradient, hessian
from physics import CLOTH, finished, grid, scene_of, shape, stepped

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.output.recorder import Recorder
from lyra_petsc.scene.schema import INTEGRATORS, Scene
from lyra_petsc.terms import registry
from lyra_petsc.terms.bending import hinge
from lyra_petsc.terms.bending.midedge_elements import edge_numbers
from lyra_petsc.terms.protocols import (
    Dissipates,
    HasDirectors,
    HasGeometry,
    LimitsStep,
    MovingTargets,
    Place,
    PullsHandles,
    SharesFrozen,
    Stateful,
    TermState,
    Yields,
)
from lyra_petsc.terms.registry import REGISTRY, Registration, Role
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Elastic, UpcomingStep

MAX_MEMBERS = 15
"""Largest number of public members of the interface of an ordinary term."""

IDENTITY = {"name", "needed", "role", "module_name", "of_contact"}

FLAGS: dict[str, Any] = {
    "energy": "idle_energy",
    "columns": {"idle_number": "max"},
    "damped": True,
    "bends": True,
    "coarse": "bending",
}
"""A value of each property of a registration besides those by which a term is found."""

SOLVER = {"pc_type": "lu", "ksp_rtol": 1e-12}
MULTIGRID = {"pc_type": "mg", "pc_mg_levels": 2, "ksp_rtol": 1e-12}

COLUMNS = {"energy": {"idle_energy": 0.0}, "columns": {"idle_number": 7.0}}
"""Columns of history.csv that properties add, and their values."""


def having(interface: type[Elastic]) -> Any:
    """Parametrises a test with the registered terms that have an interface and fixed stencils."""
    names = [entry.name for entry in REGISTRY if not entry.of_contact and issubclass(entry.kind, interface)]
    return pytest.mark.parametrize("name", names)


def bent(x: Array, size: float = 0.02, seed: int = 5) -> Array:
    """Positions or unknowns x with a random disturbance [m]."""
    return x + np.random.default_rng(seed).uniform(-size, size, x.shape)


def test_the_interface_of_an_ordinary_term_is_small() -> None:
    public = {name for kind in Elastic.__mro__[:-1] for name in vars(kind) if not name.startswith("_")}
    assert len(public) <= MAX_MEMBERS, sorted(public)


@having(HasGeometry)
def test_data_that_hold_the_geometry_give_the_same_and_compute_it_once(name: str, tmp_path: Path) -> None:
    with example(name, tmp_path) as simulation:
        term, x = simulation.problem.terms[name], bent(simulation.equations.x)
        assert isinstance(term, HasGeometry)
        frozen = frozen_by(term, simulation.equations)
        here = term.at(x, frozen)
        assert here.frozen is frozen
        assert term.at(x, here) is here
        np.testing.assert_array_equal(term.energies(x, here), term.energies(x, frozen))
        np.testing.assert_array_equal(gradient(term, x, here), gradient(term, x, frozen))
        geometry = here.geometry
        assert here.geometry is geometry
        arrays = [geometry] if isinstance(geometry, np.ndarray) else geometry
        assert not any(values.flags.writeable for values in arrays)
        there = term.at(bent(x, 0.01, 6), frozen)
        assert not np.array_equal(term.energies(x, there), term.energies(x, here))


@having(Stateful)
def test_a_restored_state_gives_the_same_forces(name: str, tmp_path: Path) -> None:
    with example(name, tmp_path) as simulation, example(name, tmp_path) as other:
        term, again = simulation.problem.terms[name], other.problem.terms[name]
        assert isinstance(term, Stateful)
        assert isinstance(again, Stateful)
        x, y = (bent(simulation.equations.x, size, seed) for size, seed in ((0.1, 5), (0.01, 6)))
        term.accept(x, frozen_by(term, simulation.equations))
        frozen = frozen_by(term, simulation.equations, x)
        state = term.state()
        assert not np.allclose(
            gradient(again, y, frozen_by(again, other.equations)), gradient(term, y, frozen)
        )
        again.restore({name: entry.values.copy() for name, entry in state.items()}, x)
        found = gradient(again, y, frozen_by(again, other.equations, x))
        expected = gradient(term, y, frozen)
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())


@having(Dissipates)
def test_heat_is_what_a_step_takes_from_the_energy(name: str, tmp_path: Path) -> None:
    with example(name, tmp_path) as simulation:
        term = simulation.problem.terms[name]
        assert isinstance(term, Dissipates)
        frozen, x = frozen_by(term, simulation.equations), bent(simulation.equations.x, 0.1)
        before, heat = term.energies(x, frozen).sum(), term.heat(x, frozen)
        term.accept(x, frozen)
        after = term.energies(x, frozen).sum()
        assert heat > 0.0
        assert before - after == pytest.approx(heat, rel=1e-9)


@having(Yields)
def test_elements_at_their_limits_are_softer_where_they_yield_further(name: str, tmp_path: Path) -> None:
    with example(name, tmp_path) as simulation:
        term = simulation.problem.terms[name]
        assert isinstance(term, Yields)
        frozen, x = frozen_by(term, simulation.equations), bent(simulation.equations.x, 0.1)
        term.accept(x, frozen)
        laws, pull = [term.at_limits(yields=yields) for yields in (False, True)], gradient(term, x, frozen)
        for law in laws:
            np.testing.assert_allclose(gradient(law, x, frozen), pull, rtol=0.0, atol=1e-5 * abs(pull).max())
        stiff, soft = (hessian(law, x, frozen).reshape(x.size, x.size) for law in laws)
        change = np.linalg.eigvalsh(stiff - soft)
        assert change.min() > -1e-5 * change.max()
        assert change.max() > 0.1 * np.abs(np.linalg.eigvalsh(stiff)).max()


@having(MovingTargets)
def test_forces_on_targets_are_derivatives_of_the_energy(name: str, tmp_path: Path) -> None:
    with example(name, tmp_path) as simulation:
        term, x = simulation.problem.terms[name], bent(simulation.equations.x)
        assert isinstance(term, MovingTargets)
        frozen = frozen_by(term, simulation.equations)
        places, force = term.targets(x, frozen)
        moved = next(name for name, values in frozen._asdict().items() if np.shares_memory(values, places))
        numeric = differences(
            lambda at: term.energies(x, frozen._replace(**{moved: at})).sum(), places.copy(), 1e-4
        )
        np.testing.assert_allclose(force, numeric, rtol=0.0, atol=1e-7 * np.abs(force).max())


@having(PullsHandles)
def test_springs_pull_handles_as_they_pull_the_sheet(name: str, tmp_path: Path) -> None:
    with example(name, tmp_path) as simulation:
        term, x = simulation.problem.terms[name], bent(simulation.equations.x)
        assert isinstance(term, PullsHandles)
        assert np.isin(term.reference_rows, np.arange(len(x))).all()
        frozen = frozen_by(term, simulation.equations)
        forces = term.handle_forces(x, frozen, len(simulation.problem.scene.handles))
        np.testing.assert_allclose(forces.sum(axis=0), -gradient(term, x, frozen).sum(axis=0), rtol=1e-12)


@having(SharesFrozen)
def test_shared_frozen_data_are_those_of_the_partner(name: str, tmp_path: Path) -> None:
    with example(name, tmp_path) as simulation:
        term = simulation.problem.terms[name]
        assert isinstance(term, SharesFrozen)
        assert frozen_by(term, simulation.equations) is frozen_by(term.partner, simulation.equations)


@having(HasDirectors)
def test_new_frames_change_neither_energy_nor_forces_on_edges(name: str, tmp_path: Path) -> None:
    with example(name, tmp_path) as simulation:
        term, x = simulation.problem.terms[name], bent(simulation.equations.x)
        assert isinstance(term, HasDirectors)
        frozen = frozen_by(term, simulation.equations)
        frames = term.frames_at_end(x, frozen)
        np.testing.assert_allclose(term.energies(x, frames), term.energies(x, frozen), rtol=1e-9)
        edges = gradient(term, x, frozen).ravel()[term.edge_indices]
        again = gradient(term, x, frames).ravel()[term.edge_indices]
        np.testing.assert_allclose(again, edges, rtol=0.0, atol=1e-9 * np.abs(edges).max())
        assert (term.edge_stiffness() > 0.0).all()
        indices, _ = term.edge_increments(x, 1e-3 * x, frozen)  # a small rotation is followed as it is
        assert not len(indices)
        assert term.largest_rotation(np.zeros_like(x)) == 0.0


@having(LimitsStep)
def test_no_step_passes_a_limit(name: str, tmp_path: Path) -> None:
    with example(name, tmp_path) as simulation:
        term, x = simulation.problem.terms[name], simulation.equations.x
        assert isinstance(term, LimitsStep)
        frozen, dx = frozen_by(term, simulation.equations), 3.0 * x
        assert not term.energies(x, frozen).any()
        assert term.overrun(x, frozen) == (0.0, "")
        excess, text = term.overrun(x + dx, frozen)
        assert excess > 0.0
        assert text
        assert np.isinf(term.energies(x + dx, frozen)).any()
        fraction = term.largest_step(x, dx, frozen)
        assert 0.0 < fraction < 1.0
        near = x + fraction * dx
        assert 0.0 < term.energies(near, frozen).sum() < np.inf
        assert term.stiffness(near, frozen).max() > term.stiffness(x, frozen).max() > 0.0
        assert term.largest_step(x, 1e-6 * dx, frozen) == 1.0


class Idle(Elastic):
    """A term without energy and force, which notes what it is asked for."""

    def __init__(self, elements: Elements, n_vertices: int) -> None:
        super().__init__(elements)
        self.calls: set[str] = set()

    def energies(self, x: Array, frozen: Any) -> Array:
        return np.zeros(self.n_owned)

    def add_gradient(self, x: Array, frozen: Any, out: Array) -> None:
        self.calls.add("add_gradient")

    def hessians(self, x: Array, frozen: Any, lo: int, hi: int, convexity: float, out: Array) -> None:
        out[:] = 0.0

    def force_scale(self, size: float) -> Array:
        return np.zeros(self.n_elements)

    def freeze(self, step: UpcomingStep) -> None:
        self.calls.add("freeze")

    def history(self, x: Array, frozen: Any) -> Mapping[str, float]:
        self.calls.add("history")
        return {"idle_number": 7.0}


class IdleTargets(Idle, MovingTargets):
    """The same with targets that stay."""

    def targets(self, x: Array, frozen: Any) -> tuple[Array, Array]:
        self.calls.add("targets")
        return np.zeros((self.n_owned, 3)), np.zeros((self.n_owned, 3))


class IdleLimit(Idle, LimitsStep):
    """The same with a limit that is never reached."""

    def largest_step(self, x: Array, dx: Array, frozen: Any) -> float:
        self.calls.add("largest_step")
        return 1.0

    def overrun(self, x: Array, frozen: Any) -> tuple[float, str]:
        self.calls.add("overrun")
        return 0.0, ""

    def stiffness(self, x: Array, frozen: Any) -> Array:
        return np.zeros(self.n_elements)


class IdleState(Idle, Stateful):
    """The same with a state of vertices, edges and elements by which each can be told from the others."""

    def __init__(self, elements: Elements, n_vertices: int) -> None:
        super().__init__(elements, n_vertices)
        assert self.edges is not None
        self._edge_indices = np.unique(self.edges).astype(np.int64)
        self.mark = (
            np.zeros((n_vertices, 3)),
            np.zeros(len(self._edge_indices)),
            np.zeros((self.n_elements, 1)),
        )

    def initialise(self, x: Array) -> None:
        self.mark = self.marks(x)

    def accept(self, x: Array, frozen: Any) -> None:
        self.calls.add("accept")
        self.mark = self.marks(x)

    def marks(self, x: Array) -> tuple[Array, Array, Array]:
        of_elements = x[self.stencil].sum(axis=(1, 2))
        return x[: len(self.mark[0])].copy(), x.ravel()[self._edge_indices].copy(), of_elements[:, None]

    def state(self) -> dict[str, TermState]:
        return {place.value: TermState(place, values) for place, values in zip(Place, self.mark, strict=True)}

    def restore(self, values: Mapping[str, Array], x: Array) -> None:
        self.calls.add("restore")
        self.mark = values["vertices"].copy(), values["edges"].copy(), values["elements"].copy()


INTERFACES: dict[str, tuple[type[Idle], set[str]]] = {
    "MovingTargets": (IdleTargets, {"freeze"}),
    "LimitsStep": (IdleLimit, {"overrun"}),
    "Stateful": (IdleState, {"accept"}),
}
"""A term with each interface, and the methods that the program must call with every integrator."""

METHODS = {"columns": {"history"}}
"""The same for properties."""


@dataclass(frozen=True)
class IdleRegistration(Registration):
    """The registration of `Idle` with one property or interface; it stands for a module, too."""

    flag: str = field(kw_only=True)

    @property
    def kind(self) -> type[Idle]:
        return INTERFACES[self.flag][0] if self.flag in INTERFACES else Idle

    def module(self) -> Any:
        return SimpleNamespace(
            elements=self._elements,
            make=self._make,
            coarse_elements=self._coarse_elements,
        )

    def _make(self, elements: Elements | None, scene: Scene, mass: Array) -> Idle:
        nothing = Elements(np.empty((0, 2), dtype=np.int32))
        return self.kind(nothing if elements is None else elements, len(mass))

    def _elements(self, rest: RestShape) -> Elements:
        triangles = rest.mesh.triangles.astype(np.int64)
        damping = {"damping": np.full(len(triangles), 0.01)} if self.damped else {}
        edges = edge_numbers(rest, rest.mesh.triangles)[0] if self.flag == "Stateful" else None
        return Elements(triangles, damping, edges=edges)

    @staticmethod
    def _coarse_elements(rest: RestShape) -> Elements:
        elements = hinge.elements(rest, "midedge")
        return replace(elements, data={**elements.data, "k": 0.0 * elements.data["k"]})


def idle(flag: str) -> Registration:
    properties = {flag: FLAGS[flag]} if flag in FLAGS else {}
    return IdleRegistration("idle", lambda scene, shells: True, Role.ELASTIC, flag=flag, **properties)


def scene(scheme: str, *, contact: bool) -> dict[str, Any]:
    """A sheet that is held at a corner and falls on a floor, or hangs on a side."""
    static = scheme == "static"
    time = (
        {"analysis": "static", "step": 1.0} if static else {"end": 0.05, "step": 0.01, "integrator": scheme}
    )
    content: dict[str, Any] = {
        "mesh": grid(0.3, 0.2, 3, 2, "alternating"),
        "material": CLOTH | {"bending": 1e-3, "bending_model": "midedge", "damping": 0.005},
        "gravity": [0.0, 1.0, -9.81],
        "handles": [{"nodes": [0, 4, 8] if static else [0]}],
        "time": time,
    }
    if contact:
        floor = {"plane": {"point": [0.0, 0.0, -0.006], "normal": [0.0, 0.0, 1.0]}}
        content |= {"contact": {"gap": 0.005, "friction": 0.3}, "obstacles": {"floor": floor}}
    return content


@cache
def without_the_term(scheme: str, contact: bool) -> Array:
    """Positions (V, 3) [m] at the end."""
    with finished(MPI.COMM_SELF, scene(scheme, contact=contact), **SOLVER) as simulation:
        return shape(simulation)


@contextmanager
def added(flag: str) -> Iterator[None]:
    """Adds the term to every scene."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "REGISTRY", [*REGISTRY, idle(flag)])
        yield


def test_every_property_is_tested() -> None:
    assert {each.name for each in fields(Registration)} == IDENTITY | FLAGS.keys()


@pytest.mark.parametrize("contact", [False, True], ids=["free", "contact"])
@pytest.mark.parametrize("flag", [*FLAGS, *INTERFACES])
def test_a_term_that_does_nothing_changes_no_answer(flag: str, contact: bool) -> None:
    """With any integrator and in statics; and the program asks the term for what the property promises."""
    schemes = ("beuler", "bdf2") if contact else INTEGRATORS  # the steps that others take in contact
    for scheme in (*schemes, "static"):
        expected = without_the_term(scheme, contact)
        solver = MULTIGRID if flag == "coarse" and scheme != "static" else SOLVER
        with added(flag), finished(MPI.COMM_SELF, scene(scheme, contact=contact), **solver) as simulation:
            term = simulation.problem.terms["idle"]
            np.testing.assert_allclose(shape(simulation), expected, rtol=0, atol=1e-10, err_msg=scheme)
            assert isinstance(term, Idle)
            columns = simulation.energy_balance.columns()
            assert columns.items() >= COLUMNS.get(flag, {}).items()
            asked = INTERFACES[flag][1] if flag in INTERFACES else METHODS.get(flag, set())
            assert term.calls >= asked, scheme


@pytest.mark.parallel
def test_checkpoints_hold_the_state_of_a_term(comm: MPI.Comm, shared_tmp: Path) -> None:
    checked, folder = scene_of(scene("bdf2", contact=True)), shared_tmp / "run"
    if comm.rank == 0:
        folder.mkdir()
    comm.Barrier()
    with added("Stateful"):
        with stepped(comm, checked) as first:
            recorder = Recorder(first)
            recorder.begin(folder)
            recorder.record(first.step())
            recorder.write_checkpoint()
            recorder.flush()
            recorder.close()
        with stepped(comm, checked) as again:
            recorder = Recorder(again)
            recorder.resume(folder)
            recorder.close()
            term = again.problem.terms["idle"]
            assert isinstance(term, IdleState)
            assert "restore" in term.calls
            for found, expected in zip(term.mark, term.marks(again.problem.equations.x), strict=True):
                n = term.n_owned if found.ndim == 2 and found.shape[1] == 1 else len(found)
                np.testing.assert_array_equal(found[:n], expected[:n])
