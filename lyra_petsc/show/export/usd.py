"""Universal Scene Description: one file with a mesh whose points and fields are sampled over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import OutputError
from lyra_petsc.output.tensors import is_tensor
from lyra_petsc.show.export.exported_states import ExportedStates, turned_up

ROOT = "/run"
MESH = f"{ROOT}/cloth"
OBSTACLE = (0.6, 0.63, 0.66)


def write_usd(states: ExportedStates, folder: Path, name: str) -> None:
    """Write ``<name>.usdc``, single precision; metres, seconds times ``timeCodesPerSecond``.

    Up is the direction against gravity. Velocities are the mesh's, other fields primvars of their names.
    Obstacles are meshes beside the cloth.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    from pxr import Tf, Usd

    path = folder / f"{name}.usdc"
    try:
        stage = Usd.Stage.CreateNew(str(path))
        _fill(stage, states)
        stage.GetRootLayer().Save()
    except Tf.ErrorException as error:
        words = " ".join(str(error).split())
        raise OutputError(f"{path.name}: cannot be written: {words[:200]}") from error


def _fill(stage: Any, states: ExportedStates) -> None:
    from pxr import Gf, Sdf, Usd, UsdGeom, Vt

    run = states.run
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, ROOT)
    root.GetPrim().SetDisplayName(run.scene.title or run.name)
    stage.SetDefaultPrim(root.GetPrim())
    if states.up in ((1, 1), (2, 1)):
        UsdGeom.SetStageUpAxis(stage, "XYZ"[states.up[0]])
    else:
        UsdGeom.SetStageUpAxis(stage, "Z")
        x, y, z, w = turned_up(states.up, 2)
        root.AddOrientOp().Set(Gf.Quatf(w, x, y, z))

    rate = states.rate
    codes = states.times * rate
    whole = np.round(codes)
    codes = np.where(np.abs(codes - whole) < 1e-6, whole, codes).tolist()
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(codes[0])
    stage.SetEndTimeCode(codes[-1])

    mesh = _mesh(stage, MESH, run.triangles)
    primvars = UsdGeom.PrimvarsAPI(mesh)
    if run.corner_uv is not None:
        uv, place = run.uv, UsdGeom.Tokens.vertex
        if uv is None:  # the texture has seams
            uv, place = run.corner_uv.reshape(-1, 2), UsdGeom.Tokens.faceVarying
        st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, place)
        st.Set(Vt.Vec2fArray.FromNumpy(uv.astype(np.float32)))

    for moment, position in zip(codes, states.positions, strict=True):
        _put(mesh, position, moment)
    for field in states.fields:
        _sample(mesh, primvars, states, field, codes)
    for label, obstacle in states.obstacles.items():
        mesh = _mesh(stage, f"{ROOT}/{label}", obstacle.triangles)
        mesh.GetPrim().SetDisplayName(obstacle.name)
        mesh.CreateDisplayColorAttr([Gf.Vec3f(*OBSTACLE)])
        mesh.CreateDisplayOpacityAttr([obstacle.opacity])
        moments = codes[:1] if obstacle.still else codes
        for moment, position in zip(moments, states.places(obstacle), strict=False):
            _put(mesh, position, Usd.TimeCode.Default() if obstacle.still else moment)


def _mesh(stage: Any, place: str, triangles: NDArray[np.int64]) -> Any:
    """A mesh without points, seen from both sides."""
    from pxr import UsdGeom, Vt

    mesh = UsdGeom.Mesh.Define(stage, place)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(triangles), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(triangles.astype(np.int32).ravel()))
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.CreateDoubleSidedAttr(True)
    return mesh


def _put(mesh: Any, x: NDArray[np.float64], code: Any) -> None:
    """The points (n, 3) [m] of a mesh at a time code."""
    from pxr import Vt

    single = np.ascontiguousarray(x, dtype=np.float32)
    mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(single), code)
    corners = np.stack([single.min(axis=0), single.max(axis=0)])
    mesh.CreateExtentAttr().Set(Vt.Vec3fArray.FromNumpy(corners), code)


def _sample(mesh: Any, primvars: Any, states: ExportedStates, field: str, codes: list[float]) -> None:
    """A field at each time code."""
    from pxr import Sdf, UsdGeom, Vt

    attribute: Any = None
    for code, rows in zip(codes, states.field(field), strict=True):
        vector = rows.ndim == 2 and not is_tensor(rows.shape)
        if attribute is None:
            if field == "velocity":
                attribute = mesh.CreateVelocitiesAttr()
            else:
                kind = Sdf.ValueTypeNames.Float3Array if vector else Sdf.ValueTypeNames.FloatArray
                on_vertices = states.field_on(field) == "vertex"
                place = UsdGeom.Tokens.vertex if on_vertices else UsdGeom.Tokens.uniform
                primvar = primvars.CreatePrimvar(field, kind, place)
                if is_tensor(rows.shape):
                    primvar.SetElementSize(rows.shape[1])
                attribute = primvar.GetAttr()
            attribute.SetCustomDataByKey("unit", states.run.field_units(field))
        values: NDArray[np.float32] = np.ascontiguousarray(rows, dtype=np.float32)
        attribute.Set(
            Vt.Vec3fArray.FromNumpy(values) if vector else Vt.FloatArray.FromNumpy(values.ravel()), code
        )
