"""The verdict on a result: good, doubtful or do not use; grades and findings are its reasons."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np

from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.catalogue import every_spec

Grade = Literal["green", "orange", "red", "grey"]

# Standard deviations that are good enough, by parameter, in reported units.
DEFAULT_LIMITS: Mapping[str, float] = MappingProxyType(
    {spec.name: spec.limit for spec in every_spec() if spec.limit is not None}
)
# Chosen: the standard deviation is orange up to this multiple of its limit.
ORANGE = 2.0


def grades(std: Array, observable: np.ndarray, limit: float = np.inf) -> tuple[Grade, ...]:
    """Return the grade of each component of a parameter.

    Green up to the limit, orange up to twice the limit, red above; grey where the data do not
    determine the component, or it is not known how well they do.

    Parameters
    ----------
    std : ndarray, shape (n,)
        Standard deviations, in reported units.
    observable : ndarray of bool, shape (n,)
        Whether the data determine a component.
    limit : float, optional
        What is good enough; there is none if infinite.
    """
    return tuple(
        "grey"
        if not seen or np.isnan(sigma)
        else "green"
        if sigma <= limit
        else "orange"
        if sigma <= ORANGE * limit
        else "red"
        for sigma, seen in zip(std.tolist(), observable.tolist(), strict=True)
    )


def grades_of(estimate: Estimate, limits: Mapping[str, float]) -> tuple[Grade, ...]:
    """Return the grade of each component of a parameter against its limit, if it has one."""
    return grades(estimate.std, estimate.observable, limits.get(estimate.name, np.inf))


VerdictGrade = Literal["good", "doubtful", "do not use"]

# Stems of the parameters that every dead-reckoned track depends on; of a lever arm it only
# does in turns.
DEAD_RECKONING = ("misalignment", "scale_error", "beam_direction", "beam_scale_error")


@dataclass(frozen=True)
class Verdict:
    """Whether a result can be used, and why not.

    Parameters
    ----------
    grade : VerdictGrade
        `do not use`: the data contradict the model. `doubtful`: there is something to check.
    reasons : tuple of Finding
        The worst first, and of equal ones causes before symptoms. Empty if the grade is good.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> verdict = fd.solve(fd.simulate("examples/short.yaml", seed=1)).verdict
    >>> verdict.grade, verdict.reasons
    ('good', ())
    """

    grade: VerdictGrade
    reasons: tuple[Finding, ...]

    def __str__(self) -> str:
        return f"{self.grade}: {self.reasons[0]}" if self.reasons else self.grade


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict on a result with these findings."""
    found = dict.fromkeys(findings)
    errors = [f for f in found if f.severity == "error"]
    warnings = [f for f in found if f.severity == "warning"]
    reasons = [f for group in (errors, warnings) for f in sorted(group, key=lambda f: f.code.rank)]
    return Verdict("do not use" if errors else "doubtful" if warnings else "good", tuple(reasons))


def verdict_of_result(
    findings: Sequence[Finding],
    estimates: Sequence[Estimate],
    limits: Mapping[str, float],
    *,
    converged: bool,
    iterations: int,
) -> Verdict:
    """Return the verdict on a result: from its findings, its grades, and how it ended.

    Parameters
    ----------
    findings : sequence of Finding
        What is known of the records and of the result.
    estimates : sequence of Estimate
        Calibration whose grades it is compared with.
    limits : mapping of str to float
        Standard deviations that are good enough, by parameter, in reported units.
    converged : bool
        Whether the solver reached a minimum.
    iterations : int
        Iterations that it took.
    """
    found = [*findings, *_uncertain(findings, estimates, limits)]
    if not converged and not any(f.severity == "error" for f in found):
        text = message("not_converged.iterations", iterations=iterations)
        found.append(Finding(Code.NOT_CONVERGED, text))
    return verdict_of(found)


def _uncertain(
    findings: Sequence[Finding], estimates: Sequence[Estimate], limits: Mapping[str, float]
) -> list[Finding]:
    """Return a finding for each misalignment or scale error that is red, or unknown.

    A component that the trial did not determine, but that was known well enough before it,
    is no reason.
    """
    out = []
    said = {f.parameter for f in findings if f.code == Code.UNCERTAIN}
    for e in estimates:
        limit = limits.get(e.name)
        if limit is None or e.name in said or e.spec.stem not in DEAD_RECKONING:
            continue
        graded = zip(e.component_names, e.std, grades_of(e, limits), strict=True)
        poor = [
            message("uncertain.component", name=name, std=std)
            for name, std, grade in graded
            if grade in ("red", "grey") and std > limit
        ]
        if poor:
            unit = f" {e.spec.unit}" if e.spec.unit else ""
            text = message("uncertain.above", components=poor, limit=limit, unit=unit)
            out.append(Finding(Code.UNCERTAIN, text, parameter=e.name))
    return out
