"""Set-up of the discretised problem: from a checked scene to each rank's part of it; collective."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Hashable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.linear.discretisation import Discretisation
from lyra_petsc.linear.hierarchy import Surface
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.linear.petsc_options import petsc_number
from lyra_petsc.mesh.build import build_scene_mesh
from lyra_petsc.mesh.distribute import TIED, GlobalMesh, LocalMesh, distribute
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.measures import SAME_PLACE, largest_changes, mean_edge_length, unit_normals
from lyra_petsc.mesh.mesh import Mesh, Source
from lyra_petsc.mesh.points import Layout
from lyra_petsc.mesh.select import select_vertices
from lyra_petsc.parallel import on_root
from lyra_petsc.phases import Phases
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.values import AXES
from lyra_petsc.stepping.initial_state import check_resolved, start_positions, start_velocities
from lyra_petsc.stepping.integrators import integrator_of
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.start_notes import nothing_holds
from lyra_petsc.terms.handles.motion import Motion, Window, motion_of
from lyra_petsc.terms.handles.prescribed_handles import (
    ExactHandles,
    Selection,
    clamps_without_edges,
    conflicts,
    has_edge_in,
    is_exact,
    select_exact,
)
from lyra_petsc.terms.membrane import Membrane
from lyra_petsc.terms.protocols import HasDirectors, HoldsTogether, SumsOverRanks
from lyra_petsc.terms.registry import Role, make_term, needed_terms, registration_of
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Elastic, Load, Term
from lyra_petsc.terms.units_check import unit_notes

if TYPE_CHECKING:
    from lyra_petsc.contact.contact_setup import Barrier
    from lyra_petsc.contact.scene_contact import SceneContact
    from lyra_petsc.mesh.frame_motion import HandleFrames
    from lyra_petsc.terms.bending.midedge_clamp import ClampedEdges


TOO_NEAR = 1e-3
"""Smallest separation at the start over contact's gap: nearer vertices, each with the energy k gap² / 1e-3,
would be thrown apart.
"""


@dataclass
class WholeProblem:
    """Properties of the whole problem that every rank knows."""

    n_vertices: int
    n_triangles: int
    spacing: float
    """Mean rest edge length [m]."""
    size: float
    """Diagonal [m] of the rest shape's bounding box."""
    largest_coordinate: float
    """Largest coordinate [m] of the start and rest shape."""
    terms: list[str]
    sources: list[Source]
    barrier: Barrier | None
    notes: list[str] = field(default_factory=list)
    summary: dict[str, Any] = field(default_factory=dict)
    """Entries of summary.json on the set-up."""


@dataclass
class Problem:
    """One rank's part of a scene, ready for time steps.

    Attributes
    ----------
    scene, whole
    discretisation : Discretisation
    terms : dict of name → Term
        The active terms.
    equations : StageEquations
    surface : Surface
        The mesh before ``initial`` of the scene displaced it.
    probes : dict of name → (n,) int
        Owned vertices of each probe, local numbering.
    mesh : Mesh or None
        The whole mesh, on rank 0, until ``release``.
    partitioner : str
    start : (n_vertices, 3) or None
        Positions [m] of the owned vertices at t = 0, if a field of the states needs them.
    tags : (n_vertices,) or None
        Node tags of the owned vertices in a .msh file, 0 for vertices without, as float64.
    """

    scene: Scene
    whole: WholeProblem
    discretisation: Discretisation
    terms: dict[str, Term]
    equations: StageEquations
    surface: Surface
    probes: dict[str, Ints]
    mesh: Mesh | None
    partitioner: str
    tags: Array | None
    start: Array | None = None

    def release(self) -> None:
        """Free the whole mesh; afterwards no rank holds a global array."""
        self.mesh = None
        _trim_heap()

    @property
    def points(self) -> Layout:
        """This rank's rows and ghosts."""
        return self.discretisation.layout

    @property
    def pattern(self) -> BlockPattern:
        """Block pattern of the matrix."""
        return self.discretisation.rows.pattern

    @property
    def membrane(self) -> Membrane:
        """The membrane term, which every scene has."""
        return next(term for term in self.terms.values() if isinstance(term, Membrane))


