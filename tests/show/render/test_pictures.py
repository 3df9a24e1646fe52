"""Pictures, checked pixel by pixel, and films."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from mpi4py import MPI
from PIL import Image
from written_run import ring as ring_mesh
from written_run import written, written_with_obstacles

from lyra_petsc.errors import InputError, OutputError
from lyra_petsc.output.mesh_file import write_mesh
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.scene.load import load_scene
from lyra_petsc.show.obstacle_surfaces import obstacle_surfaces
from lyra_petsc.show.render import opengl
from lyra_petsc.show.render.draw import draw
from lyra_petsc.show.render.image_files import film_writer
from lyra_petsc.show.render.render_plan import RenderOptions, make_plan
from lyra_petsc.show.render.scene_drawing import FLOOR_GAP, Bounds, floor_height, near_obstacle_points
from lyra_petsc.show.render.sheet_geometry import split_at_seams, vertex_normals

SIZE = "160x120"
FRONT, BACK = "#ff0000", "#0000ff"
LEVEL = ("render.camera.position=[1.5,1.5,9]", "render.camera.target=[1.5,1.5,0]", "render.camera.angle=30")
"""A camera above the ring, x to the right and y upwards; pictures show 4.8 m vertically in the plane z = 0.

"""


@pytest.fixture(scope="module")
def ring(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("ring"), states=6)


def drawn(asked: RenderOptions) -> list[Path]:
    return draw(MPI.COMM_SELF, make_plan(asked), lambda done, count: None)


def picture(run: Path, out: Path, at: str = "0", **options: object) -> np.ndarray:
    options = {"size": SIZE, "settings": LEVEL, "label": False, "colors": f"{FRONT},{BACK}", **options}
    (path,) = drawn(RenderOptions(run, at=at, out=out, **options))
    return np.asarray(Image.open(path)).astype(float)


def pixel(x: float, y: float) -> tuple[int, int]:
    """Row and column of a point of the plane z = 0 under the camera `LEVEL`."""
    half = 9.0 * np.tan(np.radians(15.0))
    return round(60 - (y - 1.5) / half * 60), round(80 + (x - 1.5) / half * 60)


def test_the_sheet_is_at_its_place_in_the_picture(ring, tmp_path):
    image = picture(ring, tmp_path)
    assert image.shape == (120, 160, 3)
    red = (image[:, :, 0] > 1.5 * image[:, :, 1]) & (image[:, :, 0] > 1.5 * image[:, :, 2])
    for x, y in [(0.5, 1.5), (2.5, 1.5), (1.5, 0.5), (1.5, 2.5), (0.1, 0.1), (2.9, 2.9)]:
        assert red[pixel(x, y)], (x, y)
    for x, y in [(1.5, 1.5), (-0.2, 1.5), (3.2, 1.5), (1.5, 3.2)]:
        assert not red[pixel(x, y)], (x, y)
    # 9 m² less the hole of 1 m²; a pixel is (4.82 m / 120)² large
    assert red.sum() * (2 * 9.0 * np.tan(np.radians(15.0)) / 120) ** 2 == pytest.approx(8.0, rel=0.05)


def test_the_back_has_its_own_colour(ring, tmp_path):
    below = ("render.camera.position=[1.5,1.5,-9]", *LEVEL[1:])
    image = picture(ring, tmp_path, settings=below)
    blue = image[pixel(0.5, 1.5)]
    assert blue[2] > 1.5 * blue[0]


def test_a_tilted_sheet_is_shaded(ring, tmp_path):
    flat = picture(ring, tmp_path, at="0")[pixel(0.5, 1.5)]
    tilted = picture(ring, tmp_path, at="0.5")
    red = tilted[:, :, 0] > 1.5 * tilted[:, :, 1]
    assert abs(np.median(tilted[red][:, 0]) - flat[0]) > 5.0


def test_the_ground_has_a_shadow(ring, tmp_path):
    """With gravity; otherwise there is no ground."""
    scene = (ring / "scene.yaml").read_text(encoding="utf-8")
    run = written(tmp_path / "run", states=6)
    (run / "scene.yaml").write_text(scene + "gravity: [0, 0, -9.81]\n", encoding="utf-8")
    aside = ("render.camera.direction=[0,-1,0.5]",)
    images = [picture(run, tmp_path, settings=aside, ground=ground) for ground in (True, False)]
    without = picture(ring, tmp_path, settings=aside)
    sheet = images[1][:, :, 0] > 1.5 * images[1][:, :, 2]
    darker = (images[1] - images[0]).sum(axis=2)
    assert (darker[~sheet] > 150.0).sum() > 100
    assert np.abs(darker[sheet]).mean() < 15.0
    np.testing.assert_array_equal(images[1], without)


def test_a_texture_is_placed_by_its_coordinates(ring, tmp_path):
    """Left half green, upper right quarter blue, lower right red; the picture's first row is v = 1."""
    colors = np.zeros((64, 64, 3), dtype=np.uint8)
    colors[:, :32, 1] = colors[:32, 32:, 2] = colors[32:, 32:, 0] = 200
    Image.fromarray(colors).save(tmp_path / "quarters.png")
    image = picture(ring, tmp_path, texture=tmp_path / "quarters.png")
    assert [int(np.argmax(image[pixel(x, y)])) for x, y in [(0.5, 1.5), (2.5, 2.0), (2.5, 1.0)]] == [1, 2, 0]


