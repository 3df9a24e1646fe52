"""``run --live``: the page starts with the run, follows it, and ends after it."""

import http.client
import os
import re
import signal
import time
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from launch import SCENE, UNHURRIED, done, finish, lyra, start, write_scene
from patience import Patience
from written_run import Writer

from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.show.view import server
from lyra_petsc.show.view.live import NICENESS, LivePage

SLOW = SCENE.replace("end: 0.05, step: 0.01", "end: 500, step: 0.01").replace("every: 0.02", "every: 0.1")
"""The same scene with a much later end."""


def pages(folder):
    """Processes that serve the page of a run started in ``folder``."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            line = entry.joinpath("cmdline").read_bytes()
            if (
                b"'lyra_petsc.show.view.live'" in line
                and entry.joinpath("cwd").readlink() == folder.resolve()
            ):
                found.append(int(entry.name))
        except (OSError, ValueError):  # no process, or gone meanwhile
            continue
    return found


def until(condition, what):
    patience = Patience()
    while not condition():
        assert not patience.over, what
        time.sleep(0.05)


def address(process):
    """Address of the page, as soon as the run prints it."""
    messages = []
    for line in process.stderr:
        messages.append(line)
        found = re.match(r"view: (http://127\.0\.0\.1:\d+/\?token=\S+)$", line)
        if found:
            return found[1]
    pytest.fail("no page:\n" + "".join(messages))


def opened(address):
    """A connection that the server takes for an open page."""
    url = urlsplit(address)
    connection = http.client.HTTPConnection("127.0.0.1", url.port, timeout=20)
    headers = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    headers |= {"Sec-WebSocket-Key": "c29tZSBub25zZW5zZSAgIA=="}
    connection.request("GET", "/ws?" + url.query, headers=headers)
    assert connection.getresponse().status == 101
    return connection


@pytest.fixture(autouse=True)
def in_its_folder(tmp_path, monkeypatch):
    pytest.importorskip("trame")
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
def test_the_page_ends_with_a_run_that_is_killed(tmp_path):
    write_scene(tmp_path, SLOW)
    process = start(
        ["run", "scene.yaml", "--out", tmp_path / "out", "--live", "--no-browser"],
        tmp_path,
        2,
        program=("-c", UNHURRIED),
    )
    try:
        opened(address(process)).close()
        assert len(pages(tmp_path)) == 1
        os.killpg(process.pid, signal.SIGKILL)
        until(lambda: not pages(tmp_path), "the page outlives its run")
    finally:
        finish(process)
    assert len(StoredRun(tmp_path / "out")) > 1


@pytest.mark.slow
def test_a_resumed_run_has_a_page_until_it_is_stopped(tmp_path):
    write_scene(tmp_path)
    done(["run", "scene.yaml", "--out", tmp_path / "out"], tmp_path)
    before = len(StoredRun(tmp_path / "out"))
    settings = ["--set", "time.end=500", "--resume", "--live", "--no-browser"]
    process = start(["run", "scene.yaml", "--out", tmp_path / "out", *settings], tmp_path)
    try:
        opened(address(process)).close()
        assert len(pages(tmp_path)) == 1
    finally:
        os.killpg(process.pid, signal.SIGINT)
        assert finish(process).code == 130
    until(lambda: not pages(tmp_path), "the page outlives its run")
    assert len(StoredRun(tmp_path / "out")) > before


@pytest.mark.slow
def test_a_run_that_ends_or_fails_leaves_no_page(tmp_path):
    # the launcher must not wait for the page, nor the page for ever
    write_scene(tmp_path)
    live = ["run", "scene.yaml", "--live", "--no-browser", "--out"]
    left = done([*live, tmp_path / "out"], tmp_path)
    options = ["-snes_max_it", "1", "-snes_rtol", "1e-15", "-snes_stol", "0", "-ts_adapt_dt_min", "0.01"]
    failed = lyra([*live, tmp_path / "failed", *options], tmp_path)
    assert failed.code == 3
    assert f"lyra-petsc view {tmp_path / 'failed'}" in failed.out

    assert len(StoredRun(tmp_path / "out")) == 4
    assert StoredRun(tmp_path / "out").finished
    assert "note: no page" not in left.err
    assert f"lyra-petsc view {tmp_path / 'out'}" in left.out
    for said in (left.err, failed.err):  # a page that somebody could open waits for a browser
        for url in re.findall(r"view: (http\S+)", said):
            opened(url).close()
    until(lambda: not pages(tmp_path), "a page outlives its run")


def test_a_port_in_use_is_refused_before_files_are_written(tmp_path):
    import socket

    write_scene(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        left = lyra(["run", "scene.yaml", "--out", "out", "--live", "--port", port], tmp_path)
    assert left.code == 2
    assert len(left.ours) == 1
    assert "Address already in use" in left.ours[0]
    assert not (tmp_path / "out").exists()


def test_a_page_that_cannot_be_served_is_reported(tmp_path):
    messages = []
    page = LivePage(tmp_path / "nowhere", "127.0.0.1", 0, messages.append, messages.append)
    until(lambda: messages, "nothing is said")
    page.end()
    assert "nowhere: no such folder" in messages[0]


@pytest.mark.slow
def test_the_page_stays_after_the_run_until_the_last_browser_leaves(tmp_path):
    writer = Writer(tmp_path / "run")
    writer.write()
    messages = []
    page = LivePage(tmp_path / "run", "127.0.0.1", 0, messages.append, messages.append)
    until(lambda: messages, "nothing is said")
    (process,) = pages(tmp_path)
    assert os.getpriority(os.PRIO_PROCESS, process) >= NICENESS
    group = Path(f"/proc/{process}/autogroup")  # where Linux shares the time out among sessions
    if group.exists() and group.read_text().strip():
        assert group.read_text().endswith(f"nice {NICENESS}\n")

    connection = opened(messages[0])
    page.end()
    time.sleep(server.LEAVE_SECONDS + 3.0)
    assert pages(tmp_path), "the page left those who look"
    connection.close()
    connection.sock = None
    until(lambda: not pages(tmp_path), "the page outlives its run")
    assert len(messages) == 1


def test_a_page_whose_address_nobody_has_ends_with_the_run(tmp_path):
    Writer(tmp_path / "run").write()
    messages = []
    page = LivePage(tmp_path / "run", "127.0.0.1", 0, messages.append, messages.append)
    page.end()
    until(lambda: not pages(tmp_path), "the page outlives its run")
    assert messages == []
