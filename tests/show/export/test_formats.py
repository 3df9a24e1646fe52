"""Exported files of each format, read back, equal the states within the format's precision."""

import numpy as np
import pytest
from written_run import (
    POST,
    REST,
    TRIANGLES,
    position,
    scene,
    tensor,
    velocity,
    written,
    written_with_obstacles,
)

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.obj_file import read_obj
from lyra_petsc.output.file_operations import replace_text
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.show.export import export_run

pytestmark = pytest.mark.quick

VT = ["none", "each vertex", "seam"]
UV = REST[TRIANGLES][..., :2] / 3.0
SEAM_UV = UV + 0.25 * (np.arange(len(TRIANGLES)) == 3)[:, None, None]


def single(array):
    return np.asarray(array, dtype=np.float32)


@pytest.mark.parametrize("vt", VT)
def test_obj(tmp_path, vt):
    done = export_run(written(tmp_path / "run", vt=vt), "obj")

    assert done.files == ("run_0000.obj", "run_0001.obj", "run_0002.obj", "times.csv")
    for state in range(3):
        lines = (done.folder / f"run_{state:04d}.obj").read_text().splitlines()
        points = [[float(word) for word in line.split()[1:]] for line in lines if line.startswith("v ")]
        np.testing.assert_array_equal(points, position(state))
        faces = [line.split()[1:] for line in lines if line.startswith("f ")]
        corners = np.array([[word.split("/") for word in face] for face in faces], dtype=int) - 1
        np.testing.assert_array_equal(corners[:, :, 0], TRIANGLES)
        uv = [[float(word) for word in line.split()[1:]] for line in lines if line.startswith("vt ")]
        if vt == "none":
            assert uv == []
            assert corners.shape[2] == 1
        else:
            found = np.array(uv)[corners[:, :, 1]]
            np.testing.assert_array_equal(found, SEAM_UV if vt == "seam" else UV)
            assert len(uv) == (8 if vt == "each vertex" else len(np.unique(found.reshape(-1, 2), axis=0)))
    ours = read_obj(done.folder / "run_0002.obj")
    np.testing.assert_array_equal(ours.points, position(2))


def test_ply(tmp_path):
    meshio = pytest.importorskip("meshio")
    done = export_run(written(tmp_path / "run"), "ply")

    for state in range(3):
        mesh = meshio.read(done.folder / f"run_{state:04d}.ply")
        np.testing.assert_array_equal(mesh.points, position(state))
        np.testing.assert_array_equal(mesh.cells_dict["triangle"], TRIANGLES)
        data = mesh.point_data
        np.testing.assert_array_equal(np.stack([data["s"], data["t"]], axis=1), REST[:, :2] / 3.0)
        found = np.stack([data[f"velocity_{axis}"] for axis in "xyz"], axis=1)
        np.testing.assert_array_equal(found, velocity(state))


@pytest.mark.parametrize("to", ["npz", "ply", "usd"])
def test_displacement_is_added_on_request(tmp_path, to):
    """From the run's first state, whichever states are chosen."""
    run = written(tmp_path / "run", states=4)
    moved = position(3) - position(0)
    for asked in (False, True):
        done = export_run(run, to, tmp_path / f"{asked}", times="0.3", displacement=asked)
        file = done.folder / done.files[0]
        if to == "npz":
            found = dict(np.load(file))
            found = found.get("displacement", [None])[0]
        elif to == "ply":
            data = pytest.importorskip("meshio").read(file).point_data
            found = np.stack([data[f"displacement_{i}"] for i in "xyz"], 1) if asked else None
        else:
            pytest.importorskip("pxr")
            from pxr import Usd, UsdGeom

            stage = Usd.Stage.Open(str(file))
            mesh = stage.GetDefaultPrim().GetChild("cloth")
            primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("displacement")
            found = primvar.Get(Usd.TimeCode.EarliestTime()) if primvar else None
        if asked:
            np.testing.assert_allclose(np.asarray(found), moved, rtol=1e-6)
        else:
            assert found is None


def test_obj_holds_positions_alone(tmp_path):
    with pytest.raises(InputError, match=r"--displacement: .*positions alone; take --to ply, usd, npz"):
        export_run(written(tmp_path / "run"), "obj", displacement=True)


