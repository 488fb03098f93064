"""The verdict on a result: good, doubtful or do not use, and the findings that are the reasons."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from factorgraph_dvl.sensors.finding import Finding

VerdictGrade = Literal["good", "doubtful", "do not use"]


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
