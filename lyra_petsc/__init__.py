"""lyra_petsc: parallel thin-shell simulation on PETSc.

    >>> import lyra_petsc
    >>> scene = lyra_petsc.load("configs/flag.yaml", {"time.end": 1.0})
    >>> run = lyra_petsc.run(scene, "runs/flag")
    >>> run.positions[-1], run.history

See ``docs/python.md``. Modules are imported, and MPI and PETSc started, when a name that needs them is first
used; `load` and `Run` need neither MPI nor PETSc.
"""

# `python -m` has put the working directory on the import path: before `__main__` removes it, only what Python
# has loaded already is imported
from importlib import import_module

__version__ = "0.1.0"

TYPE_CHECKING = False  # as that of typing
if TYPE_CHECKING:
    from typing import Any

    from lyra_petsc.api.scenes import load
    from lyra_petsc.api.simulations import Simulation, Step
    from lyra_petsc.errors import InputError, LyraError, OutputError, SolverError
    from lyra_petsc.experiments.fit.fit_runner import fit, gradient
    from lyra_petsc.scene.schema import Scene
    from lyra_petsc.show.notebook import Run, run

__all__ = [
    "InputError",
    "LyraError",
    "OutputError",
    "Run",
    "Scene",
    "Simulation",
    "SolverError",
    "Step",
    "__version__",
    "fit",
    "gradient",
    "load",
    "run",
]

_MODULES = {
    "InputError": "errors",
    "LyraError": "errors",
    "OutputError": "errors",
    "SolverError": "errors",
    "Run": "show.notebook",
    "Scene": "scene.schema",
    "Simulation": "api.simulations",
    "Step": "api.simulations",
    "fit": "experiments.fit.fit_runner",
    "gradient": "experiments.fit.fit_runner",
    "load": "api.scenes",
    "run": "show.notebook",
}


_WITH_PETSC = ("Simulation", "Step", "fit", "gradient")


def __getattr__(name: str) -> "Any":
    module = _MODULES.get(name)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name in _WITH_PETSC:
        from lyra_petsc.startup import start_petsc

        start_petsc()
    value = getattr(import_module(f"{__name__}.{module}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
