"""What ``import lyra_petsc`` offers a program or a notebook; the package itself loads it when it is used."""
