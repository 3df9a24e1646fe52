"""Least squares over numbers of a scene: the search by PETSc's TAO, and the uncertainty of its result.

With values y(p), measurements m and their standard deviations s the residual is r = (y − m) / s, and the
cost ½ rᵀr is minimised within bounds. At the minimum C = (JᵀJ)⁻¹ of the Jacobian J = ∂r/∂p is the
covariance of the parameters, and 1.96 √C_ii half the width of their 95 % intervals. Small singular values
of J, with parameters scaled by their size, belong to combinations that the data do not determine.

Source: Seber & Wild, Nonlinear Regression, Wiley 1989, ch. 2 and 5.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.experiments.case import StoredArray
from lyra_petsc.linear.petsc_options import culprits, is_set
from lyra_petsc.linear.reasons import error_message

QUANTILE = 1.959963984540054
"""Half the width of a 95 % interval over the standard deviation."""


NEAR = 0.5
"""Gauss-Newton step [standard deviations] up to which convergence that TAO reports is accepted."""


LEAST_SQUARES = ("brgn", "pounders")


@dataclass(frozen=True)
class Unknown:
    """A number to be fitted, with its start value and bounds."""

    key: str
    start: float
    low: float
    high: float

    @property
    def size(self) -> float:
        """Typical size of its changes."""
        return max(abs(self.start), 1e-3 * (self.high - self.low))


@dataclass
class Misfit:
    """Residuals (m,) and their derivatives (m, n) at the numbers (n,)."""

    numbers: StoredArray
    residuals: StoredArray
    jacobian: StoredArray

    @property
    def cost(self) -> float:
        """½ rᵀr."""
        return 0.5 * float(self.residuals @ self.residuals)


@dataclass(frozen=True)
class Estimate(Unknown):
    """A fitted number.

    Attributes
    ----------
    value : float
    deviation : float
        Standard deviation; infinite if the data do not determine it.
    at_bound : bool
    """

    value: float
    deviation: float
    at_bound: bool = False

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval."""
        return self.value - QUANTILE * self.deviation, self.value + QUANTILE * self.deviation


@dataclass
class Conclusion:
    """The result of a search and its uncertainty.

    Attributes
    ----------
    estimates : list of Estimate
    correlation : (n, n)
    singular_values : (n,)
        Singular values of the Jacobian, with numbers scaled by their size.
    directions : (n, n)
        Right singular vectors, in rows.
    misfit : float
        rᵀr over the degrees of freedom; expected value 1.
    notes : list of str
        Notes for the user.
    """

    estimates: list[Estimate]
    correlation: Array
    singular_values: Array
    directions: Array
    misfit: float
    notes: list[str] = field(default_factory=list)


Evaluate = Callable[[Array], Misfit]


class _StalledError(Exception):
    """Ends a search that is near the minimum but makes no progress."""


