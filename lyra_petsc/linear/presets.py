"""Named linear solvers, each a set of PETSc options, and which one a problem starts with.

``-pc_type`` on the command line replaces them. When a preset breaks down, the next takes over.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from petsc4py import PETSc

from lyra_petsc.linear.petsc_options import Value, is_set

PYTHON_TYPE = "lyra_petsc.linear.vcycle.VCycle"
"""Our V cycle as ``-pc_python_type`` wants it."""

_CYCLE: dict[str, Value] = {
    "ksp_type": "cg",
    "ksp_max_it": 300,
    "pc_type": "python",
    "pc_python_type": PYTHON_TYPE,
    "mg_coarse_pc_type": "redundant",
    "mg_coarse_redundant_pc_type": "cholesky",
}

PRESETS: dict[str, dict[str, Value]] = {
    # for equilibria, where bending is a millionth of the membrane, and steps of stiff sheets. The last four
    # have all pivots counted, leave out scaling and pivoting (an indefinite matrix is given up anyway) and
    # order by minimum degree. The factors are of the regularised Hessian where the exact one is indefinite;
    # where they are too unlike, more regularisation costs less than more iterations
    "direct": {
        "ksp_type": "cg",
        "ksp_max_it": 50,
        "pc_type": "cholesky",
        "pc_factor_mat_solver_type": "mumps",
        "mat_mumps_icntl_13": 1,
        "mat_mumps_icntl_8": 0,
        "mat_mumps_cntl_1": 0.0,
        "mat_mumps_icntl_7": 6,
    },
    # where PETSc was built without MUMPS; one rank
    "cholesky": {
        "ksp_type": "cg",
        "ksp_max_it": 50,
        "pc_type": "cholesky",
        "pc_factor_mat_ordering_type": "qmd",
    },
    # a fifth of the iterations of block Jacobi for a few times the price; ``stepping.shift`` helps
    "ilu": {"ksp_type": "cg", "pc_type": "ilu"},
    "block-ilu": {"ksp_type": "cg", "pc_type": "bjacobi", "sub_pc_type": "ilu"},
    # always exists for a positive-definite matrix; iterations grow like 1/h
    "block-jacobi": {"ksp_type": "cg", "pc_type": "pbjacobi"},
    # iterations that hardly grow with the mesh. Hundreds of them mean a matrix close to singular, and another
    # one is needed
    "multigrid": _CYCLE,
    # with levels from the second coarser one on visited twice: a sixth more for a cycle, and iterations that
    # do not grow where there are many, by size or stiffness
    "multigrid-w": _CYCLE | {"pc_mg_w_from": 2},
    # symmetric sweeps instead of PETSc's Chebyshev default, whose bounds age within a step. No
    # rigid-body modes: held vertices are aggregates of their own, on which six modes are dependent
    "gamg": {
        "ksp_type": "cg",
        "pc_type": "gamg",
        "mg_levels_ksp_type": "richardson",
        "mg_levels_pc_type": "sor",
    },
}

BETWEEN_RANKS: dict[str, dict[str, Value]] = {
    # sweeps are Jacobi's between ranks: undamped they diverge where each has but a few vertices
    "gamg": {"mg_levels_ksp_richardson_scale": 0.5},
}
"""What a preset needs besides on more than one rank."""

WITH_CHOSEN: dict[str, dict[str, Value]] = {
    # the kind that is symmetric, without which conjugate gradients hardly converge
    "asm": {"pc_asm_type": "basic"},
    "gasm": {"pc_gasm_type": "basic"},
    # else the shell DM of the SNES is asked for fields, which has none
    "fieldsplit": {"pc_fieldsplit_dm_splits": False},
}
"""Further options with a ``-pc_type`` that the user chose."""

CONJUGATE_GRADIENTS = ("cg", "fcg", "pipecg", "groppcg")
"""Krylov methods that only multiply by their operator, and can monitor the true residual."""

INCOMPLETE = ("ilu", "block-ilu")
FACTORISATIONS = ("direct", "cholesky")

MULTIGRID_FROM = {True: 2000, False: 3000}
"""Vertices from which multigrid is tried first; with Newton iterations, and with one linear solve a step."""

BAIJ_PRECONDITIONERS = frozenset({"none", "jacobi", "pbjacobi", "sor", "ilu"})
"""What is built from a matrix of type ``baij``; every other ``-pc_type`` of the user's gets ``aij``."""

READS_DIAGONAL = frozenset({"none", "jacobi", "pbjacobi"})
"""What reads of its matrix no more than the diagonal blocks."""

DIRECT_UNTIL = 30_000
"""Vertices up to which a direct factorisation is used: for equilibria, and where iterations grow too many."""

