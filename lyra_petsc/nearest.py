"""The helpful end of an "unknown name" message."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def nearest(word: str, known: Iterable[str]) -> str:
    """``did you mean 'x'?`` for the nearest of ``known``, else the list of them all."""
    names = sorted(known)
    by_lower = {name.lower(): name for name in names}
    match = difflib.get_close_matches(word.lower(), list(by_lower), n=1, cutoff=0.6)
    if match:
        return f"did you mean {by_lower[match[0]]!r}?"
    return f"known: {', '.join(names)}" if names else "none are known"
