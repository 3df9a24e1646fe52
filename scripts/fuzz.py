"""Fuzzing: thousands of mutated scenes, meshes and original scenes, each in a process of its own.

    python scripts/fuzz.py --cases 5000 --seed 1 --keep /tmp/failures

Exit code 1 if a case ends in a way that docs/fuzzing.md does not allow; the files of such cases are kept.
"""

from __future__ import annotations

import argparse
import collections
import shutil
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = map(str, (ROOT, ROOT / "tests", ROOT / "tests" / "fuzz"))

from all_cases import KINDS, for_each  # noqa: E402
from judge import Case, judge, warm  # noqa: E402


class Tally:
    """Runs cases and counts how they end."""

    def __init__(self, seed: int, keep: Path, scratch: str) -> None:
        self.seed, self.keep, self.scratch = seed, keep, scratch
        self.codes: collections.Counter[str] = collections.Counter()
        self.failures: list[str] = []
        self.slowest: list[tuple[float, str]] = []

    def run(self, case: Case) -> None:
        """Judge one case; keep its files if it failed."""
        folder = Path(tempfile.mkdtemp(dir=self.scratch))
        outcome = judge(case, folder)
        shutil.rmtree(folder)
        self.codes[f"{case.kind}: {outcome.code}"] += 1
        self.slowest = sorted([*self.slowest, (outcome.seconds, case.kind)], reverse=True)[:5]
        if not outcome.complaint:
            return
        kept = self.keep / f"{self.seed}-{case.kind}-{len(self.failures)}"
        shutil.rmtree(kept, ignore_errors=True)
        kept.mkdir(parents=True)
        case.write(kept)
        (kept / "WHAT").write_text(f"{outcome.complaint}\n{case.arguments}\n{outcome.err}")
        last = outcome.err.strip().splitlines()[-1:] or [""]
        self.failures.append(f"{kept}: {outcome.complaint}: {last[0][:200]}")
        print(self.failures[-1], flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=2000, help="of all kinds together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=sorted(KINDS), help="one kind")
    parser.add_argument("--keep", type=Path, default=Path("fuzz-failures"), help="folder for failing cases")
    asked = parser.parse_args()
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        warm(Path(scratch))
        tally = Tally(asked.seed, asked.keep, scratch)
        for number, (name, (share, strategy)) in enumerate(KINDS.items()):
            if asked.only not in (None, name):
                continue
            wanted = asked.cases if asked.only else max(1, asked.cases * share // 100)
            for_each(strategy, wanted, asked.seed * len(KINDS) + number, tally.run)
            print(f"{name} done, {time.monotonic() - started:.0f} s", flush=True)
    for kind, count in sorted(tally.codes.items()):
        print(f"{count:7d}  {kind}")
    print("slowest: " + ", ".join(f"{seconds:.1f} s {kind}" for seconds, kind in tally.slowest))
    seconds = time.monotonic() - started
    print(f"{tally.codes.total()} cases, seed {asked.seed}, {len(tally.failures)} failures, {seconds:.0f} s")
    return 1 if tally.failures else 0


if __name__ == "__main__":
    sys.exit(main())
