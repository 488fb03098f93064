"""A solution: trajectory, calibration, joint covariance, status."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import chdtrc

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes, wrapped
from factorgraph_dvl.geometry.unit_vectors import turned
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.catalogue import specs_of
from factorgraph_dvl.sensors.finding import Code, Finding
from factorgraph_dvl.sensors.grades import DEFAULT_LIMITS, Grade, grades
from factorgraph_dvl.sensors.message import Message, message
from factorgraph_dvl.sensors.parameters import SCALAR, Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import DO_NOT_FIT, TOO_LARGE
from factorgraph_dvl.sensors.verdict import Verdict, verdict_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from factorgraph_dvl.files.data_frames import FrameTable
    from factorgraph_dvl.report.figures.drawing import Canvas
    from factorgraph_dvl.trial import Trial

# Called on the way to a solution: with the stage, what is counted in it, and the cost if any.
Progress = Callable[[str, int, float | None], None]

# Stems of the parameters that every dead-reckoned track depends on; of a lever arm it only
# does in turns.
DEAD_RECKONING = ("misalignment", "scale_error", "beam_direction", "beam_scale_error")
# Scale errors of velocity logs, the largest that one has, and the standard deviations beyond it
# that are no chance. Chosen: a sound speed of 1500 m/s in fresh water of 5 °C makes 5 %.
_SCALES = ("scale_error", "beam_scale_error")
_LARGEST_SCALE = 0.05
_CERTAIN = 3.0
# Standard deviations between prior and data that are no chance. Chosen: its probability is 6e-7.
_FAR_FROM_PRIOR = 5.0
# Standard deviations by which a wrong prior may draw a value. Chosen: one is within what is
# claimed.
_DRAWS = 1.0
# Factors on a stated noise that no one need look into. Chosen: data sheets are as far off.
NOISE_FACTORS = (0.5, 2.0)
# Share of the prior's standard deviation that may be left for the data to say anything. Chosen:
# they are then at most three times less sharp than the prior; of less, errors of the model that
# hardly matter make a contradiction.
_INFORMED = 0.95
# Evidence against a minimum with which it is not worth a word. Chosen: a probability of e^-15.
_IMPOSSIBLE = 15.0
# The data observed a component if they at least halved what was unknown of it.
OBSERVABLE = 0.5
# Root mean square of normalised residuals from which on a filter has not converged, unless a
# few of them are so large by chance, of this probability. Chosen: noise stated half as large as
# it is.
CONTRADICTS = 2.0
_CHANCE = 1e-3
# Share of outliers from which on they are a contradiction. Chosen: a good log has some.
_MANY_OUTLIERS = 0.02
# Windows of outliers that a finding lists, and time between two of them, s. Chosen: a line's
# length, and the time in which rejected measurements make a window.
_LISTED = 5
_APART = 10.0


@dataclass(frozen=True)
class Trajectory:
    """Estimated motion of the IMU over the ellipsoid, with its covariance.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Of the epochs.
    geodetic : ndarray, shape (M, 3)
        Latitude, longitude (rad), ellipsoidal height (m).
    velocity : ndarray, shape (M, 3)
        Local-level east, north, up, m/s.
    rph : ndarray, shape (M, 3)
        Roll, pitch, heading, rad.
    position_cov : ndarray, shape (M, 3, 3)
        Local-level east, north, up, m².
    velocity_cov : ndarray, shape (M, 3, 3)
        Local-level east, north, up, m²/s².
    rph_cov : ndarray, shape (M, 3, 3)
        Roll, pitch, heading, rad².

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> motion = fd.solve(fd.simulate("examples/short.yaml", seed=1)).trajectory
    >>> motion.geodetic.shape == motion.position_std.shape == (motion.time.size, 3)
    True
    """

    time: Array
    geodetic: Array
    velocity: Array
    rph: Array
    position_cov: Array
    velocity_cov: Array
    rph_cov: Array

    def __repr__(self) -> str:
        if not self.time.size:
            return "<Trajectory without epochs>"
        return f"<Trajectory of {self.time.size} epochs, {self.time[0]:g} to {self.time[-1]:g} s>"

    @property
    def position_std(self) -> Array:
        """Standard deviation east, north, up, (M, 3), m."""
        return _std(self.position_cov)

    @property
    def velocity_std(self) -> Array:
        """Standard deviation east, north, up, (M, 3), m/s."""
        return _std(self.velocity_cov)

    @property
    def rph_std(self) -> Array:
        """Standard deviation of roll, pitch, heading, (M, 3), rad."""
        return _std(self.rph_cov)


def _std(covariance: Array) -> Array:
    return np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))


@dataclass(frozen=True)
class Estimate:
    """An estimated calibration parameter, in its reported parametrisation and unit.

    Parameters
    ----------
    name : str
        As in calibration.json, e.g. `misalignment_deg`.
    component_names : tuple of str
        As in `covariance.order`.
    value, std : ndarray, shape (n,)
        In the unit of the name.
    prior_value, prior_std : ndarray, shape (n,)
        What was known before.
    observable : ndarray of bool, shape (n,)
        Whether the data at least halved the prior's standard deviation.
    nominal : ndarray, shape (N, 3), optional
        Unit vectors, if the parameter is N directions: the n = 2 N components turn them, in deg
        (`directions`). None for all other parameters.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> solution = fd.solve(fd.simulate("examples/short.yaml", seed=1))
    >>> lever_arm = solution.estimate("lever_arm_m")
    >>> lever_arm.value.round(1), lever_arm.observable
    (array([ 0.8,  1.2, -1. ]), array([ True,  True,  True]))
    """

    name: str
    component_names: tuple[str, ...]
    value: Array
    std: Array
    prior_value: Array
    prior_std: Array
    observable: np.ndarray
    nominal: Array | None = None

    @property
    def spec(self) -> ParameterSpec:
        """What the parameter is; one that no sensor has is a number without a unit."""
        found = specs_of(self.name)
        return found.get(self.value.size) or next(
            iter(found.values()), ParameterSpec(self.name, labels=SCALAR)
        )

    @property
    def directions(self) -> Array:
        """The unit vectors of a parameter that is directions, (N, 3)."""
        assert self.nominal is not None
        return turned(self.nominal, self.value.reshape(-1, 2) * DEG)


@dataclass(frozen=True)
class Residuals:
    """What a sensor measured against what the solution predicts.

    Parameters
    ----------
    label, unit : str
        Of the measurement.
    components : tuple of str
        Names of the d components.
    time : ndarray, shape (M,), s
        Of the epochs.
    residual : ndarray, shape (M, d)
        Predicted - measured; nan where a component was not measured.
    sigma : ndarray, shape (M, d)
        Standard deviation of the measurement; likewise.
    reason : {'echo', 'outlier', 'window'}, optional
        Why they were rejected, if they were: `window` if those about them are wrong together.
    """

    label: str
    unit: str
    components: tuple[str, ...]
    time: Array
    residual: Array
    sigma: Array
    reason: str = "echo"


@dataclass(frozen=True)
class Noise:
    """Noise of a measurement against what is stated of it.

    Parameters
    ----------
    name : str
        As in calibration.json, e.g. `dvl_velocity`.
    factor : ndarray, shape (d,)
        On the stated standard deviations, by component; of white and correlated noise together.
    correlation_time : ndarray, shape (d,), s, optional
        Correlation time of what persists from one measurement to the next; nan for a component
        whose noise is white, None where all are.
    correlated_std : ndarray, shape (d,), optional
        Standard deviation of what persists, in the unit of the measurement.
    """

    name: str
    factor: Array
    correlation_time: Array | None = None
    correlated_std: Array | None = None


@dataclass(frozen=True)
class Cause:
    """What one cause adds to the standard deviations of a calibration.

    Parameters
    ----------
    cause : str
        Such as the noise of a sensor, or the prior of a parameter.
    assumed : str
        What is assumed of it, with its unit; empty where there is no number.
    adds : ndarray, shape (P,)
        Standard deviations in the order of the covariance, in reported units; their squares add
        up over causes to the variances.
    """

    cause: str
    assumed: str
    adds: Array


def noise_name(label: str) -> str:
    """Return the name in calibration.json of a measurement's noise."""
    return label.lower().replace(" ", "_")


