"""The reduced implicit system, PETSc TS/SNES/KSP, step control and recovery."""
