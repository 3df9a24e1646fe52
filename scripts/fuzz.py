"""Fuzzing: thousands of mutated scenes, meshes and original scenes, each in a process of its own.

    python scripts/fuzz.py --cases 5000 --seed 1 --keep /tmp/failures

Ends with exit code 1 if a case ended otherwise than docs/fuzzing.md allows; its files are then kept.
"""

from __future__ import annotations

import argparse
import collections
import shutil
import sys
import tempfile
import time
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "tests" / "fuzz")]

from all_cases import KINDS  # noqa: E402
from judge import Case, judge, warm  # noqa: E402


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=2000, help="of all kinds together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=sorted(KINDS), help="one kind")
    parser.add_argument("--keep", type=Path, default=Path("fuzz-failures"), help="folder for failing cases")
    asked = parser.parse_args()
    kinds = {asked.only: KINDS[asked.only]} if asked.only else KINDS
    codes: collections.Counter[str] = collections.Counter()
    failures: list[str] = []
    slowest: list[tuple[float, str]] = []
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        warm(Path(scratch))
        for number, (name, (share, strategy)) in enumerate(kinds.items()):

            @seeded(asked.seed * len(KINDS) + number)
            @settings(
                max_examples=asked.cases if asked.only else max(1, asked.cases * share // 100),
                deadline=None,
                database=None,
                phases=[Phase.generate],
                suppress_health_check=list(HealthCheck),
            )
            @given(case=strategy)
            def run(case: Case, name: str = name) -> None:
                folder = Path(tempfile.mkdtemp(dir=scratch))
                outcome = judge(case, folder)
                codes[f"{case.kind}: {outcome.code}"] += 1
                slowest.append((outcome.seconds, case.kind))
                slowest.sort(reverse=True)
                del slowest[5:]
                if outcome.complaint:
                    kept = asked.keep / f"{asked.seed}-{name}-{len(failures)}"
                    shutil.rmtree(kept, ignore_errors=True)
                    kept.mkdir(parents=True)
                    case.write(kept)
                    last = outcome.err.strip().splitlines()[-1:] or [""]
                    (kept / "WHAT").write_text(f"{outcome.complaint}\n{case.arguments}\n{outcome.err}")
                    failures.append(f"{kept}: {outcome.complaint}: {last[0][:200]}")
                    print(failures[-1], flush=True)
                shutil.rmtree(folder)

            run()
            print(f"{name} done, {time.monotonic() - started:.0f} s", flush=True)
    for kind, count in sorted(codes.items()):
        print(f"{count:7d}  {kind}")
    print("slowest: " + ", ".join(f"{seconds:.1f} s {kind}" for seconds, kind in slowest))
    total = sum(codes.values())
    seconds = time.monotonic() - started
    print(f"{total} cases, seed {asked.seed}, {len(failures)} failures, {seconds:.0f} s")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