def white_noise(factors: Mapping[str, Array]) -> tuple[Noise, ...]:
    """Return noise that is white, from factors (d,) on what is stated, by label."""
    return tuple(Noise(noise_name(label), factor) for label, factor in factors.items())


@dataclass(frozen=True)
class Hypothesis:
    """A trajectory that the data allow, or allowed for some time.

    Parameters
    ----------
    weight : float
        Normalised likelihood at the end, among all hypotheses.
    born : float
        Time of the last data when it was found, s.
    died : float or None
        Time of the data since which its weight is nil, s; None if it still has some.
    trajectory : Trajectory
        The motion, up to the end or to its death; covariances are its own.
    history : ndarray, shape (H, 2)
        Time, s, and weight.
    """

    weight: float
    born: float
    died: float | None
    trajectory: Trajectory
    history: Array


def grades_of(estimate: Estimate, limits: Mapping[str, float]) -> tuple[Grade, ...]:
    """Return the grade of each component of a parameter against its limit, if it has one."""
    return grades(estimate.std, estimate.observable, limits.get(estimate.name, np.inf))


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
        found = [*self.findings, *self._uncertain()]
        if not self.converged and not any(f.severity == "error" for f in found):
            text = message("not_converged.iterations", iterations=self.iterations)
            found.append(Finding(Code.NOT_CONVERGED, text))
        return verdict_of(found)

    def _uncertain(self) -> list[Finding]:
        """Return a finding for each misalignment or scale error that is red, or unknown.

        A component that the trial did not determine, but that was known well enough before it,
        is no reason.
        """
        out = []
        said = {f.parameter for f in self.findings if f.code == Code.UNCERTAIN}
        own = self.grades
        for e in self.estimates:
            limit = self.limits.get(e.name)
            if limit is None or e.name in said or e.spec.stem not in DEAD_RECKONING:
                continue
            poor = [
                message("uncertain.component", name=name, std=std)
                for name, std, grade in zip(e.component_names, e.std, own[e.name], strict=True)
                if grade in ("red", "grey") and std > limit
            ]
            if poor:
                unit = f" {e.spec.unit}" if e.spec.unit else ""
                text = message("uncertain.above", components=poor, limit=limit, unit=unit)
                out.append(Finding(Code.UNCERTAIN, text, parameter=e.name))
        return out


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
        That it took.
    cost : float
        Half the sum of squared whitened residuals, at the solution.
    estimates : tuple of Estimate
        The calibration parameters that were estimated.
    covariance : ndarray, shape (P, P)
        Joint covariance of all their components, in reported units, in the order of `estimates`.
    trajectory : Trajectory
        The motion.
    residuals : tuple of Residuals, optional
        Of each sensor.
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
        Of the measurements whose noise was estimated.
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
    scale_error       0.00523 ± 0.00036          green
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
        from factorgraph_dvl.report.overview import html_overview

        return html_overview(self)

    def summary(self) -> str:
        """Return verdict and calibration as text: value, standard deviation, unit and grade."""
        from factorgraph_dvl.report.overview import overview

        return overview(self)

    def to_dataframe(self, table: FrameTable = "calibration") -> Any:
        """Return a part of the solution as a pandas DataFrame, in the units of files.

        Parameters
        ----------
        table : {'calibration', 'trajectory', 'residuals'}, optional
            A row for each component, each epoch, or each component of each measurement.

        Raises
        ------
        ConfigError
            If there is no such table, or pandas is not installed (extra `notebook`).
        """
        from factorgraph_dvl.files.data_frames import to_dataframe

        return to_dataframe(self, table)

    def to_xarray(self) -> Any:
        """Return calibration, joint covariance and trajectory as an xarray Dataset.

        Dimensions are `component` (`other_component` for the columns of the covariance) and
        `time_s`; units are those of files and stand in the names.

        Raises
        ------
        ConfigError
            If xarray is not installed (extra `notebook`).
        """
        from factorgraph_dvl.files.data_frames import to_xarray

        return to_xarray(self)

    def plot(
        self, figure: str = "calibration", *, trial: Trial | None = None, axes: Axes | None = None
    ) -> Canvas:
        """Draw one of the figures that `solve` writes.

        Parameters
        ----------
        figure : str, default 'calibration'
            `track`, `motion`, `calibration`, `correlation`, `error_budget`, `beam_quality`, or the
            residuals of a sensor, such as `dvl_residuals`.
        trial : Trial, optional
            For its GNSS fixes, reference and true calibration, which are drawn if it is given.
        axes : matplotlib.axes.Axes, optional
            Axes of your own figure: the panels take their place. By default a new figure.

        Returns
        -------
        matplotlib.figure.Figure or matplotlib.figure.SubFigure
            The new figure, or the part of yours.

        Raises
        ------
        ConfigError
            If there is no such figure, or nothing to draw in it.
        """
        from factorgraph_dvl.report.figures.solution import plot

        return plot(self, figure, trial=trial, axes=axes)

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


