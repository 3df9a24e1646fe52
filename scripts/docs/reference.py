"""Writes docs/reference/ from the program itself: keys of a scene, PETSc options, commands, recovery.

``python scripts/docs/reference.py`` after a change of these; tests/docs/test_reference.py says when.
"""

from __future__ import annotations

import math
import re
import typing
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import click
from pydantic_core import PydanticUndefined

from lyra_petsc.cli.verbs import verbs
from lyra_petsc.linear.petsc_options import Value
from lyra_petsc.linear.presets import DIRECT_UNTIL, PRESETS
from lyra_petsc.scene.block import Block, attributes, summary
from lyra_petsc.scene.materials.library import ClothTable, library_entries, material_names
from lyra_petsc.scene.schema import FIELDS, Scene
from lyra_petsc.stepping.recovery import STRATEGIES

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "reference"
MADE = "<!-- made by scripts/docs/reference.py; change the program, not this page -->"

OPTIONS = {
    "ts_dt": "Δt [s] instead of `time.step`; with `step: auto` the first step.",
    "ts_time_step": "The same: its name from PETSc 3.25 on.",
    "ts_max_time": "End [s] instead of `time.end`.",
    "ts_max_steps": "Steps after which the run ends.",
    "ts_adapt_dt_min": "Smallest Δt [s] of adaptive and of repeated steps.",
    "ts_adapt_dt_max": "Largest Δt [s] of adaptive steps; static: largest increment of the load factor.",
    "ts_alpha_radius": "Spectral radius of `alpha2` instead of `time.spectral_radius`.",
    "ts_type": "Integrator instead of `time.integrator`: `beuler`, `theta`, `bdf`, `alpha2`.",
    "ts_theta_theta": "With `-ts_type theta`: 0.5 is `midpoint`, 1 is `beuler`.",
    "ts_bdf_order": "With `-ts_type bdf`: 2.",
    "ts_adapt_type": "`none`: fixed steps; `basic`: steps by `time.tolerance` (1e-3).",
    "ts_theta_endpoint": "Refused: it has no meaning for the stage equations.",
    "tao_type": "Method of `fit`: `brgn` (default), or a gradient method such as `blmvm`.",
    "tao_brgn_regularizer_weight": "With `brgn`: 0 if the data determine all parameters.",
    "vec_type": "Type of every vector.",
    "ts_init_time": "Refused: a run begins at 0.",
    "snes_type": "`newtonls`, or `ksponly`: one linear solve per step.",
    "snes_max_it": "Newton iterations of a step instead of `solver.max_iterations`.",
    "snes_rtol": "Relative residual at which iterations stop before `solver` is satisfied; off by default.",
    "snes_atol": "Residual [N] at which iterations stop; steps above `solver.force_tolerance` fail.",
    "snes_stol": "Relative increment at which iterations stop, likewise.",
    "snes_convergence_test": "Refused: `solver` has the tolerances.",
    "ksp_rtol": "Relative tolerance of linear solves; by default 1e-2, and down to 1e-6 if Newton's method "
    "converges slowly; `semi-implicit`: 1e-6.",
    "ksp_max_it": "Iterations of a linear solve (5000).",
    "ksp_type": "Krylov method (`cg`: the systems are symmetric).",
    "ksp_norm_type": "Norm in which a linear solve converges (`unpreconditioned` for methods that can).",
    "pc_type": "Preconditioner, instead of the named linear solvers below; no other one replaces it.",
    "pc_python_type": "Class of `-pc_type python`; by default the program's multigrid.",
    "pc_mg_w_from": "First of three levels of multigrid that are visited twice in a cycle (1: the next "
    "coarser than the mesh; default: none).",
    "pc_mg_vertex_sweeps": "Sweeps of multigrid over the vertices before and after the coarser levels, if "
    "edges have unknowns (by default 1 to 3, increasing with the ratio of bending stiffness to inertia).",
    "pc_mg_levels": "Maximum number of levels of multigrid.",
    "sub_pc_type": "Preconditioner of each rank's block with `-pc_type bjacobi` (`ilu`).",
    "mat_type": "Type of the operator and of the preconditioner's matrix: `aij`, `baij`, `sbaij`. By default "
    "the operator multiplies by the program's block rows (`python`), and the preconditioner determines the "
    "type of its matrix.",
    "loads_ksp_rtol": "Relative tolerance (1e-3) of the KSP with the prefix `-loads_`, which solves with the "
    "skew stiffness of pressures in equilibria.",
    "mg_coarse_mat_type": "Type of the matrix of multigrid's coarsest level (`aij`).",
    "snes_lag_preconditioner": "Number of linear systems for which a preconditioner is used; by default "
    "`semi-implicit` decides by the number of iterations.",
    "contact_monitor": "Print contacts, smallest gap, stiffest contact, step limit and friction at each "
    "Newton iterate.",
    "mat_partitioning_type": "Partitioner of the mesh: `ptscotch`, `parmetis`, …, if PETSc has it, else "
    "`average`; with `contact` by default bisection of space.",
}
"""Descriptions of the options that the program reads, sets or refuses."""

