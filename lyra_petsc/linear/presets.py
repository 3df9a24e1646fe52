"""Named linear solvers (presets), each a set of PETSc options, and their order for a problem.

``-pc_type`` on the command line replaces them. If a preset fails, the next one takes over.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from petsc4py import PETSc

from lyra_petsc.linear.petsc_options import Value, is_set

PYTHON_TYPE = "lyra_petsc.linear.vcycle.VCycle"
"""The program's V cycle as a value of ``-pc_python_type``."""

_CYCLE: dict[str, Value] = {
    "ksp_type": "cg",
    "ksp_max_it": 300,
    "pc_type": "python",
    "pc_python_type": PYTHON_TYPE,
    "mg_coarse_pc_type": "redundant",
    "mg_coarse_redundant_pc_type": "cholesky",
}

PRESETS: dict[str, dict[str, Value]] = {
    # for equilibria, where bending is a millionth of the membrane stiffness, and steps of stiff sheets. The
    # last four options count all pivots, omit scaling and pivoting (an indefinite matrix is discarded anyway)
    # and order by minimum degree. Factored is the regularised Hessian if the exact one is indefinite; if they
    # differ too much, more regularisation costs less than more iterations
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
    # if PETSc was built without MUMPS; one rank only
    "cholesky": {
        "ksp_type": "cg",
        "ksp_max_it": 50,
        "pc_type": "cholesky",
        "pc_factor_mat_ordering_type": "qmd",
    },
    # a fifth of the iterations of block Jacobi, each at a few times the cost; ``stepping.shift`` helps
    "ilu": {"ksp_type": "cg", "pc_type": "ilu"},
    "block-ilu": {"ksp_type": "cg", "pc_type": "bjacobi", "sub_pc_type": "ilu"},
    # always exists for a positive-definite matrix; iterations grow like 1/h
    "block-jacobi": {"ksp_type": "cg", "pc_type": "pbjacobi"},
    # iterations hardly grow with the mesh. Hundreds of them mean that the matrix is nearly singular, and that
    # another preset is needed
    "multigrid": _CYCLE,
    # visits levels from the second coarser one on twice: a cycle takes a sixth longer, and iterations of
    # large or stiff problems do not grow
    "multigrid-w": _CYCLE | {"pc_mg_w_from": 2},
    # symmetric sweeps instead of PETSc's default, Chebyshev, whose eigenvalue bounds become outdated within a
    # step. No rigid-body modes: on a held vertex, an aggregate of its own, six modes are linearly dependent
    "gamg": {
        "ksp_type": "cg",
        "pc_type": "gamg",
        "mg_levels_ksp_type": "richardson",
        "mg_levels_pc_type": "sor",
    },
}

BETWEEN_RANKS: dict[str, dict[str, Value]] = {
    # between ranks sweeps are Jacobi, which without damping diverges if ranks have few vertices
    "gamg": {"mg_levels_ksp_richardson_scale": 0.5},
}
"""Further options of a preset on more than one rank."""

WITH_CHOSEN: dict[str, dict[str, Value]] = {
    # the symmetric variants: with others conjugate gradients hardly converge
    "asm": {"pc_asm_type": "basic"},
    "gasm": {"pc_gasm_type": "basic"},
    # otherwise PETSc asks the shell DM of the SNES for fields, which it does not have
    "fieldsplit": {"pc_fieldsplit_dm_splits": False},
}
"""Further options for a ``-pc_type`` that the user chose."""

CONJUGATE_GRADIENTS = ("cg", "fcg", "pipecg", "groppcg")
"""Krylov methods that only use products with the operator, and can monitor the true residual."""

INCOMPLETE = ("ilu", "block-ilu")
FACTORISATIONS = ("direct", "cholesky")

MULTIGRID_FROM = {True: 2000, False: 3000}
"""Vertices from which multigrid is tried first, with Newton iterations and with one linear solve a step."""

BAIJ_PRECONDITIONERS = frozenset({"none", "jacobi", "pbjacobi", "sor", "ilu"})
"""Preconditioners built from a matrix of type ``baij``; any other ``-pc_type`` of a user gets ``aij``."""

READS_DIAGONAL = frozenset({"none", "jacobi", "pbjacobi"})
"""Preconditioners that only read the diagonal blocks of their matrix."""

DIRECT_UNTIL = 30_000
"""Vertices up to which a direct factorisation is used, for equilibria and if iterations become too many."""