def values_of(estimates: Sequence[Estimate]) -> dict[str, Array]:
    """Return values by name as in calibration.json: of directions the unit vectors, (N, 3)."""
    return {e.name: e.value if e.nominal is None else e.directions for e in estimates}


def not_observable(estimate: Estimate, why: Callable[[int], Message | str]) -> list[Finding]:
    """Return a finding for each reason why components of an estimate are not observable.

    Parameters
    ----------
    estimate : Estimate
        Components that are fixed are left out.
    why : callable of int, Message
        The reason of a component, by its index.
    """
    reasons: dict[Message | str, list[str]] = {}
    for i in np.flatnonzero(~estimate.observable & (estimate.prior_std > 0.0)):
        reasons.setdefault(why(int(i)), []).append(estimate.component_names[i])
    return [
        Finding(
            Code.NOT_OBSERVABLE,
            message("not_observable.because", names=names, reason=reason),
            parameter=estimate.name,
        )
        for reason, names in reasons.items()
    ]


def as_estimates(
    parameters: Sequence[Parameter],
    values: Array,
    covariance: Array,
    unseparated: frozenset[str] = frozenset(),
) -> tuple[Estimate, ...]:
    """Return parameters with their values (n,) and covariance (n, n), in reported units.

    Components of which the data determine only a sum are `unseparated`, so not observable.
    """
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    estimates, at = [], 0
    for p in parameters:
        rows = slice(at, at + p.mean.size)
        at += p.mean.size
        prior_value, prior = p.reported_prior
        observable = (prior > 0.0) & (std[rows] <= OBSERVABLE * prior)
        if unseparated:
            observable &= [name not in unseparated for name in p.component_names]
        estimates.append(
            Estimate(
                name=p.name,
                component_names=p.component_names,
                value=values[rows],
                std=std[rows],
                prior_value=prior_value,
                prior_std=prior,
                observable=observable,
                nominal=p.nominal,
            )
        )
    return tuple(estimates)


