"""From a trial to a solution by one of the Kalman methods."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from factorgraph_dvl.baselines.beams import BeamPings, beam_filter, beam_residuals
from factorgraph_dvl.baselines.beams import (
    without_spurious_information as without_spurious_information_of_beams,
)
from factorgraph_dvl.baselines.least_squares import least_squares
from factorgraph_dvl.baselines.navigation import Navigation, motion_at, navigate
from factorgraph_dvl.baselines.nine_state import nine_state
from factorgraph_dvl.baselines.point_set_filter import point_set
from factorgraph_dvl.baselines.point_sets import Outcome, Points
from factorgraph_dvl.baselines.spurious_information import without_spurious_information
from factorgraph_dvl.baselines.star_calibration import calibrate_gyros
from factorgraph_dvl.baselines.summary import as_sensors_see, dvl_residuals, summarise
from factorgraph_dvl.baselines.wahba import wahba
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.imu.timestamps import JUMP, without_strays
from factorgraph_dvl.sensors.dvl import Dvl
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.solution import Residuals, Solution
from factorgraph_dvl.trial import Trial

DvlMethod = Literal["point-set", "nine-state", "wahba", "least-squares"]
DVL_METHODS: tuple[DvlMethod, ...] = get_args(DvlMethod)
Method = DvlMethod | Literal["star", "beams"]
METHODS: tuple[Method, ...] = (*DVL_METHODS, "star", "beams")
Progress = Callable[[str, int, float | None], None]

_WHITE = (
    "the error of the SINS/GNSS velocity is taken for white noise; it is correlated in time, so "
    "the standard deviations of the DVL's parameters are too small"
)
_UNCORRELATED = (
    "of the calibration in dvl.calibration values and standard deviations are the prior; these "
    "methods take no correlations"
)
_NEGLECTED: dict[DvlMethod, tuple[str, ...]] = {
    "point-set": ("dvl_bias", "time_offset"),
    "nine-state": ("lever_arm", "time_offset"),
    "wahba": ("lever_arm", "dvl_bias", "time_offset"),
    "least-squares": (),
}
# GNSS that is missing for longer, s, leaves an INS to drift beyond what its filter models.
_LONGEST_GAP = 300.0
# Offsets that a search may try must stay within the IMU's record, s.
_MARGIN = 1.0


@dataclass(frozen=True)
class History:
    """How a recursive filter converged.

    Parameters
    ----------
    time : ndarray, shape (H,), s
    names : tuple of str
        Of the n components, as in `covariance.order`.
    values, std : ndarray, shape (H, n)
        In reported units.
    """

    time: Array
    names: tuple[str, ...]
    values: Array
    std: Array


def kalman(
    trial: Trial,
    method: Method = "point-set",
    *,
    rate_hz: float = 10.0,
    progress: Progress | None = None,
) -> Solution:
    """Return the solution of `calibrate` without the history."""
    return calibrate(trial, method, rate_hz=rate_hz, progress=progress)[0]


def calibrate(
    trial: Trial,
    method: Method = "point-set",
    *,
    rate_hz: float = 10.0,
    progress: Progress | None = None,
) -> tuple[Solution, History | None]:
    """Calibrate a DVL or gyros against a Kalman filter, and tell how it converged.

    First IMU and GNSS are filtered and smoothed without the DVL; then its velocities are
    held against the smoothed ones. So the joint covariance has two blocks, DVL and IMU:
    correlations between them exist, but this approach cannot know them.

    The method `star` estimates the drift of the gyros against a star tracker instead.

    Parameters
    ----------
    trial : Trial
        With IMU, GNSS and DVL, or its beams, or star tracker.
    method : Method, default 'point-set'
        `point-set` (seven states), `nine-state`, `wahba` or `least-squares`, which take beams
        without a DVL beside them for the velocity that they amount to; `star`; or `beams`, an
        extended Kalman filter of single beams.
    rate_hz : float, default 10.0
        Rate of the trajectory in the solution.
    progress : callable, optional
        Called with stage, iteration and cost (always None here).

    Returns
    -------
    Solution
    History
        None for the methods that are not recursive.

    Raises
    ------
    ConfigError, DataError
        If the trial cannot be calibrated this way.
    """
    if method not in METHODS:
        raise ConfigError(f"method is {method!r}", expected=f"one of {', '.join(METHODS)}")
    if not (np.isfinite(rate_hz) and rate_hz > 0.0):
        raise ConfigError(f"rate_hz is {rate_hz}", expected="a number above 0")
    report = progress or (lambda stage, iteration, cost: None)
    trial = without_strays(trial)
    if method == "star":
        report("SINS/stars", 0, None)
        solution, outcome = calibrate_gyros(trial, rate_hz=rate_hz)
        return solution, _history(outcome)
    if method == "beams":
        return _calibrate_beams(trial, rate_hz, report)
    dvl = trial.log
    if dvl is None:
        raise DataError(
            "the trial has no DVL",
            where="trial.yaml",
            expected="a dvl section",
            hint="The method `star` needs none",
        )
    if dvl.settings.reference == "water":
        raise ConfigError(
            "the point-set methods know no current, and this DVL measures through the water",
            where="trial.yaml dvl.reference",
            expected="bottom",
            hint="`solve` estimates the current",
        )
    report("SINS/GNSS", 0, None)
    prior = {p.stem: p for p in dvl.parameters()}
    offset = float(prior["time_offset"].mean[0])
    navigation = navigate(trial, dvl.time[dvl.locked] - offset)
    report(method, 0, None)
    points_at, unused = _point_sets(navigation, dvl)
    outcome = _calibrate(method, points_at, dvl)
    report("summary", 0, None)
    points = points_at(offset)
    arm = prior["lever_arm"].mean
    outcome = replace(
        outcome, estimated=without_spurious_information(points, outcome.estimated, arm)
    )
    joint = [_UNCORRELATED] if dvl.prior is not None else []
    notes = [
        *navigation.notes,
        *_outage(trial),
        *joint,
        *outcome.warnings,
        _WHITE,
        *_neglects(method, dvl),
    ]
    if unused:
        notes.append(f"DVL: {unused} pings at times without SINS/GNSS were not used")
    solution = summarise(
        trial,
        navigation,
        outcome,
        aid=dvl,
        measured=dvl_residuals(dvl, navigation, outcome, points),
        seen=as_sensors_see(points),
        solver=f"kalman-{method}",
        rate_hz=rate_hz,
        notes=notes,
    )
    return solution, _history(outcome)


def _outage(trial: Trial) -> list[str]:
    """Say that GNSS is missing for too long, if it is."""
    assert trial.gnss is not None
    fixes = trial.gnss.time[~np.isnan(trial.gnss.geodetic[:, 0])]
    time = trial.imu.time
    jumps = np.flatnonzero(np.diff(time) > JUMP)
    edges = np.sort(np.concatenate([time[:1], fixes, time[jumps], time[jumps + 1], time[-1:]]))
    longest = float(np.diff(edges)[~np.isin(edges[:-1], time[jumps])].max())
    if longest <= _LONGEST_GAP:
        return []
    return [
        f"GNSS is missing for {longest:.0f} s: the SINS/GNSS filter drifts there, and neither its "
        "motion nor the calibration is to be used; `solve` bridges it"
    ]


def _calibrate_beams(
    trial: Trial, rate_hz: float, report: Progress
) -> tuple[Solution, History | None]:
    sensor = trial.beams
    if sensor is None:
        raise DataError(
            "the trial has no beams", where="trial.yaml", expected="a dvl_beams section"
        )
    if sensor.settings.parametrisation != "beams":
        raise ConfigError(
            "the filter estimates every beam on its own",
            where="trial.yaml dvl_beams.parametrisation",
            expected="beams",
            hint="For a common misalignment and scale take another --method",
        )
    report("SINS/GNSS", 0, None)
    received = np.logical_not(sensor.missing)
    navigation = navigate(trial, sensor.time[received])
    report("beams", 0, None)
    covered = motion_at(navigation, sensor.time).covered
    used = received & covered
    motion = motion_at(navigation, sensor.time[used])
    pings = BeamPings(motion, sensor.nominal_b, sensor.velocity[used], sensor.sigma()[used])
    outcome = beam_filter(pings, sensor.parameters())
    report("summary", 0, None)
    outcome = replace(
        outcome, estimated=without_spurious_information_of_beams(pings, outcome.estimated)
    )
    residual, sigma = beam_residuals(pings, outcome.estimated)
    components = tuple(f"beam {i}" for i in range(1, residual.shape[1] + 1))
    notes = [*navigation.notes, _WHITE]
    unused = int(np.sum(received & ~covered))
    if unused:
        notes.append(f"{sensor.label}: {unused} pings at times without SINS/GNSS were not used")
    solution = summarise(
        trial,
        navigation,
        outcome,
        aid=sensor,
        measured=Residuals("Beam velocity", "m/s", components, motion.time, residual, sigma),
        seen=as_sensors_see(motion),
        solver="kalman-beams",
        rate_hz=rate_hz,
        notes=notes,
    )
    return solution, _history(outcome)


def _point_sets(navigation: Navigation, dvl: Dvl) -> tuple[Callable[[float], Points], int]:
    """Return the point sets as a function of the time offset, and how many pings fall out."""
    prior = next(p for p in dvl.parameters() if p.stem == "time_offset")
    mean = float(prior.mean[0])
    reach = min(4.0 * float(prior.sigma[0]), _MARGIN)
    locked = np.flatnonzero(dvl.locked)
    covered = np.ones(locked.size, dtype=bool)
    for offset in {mean - reach, mean, mean + reach}:
        covered &= motion_at(navigation, dvl.time[locked] - offset).covered
    used = locked[covered]
    sigma = dvl.sigma()[used]

    def points_at(offset: float) -> Points:
        motion = motion_at(navigation, dvl.time[used] - offset)
        return Points(
            motion.time,
            motion.v_b,
            motion.v_b_covariance,
            motion.omega_b,
            motion.omega_sigma,
            dvl.velocity[used],
            sigma,
        )

    return points_at, int(locked.size - used.size)


def _calibrate(method: DvlMethod, points_at: Callable[[float], Points], dvl: Dvl) -> Outcome:
    parameters = {p.stem: p for p in dvl.parameters()}
    misalignment, arm = parameters["misalignment"], parameters["lever_arm"]
    scale, bias, offset = (parameters[s] for s in ("scale_error", "dvl_bias", "time_offset"))
    if method == "least-squares":
        return least_squares(points_at, (misalignment, scale, arm, bias, offset))
    points = points_at(float(offset.mean[0]))
    if method == "nine-state":
        return nine_state(points, misalignment, scale, bias, arm.mean)
    single = _single(scale)
    if method == "wahba":
        return wahba(points, misalignment, single, arm.mean)
    return point_set(points, misalignment, single, arm)


def _single(scale: Parameter) -> Parameter:
    """Return one scale error for all axes."""
    return Parameter(
        scale.stem,
        scale.unit,
        scale.si,
        np.array([scale.mean.mean()]),
        np.array([scale.sigma.max()]),
        labels=("",),
    )


def _neglects(method: DvlMethod, dvl: Dvl) -> list[str]:
    """Say which parameters of the trial the method does not estimate."""
    parameters = {p.stem: p for p in dvl.parameters()}
    out = [
        f"{method} does not estimate {p.name}: held at {np.round(p.mean / p.si, 6).tolist()}"
        for p in (parameters[stem] for stem in _NEGLECTED[method])
        if p.estimated
    ]
    if method in ("point-set", "wahba") and parameters["scale_error"].mean.size == 3:
        out.append(f"{method} estimates one scale error for the three axes")
    return out


def _history(outcome: Outcome) -> History | None:
    if not outcome.history:
        return None
    reported = [estimated.reported() for _, estimated in outcome.history]
    names = tuple(n for p in outcome.estimated.parameters for n in p.component_names)
    return History(
        time=np.array([time for time, _ in outcome.history]),
        names=names,
        values=np.stack([values for values, _ in reported]),
        std=np.stack([np.sqrt(np.maximum(np.diag(P), 0.0)) for _, P in reported]),
    )