def build_problem(
    comm: MPI.Comm, scene: Scene, phases: Phases, known: Mesh | None = None, owner: Ints | None = None
) -> Problem:
    """Mesh, partition, terms and matrix pattern of a scene; collective.

    ``known`` is the mesh, and ``owner`` (V,) the rank of each vertex, on rank 0 if they are known already.

    Raises
    ------
    InputError
        On all ranks, if the scene or its meshes cannot be simulated.
    """
    global_mesh: GlobalMesh | None = None
    mesh: Mesh | None = None

    def prepare() -> WholeProblem:
        nonlocal global_mesh, mesh
        mesh = known or build_scene_mesh(scene, phases.report)
        whole, global_mesh = _prepare(scene, mesh, owner)
        return whole

    with phases("mesh"):
        whole = on_root(comm, prepare)
    with phases("partition"):
        part = distribute(comm, global_mesh)
        global_mesh = None
    with phases("assembly"):
        problem = _build_local(scene, whole, part, mesh)
        del part
        _trim_heap()
        return problem


def _trim_heap() -> None:
    """Return freed memory to the operating system."""
    # SuperLU_dist, loaded with PETSc, sets malloc to keep it
    with suppress(AttributeError, OSError):  # glibc only
        ctypes.CDLL(None).malloc_trim(0)


def event_times(scene: Scene) -> list[float]:
    """Times [s] at which a step must end, as handles and loads begin or end or velocities jump there."""
    windows = [Window.of(handle) for handle in scene.handles]
    jumps = [
        t
        for number, window in enumerate(windows)
        for t in motion_of(scene, number).velocity_jumps
        if window.start < t < window.until + window.fade
    ]
    for obstacle in (scene.obstacles or {}).values():
        if keyframes := scene.keyframes(obstacle):
            jumps += Motion(keyframes, obstacle.interpolation, file=scene.source).velocity_jumps
        if obstacle.mesh is not None and obstacle.mesh.frames is not None:
            from lyra_petsc.mesh.obstacles import surface_motion  # with frames only

            step = scene.time.step if isinstance(scene.time.step, float) else 0.0
            jumps += surface_motion(obstacle).kinks(scene.time.end, step)
    for handle, window in zip(scene.handles, list(windows), strict=False):
        if handle.frames is not None:
            from lyra_petsc.mesh.frame_motion import handle_frames  # with frames only

            step = scene.time.step if isinstance(scene.time.step, float) else 0.0
            kinks = handle_frames(handle).kinks(scene.time.end, step)
            jumps += [t for t in kinks if window.start < t < window.until]
    windows += [Window(load.start, load.until) for load in scene.loads]
    windows += [Window(seam.close.start, seam.close.until) for seam in scene.seams if seam.close]
    return [*(t for window in windows for t in window.events()), *jumps]


