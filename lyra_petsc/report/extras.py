"""The optional packages that reports and comparisons need."""

from __future__ import annotations

import importlib.util

from lyra_petsc.errors import InputError

PACKAGES = ("matplotlib", "jinja2", "scipy")
"""What the extra ``study`` brings."""


def missing(packages: tuple[str, ...] = PACKAGES) -> list[str]:
    """Those of ``packages`` that cannot be imported."""
    return [name for name in packages if importlib.util.find_spec(name) is None]


def remedy(names: list[str]) -> str:
    """One line: what is missing, and how to get it."""
    verb = "is" if len(names) == 1 else "are"
    return f"{' and '.join(names)} {verb} not installed; get the extra: pip install 'lyra-petsc[study]'"


def require(what: str, packages: tuple[str, ...] = PACKAGES) -> None:
    """Check that the extra ``study`` is installed, before anything runs.

    Parameters
    ----------
    what : str
        The verb that needs it.

    Raises
    ------
    InputError
        Naming what is missing and how to get it.
    """
    names = missing(packages)
    if names:
        raise InputError(remedy(names), key=what)
