"""Helper of scripts/environment.sh that examines a Python environment.

``probe [DIR…]``
    Checks that this interpreter, with DIR… added to its path, finds petsc4py and mpi4py, and
    prints one fact a line: executable, Python version, petsc4py version, the owner of the packages
    (``distribution`` or ``environment``), then the folders that hold them.  Exit code 3 if not.
``missing PYPROJECT EXTRA…``
    Prints the requirements of the project and of the extras that this interpreter does not meet.
``layer PYTHON_OF_VENV DIR…``
    Makes the packages in DIR… visible in the virtual environment, below its own, and prints the
    constraints with which pip does not replace them (``constraints`` prints those of this interpreter).

Uses the standard library of Python 3.8 only, as it runs in any interpreter that is found.
"""

import importlib.metadata
import importlib.util
import os
import re
import subprocess
import sys
import sysconfig

# packages that pip must not replace: they are built for one MPI, one PETSc and one NumPy
PINNED = ("numpy", "mpi4py", "petsc4py", "h5py", "gmsh")

# packages whose modules have other names (apart from a dash, which becomes an underscore)
MODULES = {"pillow": "PIL", "usd-core": "pxr", "mkdocs-material": "material"}


def package_folders():
    """The folders of ``sys.path`` that hold installed packages, in their order."""
    standard = {os.path.realpath(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib")}
    standard |= {os.path.join(folder, "lib-dynload") for folder in standard}
    scripts = os.path.dirname(os.path.abspath(__file__))
    own = {scripts, os.path.dirname(scripts)}
    seen = []
    for folder in sys.path:
        if not os.path.isdir(folder) or os.path.realpath(folder) in standard | own:
            continue
        if folder not in seen:
            seen.append(folder)
    return seen


def version_of(package):
    """Installed version of ``package``, or ``None`` without metadata."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def probe(added):
    sys.path.extend(added)
    specs = [importlib.util.find_spec(name) for name in ("petsc4py", "mpi4py")]
    if None in specs:
        return 3
    folders, owner = package_folders(), "environment"
    home = os.path.realpath(os.path.dirname(os.path.dirname(specs[0].origin)))
    if sys.prefix == "/usr" and home.startswith("/usr/lib/"):
        # the distribution's own: leave out ~/.local and /usr/local, where a NumPy 2 or a serial
        # h5py installed for other work would hide the builds that petsc4py was compiled against
        folders = [folder for folder in folders if os.path.realpath(folder).startswith("/usr/lib/")]
        owner = "distribution"
    version = version_of("petsc4py") or getattr(importlib.import_module("petsc4py"), "__version__", "0")
    print(sys.executable, sysconfig.get_python_version(), version, owner, *folders, sep="\n")
    return 0


def requirements(pyproject, extras):
    """Requirement lines of the project and its extras."""
    try:
        import tomllib
    except ImportError:  # Python 3.10
        from pip._vendor import tomli as tomllib
    with open(pyproject, "rb") as file:
        project = tomllib.load(file)["project"]
    lines = list(project["dependencies"])
    for extra in extras:
        lines += project["optional-dependencies"][extra]
    return lines


def numbers(version):
    """``"1.24.2"`` as ``(1, 24, 2)``."""
    return tuple(int(part) for part in re.findall(r"\d+", version.split("+")[0])[:3])


def is_met(line):
    """Whether the requirement ``name>=version`` is met here."""
    match = re.fullmatch(r"([A-Za-z0-9._-]+)>=([0-9.]+)", line.replace(" ", ""))
    if match is None:
        raise SystemExit(f"environment.py: only name>=version is understood, not {line!r}")
    name, least = match.groups()
    try:
        if importlib.util.find_spec(MODULES.get(name, name.replace("-", "_"))) is None:
            return False
    except ImportError:  # the parent of a dotted name
        return False
    present = version_of(name)
    if present is None:
        # no metadata: Debian's h5py and gmsh; other packages are remains of an interrupted installation
        return name in PINNED
    return numbers(present) >= numbers(least)


def layer(python, folders):
    site = subprocess.check_output(
        [python, "-Ic", "import sysconfig; print(sysconfig.get_path('purelib'))"], text=True
    ).strip()
    with open(os.path.join(site, "lyra-petsc-stack.pth"), "w", encoding="ascii") as file:
        for folder in folders:  # !a, as a .pth file is read in the locale's encoding
            file.write(f"import site; site.addsitedir({folder!a})\n")
    # run in the new environment, which sees the layers as pip does
    sys.stdout.write(
        subprocess.check_output([python, "-IB", os.path.abspath(__file__), "constraints"], text=True)
    )
    return 0


def main(arguments):
    verb, *rest = arguments
    if verb == "probe":
        return probe(rest)
    if verb == "missing":
        for line in requirements(rest[0], rest[1:]):
            if not is_met(line):
                print(line)
        return 0
    if verb == "constraints":
        for name in PINNED:
            if version_of(name) is not None:
                print(f"{name}=={version_of(name)}")
        return 0
    if verb == "layer":
        return layer(rest[0], rest[1:])
    raise SystemExit(__doc__)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
