"""Assembly of a step's matrix, and linear solvers.

In: element Hessians of ``terms``. Out: PETSc matrices, preconditioners and their options.
"""
