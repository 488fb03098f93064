"""Error budget: what each cause adds to the standard deviations of a calibration."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import numpy as np

from factorgraph_dvl.estimates import Cause
from factorgraph_dvl.geometry.units import HOUR
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.priors import PRIOR
from factorgraph_dvl.graph.problem import Problem, Rows
from factorgraph_dvl.sensors.parameters import UNITS, Parameter
from factorgraph_dvl.solvers.calibration import changes_of, reported, spread_of_fixed
from factorgraph_dvl.solvers.fixed_directions import SolvedProblem
from factorgraph_dvl.statistics.rows import CORRELATED, product, rows_by_source
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation


def causes(
    found: SolvedProblem, use: Callable[[Iterator[Rows]], object] = iter
) -> tuple[Cause, ...]:
    """Return what each cause adds to the standard deviations of a calibration.

    The squares of all causes add up to the variances that are reported.

    Parameters
    ----------
    found : SolvedProblem
        Problem at its minimum, with covariances.
    use : callable, optional
        The same as for `error_budget`; not called where nothing is estimated.
    """
    problem, evaluation = found.problem, found.minimum.evaluation
    rows = reported(problem, evaluation)
    functionals = [derivatives for _, _, derivatives in rows if derivatives is not None]
    if not functionals:
        return ()
    parts = error_budget(
        rows_by_source(problem, evaluation), found.covariances.information, functionals, use
    )
    variances = {source: np.diag(part) for source, part in parts.items()}
    spread = spread_of_fixed(found)
    if spread.size:
        variances["directions that the data do not determine"] = np.sum(spread**2, axis=1)
    for error in found.covariances.errors:
        change = changes_of(functionals, error.changes)
        variances[error.cause] = np.sum(change**2, axis=1)
    is_free = np.concatenate([np.full(v.size, d is not None) for _, v, d in rows])
    exact = np.concatenate([p.sigma == 0.0 for p, _, _ in rows])
    assumed = _assumed(found, [p for p, _, _ in rows])
    assumed |= {error.cause: error.assumed for error in found.covariances.errors}
    names = _names(problem)
    out = []
    for source, variance in variances.items():
        adds = np.zeros(is_free.size)
        adds[is_free] = np.sqrt(np.maximum(variance, 0.0))
        adds[exact] = 0.0
        out.append(Cause(names.get(source, source), assumed.get(source, ""), adds))
    total = np.maximum(np.sum([c.adds**2 for c in out], axis=0), np.finfo(float).tiny)
    return tuple(sorted(out, key=lambda c: -float(np.max(c.adds**2 / total))))


def _names(problem: Problem) -> dict[str, str]:
    """Return the words for sources that have others as causes.

    Without an IMU what persists of an error is as much stated as what is new in each measurement.
    """
    out = {o.label: f"noise of {o.label}" for o in problem.observations}
    for process in problem.processes:
        if process.parameter is not None:
            out[CORRELATED.format(process.label)] = f"changes of the {process.label}"
        elif problem.chain.interpolates:
            out[CORRELATED.format(process.label)] = f"lasting errors of {process.label}"
    return out


def _assumed(found: SolvedProblem, parameters: list[Parameter]) -> dict[str, str]:
    """Return what is assumed of each source, as text."""
    problem: Problem = found.problem
    out = problem.chain.assumed()
    for o, weight in zip(problem.observations, problem.weights, strict=True):
        sigma = 1.0 / np.where(weight > 0.0, weight, np.nan)
        if (weight > 0.0).any():
            middle = [float(np.nanmedian(s)) for s in sigma.T if np.isfinite(s).any()]
            out[o.label] = numbers_with_unit(np.array(middle), o.unit)
    units = {o.label: o.unit for o in problem.observations}
    units |= {p.name: UNITS[p.spec.unit].text for p in parameters}
    for process in problem.processes:
        unit = units[process.label if process.parameter is None else process.parameter]
        assumed = []
        if process.sigma.any():
            over = numbers_with_unit(process.tau[process.sigma > 0.0], "s")
            assumed.append(f"{numbers_with_unit(process.sigma, unit)} over {over}")
        if process.walk is not None:
            assumed.append(f"scale {process.walk.rate * np.sqrt(HOUR):.2g} /√h")
        out[CORRELATED.format(process.label)] = ", ".join(assumed)
    of_chain = [p for p, _, _ in problem.chain.mean_constants(found.minimum.evaluation.states)]
    for p in [*of_chain, *(p for p in parameters if p.name in problem.columns)]:
        unit = UNITS[p.spec.unit].text
        out[PRIOR.format(p.name)] = numbers_with_unit(p.sigma / p.si, unit)
    return out


def numbers_with_unit(values: Array, unit: str) -> str:
    """Return numbers with their unit, once if they are all the same."""
    texts = list(dict.fromkeys(_brief(value) for value in values))
    numbers = texts[0] if len(texts) == 1 else ", ".join(map(_brief, values))
    return f"{numbers} {unit}".rstrip()


def _brief(value: float) -> str:
    """Write a number with two digits that count, and without an exponent up to a million."""
    return f"{float(f'{value:.2g}'):g}"


def error_budget(
    rows: Iterable[Rows],
    information: SquareRootInformation,
    functionals: Sequence[Mapping[int, Array]],
    use: Callable[[Iterator[Rows]], object] = iter,
) -> dict[str, Array]:
    """Return what each source adds to the covariance of linear functionals.

    Each row has unit noise of its own, so with X = P Wᵀ

        W P Wᵀ = sum over sources, sum over rows of (J X)ᵀ (J X):

    exact, and additive.

    Parameters
    ----------
    rows : iterable of Rows
        All rows of the graph.
    information : SquareRootInformation
        Information of the same rows.
    functionals : sequence of mapping of int to ndarray
        Each maps keys to (n, size) matrices; values add up over keys.
    use : callable, optional
        Called with the rows, one after another as they are added up, for another use of them.

    Returns
    -------
    dict of str to ndarray
        By source, (sum n, sum n); their sum is `information.covariance_of(functionals)`.
    """
    with_functionals = information.covariance_with(functionals)
    out: dict[str, Array] = {}

    def added() -> Iterator[Rows]:
        for each in rows:
            noise = product(each, with_functionals)
            part = np.einsum("mdi,mdj->ij", noise, noise, optimize=True)
            out[each.source] = out.get(each.source, 0.0) + part
            yield each

    passing = added()
    use(passing)
    deque(passing, maxlen=0)
    return out
