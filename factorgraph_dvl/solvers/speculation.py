"""Speculation: a minimum counts as explained while the test of known parameters still runs."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import TypeVar

from factorgraph_dvl.background import Awaited, available, in_background
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.solvers.known_parameters import Explanation, explanation
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum

# Returns what `explanation` does.
Explain = Callable[[Problem, Minimum, Imu], Explanation | None]

_Result = TypeVar("_Result")


def speculated(
    compute: Callable[[Explain], _Result], meanwhile: Callable[[_Result], object]
) -> _Result:
    """Return a result that rests on tests of known parameters, with these in a second process.

    The tests seldom find anything. The result is computed as if they found nothing, and anew
    where one did.

    Parameters
    ----------
    compute : callable
        Returns the result with the test that it is given, which it makes once.
    meanwhile : callable
        Called with a result while a test of it still runs, for what would be done later.
    """
    if not available():
        return compute(explanation)
    with ExitStack() as stack:
        tests: list[Awaited[Explanation | None]] = []

        def later(problem: Problem, minimum: Minimum, imu: Imu) -> None:
            test = partial(_of_its_own, problem, minimum, imu)
            tests.append(stack.enter_context(in_background(test)))

        result = compute(later)
        if not all(test.is_there for test in tests):
            meanwhile(result)
        found = [test() for test in tests]
    if not any(found):
        return result
    known = iter(found)

    def again(problem: Problem, minimum: Minimum, imu: Imu) -> Explanation | None:
        if (first := next(known, None)) is None:
            return explanation(problem, minimum, imu)
        # Parameters of one joint prior share that prior itself, which a copy does not.
        own = {p.name: p for p in problem.all_parameters}
        return replace(first, parameter=own[first.parameter.name])

    return compute(again)


def _of_its_own(problem: Problem, minimum: Minimum, imu: Imu) -> Explanation | None:
    """Return what `explanation` does, in a process of its own."""
    # What it binds is bound already.
    problem.chain.segments.increments.release()
    return explanation(problem, minimum, imu)
