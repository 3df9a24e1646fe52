"""``scripts/bench``: measures time and memory, writes ``bench.json`` and ``bench.md``; see
docs/performance.md."""

from __future__ import annotations

import argparse
import datetime
import itertools
import json
import signal
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import measures
from cases import BENDING_MESHES, METHODS, PLAIN_MESHES, square_number
from peers import parse
from processes import WORKER, Failed, Limits
from tables import document, growth

from lyra_petsc.api.mpirun import find_launcher
from lyra_petsc.cli.arguments import split
from lyra_petsc.errors import InputError, OutputError, suggest
from lyra_petsc.output.file_operations import replace_text

DEFAULT = {"vertices": [1024, 10201, 50176], "weak": 25_000, "output": 200_000}
QUICK = {"vertices": [1024, 4900], "weak": 2_500, "output": 10_201}
GROWTH = [5_000, 10_201, 20_000, 50_176, 100_000, 200_000, 500_000]


class Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; see --help")


def flat(lists: Sequence[list[int]]) -> list[int]:
    """The numbers of all words of an option."""
    return [number for numbers in lists for number in numbers]


def numbers(text: str) -> list[int]:
    """Positive integers separated by commas."""
    try:
        values = [int(word) for word in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if not values or min(values) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} must be whole numbers from 1 on, as 1024,10201")
    return values


def read_arguments(words: Sequence[str]) -> argparse.Namespace:
    parser = Parser(prog="scripts/bench", description=__doc__, allow_abbrev=False)
    add, meshes = parser.add_argument, " ".join(BENDING_MESHES)
    add("--quick", action="store_true", help="smaller and shorter, within two minutes")
    add("--out", type=Path, default=Path("bench"), metavar="DIR", help="where the two files go (bench)")
    add("--vertices", type=numbers, nargs="+", metavar="N", help="sizes of the rows (1024,10201,50176)")
    add("--ranks", type=numbers, nargs="+", default=[[1, 2]], metavar="P", help="numbers of ranks (1,2)")
    add("--steps", type=int, metavar="N", help="measured steps of a row, at most (10)")
    add("--seconds", type=float, metavar="S", help="time after which a row measures no more steps (15)")
    add("--limit", type=float, metavar="S", help="time after which a process is given up (600)")
    add("--weak", type=int, metavar="N", help="vertices per rank of the weak scaling (25000); 0: none")
    add("--growth", type=numbers, nargs="*", metavar="N", help=f"further sizes to fit growth ({GROWTH})")
    add("--presets", nargs="*", metavar="NAME", help="CG iterations against size of these presets, or of all")
    add(
        "--against",
        type=Path,
        metavar="DIR",
        help="this program over that of another checkout, in pairs of runs",
    )
    add("--contact", action="store_true", help="also sheets in contact, for a second and more")
    add("--bending", nargs="*", metavar="MESH", help=f"also directors on edges beside hinges, on {meshes}")
    add("--settle", type=float, default=1.0, metavar="S", help="simulated time before those are measured (1)")
    add("--scenes", nargs="+", default=[], metavar="WORD", help="those of contact with a word in their names")
    add("--gap", type=float, metavar="M", help="contact gap over the ball (a quarter of a mesh edge)")
    add("--only-rows", action="store_true", help="the first table and what was asked for, nothing else")
    add("--peer", action="append", default=[], type=str, metavar="NAME='COMMAND {obj} {json} {steps}'")
    asked = parser.parse_args(list(words))
    chosen = QUICK if asked.quick else DEFAULT
    asked.vertices = flat(asked.vertices) if asked.vertices else chosen["vertices"]
    asked.ranks = sorted(set(flat(asked.ranks)))
    asked.growth = (flat(asked.growth) or GROWTH) if asked.growth is not None else []
    asked.weak = chosen["weak"] if asked.weak is None else asked.weak
    asked.output_vertices = chosen["output"]
    asked.peers = [parse(text) for text in asked.peer]
    asked.limits = Limits(
        steps=asked.steps if asked.steps is not None else (5 if asked.quick else 10),
        seconds=asked.seconds if asked.seconds is not None else (2.0 if asked.quick else 15.0),
        process=asked.limit if asked.limit is not None else (60.0 if asked.quick else 600.0),
    )
    if asked.limits.steps < 1 or min(asked.limits.seconds, asked.limits.process) <= 0.0 or asked.weak < 0:
        raise InputError("--steps must be at least 1, --seconds and --limit above 0, --weak at least 0")
    if asked.bending is not None:
        for kind in asked.bending:
            if kind not in BENDING_MESHES:
                raise InputError(f"unknown mesh {kind!r}, {suggest(kind, BENDING_MESHES)}", key="--bending")
        asked.bending = asked.bending or list(BENDING_MESHES)
    if asked.against is not None:
        asked.against = asked.against.resolve()
        if not (asked.against / WORKER).is_file():
            raise InputError(
                f"has no {WORKER}; give a checkout of lyra_petsc", file=asked.against, key="--against"
            )
    if asked.presets is not None:
        asked.presets = measures.preset_names(asked.presets)
    return asked