def consistency_findings(
    estimates: Sequence[Estimate], residuals: Sequence[Residuals], noise: Sequence[Noise] = ()
) -> list[Finding]:
    """Return findings where a solution contradicts what was stated before.

    Residuals that are larger than stated make every reported standard deviation too small,
    unless their noise was estimated; a value far outside its prior says that prior or data are
    wrong.
    """
    factors = {n.name: n.factor for n in noise}
    out = []
    for e in estimates:
        out += _far_from_prior(e) + _impossible_scale(e)
    for r in residuals:
        factor = factors.get(noise_name(r.label))
        stated = r.sigma if factor is None else r.sigma / factor
        rms = float(np.sqrt(np.nanmean((r.residual / stated) ** 2))) if r.time.size else 0.0
        if rms > DO_NOT_FIT:
            out.append(
                Finding(
                    Code.DOES_NOT_FIT,
                    message("does_not_fit.residuals", ratio=rms),
                    sensor=r.label,
                )
            )
        elif rms > TOO_LARGE:
            key = "large_residuals.stated" if factor is None else "large_residuals.estimated"
            allowed = factor is not None and np.nanmax(factor) <= NOISE_FACTORS[1]
            out.append(
                Finding(
                    Code.LARGE_RESIDUALS,
                    message(key, ratio=rms),
                    sensor=r.label,
                    severity="note" if allowed else "warning",
                )
            )
        if factor is not None and np.nanmin(factor) < NOISE_FACTORS[0]:
            text = message("small_residuals.noise", ratio=np.nanmin(factor))
            out.append(Finding(Code.SMALL_RESIDUALS, text, sensor=r.label))
    return out


