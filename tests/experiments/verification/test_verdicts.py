"""Verdicts of ``verify``: right results pass, wrong ones fail, cases that cannot run are reported."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

import pytest
from mpi4py import MPI

from lyra_petsc.errors import InputError, Interrupted, SolverError
from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.verification.cases import CASES
from lyra_petsc.experiments.verification.verification_case import (
    Claim,
    ErrorRow,
    Measured,
    VerificationCase,
    observed_order,
    run_case,
)


def row(n: float, error: float) -> ErrorRow:
    return ErrorRow("q", "m", n, 1.0 / n, value=1.0 + error, exact=1.0, error=error)


def table(*errors: float, first: float = 4.0) -> list[ErrorRow]:
    rows: list[ErrorRow] = []
    for k, error in enumerate(errors):
        new = row(first * 2.0**k, error)
        rows.append(dataclasses.replace(new, order=observed_order(rows[-1], new)) if rows else new)
    return rows


def finest(rows: list[ErrorRow]) -> float:
    return rows[-1].h


def test_orders_follow_from_errors() -> None:
    rows = table(1e-2, 2.5e-3, 1.25e-3)
    assert math.isnan(rows[0].order)
    assert [r.order for r in rows[1:]] == pytest.approx([2.0, 1.0])
    assert math.isnan(observed_order(rows[0], row(8, 0.0)))


@pytest.mark.parametrize(
    ("claim", "errors", "good"),
    [
        (Claim(exact=1e-10), (1e-11, 1e-12), True),
        (Claim(exact=1e-10), (2e-10, 1e-12), False),
        (Claim(exact=1e-10), (1e-12, math.nan), False),
        (Claim(within=1e-3), (1.0, 9e-4), True),
        (Claim(within=1e-3), (1e-4, 2e-3), False),
        (Claim(within=1e-3), (1e-4, math.nan), False),
        (Claim(order=2.0, within=1e-3), (3.6e-3, 9e-4), True),
        (Claim(order=2.0, within=1e-3), (4.8e-3, 1.2e-3), False),  # right order, too large
        (Claim(order=2.0, within=1e-3), (1.8e-3, 9e-4), False),  # small, but first order
        (Claim(order=2.0, within=1e-3), (9e-4, 9e-4), False),
        (Claim(order=2.0, within=1e-3), (3.6e-3, 3e-5), False),  # an order too good to be true
        (Claim(order=2.0, within=1e-3), (3.6e-3, math.nan), False),
        (Claim(order=2.0, within=1e-3), (3.6e-3, 0.0), False),
        (Claim(order=1.0, within=1e-3, slack=0.1), (1.6e-3, 8.1e-4), True),
    ],
)
def test_claims(claim: Claim, errors: tuple[float, ...], good: bool) -> None:
    rows = table(*errors)
    verdict = claim.judge(rows, finest(rows))
    assert verdict.passed is good, verdict.message
    assert verdict.message


def test_the_bound_of_a_quick_run_grows_with_h() -> None:
    rows = table(6e-2, 1.5e-2)
    assert Claim(order=2.0, within=1e-3).judge(rows, finest(rows) / 4.0).passed  # 16e-3
    assert not Claim(order=2.0, within=1e-3).judge(rows, finest(rows) / 2.0).passed  # 4e-3
    assert not Claim(within=1e-3, growth=1.0).judge(rows, finest(rows) / 4.0).passed


def sample_case(**changes: object) -> VerificationCase:
    def measure(bench: Bench, n: float) -> Iterable[Measured]:
        return [Measured("a", 1.0 + n**-2, 1.0, "m"), Measured("b", 2.0, 2.0)]

    claims = {"b": Claim(exact=1e-12), "*": Claim(order=2.0, within=1e-2)}
    case = VerificationCase("made-up", "title", measure, "source", (4, 8, 16), claims)
    return dataclasses.replace(case, **changes)  # type: ignore[arg-type]


@pytest.mark.parallel(2)
def test_rows_and_verdicts_of_a_case(comm: MPI.Comm) -> None:
    outcome = run_case(comm, sample_case())
    assert outcome.passed
    assert list(outcome.tables()) == ["a", "b"]
    assert [r.n for r in outcome.tables()["a"]] == [4, 8, 16]
    assert [r.order for r in outcome.tables()["a"]][1:] == pytest.approx([2.0, 2.0])
    assert all(math.isnan(r.order) for r in outcome.tables()["b"])
    assert [r.n for r in run_case(comm, sample_case(), quick=True).tables()["a"]] == [4, 8]


@pytest.mark.parallel(2)
def test_a_case_that_cannot_run_is_reported_and_the_others_continue(comm: MPI.Comm) -> None:
    def measure(bench: Bench, n: float) -> Iterable[Measured]:
        if n == 8:
            raise SolverError("the step\ndid not converge", collective=True)
        yield Measured("a", 1.0 + n**-2, 1.0)
        if n == 16:
            raise InputError("is not there", key="some.key")

    outcome = run_case(comm, sample_case(measure=measure))
    assert not outcome.passed
    assert outcome.verdicts["a"].passed  # order 2 between 4 and 16
    assert [r.n for r in outcome.tables()["a"]] == [4, 16]
    problems = [r for r in outcome.rows if r.problem]
    assert [(r.n, r.problem) for r in problems] == [
        (8, "the step did not converge"),
        (16, "some.key: is not there"),
    ]
    assert "n = 8" in outcome.verdicts["could not run"].message


@pytest.mark.parallel(2)
def test_a_case_without_measurements_fails(comm: MPI.Comm) -> None:
    assert not run_case(comm, sample_case(measure=lambda bench, n: [])).passed


@pytest.mark.parallel(2)
def test_a_stop_request_ends_the_case(comm: MPI.Comm) -> None:
    def stop() -> None:
        raise Interrupted("", 2)

    with pytest.raises(Interrupted):
        run_case(comm, CASES.load("free-fall"), watch=stop)


def wrong_by(case: VerificationCase, fraction: float) -> VerificationCase:
    """The case with every exact answer changed by a fraction of its scale."""

    def measure(bench: Bench, n: float) -> Iterable[Measured]:
        for one in case.measure(bench, n):
            scale = abs(one.exact) if one.scale is None else one.scale
            yield dataclasses.replace(one, exact=one.exact + fraction * scale, scale=scale)

    return dataclasses.replace(case, measure=measure)


QUICK_AND_EXACT = ("patch-states", "free-fall", "oscillator", "rigid-rotation", "hanging-strip-chain")


@pytest.mark.parallel(2)
@pytest.mark.parametrize("name", QUICK_AND_EXACT)
def test_an_exact_answer_wrong_by_a_billionth_fails(comm: MPI.Comm, name: str) -> None:
    case = CASES.load(name)
    outcome = run_case(comm, wrong_by(case, 1e-9), quick=True)
    exact = [q for q in outcome.tables() if case.claim_of(q) == Claim(exact=1e-10)]
    assert exact
    for quantity in exact:
        assert not outcome.verdicts[quantity].passed, quantity


@pytest.mark.parallel(2)
@pytest.mark.parametrize("name", ["stretched-membrane", "hanging-chain", "hanging-strip"])
def test_a_limit_wrong_by_a_few_percent_fails(comm: MPI.Comm, name: str) -> None:
    outcome = run_case(comm, wrong_by(CASES.load(name), 0.05), quick=True)
    assert not any(verdict.passed for verdict in outcome.verdicts.values())


def test_a_missing_package_is_named() -> None:
    def measure(bench: Bench, n: float) -> list[Measured]:
        raise ModuleNotFoundError("No module named 'scipy'", name="scipy")

    case = VerificationCase("a", "b", measure, "c", (1.0,), {"*": Claim(exact=0.0)})
    [verdict] = run_case(MPI.COMM_SELF, case).verdicts.values()
    assert not verdict.passed
    assert "scipy is not installed; get the extra" in verdict.message