_READ = re.compile(
    r"(?:is_set|petsc_number|hasName|getString|getReal|getInt|getBool)\(\s*\"(\w+)\"|\"(ts_(?:theta_\w+|dt|time_step))\""
)

_PLAIN = {
    "str": "text",
    "float": "number",
    "int": "whole number",
    "bool": "true or false",
    "dict": "by name:",
    "(3,)": "three numbers",
    "Path": "path",
    "tuple": "list",
}
"""Python values as they are written in a scene."""

_DEFAULTS = {
    ("Time", "end"): "required; static: 1",
    ("Time", "step"): "required; static: 0.25",
    ("Time", "integrator"): "beuler",
    ("Time", "tolerance"): "1e-3",
    ("Time", "spectral_radius"): "0.5",
    ("Handle", "until"): "end",
    ("AppliedLoad", "until"): "end",
}
"""Defaults that depend on other keys."""


def options_read() -> set[str]:
    """Names of the PETSc options that the program itself reads."""
    names = set()
    for path in (ROOT / "lyra_petsc").rglob("*.py"):
        for match in _READ.finditer(path.read_text(encoding="utf-8")):
            names.add(match[1] or match[2])
    return names


# -- scene -------------------------------------------------------------------------------------------


def scene_page() -> str:
    """The page of all keys of a scene."""
    parts = [
        "# Keys of a scene",
        MADE,
        "SI units. A key that is left out has its default, or its term is off; an empty key counts as left "
        "out. Unknown keys are refused. `lyra-petsc check --schema` prints the same for editors "
        "([how](../howto/editor.md)), `--set KEY.PATH=VALUE` changes a key for one run.",
        *(_block_section(block, where) for block, where in _blocks()),
        "## Names of `material.cloth`",
        "Cloths, most of them measured by Wang, O'Brien and Ramamoorthi (2011): "
        + _listed(name for name in material_names() if isinstance(library_entries()[name], ClothTable))
        + ".\n\nEngineering materials: "
        + _listed(name for name in material_names() if not isinstance(library_entries()[name], ClothTable))
        + ".\n\nTheir numbers are in `lyra_petsc/scene/materials/`.",
        "## Names of `output.fields`",
        _listed(FIELDS) + ".",
    ]
    return "\n\n".join(parts) + "\n"


def _listed(words: Iterable[str]) -> str:
    return ", ".join(f"`{word}`" for word in words)


def _blocks() -> Iterator[tuple[type[Block], list[str]]]:
    """The blocks of a scene in the order of their first use, with the keys that hold them."""
    places: dict[type[Block], list[str]] = {Scene: []}
    waiting = [Scene]
    while waiting:
        block = waiting.pop(0)
        for name, field in block.model_fields.items():
            for inner in _blocks_in(field.annotation):
                above = places[block][:1]
                path = ".".join([*above, field.alias or name])
                if inner not in places:
                    waiting.append(inner)
                places.setdefault(inner, []).append(path)
    yield from places.items()


def _blocks_in(annotation: Any) -> list[type[Block]]:
    if isinstance(annotation, type) and issubclass(annotation, Block):
        return [annotation]
    return [block for part in typing.get_args(annotation) for block in _blocks_in(part)]


def _block_section(block: type[Block], where: list[str]) -> str:
    title = "The scene" if block is Scene else ", ".join(f"`{path}`" for path in where)
    said = attributes(block)
    rows = ["| key | value | default | |", "| --- | --- | --- | --- |"]
    for name, field in block.model_fields.items():
        entry = said[name]
        default = _DEFAULTS.get((block.__name__, name)) or _default(field)
        cells = [f"`{field.alias or name}`", _kind(entry.kind, field.annotation), default, entry.text]
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    words = "" if block is Scene else f"{summary(block)}{_further(block)}\n\n"
    return f"## {title}\n\n{words}" + "\n".join(rows)


def _further(block: type[Block]) -> str:
    """The second paragraph of a block's docstring, if it is not the list of attributes."""
    paragraphs = (block.__doc__ or "").split("\n\n")[1:]
    more = [" ".join(p.split()) for p in paragraphs if "Attributes\n" not in p and p.strip()]
    return " " + more[0] if more else ""


