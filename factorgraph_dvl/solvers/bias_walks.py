"""Biases of the IMU that walk more than stated, where that explains what residuals do not fit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.inertial_chain import WALK, InertialChain
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.imu import BIASES, ImuSettings
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.solvers.change_along_trial import CHANGED, changes_at
from factorgraph_dvl.solvers.imu_noise import IMU_NOISE, sampled_segments, squares_of
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum, minimise
from factorgraph_dvl.solvers.preparation import Preparation
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Keys of the walks, and what walks.
_WALKS = dict(
    zip(("gyro_bias_walk_deg_h_sqrt_h", "accel_bias_walk_ug_sqrt_h"), BIASES, strict=True)
)
_UNITS = dict(zip(_WALKS, ("deg/h/√h", "µg/√h"), strict=True))
# Walks to start from, in the units of the keys. Chosen: those of bad MEMS; a few estimates
# lead from there to any other.
_START = dict(zip(_WALKS, (30.0, 3000.0), strict=True))
# Square of a residual of the IMU, in the mean and in variances, from which on its noise is not
# what is stated, and probability of it by chance. Chosen: data sheets are right within a factor
# of three.
_NOT_NOISE = 9.0
_CHANCE = 1e-6
# The same of a sensor, up to which it fits. Chosen: what is left is less than the noise.
_FITS = 1.5
# Estimates of a walk, and relative change from which on another one follows. Chosen: a walk is
# known to a fifth at best.
_ESTIMATES = 8
_SAME_WALK = 0.2
# Logarithm of the likelihood by which one walk more must explain more. Chosen: e^-5 is no chance.
_PER_WALK = 5.0
# Factor on what is stated, below which a walk is as stated.
_AS_STATED = 3.0


@dataclass(frozen=True)
class BiasWalks:
    """Walks of the biases that explain a misfit, in place of those stated.

    Parameters
    ----------
    prepared : Preparation
        Preparation with them.
    evaluation : Evaluation
        The minimum with them.
    against : float
        Negative logarithm of their likelihood, but for a constant that all walks share, and a
        price of each walk.
    findings : tuple of Finding
        What the user must know.
    """

    prepared: Preparation
    evaluation: Evaluation
    against: float
    findings: tuple[Finding, ...]


def bias_walks(
    prepared: Preparation,
    problem: Problem,
    minimum: Minimum,
    noise: Mapping[str, Array],
    report: Progress,
) -> BiasWalks | None:
    """Return the walks of biases that explain a misfit; None where none does.

    The IMU carries the motion to all sensors: where its biases walk more than the model allows,
    the residuals of the others grow, though nothing is wrong with them. The walk is the cause
    if all of them fit with a larger one.

    Parameters
    ----------
    prepared : Preparation
        What was minimised, with the IMU as it is stated.
    problem : Problem
        The same, with noise as stated, or as residuals ask for.
    minimum : Minimum
        Where it ended.
    noise : mapping of str to ndarray
        Factors (d,) of each label on the stated noise of sensors, up to 1.
    report : callable
        Called with stage, iteration and cost.
    """
    if not _walks(prepared.trial.inertial.settings, problem, minimum):
        return None
    start = minimum.evaluation
    largest = _walked(prepared, problem, start, _START, noise, report)
    if largest is None or not (largest.fits or largest.grows):
        # With smaller walks sensors fit even less.
        return None
    found = [
        _with_walks(prepared, problem, start, names, noise, report)
        for names in (*([name] for name in _WALKS), list(_WALKS))
    ]
    possible = [each for each in found if each is not None]
    return min(possible, key=lambda each: each.against, default=None)


@dataclass(frozen=True)
class _Walked:
    """The minimum with some walks, and by how much each is too small there."""

    prepared: Preparation
    chain: InertialChain
    problem: Problem
    minimum: Minimum
    ratios: dict[str, float]

    @property
    def fits(self) -> bool:
        """Whether all sensors fit."""
        return _fits(self.problem, self.minimum.evaluation)

    @property
    def grows(self) -> bool:
        """Whether a walk is too small."""
        return max(self.ratios.values()) > 1.0


def _walked(
    prepared: Preparation,
    problem: Problem,
    start: Evaluation,
    walks: Mapping[str, float],
    noise: Mapping[str, Array],
    report: Progress,
) -> _Walked | None:
    """Return the minimum with walks of some biases; None if there is none."""
    walking = prepared.with_imu(**walks)
    chain = walking.chain(start.states)
    test = Problem(
        chain,
        problem.observations,
        problem.all_parameters,
        start=start.parameters,
        clock_zero=problem.clock_zero,
        tilt=problem.tilt,
    )
    test.reject(problem.rejected)
    test.noise_factors = noise
    test.robust_weights = problem.robust_weights
    at = test.values(start.states, test.prior_values() | start.parameters)
    minimum = minimise(test, at, stage="walking biases", progress=report)
    if not minimum.converged:
        return None
    ratios = {}
    for name in walks:
        own = [WALK.format(_WALKS[name])]
        squares, freedom = _squares(test, minimum.evaluation, minimum.information, own)
        ratios[name] = float(np.sqrt((squares + 1.0) / (max(freedom, 0.0) + 1.0)))
    return _Walked(walking, chain, test, minimum, ratios)


def _with_walks(
    prepared: Preparation,
    problem: Problem,
    evaluation: Evaluation,
    names: list[str],
    noise: Mapping[str, Array],
    report: Progress,
) -> BiasWalks | None:
    """Return walks of some biases that explain a misfit; None if these do not."""
    stated = prepared.trial.inertial.settings
    walks = {name: _START[name] for name in names}
    for _ in range(_ESTIMATES):
        found = _walked(prepared, problem, evaluation, walks, noise, report)
        if found is None:
            return None
        at, evaluation = found, found.minimum.evaluation
        if max(abs(ratio - 1.0) for ratio in at.ratios.values()) < _SAME_WALK:
            break
        if not (at.fits or at.grows):
            return None
        walks = {name: walk * at.ratios[name] for name, walk in walks.items()}
    information = at.minimum.information
    squares, freedom = _squares(at.problem, evaluation, information, IMU_NOISE)
    least = min(walks[name] / max(getattr(stated, name), 1e-12) for name in names)
    if not at.fits or _is_not_noise(squares, freedom) or least < _AS_STATED:
        return None
    steps = np.log(at.chain.bias_steps).sum()
    against = (
        _PER_WALK * len(names) + evaluation.cost + 0.5 * information.log_determinant + float(steps)
    )
    findings = tuple(_finding(name, walks[name], stated) for name in names)
    return BiasWalks(at.prepared, evaluation, against, findings)


def _squares(
    problem: Problem,
    evaluation: Evaluation,
    information: SquareRootInformation,
    sources: Iterable[str],
) -> tuple[float, float]:
    """Return the squares of residuals of some sources together, and what they are by chance."""
    every = sampled_segments(problem)
    squares, freedom = np.sum(
        [*squares_of(problem, evaluation, information, sources, every).values()], axis=0
    )
    return float(squares), float(freedom)


def _walks(imu: ImuSettings, problem: Problem, minimum: Minimum) -> bool:
    """Whether a bias that is stated as constant changes, or the IMU does not fit its walks."""
    if any(
        c.parameter.name in BIASES and c.change.chi2 > CHANGED**2
        for c in changes_at(problem, minimum)
    ):
        return True
    walking = [WALK.format(bias) for name, bias in _WALKS.items() if getattr(imu, name) > 0.0]
    sources = [*IMU_NOISE, *walking]
    squares = _squares(problem, minimum.evaluation, minimum.information, sources)
    return bool(walking) and _is_not_noise(*squares)


def _is_not_noise(squares: float, freedom: float) -> bool:
    """Whether residuals of the IMU are larger than data sheets are wrong, and than by chance."""
    freedom = max(freedom, 1.0)
    large = squares > _NOT_NOISE * freedom
    return large and bool(chdtrc(freedom, squares) < _CHANCE)


def _fits(problem: Problem, evaluation: Evaluation) -> bool:
    """Whether all sensors fit."""
    return all(
        float(np.sum(residual**2)) <= _FITS * max(int(np.count_nonzero(weight)), 1)
        for residual, weight in zip(evaluation.residuals, problem.weights, strict=True)
    )


def _finding(name: str, walk: float, stated: ImuSettings) -> Finding:
    text = message(
        "estimated_instead.walk",
        name=name,
        value=walk,
        stated=getattr(stated, name),
        unit=_UNITS[name],
    )
    return Finding(Code.ESTIMATED_INSTEAD, text, sensor="IMU", parameter=_WALKS[name])
