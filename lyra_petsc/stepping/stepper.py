"""PETSc TS, SNES, KSP and Mat of a run, owned here, and one attempt at a step."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.assembly.matrix import SystemMatrix
from lyra_petsc.assembly.pattern import BlockPattern
from lyra_petsc.errors import SolverError
from lyra_petsc.parallel import all_here
from lyra_petsc.profiling import FROZEN, RESIDUAL, logged
from lyra_petsc.scene.schema import Scene
from lyra_petsc.solvers import failed_factors, presets, reasons
from lyra_petsc.solvers.hierarchy import Surface
from lyra_petsc.solvers.multigrid import Multigrid, kind_asked_for
from lyra_petsc.solvers.options import Value, culprits, fill_gaps, is_set, refused
from lyra_petsc.stepping.blend import Blend
from lyra_petsc.stepping.conditioning import expected_iterations
from lyra_petsc.stepping.extrapolation import Extrapolation
from lyra_petsc.stepping.forcing import LOOSEST
from lyra_petsc.stepping.guess import first_guess
from lyra_petsc.stepping.newton import Newton
from lyra_petsc.stepping.shift import allows_enlarging
from lyra_petsc.stepping.system import ReducedSystem
from lyra_petsc.stepping.trace import Stuck, Trace
from lyra_petsc.stepping.ts_options import refuse_contradictions

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Attempt:
    """Outcome of one attempt at a step."""

    converged: bool
    newton_iterations: int
    linear_iterations: int
    residual: float
    left: float = math.inf
    words: str = ""
    at_roundoff: bool = False
    stuck: Stuck | None = None


FIRST_OF_ALL = 1e-3
"""First Δt of an adaptive run over its length; the estimate corrects it at once."""


class Stepper:
    """Each step's stage by TSBEULER or TSTHETA on the reduced system.

    TSBDF and TSALPHA2 keep their histories where neither a checkpoint nor a changed linear solver reaches
    them; ours are in the scheme, and TS solves for the stage.

    Parameters
    ----------
    scene : Scene
    system : ReducedSystem
    pattern : BlockPattern
    surface : Surface
    spacing : float
        Mean edge length [m], for the step tolerance.
    floor : float
        Norm [N] of the residual's round-off.

    Attributes
    ----------
    ts, snes, ksp : PETSc objects
        Without options prefix.
    preset : str
        Name of the linear solver in use.
    presets : list of str
        It and those still to try when it breaks down.
    our_options : list of str
        Options this class filled in.

    Raises
    ------
    InputError
        For options that contradict the scene (``-ts_type``, ``-ts_theta_endpoint``, …).
    """

    def __init__(
        self,
        scene: Scene,
        system: ReducedSystem,
        pattern: BlockPattern,
        surface: Surface,
        spacing: float,
        floor: float,
    ) -> None:
        self._scene, self._system, self._pattern, self._surface = scene, system, pattern, surface
        self._spacing, self._floor = spacing, floor
        self._iterates = scene.time.scheme != "semi-implicit"
        points = system.points
        step = 0.0 if scene.time.step == "auto" else scene.time.step
        static = scene.time.scheme == "static"
        expected = 0.0 if static else expected_iterations(system, step)
        self.presets = presets.candidates(
            points.n_global, points.comm.size, static=static, newton=self._iterates, iterations=expected
        )
        self._blend = Blend("regularised" if not self._iterates else scene.solver.hessian)
        self.our_options: list[str] = []
        self._filled: list[str] = []
        self._linear_failed = False
        self._shape = (system.points.n_owned, 3)
        self._extrapolation = Extrapolation(system.points.comm)
        self._create()

    # -- objects -------------------------------------------------------------------------------------

    def _create(self) -> None:
        system, scene = self._system, self._scene
        points = system.points
        self.preset = self.presets[0]
        self._fill(presets.options_of(self.preset, points.comm.size))
        self.matrix = SystemMatrix(points, self._pattern, "baij")
        self.preconditioner = self.matrix
        if self._separate():
            diagonal = PETSc.Options().getString("pc_type", "") in presets.READS_DIAGONAL
            self.preconditioner = SystemMatrix(
                points, self._pattern, "baij", given=not diagonal, beside=self.matrix, diagonal=diagonal
            )
        self.velocity = PETSc.Vec().createMPI(
            (3 * points.n_owned, 3 * points.n_global), bsize=3, comm=points.comm
        )
        self.residual = self.velocity.duplicate()
        self.ts = ts = PETSc.TS().create(points.comm)
        ts.setProblemType(PETSc.TS.ProblemType.NONLINEAR)
        ts.setType(system.scheme.ts_type)
        if system.scheme.ts_type == "theta":
            ts.setTheta(0.5)
        ts.setIFunction(self._ifunction, self.residual)
        ts.setIJacobian(self._ijacobian, self.matrix.mat, self.preconditioner.mat)
        ts.setMaxTime(scene.time.end)
        ts.setTimeStep(FIRST_OF_ALL * scene.time.end if scene.time.step == "auto" else scene.time.step)
        ts.setMaxSteps(np.iinfo(PETSc.IntType).max - 1)
        ts.setMaxSNESFailures(1)
        ts.setErrorIfStepFails(False)
        ts.setExactFinalTime(PETSc.TS.ExactFinalTime.STEPOVER)
        self.snes = snes = ts.getSNES()
        self.ksp = ksp = snes.getKSP()
        snes.setInitialGuess(self._guess)
        limit = presets.linear_limit(points.n_global, self.presets)
        self._newton = newton = Newton(
            snes,
            system,
            self.matrix,
            self.preconditioner,
            self._blend,
            scene.solver,
            self._spacing,
            self._floor,
            iterates=self._iterates,
            linear_limit=limit,
        )
        ksp.setType(PETSc.KSP.Type.CG)
        self._multigrid: Multigrid | None = None
        if kind_asked_for():
            rows = self.preconditioner, points, self._pattern, self._surface
            self._multigrid = Multigrid(ksp, *rows, held=lambda: system.prescribed.mask)
        self._trace = Trace(snes, system, self._linear_iterations)
        if self._iterates:
            snes.setMonitor(self._trace.monitor)
            snes.setType(PETSc.SNES.Type.NEWTONLS)
            snes.setObjective(newton.objective)
            snes.setTolerances(rtol=0.0, atol=0.0, stol=0.0, max_it=scene.solver.max_iterations)
            snes.setConvergenceTest(newton.converged)
            snes.setLineSearchPreCheck(newton.direction)
            # a Hessian that is not positive definite costs an iteration, not the step
            snes.setMaxKSPFailures(scene.solver.max_iterations)
            ksp.setTolerances(rtol=LOOSEST, max_it=5000)
        else:
            snes.setType(PETSc.SNES.Type.KSPONLY)
            ksp.setTolerances(rtol=1e-6, max_it=5000)
            ksp.setInitialGuessNonzero(True)
        try:
            ts.setFromOptions()
        except PETSc.Error as error:
            raise refused(error) from None
        if self._multigrid is not None:
            self._multigrid.after_options(ksp, self.matrix)
        if ksp.getType() in presets.CONJUGATE_GRADIENTS and not is_set("ksp_norm_type"):
            # a preconditioner near breakdown makes the preconditioned norm meaningless
            ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        refuse_contradictions(ts, system.scheme.ts_type)
        ts.setSolution(self.velocity)

    def _separate(self) -> bool:
        """Whether the preconditioner is built from a matrix of its own, the regularised one.

        So it stays positive definite, and conjugate gradients see negative curvature of the exact
        Hessian only where there is some.
        """
        if not self._iterates:
            # their diagonal is a little larger
            return self.preset in presets.INCOMPLETE and not allows_enlarging(self.matrix)
        kind = PETSc.Options().getString("ksp_type", "cg")
        return self._scene.solver.hessian != "regularised" and kind != "preonly"

    def _fill(self, options: Mapping[str, Value]) -> None:
        self._filled = fill_gaps(options)
        self.our_options += [name for name in self._filled if name not in self.our_options]

    def next_preset(self) -> str | None:
        """Change to the next linear solver; its name, or None if there is none left; collective."""
        if len(self.presets) < 2:
            return None
        time, step = self.ts.getTime(), self.ts.getStepNumber()
        self.destroy()
        self.presets.pop(0)
        self._create()
        self.start(time, step)
        return self.preset

    def destroy(self) -> None:
        """Free all PETSc objects and take back the options that were filled in; collective."""
        database = PETSc.Options()
        for name in self._filled:
            database.delValue(name)
        self._system.forget_rows()
        self.ts.destroy()
        self.matrix.destroy()
        if self.preconditioner is not self.matrix:
            self.preconditioner.destroy()
        if self._multigrid is not None:
            self._multigrid.destroy()
        self.velocity.destroy()
        self.residual.destroy()

    # -- a step ----------------------------------------------------------------------------------------

    def start(self, time: float, step: int) -> None:
        """Set time [s] and step number, and take the velocities from the system."""
        self.ts.setTime(time)
        self.ts.setStepNumber(step)
        self.velocity.setArray(self._system.v[: self._shape[0]].ravel())

    def attempt(self, t0: float, t1: float) -> Attempt:
        """Try the step from t0 to t1 [s]; on success the system holds the new state; collective."""
        system = self._system
        with PETSc.Log.Event(FROZEN):
            system.begin_step(t0, t1)
        self.velocity.setArray(system.history.ravel())
        number = self.ts.getStepNumber()
        # a TS step that ends where its stage shall be, with the shift that the scheme wants
        theta = 0.5 if system.scheme.ts_type == "theta" else 1.0
        length = 1.0 / (theta * system.stage.sigma)
        self.ts.setTime(t0 + system.stage.after - theta * length)
        self.ts.setTimeStep(length)
        self._newton.begin_step()
        self._trace.begin()
        try:
            self.ts.step()
        except PETSc.Error as error:
            together = all_here(system.points.comm)
            kept = "the state before it" if together else "the last checkpoint (the other ranks work on)"
            raise SolverError(
                f"PETSc stopped in the step from t = {t0:g} s: {reasons.last_words(error)}; "
                f"{kept} is kept; check {culprits(error)}",
                collective=together,
            ) from None
        newton, linear = self.snes.getIterationNumber(), self._linear_iterations()
        words = "the velocities are not finite"
        self._linear_failed = False
        if self.ts.getConvergedReason() >= 0 and self.snes.getConvergedReason() > 0:
            velocity = self.snes.getSolution().getArray(readonly=True).reshape(self._shape).copy()
            if system.points.comm.allreduce(int(not np.isfinite(velocity).all())) == 0:
                system.accept(velocity)
                self.velocity.setArray(system.v[: self._shape[0]].ravel())
                self.ts.setTime(t1)
                self.ts.setTimeStep(t1 - t0)
                return Attempt(
                    True,
                    newton,
                    linear,
                    self._newton.norm,
                    self._newton.left,
                    at_roundoff=self._newton.at_roundoff,
                )
        else:
            words = reasons.in_words(self.snes, self.ksp)
            self._linear_failed = self._newton.too_slow or reasons.preconditioner_failed(self.ksp)
        stuck = self._trace.stuck()
        self.ts.setTime(t0)
        self.ts.setTimeStep(t1 - t0)
        self.ts.setStepNumber(number)
        self.ts.setConvergedReason(PETSc.TS.ConvergedReason.CONVERGED_ITERATING)
        if not self._iterates and (failed_factors.forget(self.ksp) or self._newton.shift.raise_()):
            return self.attempt(t0, t1)
        return Attempt(False, newton, linear, self._newton.norm, words=words, stuck=stuck)

    def _linear_iterations(self) -> int:
        return int(self.snes.getLinearSolveIterations()) + self._newton.more_linear

    @property
    def blend(self) -> float:
        """Fraction of regularisation in the last Newton iteration."""
        return self._blend.value

    @blend.setter
    def blend(self, value: float) -> None:
        self._blend.value = value

    @property
    def linear_solver_slow(self) -> bool:
        """Whether it did not fail, but took more iterations than another one would cost."""
        return self._newton.too_slow

    @property
    def linear_solver_failed(self) -> bool:
        """Whether the last failed attempt might succeed with another preconditioner."""
        return self._linear_failed

    def monitor(self) -> None:
        """Call the TS monitors that the user asked for; collective."""
        self.ts.monitor(self.ts.getStepNumber(), self.ts.getTime(), self.velocity)

    # -- callbacks ---------------------------------------------------------------------------------------

    @logged(RESIDUAL)
    def _ifunction(self, ts: PETSc.TS, t: float, u: PETSc.Vec, udot: PETSc.Vec, f: PETSc.Vec) -> None:
        v, rate = (vec.getArray(readonly=True).reshape(self._shape) for vec in (u, udot))
        self._system.residual(v, rate, f.getArray().reshape(self._shape))

    def _guess(self, snes: PETSc.SNES, u: PETSc.Vec) -> None:
        guess = u.getArray().reshape(self._shape)
        first_guess(self._system, guess)
        if not self._iterates:
            # the linear solve sets out from there; its tolerance stays relative to the whole
            system = self._system
            ahead = self._extrapolation.to(system.t1, system.t0, system.v[: len(guess)])
            system.prescribe(ahead)
            snes.getSolutionUpdate().setArray((guess - ahead).ravel())

    def _ijacobian(
        self, ts: PETSc.TS, t: float, u: PETSc.Vec, udot: PETSc.Vec, shift: float, a: PETSc.Mat, p: PETSc.Mat
    ) -> bool:
        self._newton.assemble(u)
        self._newton.factor()
        if self._iterates:
            self._newton.remember(u)
        return True