def _impossible_scale(e: Estimate) -> list[Finding]:
    """Return a finding if a scale error is larger than a velocity log has, unless stated so."""
    if e.spec.stem not in _SCALES:
        return []
    off = np.minimum(np.abs(e.value), np.abs(e.value - e.prior_value))
    if not (off - _CERTAIN * e.std > _LARGEST_SCALE).any():
        return []
    worst = int(np.argmax(off - _CERTAIN * e.std))
    value, std, name = e.value[worst], e.std[worst], e.component_names[worst]
    text = message(
        "impossible_scale.larger", name=name, value=value, std=std, limit=100.0 * _LARGEST_SCALE
    )
    return [Finding(Code.IMPOSSIBLE_SCALE, text, parameter=e.name)]


def _far_from_prior(e: Estimate) -> list[Finding]:
    """Return a finding if a component is far from its prior, by the data alone.

    The difference x - x0 of posterior and prior has the variance σ0² - σ²; without the prior
    x would be (x - x0) σ² / (σ0² - σ²) further deviation. The standard deviations by which other
    parameters would move are fewer.
    """
    informed = e.std < _INFORMED * e.prior_std
    if not informed.any():
        return []
    moved = np.abs(e.value - e.prior_value)[informed]
    rest = (e.prior_std**2 - e.std**2)[informed]
    apart = moved / np.sqrt(rest)
    worst = int(np.argmax(apart))
    if not apart[worst] > _FAR_FROM_PRIOR:
        return []
    mean, prior_std, std = (x[informed][worst] for x in (e.prior_value, e.prior_std, e.std))
    gain = prior_std**2 / rest[worst]
    alone = mean + gain * (e.value[informed][worst] - mean)
    draws = moved[worst] * std / rest[worst]
    name = np.array(e.component_names)[informed][worst]
    effect = message("far_from_prior.outweighed")
    if draws > _DRAWS:
        effect = message("far_from_prior.moves", draws=draws)
    return [
        Finding(
            Code.FAR_FROM_PRIOR,
            message(
                "far_from_prior.data",
                name=name,
                value=alone,
                std=std * np.sqrt(gain),
                apart=apart[worst],
                prior=mean,
                prior_std=prior_std,
                effect=effect,
            ),
            parameter=e.name,
            severity="error" if draws > _DRAWS else "warning",
        )
    ]


