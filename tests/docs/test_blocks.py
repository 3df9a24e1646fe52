"""Commands, scenes and programs of the documentation are run, or their syntax is checked."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import click
import pytest
from blocks import PAGES, ROOT, Block, blocks_of, commands_of
from launch import FORKS, RANK, environment
from patience import run_program

from lyra_petsc.cli.arguments import split
from lyra_petsc.cli.verbs import verbs
from lyra_petsc.scene.json_schema import FILE
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.text import parse_json, parse_yaml

END = 0.05
"""Length [s] of shortened runs."""

COARSE = "size = 0.2"
"""Element size [m] in the mesh scripts of pages, most of which are run."""

PATIENCE = 300.0

BASE = {
    "mesh": {"grid": {"width": 1, "height": 1, "nx": 2, "ny": 2}},
    "material": {"cloth": "paper"},
    "time": {"end": 1, "step": 0.01},
    "motions": {"swing": [{"time": 0}]},
}
"""A scene to which an incomplete scene is added."""

PROGRAM = f"""\
#!{sys.executable} -IS
# the program as installed, started by the tests' forks; runs are shortened, but for load factors
import os, sys
words = sys.argv[1:]
scenes = [open(word).read() for word in words if word.endswith(".yaml") and os.path.exists(word)]
if words[:1] == ["run"] and not any("analysis: static" in scene for scene in scenes):
    words += ["--set", "time.end={END}"]
os.execv(sys.executable, [sys.executable, "-IS", {str(RANK)!r}, os.environ["TEST_FORKS"], *words])
"""
PYTHON = f"""\
#!/bin/sh
[ "$1 $2" = "-m lyra_petsc" ] && {{ shift 2; exec lyra-petsc "$@"; }}
case $1 in *.py) exec {sys.executable} -IS {RANK} "$TEST_FORKS" "$@";; esac
exec {sys.executable} "$@"
"""
RUN_SH = 'exec ${RANKS:+mpirun -n "$RANKS"} lyra-petsc run "$@"\n'
LYRA_SH = 'exec lyra-petsc "$@"\n'

ALL = {page: blocks_of(page) for page in PAGES}


def shown(page: Path) -> str:
    """A page's name in the names of tests."""
    return str(page.relative_to(ROOT))


def coarse(script: str) -> str:
    """A mesh script with long edges, whatever its own are."""
    script = re.sub(r"\bsize = [0-9.]+", COARSE, script)
    assert COARSE in script or "size" not in script
    return script


LANGUAGES = {"", "sh", "yaml", "json", "python", "geo", "text", "diff"}


@pytest.fixture
def checkout(tmp_path: Path) -> tuple[Path, dict[str, str]]:
    """What a reader has, a checkout with ``.venv`` and an installed program; and the environment."""
    folder = tmp_path / "lyra_petsc"
    folder.mkdir()
    for name in ("docs", "lyra_petsc", "pyproject.toml", "README.md"):
        (folder / name).symlink_to(ROOT / name)
    for name in ("configs", "meshes"):  # a scene finds its mesh relative to its resolved path
        shutil.copytree(ROOT / name, folder / name)
    flag = (folder / "meshes" / "flag.geo").read_text(encoding="utf-8")
    (folder / "meshes" / "flag.geo").write_text(coarse(flag), encoding="utf-8")
    shutil.copytree(ROOT / "scripts", folder / "scripts", ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "scripts" / "run.sh").write_text(RUN_SH, encoding="utf-8")
    (folder / "scripts" / "lyra.sh").write_text(LYRA_SH, encoding="utf-8")
    programs = folder / ".venv" / "bin"
    programs.mkdir(parents=True)
    for name, text in (("lyra-petsc", PROGRAM), ("python", PYTHON)):
        (programs / name).write_text(text, encoding="utf-8")
        (programs / name).chmod(0o755)
    variables = environment({"TEST_FORKS": FORKS.name})
    return folder, {**variables, "PATH": f"{programs}:{variables['PATH']}"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [page for page, blocks in ALL.items() if any(b.runs for b in blocks)], ids=shown
)
def test_commands_run(page: Path, checkout: tuple[Path, dict[str, str]]) -> None:
    """The files of a page are written, and its commands are run in order."""
    folder, variables = checkout
    for block in ALL[page]:
        if block.title:
            path = folder / block.title
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(coarse(block.text) if path.suffix == ".geo" else block.text, encoding="utf-8")
        if not block.runs:
            continue
        command = ["bash", "-euo", "pipefail", "-c", block.text]
        if block.language == "python":
            (folder / "block.py").write_text(block.text, encoding="utf-8")
            command = ["python", "block.py"]
        process = run_program(command, cwd=folder, env=variables, seconds=PATIENCE)
        said = f"{block.place}\n{block.text}\n{process.stdout[-2000:]}\n{process.stderr[-3000:]}"
        assert process.returncode == block.exit_code, said


