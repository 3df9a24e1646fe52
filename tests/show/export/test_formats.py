"""Exported files of each format, read back, equal the states within the format's precision."""

import json
import shutil

import numpy as np
import pytest
from written_run import (
    POST,
    REST,
    TRIANGLES,
    position,
    scene,
    stress,
    velocity,
    written,
    written_with_obstacles,
)

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.obj_file import read_obj
from lyra_petsc.output.file_operations import replace_text
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.show.export import export_run, rotation_to_up

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


@pytest.mark.parametrize("to", ["npz", "vtkhdf", "ply", "usd"])
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
        elif to == "vtkhdf":
            ((*_, arrays),) = pytest.importorskip("vtkhdf_reader").read(file)
            found = arrays["vertex"].get("displacement")
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


@pytest.mark.parametrize("to", ["obj", "gltf"])
def test_formats_of_positions_alone_refuse_displacement(tmp_path, to):
    run = written(tmp_path / "run")
    with pytest.raises(InputError, match=r"--displacement: .*positions alone; take --to ply, usd, vtkhdf"):
        export_run(run, to, displacement=True)


def read_glb(path):
    """The JSON document, and a function that reads an accessor by the rules of the format."""
    pygltflib = pytest.importorskip("pygltflib")
    gltf = pygltflib.GLTF2().load(str(path))
    blob = gltf.binary_blob()

    def read(number):
        accessor = gltf.accessors[number]
        view = gltf.bufferViews[accessor.bufferView]
        kind = {pygltflib.FLOAT: np.float32, pygltflib.UNSIGNED_INT: np.uint32}[accessor.componentType]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[accessor.type]
        rows = np.frombuffer(blob, kind, accessor.count * width, view.byteOffset).reshape(-1, width)
        assert view.byteLength == rows.nbytes
        if accessor.min:
            np.testing.assert_array_equal(rows.min(axis=0), single(accessor.min))
            np.testing.assert_array_equal(rows.max(axis=0), single(accessor.max))
        return rows[:, 0] if width == 1 else rows

    return gltf, read


@pytest.mark.parametrize("vt", VT)
def test_gltf(tmp_path, vt):
    done = export_run(written(tmp_path / "run", states=4, vt=vt), "gltf")
    gltf, read = read_glb(done.folder / "run.glb")
    (mesh,) = gltf.meshes
    (primitive,) = mesh.primitives
    split = np.array(mesh.extras["vertex"]) if vt == "seam" else np.arange(len(REST))

    base = read(primitive.attributes.POSITION)
    moved = [read(target["POSITION"]) for target in primitive.targets]
    sampler = gltf.animations[0].samplers[0]
    np.testing.assert_array_equal(read(sampler.input), single([0.0, 0.1, 0.2, 0.1 * 3]))
    weights = read(sampler.output).reshape(4, 3)
    for state in range(4):
        shown = base + sum(weight * target for weight, target in zip(weights[state], moved, strict=True))
        np.testing.assert_allclose(shown, position(state)[split], rtol=0, atol=5e-7)
        normals = read(primitive.attributes.NORMAL) + sum(
            weight * read(target["NORMAL"])
            for weight, target in zip(weights[state], primitive.targets, strict=True)
        )
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    triangles = read(primitive.indices).reshape(-1, 3)
    np.testing.assert_array_equal(split[triangles], TRIANGLES)
    if vt == "none":
        assert primitive.attributes.TEXCOORD_0 is None
    else:
        uv = read(primitive.attributes.TEXCOORD_0)[triangles]
        uv = np.stack([uv[..., 0], 1.0 - uv[..., 1]], axis=-1)
        np.testing.assert_allclose(uv, SEAM_UV if vt == "seam" else UV, atol=1e-6)
    half = np.sqrt(0.5)
    np.testing.assert_allclose(gltf.nodes[0].rotation, [-half, 0, 0, half])  # z, against gravity, up


@pytest.mark.parametrize("vt", ["none", "each vertex"])
def test_gltf_animated_by_the_rules_of_the_format(tmp_path, vt):
    geometry = pytest.importorskip("vtkmodules.vtkIOGeometry")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    done = export_run(written(tmp_path / "run", states=4, vt=vt), "gltf")
    reader = geometry.vtkGLTFReader()
    reader.SetFileName(str(done.folder / "run.glb"))
    reader.SetFrameRate(1000)
    reader.UpdateInformation()
    reader.EnableAnimation(0)
    for state in range(4):
        reader.UpdateTimeStep(0.1 * state)
        block = reader.GetOutputDataObject(0)
        while block.IsA("vtkMultiBlockDataSet"):
            block = block.GetBlock(0)
        x, y, z = position(state).T
        shown = vtk_to_numpy(block.GetPoints().GetData())
        np.testing.assert_allclose(shown, np.stack([x, z, -y], axis=1), rtol=0, atol=1e-6)


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
        np.testing.assert_array_equal(found.Get(state), single(stress(state)))
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
    np.testing.assert_array_equal(found["stress"], [stress(i) for i in range(4)])
    np.testing.assert_array_equal(found["triangles"], TRIANGLES)
    np.testing.assert_array_equal(found["rest"], REST)
    expected = {"none": None, "each vertex": "uv", "seam": "corner_uv"}[vt]
    assert {"uv", "corner_uv"} & set(found.files) == ({expected} if expected else set())
    units = dict(zip(found["names"].tolist(), found["units"].tolist(), strict=True))
    assert set(units) == set(found.files) - {"names", "units"}
    assert (units["time"], units["position"], units["velocity"], units["stress"]) == ("s", "m", "m/s", "N/m")


