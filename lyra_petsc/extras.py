"""Optional packages, which reports, comparisons and pictures need."""

from __future__ import annotations

import importlib.util

from lyra_petsc.errors import InputError

PACKAGES = ("matplotlib", "jinja2", "scipy")
"""Packages of the extra ``study``."""


def missing_packages(packages: tuple[str, ...] = PACKAGES) -> list[str]:
    """The names in ``packages`` that cannot be imported."""
    return [name for name in packages if importlib.util.find_spec(name) is None]


def install_hint(names: list[str], extra: str = "study") -> str:
    """One line that names missing packages and the command that installs them."""
    verb = "is" if len(names) == 1 else "are"
    return f"{' and '.join(names)} {verb} not installed; get the extra: pip install 'lyra-petsc[{extra}]'"


def require_packages(verb: str, packages: tuple[str, ...] = PACKAGES, extra: str = "study") -> None:
    """Check that optional packages are installed, before any work begins.

    Parameters
    ----------
    verb : str
        The command that needs the packages.
    packages : tuple of str
        Import names of the packages.
    extra : str
        Name of the extra in pyproject.toml that installs the packages.

    Raises
    ------
    InputError
        If packages are missing; the message says how to install them.
    """
    names = missing_packages(packages)
    if names:
        raise InputError(install_hint(names, extra), key=verb)
