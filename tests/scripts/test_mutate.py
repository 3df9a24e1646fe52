"""The list of mutations fits the present code and tests."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import pytest
from module_of import module_of

SCRIPT = Path(__file__).parents[2] / "scripts" / "mutate.py"


@pytest.fixture
def mutate() -> ModuleType:
    return module_of(SCRIPT)


def test_every_mutation_fits_the_present_code(
    mutate: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["mutate.py", "--list"])
    assert mutate.main() == 0, capsys.readouterr().out
    assert len(capsys.readouterr().out.splitlines()) == len(mutate.CHANGES) >= 40


def test_every_named_test_exists(mutate: ModuleType) -> None:
    for test in {test for change in mutate.CHANGES for test in change.tests}:
        file, _, name = test.rpartition("@")[2].partition("::")
        text = (mutate.ROOT / file).read_text(encoding="utf-8")
        assert not name or f"\ndef {name.partition('[')[0]}(" in text, test
