"""The gallery has every shipped scene, and is small."""

from __future__ import annotations

import re
from pathlib import Path

from module_of import module_of
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]


def test_every_scene_is_shown_and_all_is_small() -> None:
    gallery = module_of(ROOT / "scripts" / "gallery.py")
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