def search(unknowns: Sequence[Unknown], evaluate: Evaluate) -> tuple[Misfit, str]:
    """Minimise the cost; returns the best evaluation and why the search ended, the same on every rank.

    Parameters
    ----------
    unknowns : sequence of Unknown
    evaluate : callable
        Function of the numbers (n,), with the same argument and result on all ranks; collective.

    Raises
    ------
    InputError
        For options that TAO rejects.
    SolverError
        If the search fails.
    """
    # the search ends when the Gauss-Newton step is below this many standard deviations
    converged = 0.05
    # A search whose step is below `NEAR` also ends if its cost decreases by less than this in so many
    # evaluations: if a sheet may buckle to either side the cost is discontinuous, and a line search may fail
    stall, decrease = 8, 5e-3
    n = len(unknowns)
    size = np.array([unknown.size for unknown in unknowns])
    low, high = (np.array([getattr(u, name) for u in unknowns]) for name in ("low", "high"))
    known: dict[bytes, Misfit] = {}
    failure: list[BaseException] = []

    def is_stalled() -> bool:
        costs = [evaluation.cost for evaluation in known.values()]
        if len(costs) <= stall or min(costs[:-stall]) - min(costs) >= decrease:
            return False
        return (
            _gauss_newton_step(min(known.values(), key=lambda evaluation: evaluation.cost), low, high) <= NEAR
        )

    def at(y: PETSc.Vec) -> Misfit:
        numbers = np.clip(np.array(y.getArray(readonly=True)) * size, low, high)
        key = numbers.tobytes()
        if key not in known:
            if is_stalled():
                raise _StalledError
            try:
                known[key] = evaluate(numbers)
            except BaseException as error:
                failure.append(error)
                raise
        return known[key]

    comm = PETSc.COMM_SELF  # all ranks make the same search
    tao = PETSc.TAO().create(comm)
    try:
        tao.setType(PETSc.Options().getString("tao_type", PETSc.TAO.Type.BRGN))
    except PETSc.Error:
        tao.destroy()
        raise InputError(
            "TAO has no such type; leave it out, or give brgn or blmvm", key="-tao_type"
        ) from None
    first = evaluate(np.array([unknown.start for unknown in unknowns]))
    known[first.numbers.tobytes()] = first
    m = len(first.residuals)

    def residual(tao: PETSc.TAO, y: PETSc.Vec, out: PETSc.Vec) -> None:
        out.setArray(at(y).residuals)

    def jacobian(tao: PETSc.TAO, y: PETSc.Vec, matrix: PETSc.Mat, other: PETSc.Mat) -> None:
        matrix.setValues(range(m), range(n), at(y).jacobian * size)
        matrix.assemble()

    def cost(tao: PETSc.TAO, y: PETSc.Vec, out: PETSc.Vec) -> float:
        evaluation = at(y)
        out.setArray(size * (evaluation.jacobian.T @ evaluation.residuals))
        return evaluation.cost

    start, lower, upper, values = (PETSc.Vec().createSeq(k, comm=comm) for k in (n, n, n, m))
    start.setArray(first.numbers / size)
    lower.setArray(low / size)
    upper.setArray(high / size)
    matrix = PETSc.Mat().createDense((m, n), comm=comm)
    matrix.setUp()
    before: list[Array] = []

    def ended(tao: PETSc.TAO) -> int | None:
        y = tao.getSolution()
        evaluation = at(y)
        left = _gauss_newton_step(evaluation, low, high)
        # relative change of all numbers below which the search ends as well
        stalled = bool(before) and np.all(np.abs(evaluation.numbers - before[-1]) <= 1e-7 * size)
        if not before or not np.array_equal(before[-1], evaluation.numbers):
            before.append(evaluation.numbers)
        if left <= converged or (stalled and len(before) > 1):
            return int(PETSc.TAO.Reason.CONVERGED_USER)
        if tao.getIterationNumber() >= tao.getMaximumIterations():
            return int(PETSc.TAO.Reason.DIVERGED_MAXITS)
        return None

    try:
        least_squares = tao.getType() in LEAST_SQUARES
        if least_squares:
            tao.setResidual(residual, values)
            tao.setJacobianResidual(jacobian, matrix)
        else:
            tao.setObjectiveGradient(cost, None)
        tao.setVariableBounds((lower, upper))
        tao.setMaximumIterations(40)
        tao.setFromOptions()
        tao.setSolution(start)
        if tao.getType() == PETSc.TAO.Type.BRGN:
            if not is_set("tao_brgn_regularizer_weight"):
                tao.setBRGNRegularizerWeight(0.0 if _has_full_rank(first, size) else 1e-6 * first.cost)
            tao.setUp()
            inner = tao.getBRGNSubsolver()
            inner.setMaximumIterations(tao.getMaximumIterations())
            inner.setConvergenceTest(ended)
        else:
            tao.setConvergenceTest(ended)
        tao.solve()
        reason = int(tao.getConvergedReason())
    except _StalledError:
        reason = int(PETSc.TAO.Reason.CONVERGED_USER)
    except PETSc.Error as error:
        if failure:
            raise failure[0] from None
        raise InputError(f"PETSc cannot: {error_message(error)}", key=culprits(error)) from None
    finally:
        for petsc_object in (tao, matrix, start, lower, upper, values):
            petsc_object.destroy()
    best = min(known.values(), key=lambda evaluation: evaluation.cost)
    left = _gauss_newton_step(best, low, high)
    if left <= converged or (reason > 0 and left <= NEAR):
        return (
            best,
            f"the search ended; where it tends to is {left:.2g} standard deviations away",
        )
    if best is first and best.cost > 0.0:
        raise SolverError(
            f"TAO found nothing better than the start (reason {reason}); give other starts or bounds",
            collective=True,
        )
    return best, (
        f"the search was stopped after {len(known)} evaluations (TAO: {reason}), {left:.2g} standard "
        "deviations from where it tends to; go on from these numbers, or give -tao_max_it"
    )


def _has_full_rank(evaluation: Misfit, size: Array) -> bool:
    """Whether the Jacobian has full rank: the data determine all combinations of the numbers."""
    values = np.linalg.svd(evaluation.jacobian * size, compute_uv=False)
    return len(values) == len(size) and bool(values[-1] > 1e-6 * values[0])


def _gauss_newton_step(evaluation: Misfit, low: Array, high: Array) -> float:
    """Length of the Gauss-Newton step from an evaluation, in standard deviations of the numbers."""
    gradient = evaluation.jacobian.T @ evaluation.residuals
    free = ~_at_bounds(evaluation.numbers, gradient, low, high)
    if not free.any():
        return 0.0
    jacobian = evaluation.jacobian[:, free]
    step = np.linalg.lstsq(jacobian, evaluation.residuals, rcond=1e-10)[0]
    # norm of J × step, which is finite also for combinations that the data do not determine
    return float(np.linalg.norm(jacobian @ step)) / math.sqrt(free.sum())


