"""Numbers as a reader wants them: few digits, handy units."""

from __future__ import annotations

import math
from typing import Any


def short(value: float, digits: int = 3) -> str:
    """So many significant digits, without needless zeros; ``–`` for what is not finite."""
    if not math.isfinite(value):
        return "–"
    if value == 0.0:
        return "0"
    size = abs(value)
    if 1e-3 <= size < 1e5:
        text = f"{value:.{max(0, digits - 1 - math.floor(math.log10(size)))}f}"
        return text.rstrip("0").rstrip(".") if "." in text else text
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa.rstrip('0').rstrip('.')}e{int(exponent)}"


def seconds(value: float, digits: int = 3) -> str:
    """A time with its unit: ``3.1 s``, ``4 ms``, ``25 µs``."""
    if not math.isfinite(value):
        return "–"
    for limit, factor, unit in ((1.0, 1.0, "s"), (1e-3, 1e3, "ms"), (0.0, 1e6, "µs")):
        if abs(value) >= limit * (1.0 - 1e-12) and (value != 0.0 or unit == "µs"):
            return f"{short(value * factor, digits)} {unit}"
    return f"{value:g} s"


def percent(fraction: float) -> str:
    """A fraction as per cent with two significant digits."""
    if not math.isfinite(fraction):
        return "–"
    return f"{float(f'{100.0 * fraction:.2g}'):g} %"


def cell(value: Any) -> str:
    """The text of a table's cell."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return short(value) if isinstance(value, float) else str(value)
