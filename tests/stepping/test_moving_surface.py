"""Cloth on a surface that moves through frames: as on the same surface with keyframes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import grid

from lyra_petsc.api.simulations import Simulation
from lyra_petsc.errors import SolverError
from lyra_petsc.mesh.obstacles import BOX_TRIANGLES, surface_motion
from lyra_petsc.scene.schema import Obstacle

pytestmark = pytest.mark.parallel

RING = 0.8 / 6 * np.arange(7)
"""Heights [m] of the vertices along an edge."""

CORNERS = np.array([[x, y, z] for z in (-0.1, 0.0) for y in (-0.3, 0.3) for x in (-0.3, 0.3)])
TIMES = [0.0, 0.05, 0.1, 0.2]
SHIFTS = [[0, 0, 0], [0.01, 0, 0], [0.04, 0.01, 0.01], [0.04, 0.03, 0.03]]
KEYFRAMES = [
    {"time": time, "translate": shift}
    for time, shift in zip(
        TIMES, ([0, 0, 0], [0.01, 0, 0], [0.04, 0.01, 0.01], [0.04, 0.03, 0.03]), strict=True
    )
]


def scene(folder: Path, integrator: str, **mesh: Any) -> dict[str, Any]:
    """A sheet that lies on a box and hangs over its sides."""
    return {
        "mesh": grid(0.8, 0.8, 6, 6) | {"transform": {"translate": [-0.41, -0.39, 0.004]}},
        "material": {"cloth": "gray-interlock", "damping": 0.02},
        "gravity": [0, 0, -9.81],
        "contact": {"gap": 0.005, "friction": 0.4},
        "obstacles": {"box": {"mesh": {"file": str(folder / "box.obj")} | mesh, "interpolation": "linear"}},
        "time": {"end": 0.2, "step": 0.01, "integrator": integrator},
        "solver": {"force_tolerance": 1e-9},
    }


def write(folder: Path) -> None:
    rows = [f"v {x} {y} {z}" for x, y, z in CORNERS] + [f"f {a} {b} {c}" for a, b, c in BOX_TRIANGLES + 1]
    (folder / "box.obj").write_text("\n".join(rows) + "\n")
    shifts = np.array([frame["translate"] for frame in KEYFRAMES], dtype=np.float64)
    np.savez(folder / "walk.npz", time=TIMES, position=CORNERS + shifts[:, None])


def final(comm: MPI.Comm, content: dict[str, Any]) -> np.ndarray[Any, Any]:
    with Simulation(content, comm=comm) as simulation:
        for _ in simulation:
            pass
        positions = simulation.gather(simulation.positions)
    return np.asarray(comm.bcast(positions))


@pytest.mark.parametrize("integrator", ["beuler", "bdf2", "alpha2"])
def test_a_translation_by_frames_is_that_by_keyframes(
    comm: MPI.Comm, shared_tmp: Path, integrator: str
) -> None:
    if comm.rank == 0:
        write(shared_tmp)
    comm.barrier()
    content = scene(shared_tmp, integrator)
    content["obstacles"]["box"]["motion"] = KEYFRAMES
    by_keyframes = final(comm, content)
    by_frames = final(comm, scene(shared_tmp, integrator, frames=str(shared_tmp / "walk.npz")))
    assert np.abs(by_keyframes[:, 0]).max() > 0.4
    assert np.abs(by_frames - by_keyframes).max() < 1e-6


@pytest.mark.parametrize("repeat", [False, True])
def test_a_rotation_by_frames_has_its_places_where_steps_end(
    comm: MPI.Comm, shared_tmp: Path, repeat: bool
) -> None:
    """Of a handle in the run, and of a body; frames at 29.97 Hz leave no tiny steps."""
    times, angles = np.arange(5) / 29.97, np.radians([0.0, 20.0, 60.0, 50.0, 0.0])
    turns = np.zeros((5, 3, 3))
    turns[:, 1, 1] = 1.0
    turns[:, 0, 0] = turns[:, 2, 2] = np.cos(angles)
    turns[:, 0, 2], turns[:, 2, 0] = np.sin(angles), -np.sin(angles)
    left = np.stack([0 * RING, RING, 0 * RING + 0.5], axis=1)
    if comm.rank == 0:
        write(shared_tmp)
        for name, points in (("turn.npz", CORNERS), ("pins.npz", left)):
            np.savez(shared_tmp / name, time=times, position=points @ turns.transpose(0, 2, 1))
    comm.barrier()
    frames = {"interpolation": "linear", "repeat": repeat}
    content: dict[str, Any] = {
        "mesh": grid(0.8, 0.8, 6, 6) | {"transform": {"translate": [0, 0, 0.5]}},
        "material": {"cloth": "gray-interlock", "damping": 0.02},
        "handles": [{"group": "left", "frames": str(shared_tmp / "pins.npz")} | frames, {"group": "right"}],
        "time": {"end": 0.2, "step": 0.01},
    }
    ends, seen = [0.0], 0
    with Simulation(content, comm=comm) as simulation:
        for step in simulation:
            ends.append(step.time)
            at = step.time % times[-1] if repeat else min(step.time, times[-1])
            frame = int(np.argmin(np.abs(np.append(times[:-1], times[-1]) - at)))
            positions = comm.bcast(simulation.gather(step.positions))
            if abs(times[frame] - at) < 1e-12:
                assert np.abs(positions[7 * np.arange(7)] - left @ turns[frame].T).max() < 1e-9
                seen += 1
    assert seen >= 5
    assert np.diff(ends).min() > 1e-3
    box = {"mesh": {"file": str(shared_tmp / "box.obj"), "frames": str(shared_tmp / "turn.npz")}}
    motion = surface_motion(Obstacle.model_validate(box | {"interpolation": "linear"}))
    for time, turn in zip(times, turns, strict=True):
        assert np.abs(motion.positions(time) - CORNERS @ turn.T).max() < 1e-9


@pytest.mark.parametrize("interpolation", ["monotone", "hermite", "linear"])
@pytest.mark.parametrize("integrator", ["beuler", "midpoint"])
def test_a_ring_pulled_by_frames_moves_as_by_keyframes(
    comm: MPI.Comm, shared_tmp: Path, integrator: str, interpolation: str
) -> None:
    """All along the edge of a sheet."""
    # the rates that monotone limits are those of scale and shift apart, or of the sum
    scales = (1.0, 1.0, 1.0, 1.0) if interpolation == "monotone" else (1.0, 1.02, 0.98, 1.1)
    ring = sorted(set(np.flatnonzero([k % 7 in (0, 6) or k // 7 in (0, 6) for k in range(49)]).tolist()))
    keyframes = [
        {"time": time, "translate": shift, "scale": scale}
        for time, shift, scale in zip(TIMES, SHIFTS, scales, strict=True)
    ]
    pull = {"nodes": ring, "interpolation": interpolation}
    content: dict[str, Any] = {
        "mesh": grid(0.8, 0.8, 6, 6),
        "material": {"cloth": "gray-interlock", "damping": 0.02},
        "handles": [pull | {"motion": "pull"}],
        "motions": {"pull": keyframes},
        "gravity": [0, 0, -9.81],
        "time": {"end": 0.2, "step": 0.01, "integrator": integrator},
        "solver": {"force_tolerance": 1e-12},
    }
    by_keyframes = final(comm, content)
    if comm.rank == 0:
        places = np.stack([np.array(ring) % 7, np.array(ring) // 7, 0 * np.array(ring)], axis=1) * (0.8 / 6)
        position = np.array(scales)[:, None, None] * places + np.array(SHIFTS)[:, None]
        np.savez(shared_tmp / "pins.npz", time=TIMES, position=position)
    comm.barrier()
    by_frames = final(comm, content | {"handles": [pull | {"frames": str(shared_tmp / "pins.npz")}]})
    assert np.abs(by_keyframes[:, 2]).max() > 0.01
    assert np.abs(by_frames - by_keyframes).max() < 1e-9


@pytest.mark.parametrize("whole", [False, True])
def test_vertices_pulled_by_frames_move_as_by_keyframes(
    comm: MPI.Comm, shared_tmp: Path, whole: bool
) -> None:
    content: dict[str, Any] = {
        "mesh": grid(0.8, 0.8, 6, 6),
        "material": {"cloth": "gray-interlock", "damping": 0.02},
        "handles": [{"group": "left", "motion": "pull", "interpolation": "linear"}, {"group": "right"}],
        "motions": {"pull": KEYFRAMES},
        "gravity": [0, 0, -9.81],
        "time": {"end": 0.2, "step": 0.01},
        "solver": {"force_tolerance": 1e-12},
    }
    by_keyframes = final(comm, content)
    if comm.rank == 0:
        rows = np.arange(49) if whole else 7 * np.arange(7)
        places = np.stack([rows % 7, rows // 7, 0 * rows], axis=1) * (0.8 / 6)
        np.savez(shared_tmp / "pins.npz", time=TIMES, position=places + np.array(SHIFTS)[:, None])
    comm.barrier()
    pulled = {"group": "left", "frames": str(shared_tmp / "pins.npz"), "interpolation": "linear"}
    by_frames = final(comm, content | {"handles": [pulled, {"group": "right"}]})
    assert np.abs(by_frames - by_keyframes).max() < 1e-9


@pytest.mark.parametrize("mover", ["obstacle", "handle"])
def test_frames_run_over_the_load_factor_of_a_static_analysis(
    comm: MPI.Comm, shared_tmp: Path, mover: str
) -> None:
    """As keyframes; the load steps end at frames, and the body pushes the sheet up."""
    strip = grid(0.4, 0.1, 8, 2) | {"transform": {"translate": [-0.2, -0.05, 0.004]}}
    keyframes = [
        {"time": t, "translate": shift}
        for t, shift in ((0.0, [0, 0, 0]), (0.4, [0, 0, 0.01]), (1.0, [0, 0, 0.03]))
    ]
    ends = [{"group": "left"}, {"group": "right"}]
    content: dict[str, Any] = {
        "mesh": strip,
        "material": {"young": 1e6, "poisson": 0.3, "thickness": 1e-3, "density": 1.0},
        "gravity": [0, 0, -9.81],
        "handles": ends,
        "time": {"analysis": "static", "step": 0.3},
        "solver": {"force_tolerance": 1e-10},
    }
    if comm.rank == 0:
        write(shared_tmp)
        left = np.array([[-0.2, 0.05 * k - 0.05, 0.0] for k in range(3)])
        for name, points in (("rise.npz", [0.2, 0.2, 1.0] * CORNERS), ("pins.npz", left)):
            shifts = np.array([keyframe["translate"] for keyframe in keyframes])
            times = [keyframe["time"] for keyframe in keyframes]
            np.savez(shared_tmp / name, time=times, position=points + shifts[:, None])
    comm.barrier()
    motion, frames = {"motion": keyframes}, {}
    if mover == "obstacle":
        mesh = {"file": str(shared_tmp / "box.obj"), "transform": {"scale": [0.2, 0.2, 1.0]}}
        content |= {"contact": {"gap": 0.003}}
        by_keyframes = content | {"obstacles": {"box": {"mesh": mesh, "interpolation": "linear"} | motion}}
        mesh = mesh | {"frames": str(shared_tmp / "rise.npz")}
        mesh.pop("transform")
        by_frames = content | {"obstacles": {"box": {"mesh": mesh, "interpolation": "linear"}}}
    else:
        end = {"group": "left", "interpolation": "linear"}
        by_keyframes = content | {"handles": [end | {"motion": "up"}, ends[1]], "motions": {"up": keyframes}}
        frames = {"frames": str(shared_tmp / "pins.npz")}
        by_frames = content | {"handles": [end | frames, ends[1]]}
    reached, expected = final(comm, by_frames), final(comm, by_keyframes)
    assert expected[:, 2].max() > 0.025
    assert np.abs(reached - expected).max() < 1e-6


def closing_boxes(folder: Path, high: float) -> dict[str, Any]:
    """One body of two boxes below a height [m], which pass into each other up to 0.1 s and leave again; and a
    sheet that hangs between them from its upper side, 0.1 m high.
    """
    box = np.array([[x, y, z] for z in (-0.1, high) for y in (-0.1, 0.1) for x in (0.0, 0.1)])
    x = np.concatenate([box - [0.12, 0.0, 0.0], box + [0.02, 0.0, 0.0]])
    side = np.repeat([1.0, -1.0], 8)[:, None] * [1.0, 0.0, 0.0]
    triangles = np.concatenate([BOX_TRIANGLES, BOX_TRIANGLES + 8])
    rows = [f"v {a} {b} {c}" for a, b, c in x] + [f"f {a} {b} {c}" for a, b, c in triangles + 1]
    (folder / "body.obj").write_text("\n".join(rows) + "\n")
    shifts = np.array([0.0, 0.04, 0.0])[:, None, None]
    np.savez(folder / "close.npz", time=[0.0, 0.1, 0.2], position=x + shifts * side)
    turn = {"rotate": {"axis": [1, 1, 1], "degrees": 120}, "translate": [0.0, -0.05, 0.0]}
    mesh = {"file": str(folder / "body.obj"), "frames": str(folder / "close.npz")}
    return {
        "mesh": grid(0.1, 0.1, 4, 4) | {"transform": turn},
        "material": {"cloth": "gray-interlock", "damping": 0.02},
        "handles": [{"box": [[-1, -1, 0.099], [1, 1, 1]]}],
        "contact": {"gap": 0.004},
        "obstacles": {"body": {"mesh": mesh, "interpolation": "linear"}},
        "time": {"end": 0.2, "step": 0.01},
    }


def test_parts_of_a_body_that_cross_beside_a_sheet_do_not_matter(comm: MPI.Comm, shared_tmp: Path) -> None:
    x = final(comm, shared(comm, shared_tmp, -0.02))
    np.testing.assert_allclose(x[:, 0], 0.0, atol=1e-9)


def test_parts_of_a_body_that_close_on_a_sheet_end_the_run_in_words(comm: MPI.Comm, shared_tmp: Path) -> None:
    content = shared(comm, shared_tmp, 0.06)
    with Simulation(content, comm=comm) as simulation:
        with pytest.raises(
            SolverError, match=r"something would pass through the sheet: .*obstacle 'body'"
        ) as caught:
            for _ in simulation:
                pass
        assert "try more space for the sheet" in str(caught.value)
        # the parts meet at 0.05 s, in the plane of the sheet
        assert 0.04 <= simulation.time <= 0.05
        x = simulation.gather(simulation.positions)
    if comm.rank == 0:
        np.testing.assert_allclose(x[:, 0], 0.0, atol=0.004)


def shared(comm: MPI.Comm, folder: Path, high: float) -> dict[str, Any]:
    """The scene of `closing_boxes`, whose files rank 0 writes; collective."""
    content = closing_boxes(folder, high) if comm.rank == 0 else None
    return dict(comm.bcast(content))