FACTOR_COST = 200.0, 6.5
"""Cost of a factorisation in iterations of block Jacobi: the first number plus the second times √vertices.

Measured are 300 to 400 for 1000 to 5000 vertices; a buckling sheet needs several factorisations an iteration.
"""

COST, COST_INCOMPLETE = 4.0, 2.0
"""Cost of an iteration of multigrid, and of incomplete factors, in iterations of block Jacobi, of which it
replaces at least as many."""

INCOMPLETE_FROM = 1.0
"""Expected iterations of block Jacobi (about thirty in fact) from which Newton iterations of a small sheet
use incomplete factors."""

TWICE_FROM = 300.0
"""Expected iterations of block Jacobi from which coarser levels are visited twice. With 50,000 vertices that
was no faster up to 600, but iterations of stiff sheets then hardly grow with the mesh."""


def candidates(
    n_vertices: int,
    ranks: int,
    *,
    static: bool = False,
    newton: bool = True,
    iterations: float = 0.0,
    contact: bool = False,
    tied: bool = False,
) -> list[str]:
    """Presets to try in this order; only ``user`` if the user chose the preconditioner.

    ``newton``: a step takes more than one linear solve. ``iterations``: expected number of conjugate gradient
    iterations with block Jacobi without ``contact``. ``tied``: vertices are held together, which of all but
    factorisations only multigrid knows.
    """
    if is_set("pc_type"):
        return ["user"]
    factors = _factorisations(ranks) if n_vertices <= DIRECT_UNTIL else []
    cycle = "multigrid-w" if static or iterations > TWICE_FROM else "multigrid"
    last = [cycle, "gamg", "block-jacobi"]
    if static:
        return [*factors, *last]
    if n_vertices > DIRECT_UNTIL:
        return last
    # PETSc's parallel matrix types have no incomplete factors of their own, only block by block
    several = ranks > 1 or PETSc.Options().getString("mat_type", "").startswith("mpi")
    incomplete = "block-ilu" if several else "ilu"
    small = n_vertices < MULTIGRID_FROM[newton] and not tied
    if iterations > _factor_cost(n_vertices) * (COST_INCOMPLETE if small else COST):
        return [*factors, *last]
    if not small:
        return [cycle, *factors, incomplete, "gamg", "block-jacobi"]
    if newton and iterations <= INCOMPLETE_FROM and not contact:
        return ["block-jacobi", *factors, *last[:-1]]
    return [incomplete, *factors, "block-jacobi", *last[:-1]]


def _factorisations(ranks: int) -> list[str]:
    """Factorisation presets that this PETSc offers."""
    if PETSc.Sys.hasExternalPackage("mumps"):
        return ["direct"]
    return ["cholesky"] if ranks == 1 else []


def break_even_iterations(n_vertices: int, presets: Sequence[str]) -> float:
    """Linear iterations per Newton iteration above which a factorisation, if it is the next preset, pays."""
    if len(presets) > 1 and presets[1] in FACTORISATIONS:
        costs = {"block-jacobi": 1.0} | dict.fromkeys(INCOMPLETE, COST_INCOMPLETE)
        return _factor_cost(n_vertices) / costs.get(presets[0], COST)
    return math.inf


def _factor_cost(n_vertices: int) -> float:
    """Cost of a factorisation in conjugate gradient iterations with block Jacobi."""
    constant, slope = FACTOR_COST
    return constant + slope * math.sqrt(n_vertices)


def options_of(name: str, ranks: int) -> dict[str, Value]:
    """Options of a preset; for ``user`` the defaults that suit the chosen ``-pc_type``."""
    if name != "user":
        return PRESETS[name] | (BETWEEN_RANKS.get(name, {}) if ranks > 1 else {})
    chosen = PETSc.Options().getString("pc_type", "")
    if chosen in ("lu", "cholesky") and not is_set("mat_type"):
        return PRESETS[next(iter(_factorisations(ranks)), "cholesky")] | {"pc_type": chosen}
    if chosen == PETSc.PC.Type.MG:  # replaced by the program's cycle
        return PRESETS["multigrid"]
    for preset in ("block-jacobi", "gamg", "multigrid"):
        if PRESETS[preset]["pc_type"] == chosen:
            return options_of(preset, ranks)
    return {"ksp_type": "cg"} | WITH_CHOSEN.get(chosen, {})


def matrix_type(preset: str) -> str:
    """PETSc matrix type from which a preset's preconditioner is built unless ``-mat_type`` is given."""
    blocks = PETSc.Options().getString("pc_type", "") in BAIJ_PRECONDITIONERS or preset == "block-ilu"
    return "baij" if blocks else "aij"
