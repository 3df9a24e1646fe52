"""``output: {vtkhdf: true}``: VTK reads the same states as from the other files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from launch import done, write_scene
from vtkhdf_reader import read

from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.output.tensors import TENSORS
from lyra_petsc.scene.schema import FIELDS

# the model of bending that has every field
NAMED = "contact_pressure", "plastic_curvature"  # for which a scene must name contact or yielding
PLAIN = tuple(name for name in FIELDS if name not in NAMED)
ON = ["--set", "output.vtkhdf=true", "--set", f"output.fields=[{', '.join(PLAIN)}]"]
ON += ["--set", "material.bending_model=midedge"]


def check(folder: Path) -> None:
    run = StoredRun(folder)
    found = read(folder / "states.vtkhdf")
    np.testing.assert_array_equal([time for time, *_ in found], run.times)
    for i, (_, points, triangles, arrays) in enumerate(found):
        np.testing.assert_array_equal(points, run.positions[i])
        np.testing.assert_array_equal(triangles, run.triangles)
        assert {*arrays["vertex"], *arrays["triangle"]} == {"rest", *PLAIN}
        for name in PLAIN:
            rows = run.field(name)[i]
            if name in TENSORS:  # XX, YY, ZZ, XY, YZ, XZ
                assert rows.any() or i == 0
                rows = rows[:, [0, 3, 5, 1, 4, 2]]
            np.testing.assert_array_equal(arrays[run.field_on(name)][name], rows)


def test_every_time_and_field(tmp_path: Path) -> None:
    scene = write_scene(tmp_path)
    done(["run", scene, "--out", "out", "--set", "time.end=0.03", *ON], tmp_path, 2)
    check(tmp_path / "out")
    done(["run", scene, "--out", "out", "--resume", *ON], tmp_path, 2)
    check(tmp_path / "out")
    assert len(StoredRun(tmp_path / "out")) > 3


def test_no_vtkhdf_files_by_default(tmp_path: Path) -> None:
    done(["run", write_scene(tmp_path), "--out", "out"], tmp_path)
    names = {entry.name for entry in (tmp_path / "out").iterdir()}
    assert "states.xdmf" in names
    assert not {"states.vtkhdf", "cells.h5"} & names
