"""A notebook, executed by Jupyter's kernel: what is shown below its cells."""

from __future__ import annotations

import re
from typing import Any

import pytest

pytestmark = pytest.mark.slow

CELLS = (
    """
import lyra_petsc
scene = lyra_petsc.load({
    "title": "A <small> sheet",
    "mesh": {"grid": {"width": 1, "height": 1, "nx": 3, "ny": 3}},
    "material": {"cloth": "gray-interlock", "damping": 0.01},
    "gravity": [0, 0, -9.81],
    "handles": [{"nodes": [0, 3]}],
    "time": {"end": 0.03, "step": 0.01},
    "output": {"every": 0.01, "fields": ["velocity"]},
})
scene""",
    "run = lyra_petsc.run(scene, 'run')\nrun",
    "run.render(size='160x120')",
    "run.render(size='160x120', film='gif')",
    "_ = run.render(size='160x120', field='speed')",
    "run.view()",
)


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> list[list[dict[str, Any]]]:
    """What each cell shows: data by MIME type, or a message."""
    for package in ("ipykernel", "pyvista", "trame"):
        pytest.importorskip(package)
    nbformat, nbclient = (pytest.importorskip(name) for name in ("nbformat", "nbclient"))
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in CELLS])
    folder = tmp_path_factory.mktemp("notebook")
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(folder)}}).execute()
    return [[dict(output.get("data", output)) for output in cell.outputs] for cell in notebook.cells]


def test_pictures_and_films_are_shown_once(shown: list[list[dict[str, Any]]]) -> None:
    picture, film, hidden = shown[2:5]
    assert [set(data) for data in picture] == [{"image/png", "text/plain"}]
    assert [set(data) for data in film] == [{"text/html", "text/plain"}]
    assert hidden == []


def test_scenes_and_runs_are_short(shown: list[list[dict[str, Any]]]) -> None:
    (scene,), (*_, run) = shown[:2]
    assert scene["text/html"] == (
        "<b>A &lt;small&gt; sheet</b>, 0.03 s, beuler: <code>mesh, material, gravity, handles</code>"
    )
    assert run["text/html"] == (
        "<b>A &lt;small&gt; sheet</b>, done: <code>&lt;run run: 4 states, t = 0 to 0.03 s&gt;</code>"
    )


def test_the_page_is_shown_inside(shown: list[list[dict[str, Any]]]) -> None:
    (page,) = shown[5]
    assert page["text/html"].startswith("<iframe srcdoc=")
    assert re.fullmatch(r"<page http://127\.0\.0\.1:\d+/\?token=\S+>", page["text/plain"])