def _at_bounds(numbers: Any, gradient: Any, low: Array, high: Array) -> Mask:
    """Mask of numbers at a bound towards which the cost decreases."""
    slack = 1e-9 * (high - low)
    return ((numbers <= low + slack) & (gradient > 0.0)) | ((numbers >= high - slack) & (gradient < 0.0))


def refuse_insensitive(unknowns: Sequence[Unknown], evaluation: Misfit, file: object = None) -> None:
    """Refuse numbers that do not influence any measurement.

    Raises
    ------
    InputError
    """
    size = np.array([unknown.size for unknown in unknowns])
    largest = np.abs(evaluation.jacobian * size).max(axis=0)
    for unknown, own in zip(unknowns, largest, strict=True):
        # A number has no influence if its largest scaled derivative is below this part of the others', or
        # below this many uncertainties
        if own <= max(1e-9 * largest.max(), 1e-6):
            raise InputError(
                "no measurement depends on it; leave it out, or measure something that does",
                file=file,
                key=f"fit.parameters.{unknown.key}",
            )


def conclude(unknowns: Sequence[Unknown], evaluation: Misfit) -> Conclusion:
    """Estimates, covariance and notes at the numbers of an evaluation."""
    n, m = len(unknowns), len(evaluation.residuals)
    size = np.array([unknown.size for unknown in unknowns])
    low, high = (np.array([getattr(u, name) for u in unknowns]) for name in ("low", "high"))
    at_bound = _at_bounds(evaluation.numbers, evaluation.jacobian.T @ evaluation.residuals, low, high)
    scaled = evaluation.jacobian * size
    _, values, directions = np.linalg.svd(scaled, full_matrices=m < n)
    values = np.concatenate([values, np.zeros(n - len(values))])
    covariance = np.full((n, n), np.nan)
    free = np.flatnonzero(~at_bound)
    if len(free):
        _, own, across = np.linalg.svd(scaled[:, free], full_matrices=m < len(free))
        own = np.concatenate([own, np.zeros(len(free) - len(own))])
        with np.errstate(divide="ignore"):
            inverse = np.where(own > 1e-12 * own[0], 1.0 / own, 1e12 / max(own[0], 1e-300))
        half = across.T * inverse
        covariance[np.ix_(free, free)] = half @ half.T
    deviation = np.sqrt(np.diag(covariance)) * size
    with np.errstate(invalid="ignore"):
        correlation = covariance * np.outer(size, size) / np.outer(deviation, deviation)
    estimates = [
        Estimate(u.key, u.start, u.low, u.high, float(value), float(own), bool(bound))
        for u, value, own, bound in zip(unknowns, evaluation.numbers, deviation, at_bound, strict=True)
    ]
    freedom = m - len(free)
    misfit = float(evaluation.residuals @ evaluation.residuals) / freedom if freedom > 0 else math.nan
    notes = _notes(estimates, values, directions, correlation)
    spread = math.sqrt(2.0 / freedom) if freedom > 0 else math.inf
    if freedom > 0 and misfit > 1.0 + 3.0 * spread:
        notes.append(
            f"the scene misses the measurements by {math.sqrt(misfit):.2g} times their uncertainties: these "
            "are too small, or something that acts is not in the scene; the intervals are then too narrow"
        )
    if freedom > 0 and misfit < 1.0 - 3.0 * spread:
        notes.append(
            f"the scene meets the measurements {1.0 / math.sqrt(misfit):.2g} times better than their "
            "uncertainties say; if these are too large, so are the intervals"
            if misfit > 0.0
            else "the scene meets the measurements exactly"
        )
    return Conclusion(estimates, correlation, values, directions, misfit, notes)


def _notes(estimates: Sequence[Estimate], values: Array, directions: Array, correlation: Array) -> list[str]:
    keys, notes = [estimate.key for estimate in estimates], []
    for estimate in estimates:
        if estimate.at_bound:
            notes.append(f"{estimate.key} is at its bound {estimate.value:.6g}: the data ask for more")
    for value, direction in zip(values, directions, strict=True):
        # relative standard deviation of a combination from which on the data do not determine it
        if value > 0.0 and 1.0 / value < 1.0:
            continue
        share = [key for key, part in zip(keys, direction, strict=True) if abs(part) > 0.3]
        how = f"±{100.0 / value:.0f} %" if value > 1e-6 else "not at all"
        if len(share) == 1:
            notes.append(f"the data cannot tell {share[0]} ({how} of its size)")
        else:
            notes.append(
                f"the data cannot tell {' and '.join(share)} apart: one combination of them is known {how}"
            )
    for i, one in enumerate(keys):
        for j in range(i):
            # correlation from which on two numbers are reported as not separable
            if abs(correlation[i, j]) > 0.98:
                notes.append(
                    f"{keys[j]} and {one} go together (correlation {correlation[i, j]:.3f}): "
                    "another measurement would tell them apart"
                )
    return notes
