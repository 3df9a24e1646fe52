"""A folder from somebody else: no file that its links lead to is changed, and no pipe stops the program."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from itertools import cycle
from pathlib import Path

import pytest
from launch import PLAIN, SCENE, done, lyra, write_scene

OWN = b"the user's own\n"

KINDS: dict[str, Callable[[Path, Path], None]] = {
    "link": lambda path, target: path.symlink_to(target),
    "hard link": lambda path, target: os.link(target, path),
    "dangling link": lambda path, target: path.symlink_to(target.with_name("new")),
    "pipe": lambda path, target: os.mkfifo(path),
}

FIT = """
fit:
  parameters: {material.density: {start: 0.2, bounds: [0.1, 0.3]}}
  measurements: [{points: points.csv, uncertainty: 1.0e-3}]
"""

VERBS = {
    "run": ["run", "scene.yaml", "--out", "new", "--force"],
    "study": ["study", "scene.yaml", "--vary", "dt=0.02,0.01", "--repeats", "1", "--out", "new", "--force"],
    "fit": ["fit", "fit.yaml", "--out", "new", "--force"],
    "stress": ["stress", "scene.yaml", "--only", "stiff-1e3-40ms", "--out", "new", "--force"],
    "verify": ["verify", "free-fall", "--quick", "--out", "new", "--force"],
    "fabric": ["fabric", "tensile", "gray-interlock", "--out", "new", "--force"],
    "report": ["report", "run", "--out", "new/report.html"],
    "render": ["render", "run", "--out", "new", "--at", "0.02", "--size", "64x36", "--film", "new/film.gif"],
    "script": ["render", "run", "--paraview"],
    "export": ["export", "run", "--to", "obj", "--out", "new", "--force"],
}
"""Commands that write into the folder ``new``, or into that of the run."""

WITH_PICTURES = ("report", "render", "study")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with scenes, a finished run in ``run``, and what each of the commands writes."""
    folder = tmp_path_factory.mktemp("written")
    write_scene(folder)
    write_scene(folder, SCENE + FIT, "fit.yaml")
    (folder / "points.csv").write_text("vertex,x,z\n12,0.5,-0.01\n22,0.5,-0.012\n")
    done(["run", "scene.yaml", "--out", "run"], folder)
    return folder


@pytest.fixture
def stranger(written: Path, tmp_path: Path) -> Path:
    """A copy of the folder."""
    shutil.copytree(written, tmp_path / "stranger")
    return tmp_path / "stranger"


def places(folder: Path) -> Iterator[Path]:
    """The files that a command has written, and those that they may have been before."""
    for path in [*folder.rglob("*")]:
        if path.is_file():
            yield path
            yield path.with_name(f"{path.name}.part")
            yield path.with_name(f".{path.stem}.part{path.suffix}")


def attack(words: list[str], folder: Path, own: Path) -> str:
    """Run a command in a stranger's folder, and check that it leaves the user's file alone."""
    before = own.read_bytes()
    left = lyra(words, folder, extra=None if words[0] in WITH_PICTURES else PLAIN)
    assert own.read_bytes() == before
    assert os.listdir(own.parent) == [own.name]
    assert left.code in (0, 2, 3), left.err
    assert len(left.ours) == (left.code != 0), left.err
    assert "Traceback" not in left.err
    return left.err


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A file of the user's, alone in its folder."""
    path = tmp_path / "own" / "file"
    path.parent.mkdir()
    path.write_bytes(OWN)
    return path


@pytest.mark.parametrize("name", VERBS)
def test_a_command_changes_nothing_outside_its_folder(stranger: Path, own: Path, name: str) -> None:
    folder = stranger / ("run" if name == "script" else "new")
    folder.mkdir(exist_ok=True)
    done(VERBS[name], stranger, extra=None if name in WITH_PICTURES else PLAIN)
    script = [folder / "paraview.py", folder / "paraview.py.part"]
    for path, kind in zip(sorted(script if name == "script" else places(folder)), cycle(KINDS.values())):
        path.unlink(missing_ok=True)
        kind(path, own)
    attack(VERBS[name], stranger, own)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("lock", ["run", "study", "fit"])
def test_a_lock_file_is_no_link(stranger: Path, own: Path, lock: str, kind: str) -> None:
    (stranger / "new").mkdir()
    KINDS[kind](stranger / "new" / f"{lock}.lock", own)
    assert f"new: --out: cannot be used: {lock}.lock is a link, " in attack(VERBS[lock], stranger, own)


@pytest.mark.parametrize("kind", ["link", "hard link"])
@pytest.mark.parametrize(
    "name", ["history.csv", "states-0000.h5", "states.xdmf", "checkpoint.h5", "scene.yaml"]
)
def test_a_resumed_run_changes_nothing_outside_its_folder(
    stranger: Path, own: Path, name: str, kind: str
) -> None:
    run = stranger / "run"
    (run / "checkpoint-previous.h5").replace(run / "checkpoint.h5")  # states after it are discarded
    own.write_bytes((run / name).read_bytes())
    (run / name).unlink()
    KINDS[kind](run / name, own)
    attack(["run", "--resume", "--out", "run", "--set", "time.end=0.06"], stranger, own)


@pytest.mark.parametrize("resume", [False, True])
def test_a_study_is_not_led_into_another_folder(stranger: Path, own: Path, resume: bool) -> None:
    words = VERBS["study"]
    if resume:
        done(words, stranger)
        shutil.rmtree(stranger / "new" / "cases")
        words = [*words[:-1], "--resume"]
    (stranger / "new").mkdir(exist_ok=True)
    (stranger / "new" / "cases").symlink_to(own.parent)
    own.rename(own.with_name("dt0.02"))
    attack(words, stranger, own.with_name("dt0.02"))


def test_pictures_are_not_led_into_another_folder(stranger: Path, own: Path) -> None:
    (stranger / "new").mkdir()
    (stranger / "new" / "plots").symlink_to(own.parent)
    left = lyra(VERBS["stress"], stranger)
    assert os.listdir(own.parent) == [own.name]
    assert left.code == 3
    assert "new/plots: cannot be written: " in left.err


def test_the_usual_folder_of_a_scene_is_no_link(stranger: Path, own: Path) -> None:
    (stranger / "runs").mkdir()
    (stranger / "runs" / "scene").symlink_to(own.parent)
    own.rename(own.with_name("scene.yaml"))
    attack(["run", "scene.yaml", "--force"], stranger, own.with_name("scene.yaml"))