def contradictions(residuals: Sequence[Residuals]) -> list[Finding]:
    """Return a finding for each sensor whose residuals a filter's covariance does not explain.

    Over the last half of them, when a filter should have converged. Residuals that are too
    small are none of this: a filter may be more careful than it needs.

    Parameters
    ----------
    residuals : sequence of Residuals
        With standard deviations that include those of the states, or innovations.
    """
    out = []
    for r in residuals:
        late = r.time >= np.median(r.time) if r.time.size else np.zeros(0, dtype=bool)
        z = (r.residual / r.sigma)[late]
        z = z[np.isfinite(z)]
        square = float(z @ z)
        if square > CONTRADICTS**2 * z.size and chdtrc(z.size, square) < _CHANCE:
            out.append(
                Finding(
                    Code.FILTER_CONTRADICTED,
                    message("filter_contradicted.residuals", ratio=np.sqrt(square / z.size)),
                    sensor=r.label,
                )
            )
    return out


def mixed(trajectories: Sequence[Trajectory], weights: Array) -> Trajectory:
    """Return the first of some trajectories, with covariances that include the others.

    With weights w, covariances P and differences d from the first, the mean square error of
    the first is the sum of w (P + d dᵀ).

    Parameters
    ----------
    trajectories : sequence of Trajectory
        Of the same epochs.
    weights : ndarray, shape (T,)
        Likelihoods.
    """
    first = trajectories[0]
    if len(trajectories) == 1:
        return first
    share = weights / weights.sum()
    frame = LocalFrame(*first.geodetic[0])
    p = [frame.position(*t.geodetic.T) for t in trajectories]
    rph = [first.rph + wrapped(t.rph - first.rph) for t in trajectories]

    def spread(values: Sequence[Array], covs: Sequence[Array]) -> Array:
        out = np.zeros_like(covs[0])
        for w, value, cov in zip(share, values, covs, strict=True):
            deviation = value - values[0]
            out += w * (cov + deviation[:, :, None] * deviation[:, None, :])
        return out

    return replace(
        first,
        position_cov=spread(p, [t.position_cov for t in trajectories]),
        velocity_cov=spread(
            [t.velocity for t in trajectories], [t.velocity_cov for t in trajectories]
        ),
        rph_cov=spread(rph, [t.rph_cov for t in trajectories]),
    )


def ambiguity(hypotheses: Sequence[Hypothesis]) -> list[Finding]:
    """Return a finding if more than one hypothesis is left."""
    living = [h for h in hypotheses if h.died is None]
    if len(living) < 2:
        return []
    first, second = living[:2]
    frame = LocalFrame(*first.trajectory.geodetic[-1])
    apart = float(np.linalg.norm(frame.position(*second.trajectory.geodetic[-1])))
    return [
        Finding(
            Code.AMBIGUOUS,
            message(
                "ambiguous.trajectories",
                count=len(living),
                weights=[h.weight for h in living],
                apart=apart,
            ),
        )
    ]


def joined(
    solutions: Sequence[Solution], against: Array, hypotheses: Sequence[Hypothesis]
) -> Solution:
    """Return the most likely of some solutions, with what is known of the others.

    Parameters
    ----------
    solutions : sequence of Solution
        Of the living hypotheses.
    against : ndarray, shape (S,)
        Negative logarithms of their likelihoods, relative to the best.
    hypotheses : sequence of Hypothesis
        What the search for a start found: the living, in the order of `solutions`, then the dead.
        Empty if there was no search.
    """
    if len(solutions) == 1 and len(hypotheses) < 2:
        return solutions[0]
    weights = np.exp(-against) / np.exp(-against).sum()
    order = np.argsort(-weights)
    living = [
        replace(hypotheses[i], weight=float(weights[i]), trajectory=solutions[i].trajectory)
        for i in order
    ]
    every = (*living, *hypotheses[len(solutions) :])
    best = solutions[order[0]]
    return replace(
        best,
        converged=all(s.converged for s in solutions),
        trajectory=mixed([solutions[i].trajectory for i in order], weights[order]),
        hypotheses=every,
        findings=(*best.findings, *ambiguity(every)),
    )