FACTOR_COST = 200.0, 6.5
"""Iterations of block Jacobi that a factorisation costs: the first plus the second times √vertices.

Measured are 300 to 400 for 1000 to 5000 vertices; a buckling sheet needs more than one for an iteration.
"""

WORTH, WORTH_INCOMPLETE = 4.0, 2.0
"""How many iterations of block Jacobi one of multigrid, or of incomplete factors, is worth at least."""

PRICE, PRICE_INCOMPLETE = 4.0, 2.0
"""How many of them it costs."""

INCOMPLETE_FROM = 1.0
"""Iterations that are expected of block Jacobi (it then takes some thirty) from which a small sheet's Newton
iterations use incomplete factors."""

TWICE_FROM = 300.0
"""Iterations of block Jacobi from which coarser levels are visited twice. With 50,000 vertices that was no
faster up to 600, but iterations of stiff sheets then hardly grow with the mesh."""


def candidates(
    n_vertices: int,
    ranks: int,
    *,
    static: bool = False,
    newton: bool = True,
    iterations: float = 0.0,
    contact: bool = False,
) -> list[str]:
    """Presets to try in order; only ``user`` when the user chose the preconditioner.

    ``newton`` says that a step is more than one linear solve; ``iterations`` is what conjugate gradients
    with block Jacobi are expected to take while there is no ``contact``.
    """
    if is_set("pc_type"):
        return ["user"]
    factors = _factorisations(ranks) if n_vertices <= DIRECT_UNTIL else []
    cycle = "multigrid-w" if static or iterations > TWICE_FROM else "multigrid"
    last = [cycle, "gamg", "block-jacobi"]  # where nothing else is known to be better
    if static:
        return [*factors, *last]
    if n_vertices > DIRECT_UNTIL:
        return last
    # what matrices of one rank can, those for several cannot
    several = ranks > 1 or PETSc.Options().getString("mat_type", "").startswith("mpi")
    incomplete = "block-ilu" if several else "ilu"
    small = n_vertices < MULTIGRID_FROM[newton]
    if iterations > _factor_cost(n_vertices) * (WORTH_INCOMPLETE if small else WORTH):
        return [*factors, *last]
    if not small:
        return [cycle, *factors, incomplete, "gamg", "block-jacobi"]
    if newton and iterations <= INCOMPLETE_FROM and not contact:
        return ["block-jacobi", *factors, *last[:-1]]
    return [incomplete, *factors, "block-jacobi", *last[:-1]]


def _factorisations(ranks: int) -> list[str]:
    """Those that this PETSc has."""
    if PETSc.Sys.hasExternalPackage("mumps"):
        return ["direct"]
    return ["cholesky"] if ranks == 1 else []


def break_even_iterations(n_vertices: int, presets: Sequence[str]) -> float:
    """Linear iterations per Newton iteration from which the factorisation that is next pays."""
    if len(presets) > 1 and presets[1] in FACTORISATIONS:
        prices = {"block-jacobi": 1.0} | dict.fromkeys(INCOMPLETE, PRICE_INCOMPLETE)
        return _factor_cost(n_vertices) / prices.get(presets[0], PRICE)
    return math.inf


def _factor_cost(n_vertices: int) -> float:
    """Iterations of conjugate gradients with block Jacobi that cost as much as a factorisation."""
    first, more = FACTOR_COST
    return first + more * math.sqrt(n_vertices)


def options_of(name: str, ranks: int) -> dict[str, Value]:
    """The options of a preset; ``user`` adds what goes with the ``-pc_type`` that was chosen."""
    if name != "user":
        return PRESETS[name] | (BETWEEN_RANKS.get(name, {}) if ranks > 1 else {})
    chosen = PETSc.Options().getString("pc_type", "")
    if chosen in ("lu", "cholesky") and not is_set("mat_type"):
        return PRESETS[next(iter(_factorisations(ranks)), "cholesky")] | {"pc_type": chosen}
    if chosen == PETSc.PC.Type.MG:  # which means our cycle
        return PRESETS["multigrid"]
    for preset in ("block-jacobi", "gamg", "multigrid"):
        if PRESETS[preset]["pc_type"] == chosen:
            return options_of(preset, ranks)
    return {"ksp_type": "cg"} | WITH_CHOSEN.get(chosen, {})


def matrix_type(preset: str) -> str:
    """PETSc matrix type that a preset's preconditioner is built from, without ``-mat_type``."""
    blocks = PETSc.Options().getString("pc_type", "") in BAIJ_PRECONDITIONERS or preset == "block-ilu"
    return "baij" if blocks else "aij"
