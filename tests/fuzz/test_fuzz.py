"""Some hundred fuzz cases, always the same; ``scripts/fuzz.py`` runs thousands of others."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("hypothesis")

from all_cases import KINDS, for_each
from judge import Case, judge, warm
from mesh_cases import GEO, OBJ, SCENE, msh_2, msh_4
from scene_cases import bomb, nested

CASES = 150


@pytest.fixture(scope="module", autouse=True)
def ready(tmp_path_factory: pytest.TempPathFactory) -> None:
    warm(tmp_path_factory.mktemp("warm"))


@pytest.fixture
def fresh() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def drawn(kind: str, number: int, seed: int) -> list[Case]:
    """``number`` cases of a kind, which depend on the seed only."""
    cases: list[Case] = []
    for_each(KINDS[kind][1], number, seed, cases.append)
    return cases


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_each_case_is_a_run_or_one_line(kind: str, tmp_path: Path) -> None:
    number = CASES * KINDS[kind][0] // 100
    codes: Counter[int] = Counter()
    wrong = []
    for count, case in enumerate(drawn(kind, number, seed=21)):
        folder = tmp_path / str(count)
        folder.mkdir()
        outcome = judge(case, folder)
        codes[outcome.code] += 1
        if outcome.complaint:
            wrong.append(f"{folder}: {outcome.complaint}: {outcome.err[-500:]}")
    assert not wrong, "\n".join(wrong)
    assert codes.total() >= number // 2
    assert codes[2] > 0
    ran = kind in ("bombs", "scripts") or codes[0] > 0
    assert ran, f"no case ran, of {codes}; the last one printed {outcome.err[-500:]}"


@pytest.mark.parametrize("name", ["obj", "msh2", "msh2-binary", "msh4", "msh4-binary", "geo"])
def test_the_meshes_before_mutation_are_valid(name: str, fresh: Path) -> None:
    form, _, binary = name.partition("-")
    data = {"obj": OBJ, "geo": GEO}.get(form) or {"msh2": msh_2, "msh4": msh_4}[form](binary=bool(binary))
    file = f"mesh.{form[:3]}"
    held = "group: all" if form == "obj" else "group: edge"
    scene = SCENE.format(name=file, size="", held=held).encode()
    outcome = judge(Case(name, {"scene.yaml": scene, file: data}), fresh)
    assert (outcome.code, outcome.complaint) == (0, ""), outcome.err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (bomb("lists", 40, 9), "more than 2000000 entries"),
        (bomb("merges", 40, 9), "more than 2000000 entries"),
        (nested(3000, "list"), "nested too deeply"),
        (nested(1500, "indented"), "nested too deeply"),
        (b"mesh: {grid: {width: 1, height: 1, nx: 1000000000, ny: 1000000000}}\n"
         b"material: {cloth: paper}\ntime: {end: 1, step: 1}\n", "1000000002000000001 vertices take about"),
        (b"x: &g {grid: {width: 1, height: 1, nx: 1000, ny: 1000}}\n"
         b"mesh: [" + b"*g, " * 1000 + b"*g]\n", "x: unknown key"),
        (b"mesh: [&g {grid: {width: 1, height: 1, nx: 10000, ny: 10000}}, " + b"*g, " * 1000 + b"*g]\n"
         b"material: {cloth: paper}\ntime: {end: 1, step: 1}\n", "vertices take about"),
        (b"a: !!python/object/apply:os.system ['touch mark']\n", "could not determine a constructor"),
    ],
)  # fmt: skip
def test_small_files_with_large_content_are_refused(text: bytes, words: str, fresh: Path) -> None:
    outcome = judge(Case("bomb", {"scene.yaml": text}), fresh)
    assert (outcome.code, outcome.complaint) == (2, ""), outcome.err
    assert words in outcome.line
