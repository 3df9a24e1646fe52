"""The gallery has every shipped scene, is small, and is made by its script."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path
from types import ModuleType

import pytest
from launch import FORKS
from module_of import module_of
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def gallery() -> ModuleType:
    return module_of(ROOT / "scripts" / "gallery.py")


def test_every_scene_is_shown_and_all_is_small(gallery):
    names = {path.stem for path in (ROOT / "configs").glob("*.yaml")}
    assert set(gallery.ENTRIES) == names
    page = (gallery.GALLERY.parent / "gallery.md").read_text(encoding="utf-8")
    assert set(re.findall(r"gallery/([\w-]+)\.png", page)) == names
    files = {path.name for path in gallery.GALLERY.iterdir()}
    assert files == {f"{name}.{ending}" for name in names for ending in ("png", "mp4")} | {"flag.gif"}
    assert sum(path.stat().st_size for path in gallery.GALLERY.iterdir()) < gallery.LIMIT
    for name in names:
        with Image.open(gallery.GALLERY / f"{name}.png") as picture:
            assert picture.size == (1280, 720)


@pytest.mark.slow
def test_the_script_makes_pictures_and_films(gallery, tmp_path, monkeypatch):
    small = (
        "mesh.grid.nx=4",
        "mesh.grid.ny=4",
        "handles=[{nodes: [0, 4]}]",
        "time.end=0.02",
        "output.every=0.01",
    )
    monkeypatch.setattr(gallery, "ENTRIES", {"paper": gallery.Entry(0.02, ("--handles",), small)})
    monkeypatch.setattr(gallery, "GALLERY", tmp_path / "gallery")
    monkeypatch.setattr(sys, "argv", ["gallery.py", "--runs", str(tmp_path / "runs")])
    monkeypatch.setattr(gallery, "GIF", "paper")
    program = tmp_path / "python"  # python -m lyra_petsc, started by the tests' forks
    program.write_text(f'#!/bin/sh\nshift 2\nexec {shlex.join([sys.executable, *FORKS.program])} "$@"\n')
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    gallery.main()
    assert {path.name for path in (tmp_path / "gallery").iterdir()} == {"paper.png", "paper.mp4", "paper.gif"}