def _prepare(scene: Scene, mesh: Mesh, owner: Ints | None) -> tuple[WholeProblem, GlobalMesh]:
    """Compute everything that is to be distributed (on rank 0)."""
    rest = RestShape(scene, mesh)
    massless = np.flatnonzero(~(rest.mass > 0.0))
    if len(massless):
        raise InputError(
            f"{len(massless)} vertices without mass (first: {massless[:5].tolist()}); "
            "give their material a density > 0",
            file=scene.source,
            key="material",
        )
    held = select_exact(scene, mesh)
    _check_symmetry(rest, held)
    _check_sliding(rest, held)
    _check_handle_frames(scene, mesh, held)
    elements: dict[str, Elements] = {}
    names: list[str] = []
    for entry in (needed := needed_terms(scene, rest.shells)):
        of_term = entry.module().elements(rest)
        if of_term is not None and len(of_term.stencil) == 0:
            continue
        names.append(entry.name)
        if of_term is not None:
            elements[entry.name] = of_term
    if len(mesh.tied):
        from lyra_petsc.mesh.seams import threads  # with seams only

        pairs, seam, length = threads(scene, mesh)
        elements[TIED] = Elements(pairs, {"seam": seam.astype(np.float64), "length": length})
    spacing = mean_edge_length(mesh)
    largest = float(max(np.abs(mesh.positions).max(), np.abs(mesh.rest).max()))
    check_resolved(spacing, largest, scene)
    sets: dict[Hashable, Ints] = {}
    for number, vertices in held.items():
        sets["handle", number] = vertices
    for entry in map(registration_of, names):
        if entry.coarse:
            elements[f"coarse {entry.name}"] = entry.module().coarse_elements(rest)
        if issubclass(entry.kind, HasDirectors) and any(handle.holds_slope for handle in scene.handles):
            from lyra_petsc.terms.bending import midedge_clamp  # only scenes with clamps need it

            clamps = midedge_clamp.elements(rest)
            elements |= {f"clamp {number}": clamped for number, clamped in clamps.items()}
    for name, selector in scene.probes.items():
        vertices = select_vertices(mesh, selector, key=f"probes.{name}", file=scene.source)
        sets["probe", name] = vertices
    data = {"position": mesh.positions, "mass": rest.mass}
    if scene.initial is not None:
        data |= start_positions(scene.initial, mesh, held)
        data |= start_velocities(scene.initial, mesh, rest.mass, file=scene.source)
    positions, limits, untangling, start_notes = None, _barrier(rest), None, []
    if scene.contact is not None and limits is not None:
        from lyra_petsc.contact.start_crossings import PlacedScene, find_start_crossings  # with kernels
        from lyra_petsc.mesh.obstacles import build_obstacles

        positions, bodies = data.get("start", mesh.positions), build_obstacles(scene, mesh.obstacles, Motion)
        _refuse_unconnected(scene, mesh, positions)
        placed = PlacedScene(scene, mesh, positions, bodies)
        crossings = find_start_crossings(placed)
        if scene.contact.untangle and not crossings.clear:
            from lyra_petsc.contact.untangle import untangle  # needed by few scenes

            untangling = untangle(placed, crossings, limits.gap, held)
            positions = data["start"] = untangling.positions
            start_notes = [untangling.note]
        else:
            crossings.refuse("at the start")
            start_notes = crossings.notes
    if mesh.tags is not None:
        data["tag"] = mesh.tags.astype(np.float64)
    whole = WholeProblem(
        n_vertices=mesh.n_vertices,
        n_triangles=mesh.n_triangles,
        spacing=spacing,
        size=float(np.linalg.norm(np.ptp(mesh.rest, axis=0))),
        largest_coordinate=largest,
        terms=names,
        sources=mesh.sources,
        barrier=limits,
        summary={} if untangling is None else {"untangled": untangling.content},
        notes=[
            *scene.notes,
            *mesh.notes,
            *rest.notes,
            *start_notes,
            *unit_notes(rest),
            *conflicts(scene, mesh, held),
            *clamps_without_edges(scene, mesh, held),
            *nothing_holds(rest, needed, elements),
        ],
    )
    on_edges = any(of_term.edges is not None for of_term in elements.values())
    edges = rest.edges if on_edges else None
    return whole, GlobalMesh(
        mesh.n_vertices,
        mesh.triangles,
        elements,
        data,
        edges,
        owner=owner,
        positions=positions,
        vertex_sets=sets,
    )


def _refuse_unconnected(scene: Scene, mesh: Mesh, positions: Array) -> None:
    """Refuse contact of vertices that coincide without being connected, at ``positions`` (V, 3) [m]."""
    assert scene.contact is not None
    apart = np.linalg.norm(positions[mesh.coincident[:, 0]] - positions[mesh.coincident[:, 1]], axis=1)
    least = scene.contact.thickness + SAME_PLACE * mean_edge_length(mesh)
    if scene.contact.self and apart.min(initial=np.inf) <= least:
        raise InputError(f"{mesh.unconnected}, and they cannot touch", file=scene.source, key="mesh")


