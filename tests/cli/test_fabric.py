"""The command ``fabric``: table, folder, exit codes."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from launch import done

SCENE = """
mesh: {grid: {width: 0.1, height: 0.1, nx: 1, ny: 1}}
material: {density: 0.2, membrane: {c11: 900, c22: 800, c12: 50}, kes: {B: 0.1, G: 0.6}}
time: {end: 1, step: 0.1}
"""


def test_a_test_writes_table_curve_and_page(tmp_path: Path) -> None:
    (tmp_path / "cloth.yaml").write_text(SCENE, encoding="utf-8")
    left = done(["fabric", "tensile", "cloth.yaml", "--out", "out"], tmp_path)
    assert "2 measured without a comparison" in left.out
    assert "passed" not in left.out
    with open(tmp_path / "out" / "fabric.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["test"] for row in rows] == 3 * ["tensile-warp"] + 3 * ["tensile-weft"]
    assert json.loads((tmp_path / "out" / "fabric.json").read_text())["passed"] is None
    assert {row["status"] for row in rows} == {"measured"}
    curve = (tmp_path / "out" / "tensile-warp.csv").read_text(encoding="utf-8").splitlines()
    assert curve[0] == "strain [%],force [gf/cm]"
    assert len(curve) > 10
    assert "fabric tensile cloth.yaml" in (tmp_path / "out" / "report.md").read_text(encoding="utf-8")


def test_all_leaves_out_what_the_material_does_not_resist(tmp_path: Path) -> None:
    scene = SCENE.replace("c12: 50}, kes: {B: 0.1, G: 0.6}", "c12: 50, c33: 30}")
    (tmp_path / "cloth.yaml").write_text(scene, encoding="utf-8")
    left = done(["fabric", "all", "cloth.yaml", "--out", "out"], tmp_path)
    assert "1 of 1 cases passed, 2 measured without a comparison" in left.out
    assert "left out" in left.out
    content = json.loads((tmp_path / "out" / "fabric.json").read_text())
    assert content["passed"] is True
    assert [case["status"] for case in content["cases"]] == ["measured", "measured", "passed"]