def _kind(kind: str, annotation: Any) -> str:
    text, bracket, unit = kind.removesuffix(" or None").partition(" [")
    words = [value for value in _literals(annotation) if value != "auto"]
    if words and text == "str":
        return "one of " + ", ".join(f"`{word}`" for word in words)
    blocks = {block.__name__ for block in _blocks_in(annotation)}
    plain = [_PLAIN.get(word, "block" if word in blocks else word) for word in text.split(" ")]
    return (
        " ".join(plain).replace("by name: of", "by name:").replace("of block", "of blocks") + bracket + unit
    )


def _literals(annotation: Any) -> list[str]:
    if typing.get_origin(annotation) is typing.Literal:
        return list(typing.get_args(annotation))
    return [word for part in typing.get_args(annotation) for word in _literals(part)]


def _default(field: Any) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if value in (None, PydanticUndefined, math.inf, "", [], {}) or isinstance(value, Block):
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple):
        return "[" + ", ".join(f"{entry:g}" if isinstance(entry, float) else entry for entry in value) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)


# -- PETSc -------------------------------------------------------------------------------------------


def petsc_page() -> str:
    """The page of PETSc options that the program reads, sets or refuses, and of its linear solvers."""
    rows = ["| option | |", "| --- | --- |", *(f"| `-{name}` | {text} |" for name, text in OPTIONS.items())]
    presets = ["| name | options |", "| --- | --- |"]
    presets += [f"| `{name}` | `{_words(options)}` |" for name, options in PRESETS.items()]
    parts = [
        "# PETSc options",
        MADE,
        "Every option of PETSc's TS, SNES, KSP, PC, Mat and Vec has its usual name, without a prefix: "
        "`-ksp_monitor`, `-snes_view`, `-log_view`. Later ones override earlier ones in: the program's "
        "defaults, the scene's `petsc:` block, `~/.petscrc`, the file of `--petscrc`, `PETSC_OPTIONS`, the "
        "command line. `lyra-petsc run SCENE -help` lists all options of PETSc. A note before the first "
        "step, and in `check`, names options that PETSc does not have, with the nearest name; a warning at "
        "the end names unused options.",
        "The program itself reads, sets or refuses these:",
        "\n".join(rows),
        "## Named linear solvers",
        "Without `-pc_type` the program chooses one of these by the size of the mesh and the expected and "
        f"observed numbers of iterations; factorisations up to {DIRECT_UNTIL} vertices. If one breaks "
        "down, the next one replaces it ([details](../newton.md)).",
        "\n".join(presets),
    ]
    return "\n\n".join(parts) + "\n"


def _words(options: dict[str, Value]) -> str:
    return " ".join(f"-{name}" if value is True else f"-{name} {value}" for name, value in options.items())


# -- commands ----------------------------------------------------------------------------------------


def commands_page() -> str:
    """The page of the help texts of all verbs."""
    parts = [
        "# Commands",
        MADE,
        "`mpirun -n P lyra-petsc VERB [ARGUMENTS] [--our options] [-petsc options]`; in a checkout also "
        "`bash scripts/lyra.sh VERB …` or `.venv/bin/python -m lyra_petsc VERB …`. Options with two dashes "
        "are ours, those with one go to PETSc.",
    ]
    for name in sorted(verbs.commands):
        command = verbs.commands[name]
        context = click.Context(
            command, info_name=f"lyra-petsc {name}", terminal_width=100, max_content_width=100
        )
        parts.append(f"## `{name}`\n\n```text\n{command.get_help(context)}\n```")
    return "\n\n".join(parts) + "\n"


def recovery_page() -> str:
    """The page of the ways in which a step that is not accepted is repeated."""
    rows = ["| an attempt at a step is repeated because | with | if |", "| --- | --- | --- |"]
    rows += [
        f"| {', or '.join(trouble.value for trouble in strategy.troubles)} | {strategy.name} "
        f"| {strategy.condition} |"
        for strategy in STRATEGIES
    ]
    parts = [
        "# Steps that are repeated",
        MADE,
        "A failed attempt changes no state. The first line that applies is taken; where none does, the run "
        "ends with exit code 3 and the state before the step. Each attempt counts as `rejected`. See "
        "[time steps](../time.md) for the error and the energy of a step, [failure](../failure.md) for what "
        "is reported.",
        "\n".join(rows),
    ]
    return "\n\n".join(parts) + "\n"


PAGES = {
    "scene.md": scene_page,
    "petsc.md": petsc_page,
    "commands.md": commands_page,
    "recovery.md": recovery_page,
}


def main() -> None:
    """Write the pages."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, page in PAGES.items():
        (FOLDER / name).write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