class Bench:
    """Performs the measurements; both files are rewritten after each of them.

    Parameters
    ----------
    asked : argparse.Namespace
    petsc : sequence of str
        PETSc options for every measurement of this program.
    words : sequence of str
        The command line.
    """

    def __init__(self, asked: argparse.Namespace, petsc: Sequence[str], words: Sequence[str]) -> None:
        self._asked, self._petsc, self._folder = asked, list(petsc), asked.out
        self.results: dict[str, Any] = {
            "format": 1,
            "started": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
            "arguments": list(words),
            "machine": measures.machine(),
            "versions": {},
            "rows": [],
            "failures": [],
        }

    def _attempt(self, what: str, work: Callable[..., Any], *arguments: Any, **more: Any) -> Any:
        """Perform a measurement; prints a line and returns None if it fails."""
        print(f"bench: {what}", file=sys.stderr, flush=True)
        try:
            return work(*arguments, **more)
        except Failed as error:
            line = f"{what}: {error}"
            self.results["failures"].append(line)
            print(f"bench: failed: {line}", file=sys.stderr, flush=True)
            return None
        finally:
            self.save()

    def _row(
        self,
        vertices: int,
        method: str,
        ranks: int,
        petsc: Sequence[str] = (),
        **changes: float,
    ) -> Any:
        what = f"{vertices} vertices, {method}, {ranks} rank(s)"
        what += "".join(f", {name} {value:g}" for name, value in changes.items())
        words, limits = [*self._petsc, *petsc], self._asked.limits
        return self._attempt(what, measures.row, vertices, method, ranks, words, limits, **changes)

    def save(self) -> None:
        text = json.dumps(self.results, indent=1, ensure_ascii=False)
        replace_text(self._folder / "bench.json", text + "\n")
        replace_text(self._folder / "bench.md", document(self.results))

    def run(self) -> None:
        """Perform all measurements."""
        asked = self._asked
        few = Limits(1, 1.0, 600.0)
        for method in METHODS:  # so that no row includes compilation
            self._attempt(f"compiling, {method}", measures.row, 1024, method, 1, self._petsc, few)
        for vertices in asked.vertices:
            for method, ranks in itertools.product(METHODS, asked.ranks):
                self._add("rows", self._row(vertices, method, ranks))
            for name, command in asked.peers:
                peer = name, command, vertices, self._folder, asked.limits
                self._measure("rows", f"{vertices} vertices, peer {name}", measures.peer_row, *peer)
        self._growth()
        if asked.presets is not None:
            self._presets()
        self._compare()
        if not asked.only_rows:
            self._scaling()
            self._single_numbers()
        self.save()

    def _add(self, where: str, row: Any) -> None:
        if row is not None:
            self.results.setdefault(where, []).append(row)
            self.results["versions"] |= row.get("versions", {})
            self.save()

    def _measure(self, where: str, what: str, work: Callable[..., Any], *arguments: Any) -> None:
        self._add(where, self._attempt(what, work, *arguments))

    def _compare(self) -> None:
        """Measure what was requested of: bending models, another checkout, contact."""
        asked, petsc, folder, limits = self._asked, self._petsc, self._folder, self._asked.limits
        product = itertools.product
        for kind, method, ranks, n in product(asked.bending or (), METHODS, asked.ranks, asked.vertices):
            what = f"{n} vertices, {kind}, hinge and midedge, {method}, {ranks} rank(s)"
            self._measure("bending", what, measures.bending, kind, n, method, ranks, petsc, folder, limits)
        for ranks, n, kind, method in product(asked.ranks, asked.vertices, PLAIN_MESHES, METHODS):
            if asked.against is not None:
                what = f"{n} vertices, {kind}, {method}, {ranks} rank(s), here and in {asked.against}"
                pair = kind, n, method, ranks, petsc, folder, limits, asked.against
                self._measure("against", what, measures.against, *pair)
        for n, ranks in product(asked.vertices, asked.ranks) if asked.contact else ():
            what = f"{n} vertices in contact, {ranks} rank(s)"
            chosen = asked.settle, asked.scenes, asked.gap
            self._measure("contact", what, measures.contact, n, ranks, petsc, limits, *chosen)

    def _scaling(self) -> None:
        """Measure other meshes, weak scaling, and independent sheets."""
        asked, petsc, limits = self._asked, self._petsc, self._asked.limits
        first, largest = asked.ranks[0], max(asked.vertices)
        for n in asked.vertices:
            what = f"{n} vertices, other meshes, {first} rank(s)"
            self._measure("meshes", what, measures.meshes, n, first, petsc, self._folder, limits)
        for ranks in asked.ranks if asked.weak else []:
            self._add("weak", self._row(ranks * asked.weak, METHODS[0], ranks))
        for ranks in (ranks for ranks in asked.ranks if ranks > 1):
            what = f"{ranks} sheets of {largest // ranks} vertices at once"
            self._measure("apart", what, measures.apart, largest, ranks, petsc, limits)

    def _growth(self) -> None:
        known = measures.first_method(self.results["rows"])
        rows = list(known)
        for vertices in self._asked.growth:
            if square_number(vertices) in [row["vertices"] for row in known]:
                continue
            row = self._row(vertices, METHODS[0], 1)
            self._add("growth_rows", row)
            rows += [row] if row else []
            self.results["growth"] = growth(rows)
        self.results["growth"] = growth(rows)
        self.save()

    def _presets(self) -> None:
        asked = self._asked
        classes = measures.PROBLEM_CLASSES
        for name, title, vertices in itertools.product(asked.presets, classes, asked.vertices):
            failures = len(self.results["failures"])
            row = self._row(vertices, METHODS[0], 1, measures.preset_options(name), **classes[title])
            if row is None:
                failed = self.results["failures"][failures].rpartition(": ")[2]
                row = {"vertices": square_number(vertices), "problem": failed}
            self._add("presets", row | {"preset": name, "problem_class": title})

    def _single_numbers(self) -> None:
        asked, folder, petsc, limits = self._asked, self._folder, self._petsc, self._asked.limits
        ranks, vertices = asked.ranks[-1], asked.output_vertices
        single = {
            "output": partial(measures.output, vertices, ranks, petsc, folder, limits),
            "default_scene": partial(measures.default_scene, ranks, petsc, folder, limits, short=asked.quick),
            "start_up": partial(measures.start_up, petsc, folder, limits),
        }
        for name, work in single.items():
            result = self._attempt(name.replace("_", " "), work)
            if result is not None:
                self.results[name] = result
                self.save()


def main() -> int:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that child processes are ended
    words, petsc = split(sys.argv[1:])
    try:
        asked = read_arguments(words)
        find_launcher(max(asked.ranks))
        try:
            asked.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot be made: {error.strerror}", file=asked.out, key="--out") from None
        bench = Bench(asked, petsc, sys.argv[1:])
        bench.run()
    except (InputError, OutputError) as error:
        print(f"bench: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("bench: stopped; what was measured stands", file=sys.stderr)
        return 130
    print((asked.out / "bench.md").read_text(encoding="utf-8"))
    return 1 if bench.results["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
