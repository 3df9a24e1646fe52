"""Structure of the package: imports go in one direction, and only the command line prints."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

pytestmark = pytest.mark.quick

PACKAGE = Path(__file__).resolve().parent.parent / "lyra_petsc"

LEVELS = [
    {"arrays", "errors"},
    {"extras", "parallel", "phases"},
    {"startup"},
    {"kernels"},
    {"scene"},
    {"mesh"},
    {"terms"},
    {"linear"},
    {"contact"},
    {"stepping"},
    {"output"},
    {"api"},
    {"show"},
    {"experiments"},
    {"cli"},
    {"__main__"},
]
RANK = {package: level for level, packages in enumerate(LEVELS) for package in packages}
RANK[""] = len(LEVELS)  # the package itself, which exports names

MODULES = sorted(PACKAGE.rglob("*.py"))


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def package_of(module: str) -> str:
    """The subpackage of a module; empty for the package itself."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else ""


def imported(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and name of every imported module of the package, anywhere in the file."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == PACKAGE.name:
                    yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import in line {node.lineno}"
            if node.module and node.module.split(".")[0] == PACKAGE.name:
                for alias in node.names:
                    inner = PACKAGE.parent.joinpath(*node.module.split("."), alias.name)
                    is_module = inner.is_dir() or inner.with_suffix(".py").is_file()
                    yield node.lineno, f"{node.module}.{alias.name}" if is_module else node.module


def upward(tree: ast.AST, name: str) -> list[str]:
    """Imports of a module that violate the order of the packages."""
    wrong = []
    mine = package_of(name)
    for line, other in imported(tree):
        theirs = package_of(other)
        if theirs in ("", mine):
            continue
        if RANK[theirs] >= RANK[mine]:
            wrong.append(f"line {line}: {other}")
    return wrong


def test_imports_go_in_one_direction() -> None:
    for path in MODULES:
        name = module_name(path)
        assert package_of(name) in RANK or name == PACKAGE.name, (
            f"give the package of {name} its place in LEVELS"
        )
        assert upward(parsed(path), name) == [], name


def test_names_of_classes_and_modules_occur_once() -> None:
    """A search for a name leads to one place."""
    names = Counter(path.stem for path in MODULES if path.name != "__init__.py")
    classes = (node.name for path in MODULES for node in parsed(path).body if isinstance(node, ast.ClassDef))
    names.update(classes)
    assert [name for name, count in names.items() if count > 1] == []


OF_CONTACT = {
    "SceneContact", "set_up_terms", "Barrier", "barrier", "RefusedDisplacement", "ContactModel", "NearPair",
    "Overlaps", "behind_wall", "find_overlaps", "PlacedScene", "StartCrossings", "find_start_crossings",
    "have_common_vertex", "self_crossings", "untangle", "crossings_beside_seams",
}  # fmt: skip
"""All that other packages import from `lyra_petsc.contact`."""


def test_contact_is_known_by_few_names_and_six_verbs() -> None:
    names = set()
    for path in MODULES:
        if package_of(module_name(path)) != "contact":
            for node in ast.walk(parsed(path)):
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("lyra_petsc.contact"):
                    names |= {alias.name for alias in node.names}
    assert names == OF_CONTACT
    bodies = (
        node.body
        for node in parsed(PACKAGE / "contact" / "scene_contact.py").body
        if isinstance(node, ast.ClassDef) and node.name == "SceneContact"
    )
    verbs = [
        node.name
        for body in bodies
        for node in body
        if isinstance(node, ast.FunctionDef) and not (node.name.startswith("_") or node.decorator_list)
    ]
    assert sorted(verbs) == ["begin", "finish", "follow", "limit", "report", "update"]


def test_only_the_command_line_prints() -> None:
    for path in MODULES:
        if package_of(module_name(path)) in ("cli", "__main__"):
            continue
        calls = [node for node in ast.walk(parsed(path)) if isinstance(node, ast.Call)]
        lines = [c.lineno for c in calls if isinstance(c.func, ast.Name) and c.func.id == "print"]
        assert lines == [], path


def test_terms_do_not_use_petsc_mpi_or_files() -> None:
    for path in (PACKAGE / "terms").rglob("*.py"):
        names = set()
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                names.add(node.module.split(".")[0])
        assert not names & {"petsc4py", "mpi4py", "h5py", "os", "io", "pathlib"}, path.name


COMPILERS = ("cached", "inner", "inlined", "kernel", "leaf", "njit", "subkernel")


def kernels(tree: ast.AST) -> list[ast.FunctionDef]:
    """Functions that numba compiles."""
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
        and any(ast.unparse(one).partition("(")[0] in COMPILERS for one in node.decorator_list)
    ]


def linear_algebra(kernel: ast.AST) -> list[int]:
    """Lines that numba compiles to calls of the BLAS or LAPACK, which it takes from SciPy."""
    return [
        node.lineno
        for node in ast.walk(kernel)
        if (isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult))
        or (isinstance(node, ast.Attribute) and node.attr in ("dot", "vdot", "linalg"))
    ]


def used_from_elsewhere(path: Path) -> list[str]:
    """Names that the kernels of a module use from packages which the digest of its cache does not cover."""
    home = f"{PACKAGE.name}.{package_of(module_name(path))}"
    names = {
        alias.asname or alias.name: node.module
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PACKAGE.name)
        for alias in node.names
    }
    covered = f"{home}.", f"{PACKAGE.name}.kernels."
    elsewhere = {name for name, module in names.items() if not f"{module}.".startswith(covered)}
    nodes = (node for kernel in kernels(parsed(path)) for line in kernel.body for node in ast.walk(line))
    used = {node.id for node in nodes if isinstance(node, ast.Name)}
    return sorted(used & elsewhere)


def test_kernels_are_compiled_anew_if_anything_in_them_changes() -> None:
    for path in MODULES:
        assert used_from_elsewhere(path) == [], path


def test_kernels_need_no_scipy() -> None:
    """SciPy is in an extra; a kernel compiled with it would crash a process without it."""
    count = 0
    for path in MODULES:
        for kernel in kernels(parsed(path)):
            count += 1
            assert linear_algebra(kernel) == [], f"{path}: {kernel.name}"
    assert count > 30
    assert linear_algebra(ast.parse("def f(a):\n    return np.dot(a, a)\n")) == [2]
    assert linear_algebra(ast.parse("a @ b")) == [1]