def check_scene(block: Block, folder: Path) -> None:
    """Check that a scene, or a part of one, is accepted; its meshes and names need not exist, but tables."""
    for other in ALL[block.page]:
        if other.title.endswith(".csv"):
            (folder / other.title).write_text(other.text, encoding="utf-8")
    data = parse_yaml(block.text, file=block.place)
    assert isinstance(data, dict), block.place
    Scene.model_validate(BASE | data, context={"directory": folder})


EVERY = [block for blocks in ALL.values() for block in blocks]


@pytest.mark.parametrize("block", EVERY, ids=[block.place for block in EVERY])
def test_code_blocks_are_well_formed(block: Block, tmp_path: Path) -> None:
    assert block.language in LANGUAGES
    if block.said.startswith("by="):
        assert (ROOT / block.said.removeprefix("by=")).exists(), f"{block.place}: {block.said}"
    if block.language == "yaml" and block.said != "not a scene":
        check_scene(block, tmp_path)
    elif block.language == "json":
        assert parse_json(block.text, file=block.place) is not None
    elif block.language == "python":
        compile(block.text, block.place, "exec")
    elif block.language == "sh":
        subprocess.run(["bash", "-n", "-c", block.text], check=True)
    elif block.language == "geo":
        assert block.title.endswith(".geo"), "a .geo is shown as a file, for the commands that mesh it"


@pytest.mark.parametrize("page", PAGES, ids=shown)
def test_named_verbs_and_options_exist(page: Path) -> None:
    """Also in the text, and in commands that are not run."""
    for command, words in commands_of(page):
        ours, _ = split(words)
        verb = ours[0] if ours else "VERB"
        if verb.isupper() or "…" in ours:  # VERB is any command, … any further words
            continue
        assert verb in verbs.commands or verb.startswith("--"), f"{shown(page)}: {command}"
        if verb in verbs.commands:
            try:
                verbs.commands[verb].make_context(verb, ours[1:], obj=SimpleNamespace(rank=1))
            except click.NoSuchOption as error:
                pytest.fail(f"{shown(page)}: {command}: {error.format_message()}")
            except click.UsageError:  # a verb by itself is named, or a script's variables stand for words
                pass


NAMED = re.compile(
    r"`((?:lyra_petsc|tests|scripts|configs|scene|mesh|terms|linear|stepping|output|api|show|experiments|cli"
    r"|kernels)/[\w/]*(?:\.py)?)`"
)


def test_named_files_exist() -> None:
    """Paths in the checkout, or below the package."""
    for page in PAGES:
        for name in NAMED.findall(page.read_text(encoding="utf-8")):
            places = ROOT / name, ROOT / "lyra_petsc" / name
            assert any(place.exists() for place in places), f"{shown(page)}: {name}"


def test_the_index_names_every_page() -> None:
    docs = ROOT / "docs"
    linked = set(re.findall(r"\]\(([\w/.-]+\.md)", (docs / "index.md").read_text(encoding="utf-8")))
    assert linked == {path.relative_to(docs).as_posix() for path in docs.rglob("*.md")} - {"index.md"}


def test_the_page_on_editors_names_the_schema_of_this_version() -> None:
    assert FILE in (ROOT / "docs" / "howto" / "editor.md").read_text(encoding="utf-8")
