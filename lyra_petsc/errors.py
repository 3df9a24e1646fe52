"""The exceptions that end a run early, and the exit code of each.

All modules raise these exceptions and none prints or exits by itself; ``cli`` turns an exception
into one line on rank 0 and the exit code.
"""

from __future__ import annotations

import difflib
import re
import signal
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

LONGEST_WORD = 250
"""Length from which messages shorten a word without spaces; paths and keys are shorter."""


def shorten_words(text: str) -> str:
    """``text`` with words of at least `LONGEST_WORD` characters shortened."""
    return re.sub(rf"\S{{{LONGEST_WORD},}}", lambda word: word[0][:57] + "...", text)


class LyraError(Exception):
    """Base of all errors that a user sees as one line instead of a traceback."""

    exit_code = 1
    details: tuple[str, ...] = ()
    """Further lines for the user, below the message."""

    def _render_traceback_(self) -> list[str]:
        """The lines that IPython and Jupyter show instead of the traceback."""
        return [f"{type(self).__name__}: {self}", *(f"  {detail}" for detail in self.details)]


class InputError(LyraError):
    """Bad input: a file, a key or an option that cannot be used (exit 2).

    Parameters
    ----------
    message : str
        One line that says what is wrong and what is allowed.
    file : str, optional
        The file with the mistake.
    key : str, optional
        The wrong key (dotted path, e.g. ``handles[1].group``) or option.
    """

    exit_code = 2

    def __init__(self, message: str, *, file: object | None = None, key: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.file = None if file is None else str(file)
        self.key = key

    def __str__(self) -> str:
        where = ": ".join(part for part in (self.file, self.key) if part)
        return shorten_words(f"{where}: {self.message}" if where else self.message)

    def __reduce__(self) -> tuple[object, ...]:
        # rank 0 broadcasts errors to all ranks: pickle must keep the keyword arguments
        return (_rebuild_input_error, (self.message, self.file, self.key))


class MarkedError(InputError):
    """Bad input at places that a picture can show.

    Attributes
    ----------
    places : object
        What `show` needs to draw them.
    """

    def __init__(
        self, message: str, places: object, *, file: object | None = None, key: str | None = None
    ) -> None:
        super().__init__(message, file=file, key=key)
        self.places = places

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild_marked_error, (self.message, self.places, self.file, self.key)


def _rebuild_marked_error(message: str, places: object, file: str | None, key: str | None) -> MarkedError:
    return MarkedError(message, places, file=file, key=key)


def _rebuild_input_error(message: str, file: str | None, key: str | None) -> InputError:
    return InputError(message, file=file, key=key)


class SolverError(LyraError):
    """The solver failed; the last accepted state is on disk (exit 3).

    ``collective`` is true if all ranks raise the error together, so that they can still write the state.
    """

    exit_code = 3

    def __init__(self, message: str, *, collective: bool = False, details: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.collective = collective
        self.details = details


class OutputError(LyraError):
    """A result could not be written (disk full, no permission); announced states are kept (exit 3)."""

    exit_code = 3


class Interrupted(LyraError):
    """A signal stopped the program; a run has first finished its step and written a checkpoint.

    Parameters
    ----------
    suffix : str
        Text after the signal's name: the work that is done, and how to resume.
    signal_number : int
    prefix : str
        Text before the signal's name.
    """

    def __init__(self, suffix: str, signal_number: int, prefix: str = "stopped by") -> None:
        super().__init__(f"{prefix} {signal.Signals(signal_number).name}{suffix}")
        self.signal_number = signal_number
        self.exit_code = 130 if signal_number == signal.SIGINT else 143
        self._arguments = suffix, signal_number, prefix

    def __reduce__(self) -> tuple[object, ...]:
        return Interrupted, self._arguments


_FLAGS = {"force", "resume", "sheet", "handles", "wind", "cells"}
_OPTION = re.compile(r"--([a-z]+)\b")


def _replace_options(text: str) -> str:
    return _OPTION.sub(lambda option: f"{option[1]}={'True' * (option[1] in _FLAGS)}", text)


@contextmanager
def python_argument_names() -> Iterator[None]:
    """A context in which errors name Python arguments (``force=True``) instead of options (``--force``)."""
    try:
        yield
    except LyraError as error:
        error.args = tuple(_replace_options(arg) if isinstance(arg, str) else arg for arg in error.args)
        error.details = tuple(map(_replace_options, error.details))
        if isinstance(error, InputError):
            error.message = _replace_options(error.message)
            error.key = None if error.key is None else error.key.removeprefix("--")
        raise


def suggest(word: str, known: Iterable[str]) -> str:
    """``did you mean 'x'?`` with the name in ``known`` that is most similar to ``word``, else all names."""
    names = sorted(known)
    by_lower = {name.lower(): name for name in names}
    match = difflib.get_close_matches(word.lower(), list(by_lower), n=1, cutoff=0.6)
    if match:
        return f"did you mean {by_lower[match[0]]!r}?"
    return f"known: {', '.join(names)}" if names else "none are known"
