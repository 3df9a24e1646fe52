"""lyra_petsc: parallel thin-shell simulation on PETSc."""

__version__ = "0.1.0"