LARGEST_TILT = 10.0
"""Largest angle [°] between a symmetry plane and the normal of a flat sheet there."""


def _check_symmetry(rest: RestShape, held: Selection) -> None:
    """Refuse symmetry handles off a plane, and those at which hinges end, or a sheet is not normal to the
    plane.

    A facet of a curved sheet that is normal to the plane is off it by half the angle to the next facet.
    """
    scene, mesh = rest.scene, rest.mesh
    tolerance = SAME_PLACE * float(np.ptp(mesh.positions, axis=0).max())
    for number, vertices in held.items():
        axis = scene.handles[number].symmetry
        if axis is None:
            continue
        coordinate = mesh.positions[vertices][:, AXES.index(axis)]
        distance = np.abs(coordinate - np.median(coordinate))
        at_plane = has_edge_in(mesh, vertices)
        along = mesh.positions[mesh.triangles, AXES.index(axis)] - np.median(coordinate)
        in_plane = (np.abs(along) <= tolerance).all(axis=1) & ~np.isin(mesh.triangles, vertices).all(axis=1)
        problem = ""
        if distance.max() > tolerance:
            problem = (
                f"vertex {vertices[distance.argmax()]} lies {distance.max():.2g} m beside the plane {axis} = "
                f"{np.median(coordinate):.6g} m; choose only vertices in one plane, or hold axes instead"
            )
        elif (at_plane & rest.bends_with("hinge")).any():
            problem = "is not kept by hinges; give the material bending_model: midedge, or hold axes instead"
        elif len(flat := np.flatnonzero(at_plane & in_plane)):
            problem = (
                f"triangle {flat[0]} lies in the plane {axis} = {np.median(coordinate):.6g} m, to which the "
                "sheet must be normal; take another axis, or hold axes instead"
            )
        elif at_plane.any():
            sine = unit_normals(mesh.positions, mesh.triangles)[:, AXES.index(axis)]
            tilt = np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0)))
            steep = np.flatnonzero(at_plane & (np.abs(tilt) > LARGEST_TILT))
            allowed = LARGEST_TILT + 0.5 * largest_changes(tilt, mesh.triangles, steep)
            if len(off := steep[np.abs(tilt[steep]) > allowed]):
                worst = off[np.abs(tilt[off]).argmax()]
                problem = (
                    f"the sheet is off the normal of the plane {axis} = {np.median(coordinate):.6g} m by up "
                    f"to {abs(tilt[worst]):.3g}° (triangle {worst}), so that its image would make a fold; "
                    "choose the plane to which it is normal, or hold axes instead"
                )
        if problem:
            raise InputError(problem, file=scene.source, key=f"handles[{number}].symmetry")


def _check_sliding(rest: RestShape, held: Selection) -> None:
    """Refuse clamps that slide and turn, or slide out of the sheet's plane, or at which hinges end.

    A clamp keeps the slope of an edge that slides in the sheet's plane by keeping its director constant.
    """
    scene, mesh = rest.scene, rest.mesh
    for number, vertices in held.items():
        handle = scene.handles[number]
        free = [axis for axis in range(3) if axis not in handle.axis_numbers]
        if not handle.clamp or not free:
            continue
        from lyra_petsc.terms.bending.midedge_geometry import normals_of  # only clamps need its kernels

        at_clamp = has_edge_in(mesh, vertices)
        slope = np.abs(normals_of(mesh.positions, mesh.triangles[at_clamp])[:, free]).max(initial=0.0)
        keyframes = scene.motions[handle.motion] if handle.motion is not None else ()
        names = ", ".join(AXES[axis] for axis in free)
        problem = ""
        if slope > SAME_PLACE:
            problem = (
                f"keeps the slope of an edge that slides in its sheet's plane, not along {names} out of it"
            )
        elif (at_clamp & rest.bends_with("hinge")).any():
            problem = "is not kept by hinges on edges that slide; give the material bending_model: midedge"
        elif any(keyframe.rotate is not None for keyframe in keyframes):
            problem = "keeps no slope of an edge that turns and slides"
        if problem:
            raise InputError(
                f"{problem}; hold all axes, or leave clamp out",
                file=scene.source,
                key=f"handles[{number}].clamp",
            )