def test_a_texture_without_vt_covers_the_sheet_once(tmp_path):
    colors = np.zeros((64, 64, 3), dtype=np.uint8)
    colors[:, :32, 1] = colors[:, 32:, 0] = 200
    Image.fromarray(colors).save(tmp_path / "halves.png")
    run = written(tmp_path / "run", vt="none")
    image = picture(run, tmp_path, texture=tmp_path / "halves.png")
    assert [int(np.argmax(image[pixel(x, 1.6)])) for x in (0.2, 0.8, 2.2, 2.8)] == [1, 1, 0, 0]


def test_vertices_on_a_seam_are_drawn_twice():
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    x = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 1], [0, 1, 0]])
    corner_uv = x[triangles][..., :2].copy()
    corner_uv[1] += 5.0
    source, corners, uv = split_at_seams(triangles, corner_uv)
    assert len(source) == 6
    np.testing.assert_array_equal(x[source][corners], x[triangles])
    np.testing.assert_array_equal(uv[corners], corner_uv)
    np.testing.assert_allclose(np.linalg.norm(vertex_normals(x, triangles), axis=1), 1.0)
    assert np.isfinite(vertex_normals(np.zeros((4, 3)), triangles)).all()


def test_colours_distinguish_values_and_have_a_bar(ring, tmp_path):
    """Stress grows with the number of the triangle: the first is darkest (viridis), the last brightest."""
    image = picture(ring, tmp_path, field="stress", range="0,7", cells=True)
    first, last = image[pixel(1.2, 0.5)], image[pixel(2.2, 2.5)]
    assert last[1] > first[1] + 80.0
    plain = picture(ring, tmp_path)
    assert np.abs(image - plain)[100:, 100:].max() > 60.0, "no bar"
    means = picture(ring, tmp_path, field="stress", range="0,7")

    def jumps(shown: np.ndarray) -> float:
        """Largest change of green from pixel to pixel along a line across the triangles of the upper side."""
        row, first = pixel(0.3, 2.6)
        return np.abs(np.diff(shown[row, first : pixel(2.7, 2.6)[1], 1])).max()

    assert jumps(means) < 0.6 * jumps(image)


