"""Every property that a registration may have, of a term that does nothing: no answer depends on it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_type_hints

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, finished, grid, scene_of, shape, stepped

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.output.recorder import Recorder
from lyra_petsc.scene.schema import INTEGRATORS, Scene
from lyra_petsc.terms import registry
from lyra_petsc.terms.bending import hinge
from lyra_petsc.terms.bending.midedge import edge_numbers
from lyra_petsc.terms.registry import REGISTRY, Registration, Role
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Elastic, UpcomingStep

IDENTITY = {"name", "needed", "role", "module_name"}

FLAGS: dict[str, Any] = {
    "energy": "idle_energy",
    "columns": {"idle_number": "max"},
    "damped": True,
    "bends": True,
    "moving": True,
    "neighbours": True,
    "limits_step": True,
    "state": ("mark",),
    "edge_state": ("mark",),
    "element_vertices": 3,
    "coarse": "bending",
}
"""A value of each property besides those by which a term is found."""

METHODS: dict[str, tuple[str, ...]] = {
    "columns": ("history",),
    "moving": ("freeze",),
    "neighbours": ("neighbours",),
    "limits_step": ("largest_step",),
}
"""Methods without which a property is nothing; the program must call them."""

STATES: dict[str, tuple[str, ...]] = {
    "state": ("state", "restore"),
    "edge_state": ("edge_state", "restore_edges"),
    "element_vertices": ("element_values", "restore_values"),
}
"""The same for checkpoints."""

SOLVER = {"pc_type": "lu", "ksp_rtol": 1e-12}
MULTIGRID = {"pc_type": "mg", "pc_mg_levels": 2, "ksp_rtol": 1e-12}

COLUMNS = {"energy": {"idle_energy": 0.0}, "columns": {"idle_number": 7.0}}
"""Columns of history.csv that properties add, and their values."""

OF_CHANGING_STENCILS = {
    "neighbours": "current_elements",
    "element_values": "element_state",
    "restore_values": "restore_elements",
}
"""Methods that terms whose stencils change may have instead."""


class Idle(Elastic):
    """A term without energy, force and limit, which counts the accepted steps."""

    def __init__(self, elements: Elements, n_vertices: int) -> None:
        super().__init__(elements)
        self.calls: set[str] = set()
        self.mark = np.zeros((n_vertices, 3))
        self.edge_mark = np.zeros(len(self.edge_indices))
        self.element_mark = np.zeros((self.n_elements, 1))

    def energies(self, x: Array, frozen: Any) -> Array:
        return np.zeros(self.n_owned)

    def add_gradient(self, x: Array, frozen: Any, out: Array) -> None:
        self.calls.add("add_gradient")

    def hessians(self, x: Array, frozen: Any, lo: int, hi: int, blend: float, out: Array) -> None:
        out[:] = 0.0

    def force_scale(self, size: float) -> Array:
        return np.zeros(self.n_elements)

    def freeze(self, step: UpcomingStep) -> None:
        self.calls.add("freeze")

    def targets(self, x: Array, frozen: Any) -> tuple[Array, Array]:
        return np.zeros((self.n_owned, 3)), np.zeros((self.n_owned, 3))

    def history(self, x: Array, frozen: Any) -> Mapping[str, float]:
        self.calls.add("history")
        return {"idle_number": 7.0}

    def neighbours(self, x: Array, dx: Array, numbers: Ints, triangles: Ints) -> tuple[Ints, Ints]:
        self.calls.add("neighbours")
        return np.empty((0, 2), dtype=np.int64), np.empty((0, 0), dtype=np.int64)

    def largest_step(self, x: Array, dx: Array, frozen: Any) -> float:
        self.calls.add("largest_step")
        return 1.0

    def accept(self, x: Array, frozen: Any) -> None:
        self.mark, self.edge_mark, self.element_mark = self.marks(x)

    def marks(self, x: Array) -> tuple[Array, Array, Array]:
        """A state of vertices, of edges and of elements by which each can be told from the others."""
        of_elements = x[self.stencil].sum(axis=(1, 2))
        return x[: len(self.mark)].copy(), x.ravel()[self.edge_indices].copy(), of_elements[:, None]

    def state(self) -> dict[str, Array]:
        return {"mark": self.mark} if self.registration.state else {}

    def restore(self, state: Mapping[str, Array]) -> None:
        self.mark = state["mark"].copy()

    @property
    def edge_indices(self) -> Ints:
        return np.empty(0, dtype=np.int64) if self.edges is None else np.unique(self.edges).astype(np.int64)

    def edge_stiffness(self, weight: Array | None = None) -> Array:
        return np.zeros(len(self.edge_indices))

    def edge_state(self) -> dict[str, Array]:
        return {"mark": self.edge_mark} if self.registration.edge_state else {}

    def restore_edges(self, state: Mapping[str, Array], x: Array) -> None:
        self.edge_mark = state["mark"].copy()

    def element_values(self) -> Array:
        return self.element_mark

    def restore_values(self, values: Array) -> None:
        self.element_mark = values.copy()


@dataclass(frozen=True)
class IdleRegistration(Registration):
    """The registration of `Idle` with one property; it stands for a module, too."""

    flag: str = field(kw_only=True)

    def module(self) -> Any:
        return SimpleNamespace(
            elements=self._elements,
            make=self._make,
            coarse_elements=self._coarse_elements,
        )

    def _make(self, elements: Elements | None, scene: Scene, mass: Array) -> Idle:
        nothing = Elements(np.empty((0, 2), dtype=np.int32))
        term = Idle(nothing if elements is None else elements, len(mass))
        if self.neighbours:
            term.search_distance, term.skin = 0.01, 0.005
        return term

    def _elements(self, rest: RestShape) -> Elements | None:
        if self.neighbours:
            return None
        triangles = rest.mesh.triangles.astype(np.int64)
        damping = {"damping": np.full(len(triangles), 0.01)} if self.damped else {}
        edges = edge_numbers(rest, rest.mesh.triangles)[0] if self.edge_state else None
        return Elements(triangles, damping, edges=edges)

    @staticmethod
    def _coarse_elements(rest: RestShape) -> Elements:
        elements = hinge.elements(rest, "midedge")
        return replace(elements, data={**elements.data, "k": 0.0 * elements.data["k"]})


def idle(flag: str) -> Registration:
    return IdleRegistration(
        "idle", lambda scene, shells: True, Role.ELASTIC, flag=flag, **{flag: FLAGS[flag]}
    )


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


@pytest.mark.parametrize("entry", REGISTRY, ids=lambda entry: entry.name)
def test_a_term_has_what_its_properties_need(entry: Registration) -> None:
    kind = get_type_hints(entry.module().make)["return"]
    for flag, methods in (METHODS | STATES).items():
        for method in methods if getattr(entry, flag) else ():
            alternatives = (method, OF_CHANGING_STENCILS.get(method, method))
            assert any(getattr(kind, name) is not getattr(Elastic, name) for name in alternatives), method
    assert not entry.coarse or callable(entry.module().coarse_elements)


@pytest.mark.parametrize("contact", [False, True], ids=["free", "contact"])
@pytest.mark.parametrize("flag", FLAGS)
def test_a_term_that_does_nothing_changes_no_answer(flag: str, contact: bool) -> None:
    """With any integrator and in statics; and the program asks the term for what the property promises."""
    for scheme in (*INTEGRATORS, "static"):
        expected = without_the_term(scheme, contact)
        solver = MULTIGRID if flag == "coarse" and scheme != "static" else SOLVER
        with added(flag), finished(MPI.COMM_SELF, scene(scheme, contact=contact), **solver) as simulation:
            term = simulation.problem.terms["idle"]
            np.testing.assert_allclose(shape(simulation), expected, rtol=0, atol=1e-10, err_msg=scheme)
            assert isinstance(term, Idle)
            columns = simulation.energy_balance.columns()
            assert columns.items() >= COLUMNS.get(flag, {}).items()
            if scheme != "semi-implicit" or flag != "limits_step":  # which is about Newton's iterations
                assert term.calls.issuperset(METHODS.get(flag, ())), scheme


@pytest.mark.parallel
@pytest.mark.parametrize("flag", STATES)
def test_checkpoints_hold_the_state_of_a_term(comm: MPI.Comm, flag: str, shared_tmp: Path) -> None:
    checked, folder = scene_of(scene("bdf2", contact=True)), shared_tmp / "run"
    if comm.rank == 0:
        folder.mkdir()
    comm.Barrier()
    with added(flag):
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
            assert isinstance(term, Idle)
            number = list(STATES).index(flag)
            found = (term.mark, term.edge_mark, term.element_mark)[number]
            expected = term.marks(again.problem.system.x)[number]
            n = term.n_owned if flag == "element_vertices" else len(found)
            np.testing.assert_array_equal(found[:n], expected[:n])
