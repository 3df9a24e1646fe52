"""What ``run --live`` costs: the same run with and without the page, one after the other, and their ratios.

    python scripts/live_benchmark.py [--ranks 2] [--pairs 5] [--watch chromium] [SCENE [--set KEY=VALUE …]]

Without SCENE the default one, to t = 1 s. With ``--watch`` that browser, without a screen and at the lowest
priority, has the page open throughout, so that each state is drawn on this machine as well. Printed for each
pair are the wall seconds of the steps and of the output, from summary.json; the median of the ratios is the
answer, as other work on the machine comes and goes.
"""

from __future__ import annotations

import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import click

from lyra_petsc.study.launch import environment, find_launcher

BROWSER = (
    "--headless=new",
    "--disable-dev-shm-usage",
    "--enable-unsafe-swiftshader",
    "--use-angle=swiftshader",
)


def seconds(words: list[str], out: Path, browser: str | None) -> float:
    """Wall seconds of the steps and of the output of one run."""
    run = subprocess.Popen(
        [*words, "--out", str(out)],
        env=environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    watching: subprocess.Popen[bytes] | None = None
    told = []
    for line in run.stderr or ():
        told.append(line)
        found = re.match(r"view: (\S+)", line)
        if found and browser:
            root = ["--no-sandbox"] if os.geteuid() == 0 else []
            profile = f"--user-data-dir={out}.browser"
            command = [
                "nice",
                "-n",
                "19",
                browser,
                *BROWSER,
                *root,
                profile,
                "--remote-debugging-port=0",
                found[1],
            ]
            watching = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    if run.wait() != 0:
        raise SystemExit("".join(told))
    if watching is not None:
        watching.terminate()
        watching.wait()
    elif browser and "--live" in words:
        raise SystemExit("the run ended before its page was there: give a longer one")
    phases = json.loads((out / "summary.json").read_text())["wall_seconds"]
    return float(phases["solve"] + phases["assembly"] + phases["output"])


@click.command()
@click.argument("scene", required=False)
@click.option("--set", "settings", multiple=True)
@click.option("--ranks", default=2)
@click.option("--pairs", default=5)
@click.option("--watch", metavar="BROWSER")
def main(scene: str | None, settings: tuple[str, ...], ranks: int, pairs: int, watch: str | None) -> None:
    """Run the pairs and print a table."""
    if scene is None and not settings:
        settings = ("time.end=1",)
    words = [*(find_launcher(ranks) if ranks > 1 else []), sys.executable, "-m", "lyra_petsc", "run"]
    words += [scene] if scene else []
    words += [word for setting in settings for word in ("--set", setting)]
    ratios = []
    print("| without [s] | --live [s] | ratio |\n| --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        for pair in range(pairs):
            # who goes first alternates: what slows down over time hits both
            order = [["--live", "--no-browser"], []] if pair % 2 else [[], ["--live", "--no-browser"]]
            took = {bool(o): seconds([*words, *o], Path(folder) / f"{pair}-{len(o)}", watch) for o in order}
            ratios.append(took[True] / took[False])
            print(f"| {took[False]:.2f} | {took[True]:.2f} | {ratios[-1]:.3f} |", flush=True)
    print(f"median {statistics.median(ratios):.3f} on {ranks} rank(s), {os.cpu_count()} processors")


if __name__ == "__main__":
    main()
