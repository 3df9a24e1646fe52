"""The report of a run that is finished, failed, stopped, killed, or unfinished."""

from __future__ import annotations

import fcntl
import html
import json
import re
import shutil
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

sys.path.insert(0, str(Path(__file__).parents[2] / "cli"))

from launch import PICTURES, SCENE, done, finish, lyra, read_json, start, wait_until, without, write_scene

from lyra_petsc.output.history import HISTORY_COLUMNS
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.show.report.run_facts import Facts, advice
from lyra_petsc.show.report.run_page import run_page, write_page

FAILING = SCENE.replace("c11: 800, c22: 800", "c11: 8.0e+9, c22: 8.0e+9") + "solver: {max_iterations: 2}\n"


def page_of(folder: Path, *, drawn: bool = True) -> str:
    """Text of the page without tags and pictures, of which those of the sheet need not be drawn."""
    if drawn:
        write_page(folder, None)
        page = (folder / "report.html").read_text(encoding="utf-8")
    else:
        page = run_page(StoredRun(folder), []).html()
    assert not re.search(r"https?://|<script|<link|url\(", page)
    text = re.sub(r'src="data:[^"]*"', 'src=""', page)
    return html.unescape(re.sub(r"<[^>]*>", " ", text.split("</style>")[1]))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished")
    write_scene(folder, "title: A <b>small</b> sheet\n" + SCENE)
    done(["run", "scene.yaml", "--out", "sheet", "-ksp_rtol", "1e-5", "-ksp_rtoll", "1"], folder, ranks=2)
    return folder / "sheet"


def copied(run: Path, folder: Path) -> Path:
    return Path(shutil.copytree(run, folder / "sheet"))


