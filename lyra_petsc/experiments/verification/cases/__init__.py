"""The cases, by what they look at; `lyra_petsc.experiments.verification.registry` lists them by name."""
