"""The cases, by what they look at; `lyra_petsc.experiments.verification.answers` lists them by name."""
