"""Cost of ``run --live``: one run whose page is stopped and continued in turn.

    python scripts/live_benchmark.py [--ranks 2] [--pairs 20] [--seconds 2] [--watch chromium]
        [SCENE [--set KEY=VALUE …]]

The page's process is stopped (SIGSTOP) for some seconds and continued (SIGCONT) for as many. Two neighbouring
intervals make a pair: wall time per iteration of the linear solver with the page over that without it, from
history.csv. Other work on the machine affects both alike; the median of the ratios is the result. With
``--watch`` that browser, without a screen and at the lowest priority, has the page open, and is stopped too.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np

from lyra_petsc.api.mpirun import environment, find_launcher
from lyra_petsc.output.read_run import StoredRun

BROWSER = (
    "--headless=new",
    "--disable-dev-shm-usage",
    "--enable-unsafe-swiftshader",
    "--use-angle=swiftshader",
)


def page_process(folder: Path) -> int:
    """The page's process of the run started in that folder."""
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            words = entry.joinpath("cmdline").read_bytes().split(b"\0") if entry.name.isdigit() else []
            if b"lyra_petsc.show.view.live" in words and entry.joinpath("cwd").readlink() == folder.resolve():
                return int(entry.name)
    raise SystemExit("the run has no page")


def processor_seconds(process: int) -> float:
    """User and system time of a process so far [s]."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def address(run: subprocess.Popen[str]) -> str:
    """The address of the page."""
    told = []
    for line in run.stderr or ():
        told.append(line)
        found = re.match(r"view: (\S+)", line)
        if found:
            # the run must not block on a full pipe
            threading.Thread(target=lambda: list(run.stderr or ()), daemon=True).start()
            return found[1]
    raise SystemExit("".join(told))


def open_page(browser: str, url: str, folder: str) -> subprocess.Popen[bytes]:
    """A browser without a screen, in a group of its own."""
    root = ["--no-sandbox"] if os.geteuid() == 0 else []
    # of low priority beside other sessions as well, where Linux groups processes by sessions
    low_priority = ["sh", "-c", 'echo 19 >/proc/self/autogroup; exec nice -n 19 "$@"', "sh"]
    options = [*BROWSER, *root, f"--user-data-dir={folder}", "--remote-debugging-port=0"]
    words, quiet = [*low_priority, browser, *options, url], subprocess.DEVNULL
    return subprocess.Popen(words, stdout=quiet, stderr=quiet, start_new_session=True)


def intervals(page: int, group: int | None, out: Path, seconds: float, count: int) -> list[int]:
    """Rows of history.csv at the ends of the intervals; in the first, third, … the page is stopped."""
    rows = [len(StoredRun(out).history["step"])]
    for i in range(count):
        number = signal.SIGCONT if i % 2 else signal.SIGSTOP
        os.kill(page, number)
        if group is not None:
            os.killpg(group, number)
        time.sleep(seconds)
        rows.append(len(StoredRun(out).history["step"]))
    os.kill(page, signal.SIGCONT)
    return rows


def ratios(out: Path, rows: Sequence[int]) -> list[float]:
    """Time per linear iteration with the page over that without, for pairs of neighbouring intervals."""
    history = StoredRun(out).history
    wall, work = np.asarray(history["wall_seconds"]), np.asarray(history["linear_iterations"])
    # a step at the end of an interval belongs to neither
    costs = [wall[a + 1 : b].sum() / max(work[a + 1 : b].sum(), 1) for a, b in itertools.pairwise(rows)]
    return [on / off for off, on in zip(costs[::2], costs[1::2], strict=True) if on > 0 and off > 0]


@click.command()
@click.argument("scene", required=False)
@click.option("--set", "settings", multiple=True)
@click.option("--ranks", default=2)
@click.option("--pairs", default=20)
@click.option("--seconds", default=2.0)
@click.option("--watch", metavar="BROWSER")
def main(
    scene: str | None, settings: tuple[str, ...], ranks: int, pairs: int, seconds: float, watch: str | None
) -> None:
    """Run once and print the ratio."""
    words = [*(find_launcher(ranks) if ranks > 1 else []), sys.executable, "-m", "lyra_petsc", "run"]
    words += [str(Path(scene).absolute())] if scene else []
    words += [word for setting in ("time.end=1000", *settings) for word in ("--set", setting)]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        out = Path(folder) / "run"
        words += ["--out", str(out), "--live", "--no-browser"]
        run = subprocess.Popen(
            words, cwd=folder, env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        browser = None
        try:
            url = address(run)
            page = page_process(Path(folder))
            began = processor_seconds(page)
            if watch:
                browser = open_page(watch, url, f"{folder}/browser")
                time.sleep(10.0)
            rows = intervals(page, browser and browser.pid, out, seconds, 2 * pairs)
            used = processor_seconds(page) - began
        finally:
            if browser is not None:
                os.killpg(browser.pid, signal.SIGCONT)
                os.killpg(browser.pid, signal.SIGTERM)
                browser.wait()
            run.terminate()
            run.wait()
        found = ratios(out, rows)
    low, middle, high = np.percentile(found, [25, 50, 75])
    print(
        f"{ranks} rank(s), {os.cpu_count()} processors, {rows[-1] - rows[0]} steps, {len(found)} pairs: "
        f"time with the page over time without {middle:.3f} (half of the pairs: {low:.3f} to {high:.3f}; "
        f"mean {statistics.mean(found):.3f})"
    )
    print(
        f"processor time of the page: {began:.1f} s to start, then {used:.1f} s "
        f"in the {pairs * seconds:g} s that it was let run"
    )


if __name__ == "__main__":
    main()
