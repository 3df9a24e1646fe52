"""Makes the modules of the bench, which are in a folder of their own, and helpers of tests/cli importable."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "cli"))
sys.path.insert(0, str(Path(__file__).parents[2] / "scripts" / "benchmarks"))