def test_handles_and_label_are_drawn_on_request(tmp_path):
    run = written(tmp_path / "run")
    scene = (run / "scene.yaml").read_text(encoding="utf-8").replace("handles: []\n", "")
    (run / "scene.yaml").write_text(
        scene + "handles: [{nodes: [0, 2]}]\nwind: {velocity: [1, 0, 0], density: 1}\n", encoding="utf-8"
    )
    assert len(load_scene(run / "scene.yaml", meshes_needed=False).handles) == 1
    plain = picture(run, tmp_path)
    held = picture(run, tmp_path, handles=True)
    changed = np.abs(held - plain).sum(axis=2) > 100.0
    assert changed[pixel(1.5, 0.0)]
    assert not changed[pixel(1.5, 3.0)]
    label = np.abs(picture(run, tmp_path, label=True) - plain).sum(axis=2) > 100.0
    assert label[100:, :60].any()
    assert not label[:100].any()
    fitted = ("render.camera.direction=[0,-1,0.4]",)
    blowing, calm = (picture(run, tmp_path, settings=fitted, wind=wind) for wind in (True, False))
    assert (np.abs(blowing - calm).sum(axis=2) > 100.0).any()


@pytest.mark.parametrize("ending", ["mp4", "webm", "gif"])
def test_a_film_has_its_size_length_and_motion(ring, tmp_path, ending):
    path = tmp_path / f"film.{ending}"
    assert drawn(RenderOptions(ring, film=path, size=SIZE, settings=LEVEL, fps=10.0, out=tmp_path)) == [path]
    frames = imageio_ffmpeg.read_frames(str(path))
    about = next(frames)
    pictures = [np.frombuffer(frame, np.uint8).reshape(120, 160, 3).astype(float) for frame in frames]
    assert about["source_size"] == (160, 120)
    assert about["fps"] == pytest.approx(10.0)
    assert len(pictures) == 6
    for before, after in itertools.pairwise(pictures):
        assert np.abs(after - before).max() > 20.0
    assert list(tmp_path.iterdir()) == [path]


def test_without_options_a_film_and_a_sheet(ring):
    asked = RenderOptions(ring, size=SIZE)
    plan = make_plan(asked)
    assert plan.film is not None
    assert plan.sheet is not None
    paths = drawn(asked)
    assert {path.name for path in paths} == {"film.mp4", "sheet.png"}
    with Image.open(ring / "sheet.png") as sheet:
        assert sheet.size == (3 * 80 + 2 * 4, 2 * 60 + 4)
        tiles = np.asarray(sheet).astype(float)
    assert np.abs(tiles[:60, :80] - tiles[64:, 168:]).max() > 30.0


def test_a_film_that_cannot_be_finished_leaves_the_old_one(tmp_path):
    path = tmp_path / "film.mp4"
    path.write_bytes(b"old")

    def film(path: Path, frames: int, *, stop: bool) -> None:
        with film_writer(path, (64, 64), 10.0) as add_frame:
            for _ in range(frames):
                add_frame(np.zeros((64, 64, 3), np.uint8))
            if stop:
                raise InputError("stopped")

    with pytest.raises(InputError, match="stopped"):
        film(path, 1, stop=True)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    for frames in (0, 1, 1000):
        with pytest.raises(OutputError, match=r"nowhere/a\.mp4: cannot be written by ffmpeg: No such file"):
            film(tmp_path / "nowhere" / "a.mp4", frames, stop=False)


def test_states_with_nan_are_refused(tmp_path, monkeypatch):
    import h5py

    from lyra_petsc.output.stored import check_sum

    run = written(tmp_path / "run")
    with h5py.File(run / "states-0000.h5", "a") as file:
        position = file["states/000001/position"]
        position[3, 1] = np.nan
        file["written/sums"][1, 0] = check_sum(position[()])
    with pytest.raises(InputError, match="position holds numbers that are not finite"):
        drawn(RenderOptions(run, film=tmp_path / "a.mp4", size=SIZE))
    assert not (tmp_path / "a.mp4").exists()


