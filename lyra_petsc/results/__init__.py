"""What a run left on disk, read back by one process without MPI and PETSc."""
