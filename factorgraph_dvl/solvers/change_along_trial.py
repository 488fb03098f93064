"""Findings of parameters that are not the same all along a trial."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.finding import Code, Finding
from factorgraph_dvl.sensors.imu import ERRORS
from factorgraph_dvl.sensors.parameters import UNITS
from factorgraph_dvl.solvers.calibration import reported
from factorgraph_dvl.solvers.fixed_directions import SolvedProblem
from factorgraph_dvl.statistics.constancy import changes
from factorgraph_dvl.statistics.rows import rows_with_times

# Standard deviations from which on a change is one. Chosen: the probability by chance is below
# 1e-4 although each of hundreds of times may be the one.
_CHANGED = 5.0
# Cost up to which a change is as probable as the most probable one. Chosen: a likelihood of e^-4.
_TIE = 4.0


def change_findings(found: SolvedProblem) -> Iterator[Finding]:
    """Yield a finding where a parameter changes along the trial by more than chance allows.

    Of several components the most probable one is named, and those that are about as probable.

    Parameters
    ----------
    found : SolvedProblem
        Problem at its minimum, with covariances.
    """
    problem, evaluation = found.problem, found.minimum.evaluation
    rows = [
        (p, derivatives)
        for p, _, derivatives in reported(problem, evaluation)
        if derivatives is not None and p.name in problem.columns and np.all(p.sigma > 0.0)
    ]
    if not rows:
        return
    functionals = [derivatives for _, derivatives in rows]
    joint: dict[int, Array] = {}
    names = [name for p, _ in rows for name in p.component_names]
    size = len(names)
    at = 0
    for functional in functionals:
        for key, matrix in functional.items():
            whole = joint.setdefault(key, np.zeros((size, matrix.shape[1])))
            whole[at : at + matrix.shape[0]] += matrix
        at += next(iter(functional.values())).shape[0]
    information = found.covariances.information
    time = problem.chain.segments.node_time
    tests = changes(
        rows_with_times(problem, evaluation),
        information.covariance_with(joint),
        information.covariance_of(functionals),
        (float(time[0]), float(time[-1])),
    )
    parameters = [p for p, _ in rows for _ in p.component_names]
    candidates = [i for i, p in enumerate(parameters) if p.name not in ERRORS]
    if not candidates:
        return
    largest = max(tests[i].chi2 for i in candidates)
    if largest < _CHANGED**2:
        return
    ties = [i for i in candidates if largest - tests[i].chi2 < 2.0 * _TIE]
    # Of what is about as probable, what the trial is for.
    best = min(ties, key=lambda i: (parameters[i].spec.nuisance, -tests[i].chi2))
    ties.remove(best)
    test, p = tests[best], parameters[best]
    unit = UNITS[p.spec.unit].text
    others = f", or {', '.join(names[i] for i in ties)} does" if ties else ""
    yield Finding(
        Code.CHANGED_ALONG_TRIAL,
        f"{names[best]} changes by {test.size:.2g} ± {test.std:.1g} {unit} at {test.time:.0f} s"
        f"{others}: {test.significance:.0f} standard deviations; the result is a mean of before "
        "and after",
        parameter=p.name,
    )