def usd_errors(stage):
    """Complaints of the library's own validators about a stage."""
    validation = pytest.importorskip("pxr.UsdValidation")
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    return [error.GetMessage() for error in validation.ValidationContext(validators).Validate(stage)]


@pytest.mark.parametrize("vt", VT)
def test_usd(tmp_path, vt):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    done = export_run(written(tmp_path / "run", states=4, vt=vt), "usd")
    path = str(done.folder / "run.usdc")
    stage = Usd.Stage.Open(path)
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == 10.0
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 3.0)
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim().GetChild("cloth"))
    np.testing.assert_array_equal(np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), TRIANGLES)
    assert mesh.GetPointsAttr().GetTimeSamples() == [0.0, 1.0, 2.0, 3.0]
    primvars = UsdGeom.PrimvarsAPI(mesh)
    for state in range(4):
        np.testing.assert_array_equal(mesh.GetPointsAttr().Get(state), single(position(state)))
        np.testing.assert_array_equal(mesh.GetVelocitiesAttr().Get(state), single(velocity(state)))
        found = primvars.GetPrimvar("stress")
        np.testing.assert_array_equal(found.Get(state), single(tensor(state)).ravel())
        assert found.GetInterpolation() == "uniform"
        low, high = mesh.GetExtentAttr().Get(state)
        np.testing.assert_array_equal([low, high], single([position(state).min(0), position(state).max(0)]))
    assert primvars.GetPrimvar("stress").GetAttr().GetCustomDataByKey("unit") == "N/m"
    st = primvars.GetPrimvar("st")
    if vt == "none":
        assert not st.HasValue()
    elif vt == "seam":
        np.testing.assert_array_equal(np.array(st.Get()).reshape(-1, 3, 2), single(SEAM_UV))
        assert st.GetInterpolation() == "faceVarying"
    else:
        np.testing.assert_array_equal(np.array(st.Get())[TRIANGLES], single(UV))
    assert usd_errors(stage) == []


@pytest.mark.parametrize("vt", VT)
def test_npz(tmp_path, vt):
    done = export_run(written(tmp_path / "run", states=4, vt=vt), "npz")
    found = np.load(done.folder / "run.npz")

    np.testing.assert_array_equal(found["time"], StoredRun(tmp_path / "run").times)
    np.testing.assert_array_equal(found["position"], [position(i) for i in range(4)])
    np.testing.assert_array_equal(found["velocity"], [velocity(i) for i in range(4)])
    np.testing.assert_array_equal(found["stress"], [tensor(i) for i in range(4)])
    np.testing.assert_array_equal(found["triangles"], TRIANGLES)
    np.testing.assert_array_equal(found["rest"], REST)
    expected = {"none": None, "each vertex": "uv", "seam": "corner_uv"}[vt]
    assert {"uv", "corner_uv"} & set(found.files) == ({expected} if expected else set())
    units = dict(zip(found["names"].tolist(), found["units"].tolist(), strict=True))
    assert set(units) == set(found.files) - {"names", "units"}
    assert (units["time"], units["position"], units["velocity"], units["stress"]) == ("s", "m", "m/s", "N/m")


@pytest.mark.parametrize("to", ["obj", "ply", "usd", "npz"])
def test_a_single_state_of_a_named_run(tmp_path, to):
    folder = tmp_path / "Fähnchen 旗 (1)"
    done = export_run(written(folder, states=1, fields=False), to)
    assert done.states == 1
    (name,) = done.files
    assert name.startswith("Fähnchen_旗__1_")
    if to == "usd":
        from pxr import Usd, UsdGeom

        stage = Usd.Stage.Open(str(done.folder / name))
        mesh = UsdGeom.Mesh(stage.GetDefaultPrim().GetChild("cloth"))
        np.testing.assert_array_equal(mesh.GetPointsAttr().Get(0), single(position(0)))
        assert stage.GetDefaultPrim().GetDisplayName() == folder.name