def _barrier(rest: RestShape) -> Barrier | None:
    """Parameters of contact for all ranks, or None if the scene has no contact."""
    if rest.scene.contact is None:
        return None
    from lyra_petsc.contact.contact_setup import barrier  # only contact needs its kernels

    return barrier(rest)


def _set_up_contact(
    scene: Scene, whole: WholeProblem, terms: Mapping[str, Term], part: LocalMesh, mesh: Mesh | None
) -> None:
    """Pass the obstacles, and what seams hold together, to the contact and friction terms; collective."""
    if whole.barrier is None:
        return
    from lyra_petsc.contact.scene_contact import set_up_terms
    from lyra_petsc.mesh.obstacles import build_scene_obstacles

    obstacles = build_scene_obstacles(part.layout.comm, scene, mesh, Motion)
    set_up_terms(terms, whole.barrier, obstacles, *_tied_vertices(scene, part))


def _tied_vertices(scene: Scene, part: LocalMesh) -> tuple[Ints, Callable[[float], Array]]:
    """Pairs (n, 2) of global numbers of vertices that seams hold together, on all ranks, and the lengths (n,)
    [m] of their threads at a time [s]; collective.
    """
    layout, tied = part.layout, part.elements.get(TIED)
    if not scene.seams:
        return np.empty((0, 2), dtype=np.int64), lambda time: np.empty(0)
    from lyra_petsc.terms.seam import closed_part  # with seams only

    own = np.empty((0, 4))
    if tied is not None:
        n = tied.n_owned
        own = np.column_stack(
            [layout.global_number[tied.stencil[:n]], tied.data["seam"][:n], tied.data["length"][:n]]
        )
    every = np.concatenate(layout.comm.allgather(own))
    pairs, seam, length = every[:, :2].astype(np.int64), every[:, 2].astype(np.int64), every[:, 3]

    def lengths(time: float) -> Array:
        still_open = np.array([1.0 - closed_part(one, time) for one in scene.seams])
        return np.asarray(still_open[seam] * length)

    return pairs, lengths


def _scene_contact(
    discretisation: Discretisation, terms: Mapping[str, Term], mass: Array
) -> SceneContact | None:
    """Contact of the scene with masses (n_owned,) [kg] of the rows, or None."""
    if "contact" not in terms:
        return None
    from lyra_petsc.contact.scene_contact import SceneContact

    return SceneContact(discretisation, terms, mass)


