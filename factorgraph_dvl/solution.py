"""A solution: trajectory, calibration, joint covariance, status."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from html import escape

from factorgraph_dvl.errors import printable
from factorgraph_dvl.estimates import (
    Cause,
    Estimate,
    Hypothesis,
    Noise,
    Residuals,
    Trajectory,
    values_of,
)
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.quality.notation import split_unit, with_std
from factorgraph_dvl.quality.verdict import (
    DEFAULT_LIMITS,
    Grade,
    Verdict,
    grades_of,
    verdict_of_result,
)

# Called on the way to a solution: with the stage, what is counted in it, and the cost if any.
Progress = Callable[[str, int, float | None], None]


class Judged:
    """What a result's findings and standard deviations amount to."""

    trial: str
    solver: str
    converged: bool
    iterations: int
    estimates: tuple[Estimate, ...]
    findings: tuple[Finding, ...]
    limits: Mapping[str, float]

    def __repr__(self) -> str:
        return (
            f"<{type(self).__name__} of {self.trial!r} by {self.solver}: {self.verdict.grade}, "
            f"{len(self.estimates)} parameters>"
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """The reasons of the verdict as texts."""
        return tuple(map(str, self.verdict.reasons))

    @property
    def order(self) -> tuple[str, ...]:
        """Component names of the rows of `covariance`."""
        return tuple(name for e in self.estimates for name in e.component_names)

    @property
    def grades(self) -> dict[str, tuple[Grade, ...]]:
        """Grade of each component of each parameter, by reported name."""
        return {e.name: grades_of(e, self.limits) for e in self.estimates}

    @property
    def verdict(self) -> Verdict:
        """Whether the result can be used, from its findings and grades."""
        return verdict_of_result(
            self.findings,
            self.estimates,
            self.limits,
            converged=self.converged,
            iterations=self.iterations,
        )


@dataclass(frozen=True)
class SolverStep:
    """A change of what is assumed of a trial, that the solver has kept.

    Parameters
    ----------
    change : str
        What has changed.
    objective : float
        -2 log of the restricted likelihood after it, but for a constant.
    fall : float
        What it took off the objective.
    largest_move_sigma : float
        Largest move of a calibration component, in standard deviations.
    """

    change: str
    objective: float
    fall: float
    largest_move_sigma: float


@dataclass(frozen=True, repr=False)
class Solution(Judged):
    """What a solver found.

    Parameters
    ----------
    trial, solver : str
        Names.
    body_axes : BodyAxes
        Axes of the body quantities.
    converged : bool
        Whether the solver reached a minimum.
    iterations : int
        Iterations that it took.
    cost : float
        Half the sum of squared whitened residuals, at the solution.
    estimates : tuple of Estimate
        The calibration parameters that were estimated.
    covariance : ndarray, shape (P, P)
        Joint covariance of all their components, in reported units, in the order of `estimates`.
    trajectory : Trajectory
        The motion.
    residuals : tuple of Residuals, optional
        Residuals of each sensor.
    findings : tuple of Finding, optional
        What the user must know of the records and the result.
    hypotheses : tuple of Hypothesis, optional
        Where the data allow, or for some time allowed, more than one trajectory: all of them, the
        heaviest first, which is the solution's; else empty.
    rejected : tuple of Residuals, optional
        Measurements that are none, such as echoes.
    inputs : tuple of str, optional
        Fingerprints of the data that it came from.
    limits : mapping of str to float, optional
        Standard deviations that are good enough, by parameter, in reported units.
    noise : tuple of Noise, optional
        Noise of the measurements whose noise was estimated.
    error_budget : tuple of Cause, optional
        What makes up the standard deviations, the largest causes first.
    epoch : str, optional
        UTC of time zero, ISO 8601; empty if not given.
    steps : tuple of SolverStep, optional
        What the solver changed of its assumptions, in order.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> solution = fd.solve(fd.simulate("examples/short.yaml", seed=1))
    >>> solution
    <Solution of 'short run' by batch: good, 9 parameters>
    >>> print(solution.summary().splitlines()[5])
    scale_error       0.00521 ± 0.00036          green
    >>> solution.covariance.shape == 2 * (len(solution.order),)
    True
    """

    trial: str
    solver: str
    body_axes: BodyAxes
    converged: bool
    iterations: int
    cost: float
    estimates: tuple[Estimate, ...]
    covariance: Array
    trajectory: Trajectory
    residuals: tuple[Residuals, ...] = ()
    findings: tuple[Finding, ...] = ()
    hypotheses: tuple[Hypothesis, ...] = ()
    rejected: tuple[Residuals, ...] = ()
    inputs: tuple[str, ...] = ()
    limits: Mapping[str, float] = field(default_factory=lambda: dict(DEFAULT_LIMITS))
    noise: tuple[Noise, ...] = ()
    error_budget: tuple[Cause, ...] = ()
    epoch: str = ""
    steps: tuple[SolverStep, ...] = ()

    @property
    def span(self) -> tuple[float, float] | None:
        """Times of the first and the last epoch, s."""
        time = self.trajectory.time
        return (float(time[0]), float(time[-1])) if time.size else None

    @property
    def calibration(self) -> Calibration:
        """The calibration alone, as `load_calibration` would read it."""
        names = (f.name for f in fields(Calibration) if hasattr(self, f.name))
        return Calibration(**{name: getattr(self, name) for name in names})

    def _repr_html_(self) -> str:
        head = "".join(f"<p>{escape(line)}</p>" for line in _heading(self))
        header = "".join(f"<th>{escape(cell)}</th>" for cell in _COLUMNS)
        body = "".join(
            "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
            for row in _rows(self)
        )
        return f"{head}<table><tr>{header}</tr>{body}</table>"

    def summary(self) -> str:
        """Return verdict and calibration as text: value, standard deviation, unit and grade."""
        rows = [_COLUMNS, *_rows(self)]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = (
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
            for row in rows
        )
        return "\n".join([*_heading(self), *(line.rstrip() for line in lines)])

    def with_findings(self, findings: Iterable[Finding]) -> Solution:
        """Return the solution with findings before its own, each once."""
        return replace(self, findings=tuple(dict.fromkeys((*findings, *self.findings))))

    def estimate(self, name: str) -> Estimate:
        """Return a parameter by its name in calibration.json.

        Raises
        ------
        KeyError
            If the parameter was not estimated.
        """
        for estimate in self.estimates:
            if estimate.name == name:
                return estimate
        raise KeyError(f"{name} was not estimated; there are {[e.name for e in self.estimates]}")


@dataclass(frozen=True, repr=False)
class Calibration(Judged):
    """What a solver found of the sensors alone; the fields are those of `Solution`.

    Examples
    --------
    >>> import tempfile
    >>> import factorgraph_dvl as fd
    >>> solution = fd.solve(fd.simulate("examples/short.yaml", seed=1))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     fd.save_solution(solution, f"{folder}/out")
    ...     calibration = fd.load_calibration(f"{folder}/out/calibration.json")
    >>> calibration.order == solution.order
    True
    """

    trial: str
    solver: str
    body_axes: BodyAxes
    converged: bool
    iterations: int
    cost: float
    estimates: tuple[Estimate, ...]
    covariance: Array
    findings: tuple[Finding, ...] = ()
    inputs: tuple[str, ...] = ()
    limits: Mapping[str, float] = field(default_factory=lambda: dict(DEFAULT_LIMITS))
    noise: tuple[Noise, ...] = ()
    error_budget: tuple[Cause, ...] = ()
    epoch: str = ""
    span: tuple[float, float] | None = None

    @property
    def values(self) -> dict[str, Array]:
        """Values by name, as `values_of`."""
        return values_of(self.estimates)


_COLUMNS = ("parameter", "value ± std", "unit", "grade")


def _heading(solution: Solution) -> tuple[str, ...]:
    """Return what was solved by what and its verdict, then the first reason of the verdict."""
    first, *reasons = str(solution.verdict).split(": ", 1)
    name = printable(solution.trial or "unnamed")
    solver = printable(solution.solver or "an unnamed solver")
    return (f"{name}, solved by {solver}: {first}", *(printable(reason) for reason in reasons))


def _rows(solution: Solution) -> Iterator[tuple[str, str, str, str]]:
    """Yield a row for each component of the calibration."""
    grades = solution.grades
    for e in solution.estimates:
        for i, component in enumerate(e.component_names):
            name, unit = split_unit(component)
            yield name, with_std(float(e.value[i]), float(e.std[i])), unit, grades[e.name][i]
