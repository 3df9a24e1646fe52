"""Frames from files: what is read, what is refused, and positions between them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.frame_files import check_frames, open_frames
from lyra_petsc.mesh.frame_motion import FrameMotion

TIMES = np.array([0.0, 0.1, 0.3, 0.4, 0.7, 0.8])
RNG = np.random.default_rng(3)
POSITION = RNG.normal(size=(6, 5, 3))


def npz(folder: Path, **arrays: Any) -> Path:
    np.savez(folder / "walk.npz", **({"time": TIMES, "position": POSITION} | arrays))
    return folder / "walk.npz"


def obj(folder: Path, numbers: Any) -> None:
    for frame, number in enumerate(numbers):
        lines = [f"v {x!r} {y!r} {z!r}\n" for x, y, z in POSITION[frame].tolist()]
        (folder / f"body_{number:04}.obj").write_text("".join(lines) + "f 1 2 3\n")


def test_npz_frames_are_read_one_by_one(tmp_path: Path) -> None:
    frames = open_frames(npz(tmp_path), None)
    assert np.array_equal(frames.times, TIMES)
    assert all(np.array_equal(frames.read(i), POSITION[i]) for i in (4, 0, 5))


def test_frames_per_second_count_where_there_are_no_times(tmp_path: Path) -> None:
    np.savez(tmp_path / "walk.npz", position=POSITION.astype(np.float32))
    assert np.allclose(open_frames(tmp_path / "walk.npz", 20.0).times, np.arange(6) / 20.0)
    assert np.array_equal(open_frames(npz(tmp_path), 20.0).times, TIMES)
    np.savez(tmp_path / "walk.npz", position=POSITION)
    with pytest.raises(InputError, match="give fps"):
        open_frames(tmp_path / "walk.npz", None)


def test_a_sequence_of_obj_files_is_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    obj(tmp_path, [8, 9, 10, 11, 12, 13])
    frames = open_frames(tmp_path / "body_*.obj", 10.0)
    assert np.array_equal([frames.read(i) for i in range(6)], POSITION)
    files = tuple(tmp_path / f"body_{i:04}.obj" for i in (9, 8))
    assert np.array_equal(open_frames(files, 10.0).read(0), POSITION[1])


def test_a_missing_number_is_named(tmp_path: Path) -> None:
    obj(tmp_path, [0, 1, 3])
    with pytest.raises(InputError, match="number 2 is missing between"):
        open_frames(tmp_path / "body_*.obj", 10.0)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"position": POSITION[:, :, :2]}, "must be \\(frames, vertices, 3\\)"),
        ({"time": TIMES[:5]}, "for 6 frames"),
        ({"time": TIMES[::-1]}, "each later than the one before"),
        ({"position": np.array([object()])}, "not numbers"),
        ({"position": np.asfortranarray(POSITION)}, "Fortran"),
    ],
)
def test_arrays_that_are_no_frames_are_refused(tmp_path: Path, arrays: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        open_frames(npz(tmp_path, **arrays), None)


def test_compressed_and_damaged_files_are_refused(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "walk.npz", time=TIMES, position=POSITION)
    with pytest.raises(InputError, match="is compressed"):
        open_frames(tmp_path / "walk.npz", None)
    whole = npz(tmp_path).read_bytes()
    (tmp_path / "walk.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="cannot be read as an npz file"):
        open_frames(tmp_path / "walk.npz", None)


def test_a_frame_that_is_not_finite_or_of_another_size_is_named(tmp_path: Path) -> None:
    bad = POSITION.copy()
    bad[3, 2, 1] = np.nan
    with pytest.raises(InputError, match=r"frame 3 \(t = 0.4 s\) .* not finite: vertices 2 "):
        check_frames(open_frames(npz(tmp_path, position=bad), None), (5,), "body.obj has")
    with pytest.raises(InputError, match=r"frame 0 .* has 5 vertices; body\.obj has 7"):
        check_frames(open_frames(npz(tmp_path), None), (7,), "body.obj has")
    obj(tmp_path, range(6))
    (tmp_path / "body_0004.obj").write_text("v 0 0 0\n")
    with pytest.raises(InputError, match="has 1 vertices") as refusal:
        check_frames(open_frames(tmp_path / "body_*.obj", 10.0), (5,), "body.obj has")
    assert str(refusal.value.file).endswith("body_0004.obj")


def test_points_of_a_usd_file(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateNew(str(tmp_path / "walk.usdc"))
    stage.SetTimeCodesPerSecond(10.0)
    points = UsdGeom.Mesh.Define(stage, "/body").CreatePointsAttr()
    for code, x in zip(10.0 * TIMES, POSITION, strict=True):
        points.Set(Vt.Vec3fArray.FromNumpy(x.astype(np.float32)), float(code))
    stage.GetRootLayer().Save()
    frames = open_frames(tmp_path / "walk.usdc", None)
    assert np.allclose(frames.times, TIMES)
    assert np.allclose(frames.read(4), POSITION[4], atol=1e-6)


@pytest.mark.parametrize("interpolation", ["monotone", "hermite", "linear"])
@pytest.mark.parametrize("repeat", [False, True])
def test_a_motion_meets_its_frames_and_keeps_at_most_four(
    tmp_path: Path, interpolation: str, repeat: bool
) -> None:
    motion = FrameMotion(open_frames(npz(tmp_path), None), interpolation, repeat=repeat)
    for time, x in zip(TIMES, POSITION, strict=True):
        assert np.abs(motion.positions(time) - x).max() < 1e-14
        assert len(motion._kept) <= 4
    assert np.array_equal(motion.positions(-1.0), POSITION[0])
    period = 0.9
    later = motion.positions(0.3 + 2 * period)
    assert np.abs(later - (POSITION[2] if repeat else POSITION[5])).max() < 1e-12
    before, after = motion.positions(0.35 - 1e-6), motion.positions(0.35 + 1e-6)
    assert np.abs((after - before) / 2e-6 - motion.velocities(0.35)).max() < 1e-4
    jump = motion._at(0.4 + 1e-9)[1] - motion._at(0.4 - 1e-9)[1]
    assert (np.abs(jump).max() < 1e-4) == (interpolation != "linear")


def test_a_cycle_whose_last_frame_is_the_first_does_not_stop(tmp_path: Path) -> None:
    closed = np.concatenate([POSITION[:5], POSITION[:1]])
    motion = FrameMotion(open_frames(npz(tmp_path, position=closed), None), "linear", repeat=True)
    assert np.abs(motion.positions(0.8 + 0.1) - POSITION[1]).max() < 1e-12
    assert np.allclose(motion.kinks(1.2, 0.01), [0.0, 0.1, 0.3, 0.4, 0.7, 0.8, 0.9, 1.1])
    assert motion.kinks(1.2, 0.5) == []