def test_vtkhdf(tmp_path):
    reader = pytest.importorskip("vtkhdf_reader")
    done = export_run(written(tmp_path / "run", states=4), "vtkhdf", tmp_path / "out", every=2)
    shutil.rmtree(tmp_path / "run")  # the export is self-contained
    for i, (time, points, triangles, arrays) in zip(
        (0, 2), reader.read(done.folder / "run.vtkhdf"), strict=True
    ):
        assert time == 0.1 * i
        np.testing.assert_array_equal(points, position(i))
        np.testing.assert_array_equal(triangles, TRIANGLES)
        np.testing.assert_array_equal(arrays["vertex"]["rest"], REST)
        np.testing.assert_array_equal(arrays["vertex"]["velocity"], velocity(i))
        np.testing.assert_array_equal(arrays["triangle"]["stress"], stress(i))


@pytest.mark.parametrize("to", ["obj", "ply", "gltf", "usd", "npz", "vtkhdf"])
def test_a_single_state_of_a_named_run(tmp_path, to):
    folder = tmp_path / "Fähnchen 旗 (1)"
    done = export_run(written(folder, states=1, fields=False), to)
    assert done.states == 1
    (name,) = done.files
    assert name.startswith("Fähnchen_旗__1_")
    if to == "gltf":
        gltf, read = read_glb(done.folder / name)
        assert not gltf.animations
        np.testing.assert_array_equal(
            read(gltf.meshes[0].primitives[0].attributes.POSITION), single(position(0))
        )
    elif to == "usd":
        from pxr import Usd, UsdGeom

        stage = Usd.Stage.Open(str(done.folder / name))
        mesh = UsdGeom.Mesh(stage.GetDefaultPrim().GetChild("cloth"))
        np.testing.assert_array_equal(mesh.GetPointsAttr().Get(0), single(position(0)))
        assert stage.GetDefaultPrim().GetDisplayName() == folder.name


@pytest.mark.parametrize(("gravity", "axis"), [([0, -9.81, 0], "Y"), ([9.81, 0, 0], "Z"), (None, "Z")])
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


@pytest.mark.parametrize("target", [0, 1, 2])
@pytest.mark.parametrize("up", [(axis, sign) for axis in range(3) for sign in (-1, 1)])
def test_rotations_that_make_an_axis_vertical(up, target):
    x, y, z, w = rotation_to_up(up, target)
    assert x * x + y * y + z * z + w * w == pytest.approx(1.0)
    vector, q = np.zeros(3), np.array([x, y, z])
    vector[up[0]] = up[1]
    turned = vector + 2 * np.cross(q, np.cross(q, vector) + w * vector)
    np.testing.assert_allclose(turned, np.arange(3) == target, atol=1e-12)


def test_json_of_a_glb_holds_no_empty_values(tmp_path):
    done = export_run(written(tmp_path / "run"), "gltf")
    raw = (done.folder / "run.glb").read_bytes()
    length = int.from_bytes(raw[12:16], "little")
    text = json.dumps(json.loads(raw[20 : 20 + length]))
    assert "null" not in text
    assert "[]" not in text


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
    if to == "vtkhdf":
        read = pytest.importorskip("vtkhdf_reader").read
        steps = {file.stem.removeprefix("run-"): read(file) for file in folder.glob("run-*")}
        return {name: (np.array([x for _, x, _, _ in each]), each[0][2]) for name, each in steps.items()}
    if to == "gltf":
        gltf, read = read_glb(folder / "run.glb")
        found, moving = {}, {channel.target.node for channel in gltf.animations[0].channels}
        assert 0 in moving
        for number, node in enumerate(gltf.nodes[1:], 1):
            (primitive,) = gltf.meshes[node.mesh].primitives
            assert gltf.materials[primitive.material].name.endswith("obstacle")
            x = [read(primitive.attributes.POSITION)]
            assert (number in moving) == bool(primitive.targets)
            x.append(x[0] + (read(primitive.targets[0]["POSITION"]) if primitive.targets else 0))
            found[node.name] = np.array(x), read(primitive.indices).reshape(-1, 3)
        return found
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    stage, found = Usd.Stage.Open(str(folder / "run.usdc")), {}
    for prim in stage.GetDefaultPrim().GetChildren()[1:]:
        mesh = UsdGeom.Mesh(prim)
        x = [np.array(mesh.GetPointsAttr().Get(code)) for code in (0.0, 1.0)]
        faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        found[prim.GetName()] = np.array(x), faces
    return found


@pytest.mark.parametrize("to", ["obj", "ply", "npz", "vtkhdf", "gltf", "usd"])
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