def most_probable_minimum(solutions: Sequence[Solution], against: Array) -> Solution:
    """Return the most probable of some minima of one problem, with the spread of the others.

    Parameters
    ----------
    solutions : sequence of Solution
        At the minima, with the same estimates and epochs.
    against : ndarray, shape (S,)
        Negative logarithms of their probabilities.
    """
    order = [i for i in np.argsort(against) if against[i] - against.min() < _IMPOSSIBLE]
    best = solutions[order[0]]
    if len(order) == 1:
        return best
    weights = np.exp(against.min() - against[order])
    weights /= weights.sum()
    values = [np.concatenate([e.value for e in solutions[i].estimates]) for i in order]
    covariance = np.zeros_like(best.covariance)
    for i, weight, value in zip(order, weights, values, strict=True):
        deviation = value - values[0]
        covariance += weight * (solutions[i].covariance + np.outer(deviation, deviation))
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    estimates, at = [], 0
    for k, e in enumerate(best.estimates):
        own = std[at : at + e.std.size]
        at += e.std.size
        seen = np.all([solutions[i].estimates[k].observable for i in order], axis=0)
        seen &= own <= OBSERVABLE * e.prior_std
        estimates.append(replace(e, std=own, observable=seen))
    turned = [
        message("words.at", name=e.name, value=str(np.round(e.value, 1).tolist()))
        for i in order[1:]
        for e in solutions[i].estimates
        if e.spec.kind == "rotation"
    ]
    return replace(
        best,
        converged=all(solutions[i].converged for i in order),
        # That of one minimum does not explain the spread of all.
        error_budget=(),
        estimates=tuple(estimates),
        covariance=covariance,
        trajectory=mixed([solutions[i].trajectory for i in order], weights),
        findings=(
            *best.findings,
            Finding(
                Code.AMBIGUOUS,
                message(
                    "ambiguous.minima", count=len(order), weights=weights, others=tuple(turned)
                ),
            ),
        ),
    )


def outlier_findings(used: Sequence[Residuals], rejected: Sequence[Residuals]) -> list[Finding]:
    """Return a finding for each kind of measurement of which some are outliers."""
    kept = {r.label: r.time.size for r in used}
    out = []
    for label in dict.fromkeys(r.label for r in rejected):
        own = [r for r in rejected if r.label == label]
        count = sum(r.time.size for r in own)
        total = count + kept.get(label, 0)
        text = message("outliers.some", count=count, total=total)
        spans = [span for r in own if r.reason == "window" for span in _spans(r.time)]
        if spans:
            listed = [message("words.span", start=a, end=b) for a, b in spans[:_LISTED]]
            more: Message | str = ""
            if len(spans) > _LISTED:
                more = message("words.and_more", count=len(spans) - _LISTED)
            text = message("outliers.windows", count=count, total=total, windows=listed, more=more)
        severe = count > _MANY_OUTLIERS * total or bool(spans)
        out.append(
            Finding(Code.OUTLIERS, text, sensor=label, severity="warning" if severe else "note")
        )
    return out


def _spans(time: Array) -> list[tuple[float, float]]:
    """Return begin and end of the windows that times (M,) form."""
    ends = np.flatnonzero(np.diff(time) > _APART)
    first = np.concatenate([[0], ends + 1])
    last = np.concatenate([ends, [time.size - 1]])
    return [(float(time[a]), float(time[b])) for a, b in zip(first, last, strict=True)]


def mostly_rejected(used: Sequence[Residuals], rejected: Sequence[Residuals]) -> list[Finding]:
    """Return a finding for each kind of measurement of which over a third were rejected."""
    kept = {r.label: r.time.size for r in used}
    return [
        Finding(
            Code.MANY_REJECTED,
            message(
                "many_rejected.echoes",
                count=r.time.size,
                total=r.time.size + kept.get(r.label, 0),
            ),
            sensor=r.label,
        )
        for r in rejected
        if 2 * r.time.size > kept.get(r.label, 0)
    ]