def test_missing_opengl_is_one_line(ring, monkeypatch):
    class Window:
        def SetOffScreenRendering(self, on: bool) -> None: ...

        def GetClassName(self) -> str:
            return "vtkOSOpenGLRenderWindow"

    monkeypatch.setattr("vtkmodules.vtkRenderingCore.vtkRenderWindow", Window)
    monkeypatch.setattr(opengl, "_has_osmesa", lambda: False)
    with pytest.raises(InputError, match="install libegl1"):
        make_plan(RenderOptions(ring))


@pytest.mark.parallel(2)
def test_ranks_share_the_states_and_draw_the_same(comm, shared_tmp):
    run = shared_tmp / "run"
    if comm.rank == 0:
        written(run, states=5)
    comm.barrier()
    asked = RenderOptions(
        run, at="0,0.1,0.2,0.3,0.4", film=shared_tmp / "f.mp4", out=shared_tmp, size=SIZE, field="speed"
    )
    plan = comm.bcast(make_plan(asked) if comm.rank == 0 else None)
    progress = []
    paths = draw(comm, plan, lambda done, count: progress.append((done, count)))
    assert progress[-1] == (5, 5)
    if comm.rank > 0:
        assert paths == []
        return
    assert len(paths) == 6
    alone = shared_tmp / "alone"
    drawn(RenderOptions(run, at=asked.at, out=alone, size=SIZE, field="speed"))
    for path in paths:
        if path.suffix == ".png":
            np.testing.assert_array_equal(
                np.asarray(Image.open(path)), np.asarray(Image.open(alone / path.name))
            )


@pytest.mark.parallel(2)
def test_a_state_that_one_rank_cannot_read_ends_all(comm, shared_tmp):
    run = shared_tmp / "run"
    if comm.rank == 0:
        written(run, states=4)
    comm.barrier()
    asked = RenderOptions(run, film=shared_tmp / "f.mp4", size=SIZE)
    plan = comm.bcast(make_plan(asked) if comm.rank == 0 else None)
    if comm.rank == 0:
        (run / "states-0000.h5").unlink()
    comm.barrier()
    with pytest.raises(InputError, match=r"states-0000\.h5"):
        draw(comm, plan, lambda done, count: None)
    assert not (shared_tmp / "f.mp4").exists()


def grey(image: np.ndarray, x: float, y: float) -> bool:
    """Whether an obstacle is seen at a point of the plane z = 0."""
    red, green, blue = image[pixel(x, y)]
    return bool(max(red, green, blue) < 1.35 * min(red, green, blue) and max(red, green, blue) < 200)


def test_obstacles_are_drawn_at_their_place_at_each_time(tmp_path):
    """A ball that moves by 1.5 m in 0.5 s, and a mesh from the run's folder."""
    run = written_with_obstacles(tmp_path / "run")
    start, end = (picture(run, tmp_path, at=at) for at in ("0", "0.5"))
    for image, here, there in ((start, 0.0, 1.5), (end, 1.5, 0.0)):
        assert grey(image, here, 3.6)
        assert grey(image, here + 0.2, 3.6)
        assert not grey(image, there, 3.6)
        assert grey(image, 3.5, 0.2)  # the mesh, half a square, is at rest
        assert not grey(image, 3.9, 0.9)


def test_planes_and_containers_do_not_hide_sheets(tmp_path):
    plane = {"plane": {"point": [0, 0, 2], "normal": [0, 0, -1]}}
    hull = {"box": {"min": [-9, -9, -9], "max": [9, 9, 4]}, "inside": True}
    plain = picture(written_with_obstacles(tmp_path / "plain", obstacles={}), tmp_path)
    for number, (kind, least) in enumerate(((plane, 0.3), (hull, 0.05))):
        image = picture(written_with_obstacles(tmp_path / f"{number}", obstacles={"one": kind}), tmp_path)
        there = pixel(0.5, 1.5)
        assert image[there][0] > 1.2 * image[there][1:].max()  # red through it
        change = np.abs(image - plain).max(axis=2)
        assert change[there] > least * 255 * 0.3
        assert change[pixel(1.5, 1.5)] > 5  # where the sheet has its hole


