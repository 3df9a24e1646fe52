"""Named linear solvers, each a set of PETSc options, and which one a problem starts with.

A preset is tried in full: ``-pc_type`` on the command line replaces it. When its preconditioner
breaks down, the next of ``ORDER`` takes over.
"""

from __future__ import annotations

from lyra_petsc.solvers.options import Value, is_set

PRESETS: dict[str, dict[str, Value]] = {
    # incomplete factors of 3×3 blocks: unbeatable while they exist
    "ilu": {"mat_type": "baij", "ksp_type": "cg", "pc_type": "bjacobi", "sub_pc_type": "ilu"},
    "ilu-1": {
        "mat_type": "baij",
        "ksp_type": "cg",
        "pc_type": "bjacobi",
        "sub_pc_type": "ilu",
        "sub_pc_factor_levels": 1,
    },
    # aggregation with the six rigid-body modes of the current shape; couplings by hinges are orders
    # of magnitude weaker than the membrane's, smoothed aggregation would only fill in
    "gamg": {
        "mat_type": "aij",
        "ksp_type": "cg",
        "pc_type": "gamg",
        "pc_gamg_agg_nsmooths": 0,
        "mg_levels_ksp_type": "chebyshev",
        "mg_levels_pc_type": "pbjacobi",
    },
    # always exists for a positive-definite matrix
    "block-jacobi": {"mat_type": "baij", "ksp_type": "cg", "pc_type": "pbjacobi"},
}
ORDER = ("ilu", "ilu-1", "gamg", "block-jacobi")

BAIJ_PRECONDITIONERS = frozenset({"none", "jacobi", "pbjacobi", "bjacobi", "asm", "ilu", "icc", "sor"})
"""What works on block storage; every other ``-pc_type`` gets ``aij``."""


def candidates() -> list[str]:
    """Presets to try in order; only one when the user chose the preconditioner."""
    return ["user"] if is_set("pc_type") else list(ORDER)


def options_of(name: str, chosen_pc: str) -> dict[str, Value]:
    """The options of a preset; ``user`` adds only a matrix type that suits ``-pc_type``."""
    if name != "user":
        return PRESETS[name]
    kind = "baij" if chosen_pc in BAIJ_PRECONDITIONERS else "aij"
    return {"mat_type": kind, "ksp_type": "cg"}
