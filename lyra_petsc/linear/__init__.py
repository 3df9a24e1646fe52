"""The matrix of a step and its solvers.

In: element Hessians of ``terms``. Out: PETSc matrices, preconditioners and their options.
"""
