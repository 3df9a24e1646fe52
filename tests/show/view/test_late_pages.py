"""Slow pages: data that they still have to fetch are kept, and delays are shown."""

from __future__ import annotations

import asyncio
import re
import time
from types import SimpleNamespace

import pytest
from patience import Patience
from written_run import written

from lyra_petsc.output.read_run import StoredRun

pytest.importorskip("trame")


class Sent:
    """An array that was sent, without other references."""

    def __init__(self, mebibytes: float, references: int = 1) -> None:
        self._size, self._references = int(1024 * mebibytes), references

    def GetActualMemorySize(self) -> int:
        return self._size

    def GetReferenceCount(self) -> int:
        return self._references


def test_only_the_oldest_arrays_beyond_the_budget_are_released() -> None:
    from lyra_petsc.show.view.page import release_old_arrays

    now = time.time()
    cache = {
        "in use": {"array": Sent(100, 2), "ts": now - 900},
        "oldest": {"array": Sent(100), "ts": now - 800},
        "late": {"array": Sent(100), "ts": now - 60},
        "newer": {"array": Sent(100), "ts": now - 1},
    }
    release_old_arrays(SimpleNamespace(data_array_cache=cache))
    assert list(cache) == ["in use", "late", "newer"]
    young = {str(i): {"array": Sent(100), "ts": now} for i in range(9)}
    release_old_arrays(SimpleNamespace(data_array_cache=young))
    assert len(young) == 9


async def until(condition) -> None:
    patience = Patience()
    while not condition():
        assert not patience.over
        await asyncio.sleep(0.02)


def test_the_page_waits_for_slow_browsers_and_shows_it(tmp_path, monkeypatch) -> None:
    from lyra_petsc.show.view import page as module

    monkeypatch.setattr(module, "SLOW_DRAWING", 0.05)
    access = SimpleNamespace(n_open=1)
    page = module.Page(StoredRun(written(tmp_path / "run", states=9)), access)
    state = page.server.state

    async def watch() -> None:
        task = asyncio.create_task(page.animate())
        page._player.go(2)
        await until(lambda: "waiting for the browser" in state.waiting)
        assert state.frame == 2
        page._player.go(3)
        await asyncio.sleep(0.3)
        assert state.frame == 2, "another state was sent before the last one was drawn"
        page.drawn()
        await until(lambda: state.frame == 3)
        page.drawn()
        await until(lambda: state.waiting == "")
        task.cancel()

    asyncio.run(watch())


def test_the_page_shows_that_a_run_is_late(tmp_path, monkeypatch) -> None:
    from lyra_petsc.show.view import page as module

    monkeypatch.setattr(module, "is_locked", lambda folder: True)
    run = StoredRun(written(tmp_path / "run", states=3))
    page = module.Page(run, SimpleNamespace(n_open=1))
    monkeypatch.setattr(StoredRun, "summary", {"outcome": "running"})
    run.__dict__.pop("summary", None)
    assert page._outcome().endswith(" running")
    page._last_news -= 7.0
    assert re.search(r"running, the next state awaited for ([7-9]|\d\d) s$", page._outcome())
