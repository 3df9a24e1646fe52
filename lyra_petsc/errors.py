"""The few ways in which a run ends early, and the exit code of each.

Every module raises one of these and nothing prints or exits by itself; ``cli`` turns
them into one line on rank 0 and the exit code.
"""

from __future__ import annotations

import difflib
import re
import signal
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

LONGEST_WORD = 250
"""Characters that messages quote of what has no spaces: more than paths and keys have."""


def with_short_words(text: str) -> str:
    """``text`` with its longest words cut short."""
    return re.sub(rf"\S{{{LONGEST_WORD},}}", lambda word: word[0][:57] + "...", text)


class LyraError(Exception):
    """Base of everything a user may see as one line."""

    exit_code = 1
    details: tuple[str, ...] = ()
    """Further lines for the user, below the one that says it."""

    def _render_traceback_(self) -> list[str]:
        """What IPython and Jupyter show instead of the whole traceback."""
        return [f"{type(self).__name__}: {self}", *(f"  {detail}" for detail in self.details)]


class InputError(LyraError):
    """Bad input: a file, a key or an option that cannot be used (exit 2).

    Parameters
    ----------
    message : str
        What is wrong and what is allowed, in one line.
    file : str, optional
        The file in which the mistake stands.
    key : str, optional
        The key (dotted path, e.g. ``handles[1].group``) or option in question.
    """

    exit_code = 2

    def __init__(self, message: str, *, file: object | None = None, key: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.file = None if file is None else str(file)
        self.key = key

    def __str__(self) -> str:
        where = ": ".join(part for part in (self.file, self.key) if part)
        return with_short_words(f"{where}: {self.message}" if where else self.message)

    def __reduce__(self) -> tuple[object, ...]:
        # broadcast from rank 0 to all: pickle must keep the keywords
        return (_rebuild_input_error, (self.message, self.file, self.key))


def _rebuild_input_error(message: str, file: str | None, key: str | None) -> InputError:
    return InputError(message, file=file, key=key)


class SolverError(LyraError):
    """The solver could not go on; the last good state is on disk (exit 3).

    ``collective`` is true where all ranks raise it together, so that the state can still be written.
    """

    exit_code = 3

    def __init__(self, message: str, *, collective: bool = False, details: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.collective = collective
        self.details = details


class OutputError(LyraError):
    """A result could not be written (disk full, no permission); what was announced stands (exit 3)."""

    exit_code = 3


class Interrupted(LyraError):
    """A signal asked the program to stop; a run has finished its step and written a checkpoint.

    Parameters
    ----------
    told : str
        After the signal's name: what has been done, and how to go on.
    signal_number : int
    how : str
        Before the name.
    """

    def __init__(self, told: str, signal_number: int, how: str = "stopped by") -> None:
        super().__init__(f"{how} {signal.Signals(signal_number).name}{told}")
        self.signal_number = signal_number
        self.exit_code = 130 if signal_number == signal.SIGINT else 143
        self._given = told, signal_number, how

    def __reduce__(self) -> tuple[object, ...]:
        return Interrupted, self._given


_FLAGS = {"force", "resume", "sheet", "handles", "wind", "cells"}
_COMMAND = re.compile(r"--([a-z]+)\b")


def _words(text: str) -> str:
    return _COMMAND.sub(lambda found: f"{found[1]}={'True' * (found[1] in _FLAGS)}", text)


@contextmanager
def in_python() -> Iterator[None]:
    """A context in which errors name Python's arguments (``force=True``), not options (``--force``)."""
    try:
        yield
    except LyraError as error:
        error.args = tuple(_words(part) if isinstance(part, str) else part for part in error.args)
        error.details = tuple(map(_words, error.details))
        if isinstance(error, InputError):
            error.message = _words(error.message)
            error.key = None if error.key is None else error.key.removeprefix("--")
        raise


def nearest(word: str, known: Iterable[str]) -> str:
    """``did you mean 'x'?`` for the nearest of ``known``, else the list of them all."""
    names = sorted(known)
    by_lower = {name.lower(): name for name in names}
    match = difflib.get_close_matches(word.lower(), list(by_lower), n=1, cutoff=0.6)
    if match:
        return f"did you mean {by_lower[match[0]]!r}?"
    return f"known: {', '.join(names)}" if names else "none are known"
