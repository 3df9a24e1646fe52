"""Environments with fake packages, for scripts that look for packages."""

from __future__ import annotations

import os
import subprocess
import sys
import venv
from pathlib import Path

from patience import run_program

ROOT = Path(__file__).parents[2]
NEEDED = {
    "numpy": "1.26.0",
    "numba": "0.60.0",
    "pydantic": "2.9",
    "ruamel.yaml": "0.18.6",
    "click": "8.1.7",
    "rich": "13.9",
    "h5py": "3.11",
    "gmsh": "4.12",
    "mpi4py": "4.0.0",
    "petsc4py": "3.20.1",
    "matplotlib": "3.9",
    "jinja2": "3.1.4",
    "scipy": "1.14",
}
"""Packages that the program and its studies need."""
YIELD = "OMPI_MCA_mpi_yield_when_idle"
MODULES = {"pillow": "PIL", "usd-core": "pxr"}


def site_packages(environment: Path) -> Path:
    return environment / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"


def put(environment: Path, name: str, version: str) -> None:
    """Create a package: an empty module and its metadata."""
    site = site_packages(environment)
    module = site.joinpath(*MODULES.get(name, name.replace("-", "_")).split("."))
    module.mkdir(parents=True)
    (module / "__init__.py").write_text(f"__version__ = {version!r}\n")
    metadata = site / f"{name.replace('-', '_')}-{version}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")


def make(folder: Path) -> None:
    """Create an environment with all necessary packages, and a launcher that prints its arguments."""
    venv.create(folder, symlinks=True)
    for name, version in NEEDED.items():
        put(folder, name, version)
    launcher = folder / "bin" / "mpirun"
    launcher.write_text('#!/bin/sh\necho "launched in $PWD: $*"\nexit "${LAUNCHER_EXIT:-0}"\n')
    launcher.chmod(0o755)


def surroundings(folder: Path) -> dict[str, str]:
    """Environment variables without those about the present environment; nothing is downloaded."""
    names = ("PYTHON", "RANKS", "MPIRUN", "PYTHONPATH", "VIRTUAL_ENV", "PYTHONHOME", YIELD)
    clean = {name: value for name, value in os.environ.items() if name not in names}
    return {**clean, "LYRA_VENV": str(folder / "laid over"), "PIP_NO_INDEX": "1"}


def call(script: str, *arguments: str, cwd: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a script of the repository."""
    return run_program(
        ["bash", str(ROOT / "scripts" / script), *arguments],
        cwd=cwd,
        env=surroundings(cwd) | variables,
        seconds=60,
    )


def activated(environment: Path) -> dict[str, str]:
    return {"PATH": f"{environment / 'bin'}{os.pathsep}{os.environ['PATH']}"}
