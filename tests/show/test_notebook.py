"""Runs in a notebook: progress, inline pictures, films and reports, errors with Python's names."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import lyra_petsc
from lyra_petsc.errors import InputError, SolverError, python_argument_names

SCENE = {
    "mesh": {"grid": {"width": 1.0, "height": 1.0, "nx": 3, "ny": 3}},
    "material": {"cloth": "gray-interlock", "damping": 0.01},
    "gravity": [0, 0, -9.81],
    "handles": [{"nodes": [0, 3]}],
    "time": {"end": 0.03, "step": 0.01},
    "output": {"every": 0.01, "fields": ["velocity"]},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> lyra_petsc.Run:
    return lyra_petsc.run(SCENE, tmp_path_factory.mktemp("notebook") / "run")


def test_a_run_shows_its_progress_in_a_notebook(monkeypatch, tmp_path) -> None:
    shown: list[str] = []

    def draw(table: object) -> None:
        bundle = table._repr_mimebundle_(include=(), exclude=())
        assert "<pre" in bundle["text/html"]
        shown.append(bundle["text/plain"])

    def display(table: object, display_id: bool) -> SimpleNamespace:
        draw(table)
        return SimpleNamespace(update=draw)

    shell = type("ZMQInteractiveShell", (), {})()
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=display))
    steps: list[int] = []
    done = lyra_petsc.run(SCENE, tmp_path / "run", on_step=lambda report: steps.append(report.step))
    assert steps == [1, 2, 3]
    assert "set-up and first step" in shown[0]
    assert "step 3, t = 0.03 of 0.03, done:" in " ".join(shown[-1].split())
    assert str(done.folder) in "".join(shown[-1].split())
    with pytest.raises(InputError):
        lyra_petsc.run(SCENE, tmp_path / "run")
    assert "stopped" in shown[-1]


def test_there_is_no_output_outside_notebooks(tmp_path, capfd) -> None:
    lyra_petsc.run(SCENE, tmp_path / "run")
    assert capfd.readouterr() == ("", "")


def test_a_picture_a_film_and_the_page_are_inline(run, tmp_path) -> None:
    pytest.importorskip("pyvista")
    picture = run.render(size="160x120", field="speed", range=(0, 1))
    assert picture._repr_png_().startswith(b"\x89PNG")
    assert picture._repr_html_() is None
    assert picture.save(tmp_path / "a.png").read_bytes() == picture.data
    first = run.render(at=0.0, size="160x120")
    assert first.data != run.render(size="160x120").data
    film = run.render(film=True, size="160x120")
    assert film._repr_html_().startswith('<video controls loop autoplay muted src="data:video/mp4;base64,')
    assert film._repr_png_() is None
    assert "data:image/gif;base64," in run.render(film="gif", size="160x120")._repr_html_()
    page = run.report(tmp_path / "page.html")
    assert page._repr_html_().startswith("<iframe srcdoc=")
    assert (tmp_path / "page.html").read_bytes() == page.data
    assert {path.name for path in Path(run.folder).iterdir()}.isdisjoint({"film.mp4", "report.html"})


def test_errors_are_short_and_use_names_of_python(run, tmp_path) -> None:
    with pytest.raises(InputError) as caught:
        lyra_petsc.run(SCENE, run.folder)
    said = "".join(caught.value._render_traceback_())
    assert said == f"InputError: {caught.value}"
    assert "give resume=True to go on with its run or force=True to replace it" in said
    assert "--" not in said
    with pytest.raises(InputError, match=r"^force: force=True begins anew and resume=True goes on"):
        lyra_petsc.run(SCENE, tmp_path / "new", force=True, resume=True)
    with pytest.raises(InputError, match=r"^range: is the range of what field= shows"):
        run.render(range="0,1")
    with pytest.raises(InputError, match=r"^range: must be two numbers"):
        run.render(field="speed", range=(2, 1))


def test_details_use_names_of_python() -> None:
    with pytest.raises(SolverError) as caught, python_argument_names():
        raise SolverError("stopped", details=("--resume goes on", "take --set"))
    assert caught.value._render_traceback_() == [
        "SolverError: stopped",
        "  resume=True goes on",
        "  take set=",
    ]