def _build_local(scene: Scene, whole: WholeProblem, part: LocalMesh, mesh: Mesh | None) -> Problem:
    layout = part.layout
    on_vertices = part.vertex_data["mass"]
    terms = {n: make_term(registration_of(n), part.elements.get(n), scene, on_vertices) for n in whole.terms}
    _set_up_contact(scene, whole, terms, part, mesh)
    for term in terms.values():
        if isinstance(term, SumsOverRanks):
            term.set_communication(lambda values: layout.global_sum(*values))
        if isinstance(term, (Elastic, Load)):
            term.connect(terms.values())
    integrator = integrator_of(scene.time.scheme, _spectral_radius(scene))
    roles = {Role.ELASTIC, Role.EXTERNAL} | (set() if integrator.lagged_loads else {Role.VISCOUS})
    coupling = [term for term in terms.values() if term.registration.role in roles]
    discretisation = Discretisation(layout, coupling)
    _check_indices(layout, discretisation.rows.pattern.n_couplings)
    held = ExactHandles(
        scene,
        {n: part.vertex_sets["handle", n] for n, handle in enumerate(scene.handles) if is_exact(handle)},
        _clamped_edges(scene, part, terms),
        _handle_frames(scene, part),
    )
    mass = np.zeros(layout.n_owned)
    mass[: layout.n_vertices] = part.vertex_data["mass"]
    equations = StageEquations(
        discretisation,
        mass,
        list(terms.values()),
        held,
        integrator=integrator,
        contact=_scene_contact(discretisation, terms, mass),
        starts=[Window.of(handle).start for handle in scene.handles],
        events=event_times(scene),
    )
    for term in equations.active.elastic:
        if term.registration.coarse:
            entry, name = registration_of(term.registration.coarse), f"coarse {term.name}"
            # regularised Hessians do not depend on these data, nor on the rest angle
            elements = part.elements[name].without("length", "rest_height")
            data = {**elements.data, "rest_angle": elements.data["k"]}
            elements = replace(elements, data=data, index=np.empty(0, dtype=np.int32))
            # of its own name, as another sheet may have this term
            coarse = make_term(entry, elements, scene, on_vertices, name)
            equations.active.coarse[term] = cast("Elastic", coarse)
    data, rows = part.vertex_data, slice(0, layout.n_vertices)
    equations.x[rows] = data["position"]
    layout.update_ghosts(equations.x)
    surface = Surface(
        equations.x[rows].copy(),
        next(t for t in terms.values() if isinstance(t, Membrane)).stencil,
        [term.ties() for term in terms.values() if isinstance(term, HoldsTogether)],
    )
    # reference positions of handles are those before noise
    equations.reference.record_starts(0.0, equations.x)
    equations.x[rows] = data.get("start", data["position"])
    equations.v[rows] = data.get("velocity", 0.0)
    equations.state.update_ghosts()
    equations.evaluate(equations.stationary_velocity())
    for term in equations.active.stateful:
        term.initialise(equations.x)
    equations.hold_targets(0.0)
    refuse_overrun(equations, scene, "at the start")
    refuse_contact(equations, scene, "at the start", TOO_NEAR * whole.barrier.gap if whole.barrier else 0.0)
    probes = {name: part.vertex_sets["probe", name] for name in scene.probes}
    return Problem(
        scene,
        whole,
        discretisation,
        terms,
        equations,
        surface,
        probes,
        mesh,
        part.partitioner,
        data.get("tag"),
        equations.x[rows].copy() if "displacement" in scene.output.fields else None,
    )


def refuse_overrun(equations: StageEquations, scene: Scene, when: str) -> None:
    """Refuse a state, described by ``when``, that is beyond the limit of a term; collective.

    Raises
    ------
    InputError
        Names the worst element.
    """
    frozen = equations.step.frozen
    worst = max(
        (term.overrun(equations.x, frozen[term]) for term in equations.active.limiting), default=(0.0, "")
    )
    _, text = max(equations.points.comm.allgather(worst))
    if text:
        raise InputError(f"{when} {text}; raise it, or change the start", file=scene.source, key="material")


def refuse_contact(equations: StageEquations, scene: Scene, when: str, minimum: float = 0.0) -> None:
    """Refuse a state, described by ``when``, with a contact pair not separated by more than ``minimum`` [m];
    collective.

    Raises
    ------
    InputError
        Names the nearest pair.
    """
    if (contact := equations.contact) is None:
        return
    near = contact.report(equations.x, equations.step.frozen).nearest()
    if near is None or near.gap > minimum:
        return
    distance, remedy = "not apart", "move them apart"
    if near.gap > 0.0:
        distance = f"{near.gap:.3g} m apart" + (", beside contact.thickness" if near.kept else "")
        distance += ", less than a thousandth of contact.gap, which would throw them from each other"
        remedy += f", best by {minimum / TOO_NEAR:.3g} m"
    elif near.kept > 0.0:
        distance = f"{max(0.0, near.gap + near.kept):.3g} m apart, not more than contact.thickness"
        distance, remedy = f"{distance} = {near.kept:g} m", f"{remedy}, or give a smaller thickness"
    raise InputError(
        f"{when} {near.text} are {distance}; {remedy}",
        file=scene.source,
        key=f"obstacles.{near.obstacle}" if near.obstacle in (scene.obstacles or {}) else "contact",
    )


