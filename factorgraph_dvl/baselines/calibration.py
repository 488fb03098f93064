"""From a trial to a solution by one of the Kalman methods."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from factorgraph_dvl.baselines.beam_calibration import calibrate_beams
from factorgraph_dvl.baselines.evolution import evolved
from factorgraph_dvl.baselines.kinsey_whitcomb import kinsey_whitcomb
from factorgraph_dvl.baselines.least_squares import least_squares
from factorgraph_dvl.baselines.luo_2024 import as_printed
from factorgraph_dvl.baselines.navigation import Navigation, attitude_is_known, navigate
from factorgraph_dvl.baselines.nine_state import nine_state, unscented, with_bias
from factorgraph_dvl.baselines.outcome import History, Outcome, history_of
from factorgraph_dvl.baselines.point_set_filter import point_set
from factorgraph_dvl.baselines.point_sets import Points
from factorgraph_dvl.baselines.recorded_navigation import (
    RecordedNavigation,
    recorded_navigation,
)
from factorgraph_dvl.baselines.residual_covariance import neglected_by
from factorgraph_dvl.baselines.ship_adcp import horizontal, joyce, outcome_of, pollard_read
from factorgraph_dvl.baselines.single_beacon import METHODS as BEACON_METHODS
from factorgraph_dvl.baselines.single_beacon import Method as BeaconMethod
from factorgraph_dvl.baselines.single_beacon import filter_planar
from factorgraph_dvl.baselines.spurious_information import without_spurious_information
from factorgraph_dvl.baselines.star_calibration import calibrate_gyros
from factorgraph_dvl.baselines.summary import (
    dvl_residuals,
    left_out,
    sensor_motion,
    summarise,
    treated_as_white,
)
from factorgraph_dvl.baselines.three_points import three_points
from factorgraph_dvl.baselines.wahba import wahba
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.geometry.rotations import BodyAxes, rph_from_rotation
from factorgraph_dvl.imu.timestamps import JUMP, without_restarted_clock
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.dvl import SCALE_SPEC, Dvl
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.solution import Progress, Solution
from factorgraph_dvl.trial import Trial

DvlMethod = Literal[
    "point-set",
    "luo-2024",
    "nine-state",
    "nine-state-linear",
    "nine-state-ukf",
    "wahba",
    "least-squares",
    "differential-evolution",
    "kinsey-whitcomb",
    "three-points",
    "joyce",
    "pollard-read",
]
DVL_METHODS: tuple[DvlMethod, ...] = get_args(DvlMethod)
Method = DvlMethod | BeaconMethod | Literal["star", "liu-2020", "beams"]
METHODS: tuple[Method, ...] = (*DVL_METHODS, "star", "liu-2020", "beams", *BEACON_METHODS)

_UNCORRELATED = Finding(Code.METHOD_LIMITS, message("method_limits.uncorrelated_prior"))
_NEGLECTED: dict[DvlMethod, tuple[str, ...]] = {
    "point-set": ("dvl_bias", "time_offset"),
    "luo-2024": ("dvl_bias", "time_offset"),
    "nine-state": ("lever_arm", "time_offset"),
    "nine-state-linear": ("lever_arm", "time_offset"),
    "nine-state-ukf": ("lever_arm", "time_offset"),
    "wahba": ("lever_arm", "dvl_bias", "time_offset"),
    "least-squares": (),
    "differential-evolution": ("dvl_bias", "time_offset"),
    "kinsey-whitcomb": ("scale_error", "lever_arm", "dvl_bias", "time_offset"),
    "three-points": ("lever_arm", "dvl_bias", "time_offset"),
    "joyce": ("lever_arm", "dvl_bias", "time_offset"),
    "pollard-read": ("lever_arm", "dvl_bias", "time_offset"),
}
_ONE_SCALE = (
    "point-set",
    "luo-2024",
    "wahba",
    "differential-evolution",
    "three-points",
    "joyce",
    "pollard-read",
)
# Methods that have no standard deviations of their own.
_NO_SIGMA = ("differential-evolution", "kinsey-whitcomb")
# Methods that a current does not mislead.
_THROUGH_WATER = ("joyce", "pollard-read")
# Chosen: longest gap of GNSS, s. Over a longer one the INS drifts beyond the linear error model.
_LONGEST_GAP = 300.0
# Chosen: time offsets that a search may try, s; pings nearer to the ends are not used.
_MARGIN = 1.0


def kalman(
    trial: Trial,
    method: Method | None = None,
    *,
    rate_hz: float = 10.0,
    progress: Progress | None = None,
) -> Solution:
    """Return the solution of `calibrate` without the history.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> found = fd.kalman(fd.simulate("examples/short.yaml", seed=1), "least-squares")
    >>> found.solver
    'kalman-least-squares'
    """
    return calibrate(trial, method, rate_hz=rate_hz, progress=progress)[0]


def calibrate(
    trial: Trial,
    method: Method | None = None,
    *,
    rate_hz: float = 10.0,
    progress: Progress | None = None,
) -> tuple[Solution, History | None]:
    """Calibrate a DVL or gyros against a Kalman filter, and return how it converged.

    IMU and GNSS are filtered and smoothed without the DVL, whose velocities are then compared
    with the smoothed ones. So the joint covariance has two blocks, DVL and IMU: the approach
    neglects the correlations between them.

    The methods `star` and `liu-2020` estimate the drift of the gyros against a star tracker
    instead, and `4sv-2ob` and `4sv-3ob` the track of a planar trial and the current.

    Parameters
    ----------
    trial : Trial
        Trial with IMU, GNSS and DVL, or its beams, or star tracker. Without IMU, an INS, or GNSS
        with a compass, is what the DVL is compared with. Or a planar trial, with its first
        position.
    method : Method, optional
        Method; by default `point-set`, and `4sv-3ob` for a planar trial.
        `point-set` (seven states), `luo-2024` (the same as printed), `nine-state`,
        `nine-state-linear` (as printed), `nine-state-ukf`, `wahba`, `least-squares`,
        `differential-evolution`, `kinsey-whitcomb`, `three-points` (Tang et al.), or the fits
        `joyce` and `pollard-read` for ships. These take beams without a DVL beside them for the
        velocity that they amount to. `star`, or `liu-2020` as printed; `beams`, an extended
        Kalman filter of single beams; or, for planar trials, `4sv-2ob` or `4sv-3ob`.
    rate_hz : float, default 10.0
        Rate of the trajectory in the solution.
    progress : callable, optional
        Called with stage, iteration and cost (always None here).

    Returns
    -------
    solution : Solution
        Trajectory, calibration and covariance.
    history : History or None
        None for the methods that are not recursive.

    Raises
    ------
    ConfigError, DataError
        If the trial cannot be calibrated this way.
    """
    if method is None:
        method = "4sv-3ob" if trial.planar else "point-set"
    if method not in METHODS:
        raise ConfigError(f"method is {method!r}", expected=f"one of {', '.join(METHODS)}")
    if not (np.isfinite(rate_hz) and rate_hz > 0.0):
        raise ConfigError(f"rate_hz is {rate_hz}", expected="a number above 0")
    report = progress or (lambda stage, iteration, cost: None)
    if method == "4sv-2ob" or method == "4sv-3ob":
        return filter_planar(trial, method, progress=report)
    trial = (trial if trial.imu is None else without_restarted_clock(trial)).on_one_clock()
    if method == "star" or method == "liu-2020":
        report("SINS/stars", 0, None)
        solution, outcome = calibrate_gyros(trial, rate_hz=rate_hz, printed=method == "liu-2020")
        return solution, history_of(outcome)
    if method == "beams":
        solution, outcome = calibrate_beams(trial, rate_hz=rate_hz, report=report)
        return solution, history_of(outcome)
    return _calibrate_dvl(trial, _dvl_of(trial, method), method, rate_hz, report)


def _dvl_of(trial: Trial, method: DvlMethod) -> Dvl:
    """Return the DVL that a method calibrates.

    Raises
    ------
    ConfigError, DataError
        If there is none, or it measures through the water, for which the method does not allow.
    """
    dvl = trial.log
    if dvl is None:
        raise DataError(
            "the trial has no DVL",
            where="trial.yaml",
            expected="a dvl section",
            hint="The method `star` needs none",
        )
    if dvl.settings.reference == "water" and method not in _THROUGH_WATER:
        raise ConfigError(
            "the point-set methods do not estimate a current, and this DVL measures through the "
            "water",
            where="trial.yaml dvl.reference",
            expected="bottom",
            hint="`solve` estimates the current; methods joyce and pollard-read allow for it",
        )
    return dvl


def _calibrate_dvl(
    trial: Trial, dvl: Dvl, method: DvlMethod, rate_hz: float, report: Progress
) -> tuple[Solution, History | None]:
    """Calibrate a DVL against the smoothed motion; see `calibrate`."""
    prior = {p.stem: p for p in dvl.parameters()}
    offset = float(prior["time_offset"].mean[0])
    pings = dvl.time[dvl.locked] - offset
    report("motion", 0, None)
    navigation: Navigation | RecordedNavigation
    if trial.imu is None:
        navigation = recorded_navigation(trial)
    else:
        navigation = navigate(trial, pings, smoothed=method != "luo-2024")
    report(method, 0, None)
    points_at, unused = point_sets(navigation, dvl, as_printed=method == "luo-2024")
    points = points_at(offset)
    if method in ("joyce", "pollard-read", "three-points"):
        outcome = _by_track(method, navigation, points, dvl, trial.body_axes)
    else:
        outcome = _calibrate(method, points_at, dvl)
    report("summary", 0, None)
    arm = prior["lever_arm"].mean
    outcome = replace(
        outcome, estimated=without_spurious_information(points, outcome.estimated, arm)
    )
    lasting = neglected_by(points, navigation.at(points.time), outcome.estimated, arm)
    joint = [_UNCORRELATED] if dvl.prior is not None else []
    findings = [
        *navigation.findings,
        *_outage(trial),
        *joint,
        *outcome.findings,
        treated_as_white(outcome.estimated, lasting),
        *_neglects(method, dvl),
        *left_out(dvl, *unused),
    ]
    solution = summarise(
        trial,
        navigation,
        outcome,
        aid=dvl,
        measured=dvl_residuals(dvl, navigation, outcome, points),
        motion=sensor_motion(points),
        solver=f"kalman-{method}",
        rate_hz=rate_hz,
        findings=findings,
    )
    return solution, history_of(outcome)


def _outage(trial: Trial) -> list[Finding]:
    """Say that GNSS is missing for too long, if it is."""
    if trial.imu is None or trial.gnss is None:
        return []
    fixes = trial.gnss.time[~np.isnan(trial.gnss.geodetic[:, 0])]
    time = trial.inertial.time
    jumps = np.flatnonzero(np.diff(time) > JUMP)
    edges = np.sort(np.concatenate([time[:1], fixes, time[jumps], time[jumps + 1], time[-1:]]))
    longest = float(np.diff(edges)[~np.isin(edges[:-1], time[jumps])].max())
    if longest <= _LONGEST_GAP:
        return []
    return [Finding(Code.GNSS_OUTAGE, message("gnss_outage.long", duration=longest))]


def _by_track(
    method: DvlMethod,
    navigation: Navigation | RecordedNavigation,
    points: Points,
    dvl: Dvl,
    body_axes: BodyAxes,
) -> Outcome:
    """Return angles and scale as fits show them that need the track in navigation axes."""
    parameters = {p.stem: p for p in dvl.parameters()}
    misalignment, arm = parameters["misalignment"], parameters["lever_arm"]
    motion, scale = navigation.at(points.time), _single(parameters["scale_error"])
    if method == "three-points":
        return three_points(motion, points.v_d, misalignment, scale, arm.mean, body_axes)
    ship, adcp = horizontal(motion, points.v_d, misalignment, arm.mean)
    water = dvl.settings.reference == "water"
    if method == "joyce":
        c, sigma = joyce(points.time, ship, adcp, water=water)
    else:
        heading = rph_from_rotation(motion.nRb, body_axes)[:, 2]
        c, sigma = pollard_read(points.time, heading, ship, adcp, water=water)
    return outcome_of(c, sigma, misalignment, scale, body_axes)


def point_sets(
    navigation: Navigation | RecordedNavigation, dvl: Dvl, *, as_printed: bool
) -> tuple[Callable[[float], Points], tuple[int, int]]:
    """Return the point sets as a function of the time offset, and how many pings fall out.

    Outside the motion to compare with, and where it leaves the heading open; the printed filter
    takes the latter.
    """
    prior = next(p for p in dvl.parameters() if p.stem == "time_offset")
    mean = float(prior.mean[0])
    reach = min(4.0 * float(prior.sigma[0]), _MARGIN)
    locked = np.flatnonzero(dvl.locked)
    covered = np.ones(locked.size, dtype=bool)
    known = covered.copy()
    for offset in {mean - reach, mean, mean + reach}:
        motion = navigation.at(dvl.time[locked] - offset)
        covered &= motion.covered
        known &= motion.covered if as_printed else attitude_is_known(motion)
    used = locked[known]
    sigma = dvl.sigma()[used]

    def points_at(offset: float) -> Points:
        motion = navigation.at(dvl.time[used] - offset)
        return Points(
            motion.time,
            motion.v_b,
            motion.v_b_covariance,
            motion.omega_b,
            motion.omega_sigma,
            dvl.velocity[used],
            sigma,
        )

    return points_at, (int(np.sum(~covered)), int(np.sum(covered & ~known)))


def _calibrate(method: DvlMethod, points_at: Callable[[float], Points], dvl: Dvl) -> Outcome:
    parameters = {p.stem: p for p in dvl.parameters()}
    misalignment, arm = parameters["misalignment"], parameters["lever_arm"]
    scale, bias, offset = (parameters[s] for s in ("scale_error", "dvl_bias", "time_offset"))
    if method == "least-squares":
        return least_squares(points_at, (misalignment, scale, arm, bias, offset))
    points = points_at(float(offset.mean[0]))
    if method == "nine-state-ukf":
        three, findings = with_bias(misalignment, scale, bias)
        return unscented(points, three, arm.mean, findings)
    if method in ("nine-state", "nine-state-linear"):
        iterated = method == "nine-state"
        return nine_state(points, misalignment, scale, bias, arm.mean, iterated=iterated)
    if method == "kinsey-whitcomb":
        return kinsey_whitcomb(points, misalignment, arm.mean)
    single = _single(scale)
    if method == "differential-evolution":
        return evolved(points, misalignment, single, arm)
    if method == "wahba":
        return wahba(points, misalignment, single, arm.mean)
    if method == "luo-2024":
        return as_printed(points, misalignment, single, arm)
    return point_set(points, misalignment, single, arm)


def _single(scale: Parameter) -> Parameter:
    """Return one scale error for all axes."""
    return Parameter(SCALE_SPEC, np.array([scale.mean.mean()]), np.array([scale.sigma.max()]))


def _neglects(method: DvlMethod, dvl: Dvl) -> list[Finding]:
    """Say which parameters of the trial the method does not estimate."""
    parameters = {p.stem: p for p in dvl.parameters()}
    out = [
        Finding(
            Code.METHOD_LIMITS,
            message(
                "method_limits.fixed",
                method=method,
                name=p.name,
                value=str(np.round(p.mean / p.si, 6).tolist()),
            ),
            parameter=p.name,
        )
        for p in (parameters[stem] for stem in _NEGLECTED[method])
        if p.estimated
    ]
    if method in _ONE_SCALE and parameters["scale_error"].mean.size == 3:
        text = message("method_limits.one_scale", method=method)
        out.append(Finding(Code.METHOD_LIMITS, text, parameter=parameters["scale_error"].name))
    if method in _NO_SIGMA:
        text = message("method_limits.no_sigma", method=method)
        out.append(Finding(Code.METHOD_LIMITS, text))
    if method == "three-points":
        text = message("method_limits.positions_alone", method=method)
        out.append(Finding(Code.METHOD_LIMITS, text))
    return out