def test_a_finished_run_has_all_sections(finished: Path) -> None:
    text = page_of(finished)
    assert "The run came to its end, t = 0.05 of 0.05 s." in text
    assert "A <b>small</b> sheet" in text
    for heading in (
        "What to change", "Pictures", "Energy", "Steps and iterations", "Wall time", "Warnings and notes",
        "Settings", "Versions",
    ):  # fmt: skip
        assert heading in text
    assert "5 accepted, 0 attempts rejected; 4 states written" in text
    for caption in ("t = 0 s", "t = 0.02 s", "t = 0.05 s", "Energies over time", "The slowest steps"):
        assert caption in text
    page = (finished / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/") == 3 + 2 + 1 + 1
    assert "A &lt;b&gt;small" in page
    assert "bending_scale: 1.0" in text  # the resolved scene
    assert "-ksp_rtol 1e-5" in text
    assert "PETSc options that nothing used: -ksp_rtoll" in text


def test_the_page_needs_no_packages_for_films(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = copied(finished, tmp_path)
    monkeypatch.setattr("lyra_petsc.show.report.run_page.PACKAGES", ("no_such_package",))
    write_page(run, None)
    page = (run / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/svg+xml") == 3 + 2 + 1 + 1


def test_the_energies_of_the_page_are_those_of_the_history(finished: Path) -> None:
    facts = Facts.of(StoredRun(finished))
    table = np.loadtxt(finished / "history.csv", delimiter=",", skiprows=1)
    column = {name: table[:, i] for i, name in enumerate(HISTORY_COLUMNS)}
    energy = sum(column[f"{kind}_energy"] for kind in ("kinetic", "membrane", "bending", "potential"))
    loss = energy[0] - energy + column["external_work"] - column["dissipation"]
    np.testing.assert_allclose(facts.scheme_loss, loss, atol=1e-14)
    assert facts.scheme_loss[-1] > 0  # backward Euler takes energy
    assert f"taken away by the time scheme {facts.scheme_loss[-1]:.3g}"[:38] in page_of(finished, drawn=False)


def test_a_failed_run_has_its_cause_and_advice(tmp_path: Path) -> None:
    write_scene(tmp_path, FAILING)
    left = lyra(["run", "scene.yaml", "--out", "bad", "-ts_adapt_dt_min", "0.005"], tmp_path)
    assert left.code == 3, left.err
    text = page_of(tmp_path / "bad")
    assert "did not converge even with" in text
    assert "The solver stopped. Try " in text
    assert "The last attempt, Newton iteration by iteration" in text  # failure.txt


def test_a_killed_run_is_distinguished_from_an_unfinished_one(finished: Path, tmp_path: Path) -> None:
    run = copied(finished, tmp_path)
    summary = read_json(run / "summary.json")
    (run / "summary.json").write_text(json.dumps({**summary, "outcome": "running"}), encoding="utf-8")
    with open(run / "history.csv", "a", encoding="utf-8") as table:
        table.write("6,0.06,0.0")  # a kill in the middle of a row
    text = page_of(run)
    assert "The run was killed" in text
    assert f"lyra-petsc run --resume --out {run}" in text
    with open(run / "run.lock", "w", encoding="utf-8") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert "The run goes on: t = 0.05 of 0.05 s" in page_of(run, drawn=False)
    (run / "summary.json").unlink()
    assert "How the run ended is not known" in page_of(run, drawn=False)


def test_a_stopped_run_says_how_to_continue(tmp_path: Path) -> None:
    write_scene(tmp_path, SCENE.replace("end: 0.05, step: 0.01", "end: 1000, step: 0.01"))
    process = start(["run", "scene.yaml", "--out", "long"], tmp_path)
    wait_until((tmp_path / "long" / "states.xdmf").exists)
    running = page_of(tmp_path / "long")  # also of an unfinished run
    process.send_signal(signal.SIGTERM)
    assert finish(process).code == 143
    assert "The run goes on" in running
    text = page_of(tmp_path / "long", drawn=False)
    assert "stopped by SIGTERM after step" in text
    assert "It goes on with: mpirun -n 1 lyra-petsc run --resume --out " in text


def test_a_static_run_has_load_factors(tmp_path: Path) -> None:
    write_scene(tmp_path, SCENE.replace("time: {end: 0.05, step: 0.01}", "time: {analysis: static}"))
    done(["run", "scene.yaml", "--out", "still"], tmp_path)
    text = page_of(tmp_path / "still")
    assert "load factor 1" in text
    assert "increment of the load factor" in text


def test_the_page_is_written_to_a_given_file_and_mistakes_are_one_line(
    finished: Path, tmp_path: Path
) -> None:
    done(["report", finished, "--out", "page.html"], tmp_path, ranks=2)
    assert (tmp_path / "page.html").is_file()
    for arguments, words in (
        (["report"], "Missing argument"),
        (["report", "nothing"], "nothing: no such folder; give the folder of a run"),
        (["report", tmp_path], "is not the folder of a run"),
        (["report", finished, "--out", tmp_path], "is a folder; name a file"),
        (["report", finished, "--out", "no/where.html"], "there is no such folder"),
    ):
        left = lyra(arguments, tmp_path)
        assert left.code == 2, left.err
        assert len(left.ours) == 1
        assert words in left.ours[0]


def test_without_matplotlib_one_line_says_how_to_get_it(finished: Path) -> None:
    left = without(PICTURES, ["report", str(finished)], finished)
    assert left.code == 2
    assert "pip install 'lyra-petsc[study]'" in left.err


# -- advice ------------------------------------------------------------------------------------------


def advice_of(finished: Path, columns: dict[str, float]) -> str:
    """Advice for the finished run with a changed history."""
    facts = Facts.of(StoredRun(finished))
    for name, value in columns.items():
        facts.columns[name][1:] = value
    return "\n".join(advice(facts))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rejected": 1.0}, "5 attempts at a step were rejected over 5 accepted steps"),
        ({"rejected": 1.0, "dt": 0.004}, "Set time.step to 0.004 s"),
        ({"newton_iterations": 12.0}, "takes 12 Newton iterations on average"),
        ({"linear_iterations": 5000.0, "newton_iterations": 2.0}, "takes 2500 linear iterations"),
        ({"dissipation": -1.0}, "The time scheme (beuler) took away"),
    ],
)  # fmt: skip
def test_advice_for_slow_or_inaccurate_runs(finished: Path, changes: dict[str, float], words: str) -> None:
    quiet = {"newton_iterations": 3.0, "linear_iterations": 30.0, "dissipation": 0.01}
    assert words not in advice_of(finished, quiet)
    assert words in advice_of(finished, quiet | changes)