def test_obstacles_are_in_the_picture(tmp_path):
    """A ball near the sheet is completely visible without a camera; a distant one takes little space."""
    images = []
    for number, x in enumerate((4.0, 400.0, None)):
        ball = {"ball": {"sphere": {"center": [x, 1.5, 0], "radius": 0.5}}} if x is not None else {}
        run = written_with_obstacles(tmp_path / f"{number}", obstacles=ball)
        images.append(picture(run, tmp_path, settings=("render.camera.direction=[0,0,1]",)))
    near, _, none = images
    dark = np.abs(near - none).max(axis=2)
    assert (dark > 30).sum() > 100
    red = [(image[:, :, 0] > 1.5 * image[:, :, 1]).sum() for image in images]
    assert red[0] < red[2]
    assert 0.3 * red[2] < red[1] < red[2]
    edge = near[:, [0, -1]].reshape(-1, 3)
    assert (np.ptp(edge, axis=1) < 30).all()


@pytest.mark.parametrize("at", ["0", "0.5"])
def test_a_single_picture_is_filled_by_its_state(ring, tmp_path, at):
    """The sheet moves by its own size during the run; it has a margin of 7 % on the nearest sides."""
    run = written(tmp_path / "run", states=30)
    image = picture(run, tmp_path, at=at, settings=("render.camera.direction=[0,-1,1]",))
    rows, columns = np.nonzero(image[:, :, 0] > 1.5 * image[:, :, 2])
    assert max(np.ptp(rows) / 120, np.ptp(columns) / 160) == pytest.approx(0.86, abs=0.02)


def test_each_sheet_has_its_own_colours(tmp_path):
    run, apart = written(tmp_path / "run", fields=False), [0, 4]
    mesh = ring_mesh()
    write_mesh(
        run,
        replace(mesh, triangles=mesh.triangles[apart], triangle_uv=mesh.triangle_uv[apart]),
        MPI.COMM_SELF,
    )
    own, given = (picture(run, tmp_path, colors=colors) for colors in (None, f"{FRONT},{BACK}"))
    lower, upper = pixel(1.7, 0.3), pixel(1.3, 2.7)
    assert [int(np.argmax(own[there])) for there in (lower, upper)] == [0, 2]
    assert [int(np.argmax(given[there])) for there in (lower, upper)] == [0, 0]


@pytest.mark.parametrize(
    ("shape", "lowest", "shown"),
    [
        ({"box": {"min": [0, 0, -4], "max": [3, 3, -1]}}, -4.0, -4.0),
        ({"box": {"min": [0, 0, -9], "max": [3, 3, -1]}}, -9.0, -1.25),  # in part, as it is large
        ({"sphere": {"center": [1, 1, 3], "radius": 1}}, -0.1, 2.0),
        ({"plane": {"point": [0, 0, -9], "normal": [0, 0, 1]}}, -0.1, np.inf),
    ],
)
def test_the_floor_is_below_what_stands_on_it(tmp_path, shape, lowest, shown):
    run = StoredRun(written_with_obstacles(tmp_path / "run", obstacles={"one": shape}))
    bounds = Bounds(np.eye(3), np.zeros(3), np.array([3.0, 4.0, 0.0]))
    surfaces = obstacle_surfaces(run, bounds.middle, bounds.size)
    assert FLOOR_GAP * bounds.size == pytest.approx(0.1)
    assert floor_height(surfaces, bounds, run.times) == pytest.approx(lowest)
    near = near_obstacle_points(surfaces, bounds, run.times, -np.eye(3))
    assert near[:, 2].min(initial=np.inf) == pytest.approx(shown)


def test_a_run_without_the_mesh_of_an_obstacle_is_refused(tmp_path):
    run = written_with_obstacles(tmp_path / "run")
    write_mesh(run, ring_mesh(), MPI.COMM_SELF)
    with pytest.raises(InputError, match="does not hold the mesh of obstacle 'post'"):
        picture(run, tmp_path)
