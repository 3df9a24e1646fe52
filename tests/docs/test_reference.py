"""Generated pages are up to date and complete, and the site builds without warnings."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
from module_of import module_of
from patience import run_program
from petsc4py import PETSc

from lyra_petsc.cli.verbs import verbs
from lyra_petsc.linear.petsc_options import unknown
from lyra_petsc.linear.presets import PRESETS

ROOT = Path(__file__).parents[2]
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")


@pytest.fixture(scope="module")
def reference() -> ModuleType:
    return module_of(ROOT / "scripts" / "docs" / "reference.py")


@pytest.mark.parametrize("name", ["scene.md", "petsc.md", "commands.md", "recovery.md"])
def test_the_pages_are_up_to_date(name: str, reference: ModuleType) -> None:
    text = (ROOT / "docs" / "reference" / name).read_text(encoding="utf-8")
    assert text == reference.PAGES[name](), "run: python scripts/docs/reference.py"


def test_every_option_that_the_program_reads_is_listed(reference: ModuleType) -> None:
    read = reference.options_read()
    assert {"ts_dt", "pc_type", "mat_partitioning_type", "ts_theta_endpoint"} <= read
    assert read <= set(reference.OPTIONS)


def test_every_verb_and_linear_solver_is_listed(reference: ModuleType) -> None:
    commands = reference.commands_page()
    assert all(f"## `{name}`" in commands for name in verbs.commands)
    petsc = reference.petsc_page()
    assert all(f"`{name}`" in petsc for name in PRESETS)


def test_readme_names_every_verb() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [name for name in verbs.commands if f"`{name}`" not in readme] == []


def test_links_of_the_readme_exist() -> None:
    links = LINK.findall((ROOT / "README.md").read_text(encoding="utf-8"))
    inside = [link for link in links if "://" not in link]
    assert len(inside) > 10
    assert [link for link in inside if not (ROOT / link).exists()] == []


@pytest.mark.slow
def test_the_site_builds_without_warnings(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    pytest.importorskip("material")
    pytest.importorskip("latex2mathml")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", "scripts/docs/mkdocs.yml"]
    built = run_program(
        [*command, "--site-dir", str(tmp_path / "site")],
        cwd=ROOT,
        seconds=300,
    )
    assert built.returncode == 0, built.stdout + built.stderr
    assert (tmp_path / "site" / "tutorial.html").is_file()


def test_no_option_of_the_reference_counts_as_unknown(reference: ModuleType) -> None:
    database = PETSc.Options()
    names = [name for name in reference.OPTIONS if not database.hasName(name)]
    try:
        for name in [*names, "ts_maximum_time"]:
            database.setValue(name, "1")
        (note,) = unknown(["ts_time_step"])  # of later versions of PETSc; the program always reads it
        assert note.startswith("-ts_maximum_time: PETSc has no option of this name, did you mean -ts_max_")
    finally:
        for name in [*names, "ts_maximum_time"]:
            database.delValue(name)
