"""The optional packages that reports, comparisons and pictures need."""

from __future__ import annotations

import importlib.util

from lyra_petsc.errors import InputError

PACKAGES = ("matplotlib", "jinja2", "scipy")
"""What the extra ``study`` brings."""


def missing(packages: tuple[str, ...] = PACKAGES) -> list[str]:
    """Those of ``packages`` that cannot be imported."""
    return [name for name in packages if importlib.util.find_spec(name) is None]


def remedy(names: list[str], extra: str = "study") -> str:
    """One line: what is missing, and how to get it."""
    verb = "is" if len(names) == 1 else "are"
    return f"{' and '.join(names)} {verb} not installed; get the extra: pip install 'lyra-petsc[{extra}]'"


def require(what: str, packages: tuple[str, ...] = PACKAGES, extra: str = "study") -> None:
    """Check that the packages of an extra are installed, before anything runs.

    Parameters
    ----------
    what : str
        The verb that needs them.
    packages : tuple of str
        Their names in Python.
    extra : str
        Its name in pyproject.toml.

    Raises
    ------
    InputError
        Naming what is missing and how to get it.
    """
    names = missing(packages)
    if names:
        raise InputError(remedy(names, extra), key=what)