def _handle_frames(scene: Scene, part: LocalMesh) -> dict[int, HandleFrames]:
    """The motions of handles by frames, of the vertices of this rank; collective."""
    motions: dict[int, HandleFrames] = {}
    for number, handle in enumerate(scene.handles):
        if handle.frames is not None:
            from lyra_petsc.mesh.frame_motion import frames_of  # with frames only

            layout = part.layout
            vertices = layout.mesh_vertices[part.vertex_sets["handle", number]]
            group = np.sort(np.concatenate(layout.comm.allgather(vertices)))
            motions[number] = frames_of(handle, vertices, group, layout.n_vertices_global)
    return motions


def _check_handle_frames(scene: Scene, mesh: Mesh, held: Selection) -> None:
    """Refuse frames of handles that cannot be used, and keep in the mesh what they are (rank 0)."""
    for number, vertices in held.items():
        handle = scene.handles[number]
        if handle.frames is not None:
            from lyra_petsc.mesh.frame_files import check_frames  # with frames only
            from lyra_petsc.mesh.frame_motion import handle_frames

            counts = len(vertices), mesh.n_vertices
            key, frames = f"handles[{number}].frames", handle_frames(handle).frames
            mesh.frames[key] = check_frames(frames, counts, f"handles[{number}] or the mesh has")


def _clamped_edges(scene: Scene, part: LocalMesh, terms: Mapping[str, Term]) -> ClampedEdges | None:
    """The edges that handles clamp, if edges have unknowns; else None."""
    clamping = {n: handle for n, handle in enumerate(scene.handles) if f"clamp {n}" in part.elements}
    if not clamping:
        return None
    from lyra_petsc.terms.bending.midedge import MidEdge
    from lyra_petsc.terms.bending.midedge_clamp import ClampedEdges

    term, layout = next(term for term in terms.values() if isinstance(term, MidEdge)), part.layout
    return ClampedEdges(
        term,
        {n: part.elements[f"clamp {n}"] for n in clamping},
        {n: (motion_of(scene, n), Window.of(h), h.symmetry is not None) for n, h in clamping.items()},
        layout.edge_indices,
    )


def _check_indices(points: Layout, n_blocks: int) -> None:
    """Refuse more unknowns, or more matrix entries on a rank, than PETSc's integers count; collective."""
    largest = int(np.iinfo(PETSc.IntType).max)
    n_entries = 9 * points.comm.allreduce(n_blocks, MPI.MAX)
    if 3 * points.n_global <= largest and n_entries <= largest:
        return
    remedy = "a PETSc with 64-bit indices" if 3 * points.n_global > largest else "more ranks"
    raise InputError(
        f"{points.n_global} vertices make {3 * points.n_global} unknowns and up to {n_entries} matrix "
        f"entries on a rank, of which this PETSc counts {largest}; take {remedy}, or make the mesh coarser",
        key="mesh",
    )


def _spectral_radius(scene: Scene) -> float | None:
    """Spectral radius of the scene or of PETSc's ``-ts_alpha_radius``; None if the integrator has none."""
    if scene.time.spectral_radius is None:
        return None
    radius = petsc_number("ts_alpha_radius", scene.time.spectral_radius)
    if not 0.0 <= radius <= 1.0:
        raise InputError(f"must be from 0 to 1, not {radius:g}", key="-ts_alpha_radius")
    return radius
