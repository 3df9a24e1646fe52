"""Helpers of tests/cli for the tests of the documentation, which start the program."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "cli"))