@pytest.mark.parametrize(
    ("gravity", "axis"), [([0, -9.81, 0], "Y"), ([9.81, 0, 0], "Z"), ([0, 0, 9.81], "Z"), (None, "Z")]
)
def test_the_vertical_axis_is_against_gravity(tmp_path, gravity, axis):
    pytest.importorskip("pxr")
    from pxr import Gf, Usd, UsdGeom

    folder = written(tmp_path / "run")
    replace_text(folder / "scene.yaml", dump_scene(scene().changed({"gravity": gravity})))
    stage = Usd.Stage.Open(str(export_run(folder, "usd").folder / "run.usdc"))
    assert UsdGeom.GetStageUpAxis(stage) == axis
    matrix = UsdGeom.Xformable(stage.GetDefaultPrim()).ComputeLocalToWorldTransform(0)
    against = Gf.Vec3d(*(-np.array(gravity or [0, 0, -1.0]))).GetNormalized()
    up = Gf.Vec3d(*("XYZ".index(axis) == np.arange(3)).astype(float))
    np.testing.assert_allclose(matrix.TransformDir(against), up, atol=1e-6)


def read_objects(to, folder):
    """Points (2, n, 3) and triangles (m, 3) of each obstacle in an export of two states."""
    if to == "obj":
        found = {}
        for file in sorted(folder.glob("*.obj")):
            _, cloth, *others = file.read_text().split("\no ")
            assert cloth.startswith("cloth\nv ")
            before = len(REST)
            for text in others:
                name, *lines = text.splitlines()
                rows = {kind: [line.split()[1:] for line in lines if line[0] == kind] for kind in "vf"}
                x, faces = (np.array(rows[kind], dtype=float) for kind in "vf")
                found.setdefault(name, ([], faces.astype(int) - before - 1))[0].append(x)
                before += len(x)
        return {name: (np.array(x), faces) for name, (x, faces) in found.items()}
    if to == "npz":
        data = np.load(folder / "run.npz")
        assert dict(zip(data["names"], data["units"], strict=True))["obstacle_ball"] == "m"
        names = [name.removeprefix("obstacle_") for name in data if name.startswith("obstacle_")]
        return {name: (data[f"obstacle_{name}"], data[f"triangles_of_{name}"]) for name in names}
    if to == "ply":
        meshio = pytest.importorskip("meshio")
        found = {}
        for file in sorted(folder.glob("run-*.ply")):
            mesh = meshio.read(file)
            name = file.stem.removeprefix("run-")[:-5]
            found.setdefault(name, ([], mesh.cells_dict["triangle"]))[0].append(mesh.points)
        return {name: (np.array(x), faces) for name, (x, faces) in found.items()}
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    stage, found = Usd.Stage.Open(str(folder / "run.usdc")), {}
    for prim in stage.GetDefaultPrim().GetChildren()[1:]:
        mesh = UsdGeom.Mesh(prim)
        x = [np.array(mesh.GetPointsAttr().Get(code)) for code in (0.0, 1.0)]
        faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        found[prim.GetName()] = np.array(x), faces
    return found


@pytest.mark.parametrize("to", ["obj", "ply", "npz", "usd"])
def test_obstacles_are_separate_objects(tmp_path, to):
    """A ball that moves by 1.5 m along x and a triangle at rest; the cloth is as without them."""
    export_run(written_with_obstacles(tmp_path / "run"), to, tmp_path / "out", times="0,0.5")
    found = read_objects(to, tmp_path / "out")
    assert set(found) == {"ball", "post"}
    x, faces = found["ball"]
    assert len(x) == 2
    for points, centre in zip(x, ([0, 3.6, 0], [1.5, 3.6, 0]), strict=True):
        np.testing.assert_allclose(np.linalg.norm(points - centre, axis=1), 0.3, rtol=0, atol=1e-6)
    a, b, c = np.moveaxis(x[1][faces], 1, 0)
    assert (np.cross(a, b) * c).sum() / 6.0 == pytest.approx(4 / 3 * np.pi * 0.3**3, rel=0.01)
    x, faces = found["post"]
    np.testing.assert_allclose(x, [POST.points] * 2, rtol=1e-6)
    np.testing.assert_array_equal(faces, POST.triangles)


def test_names_of_obstacles_in_files_are_unique(tmp_path):
    ball = {"sphere": {"center": [0, 0, 0], "radius": 1}}
    names = ["cloth", "a b", "a_b", "2/1", "ü"]
    done = export_run(written_with_obstacles(tmp_path / "run", dict.fromkeys(names, ball)), "obj", every=99)
    lines = (done.folder / done.files[0]).read_text().splitlines()
    objects = [line[2:] for line in lines if line.startswith("o ")]
    assert objects == ["cloth", "cloth_", "a_b", "a_b_", "_2_1", "_"]
    assert done.files == ("run_0000.obj",)
