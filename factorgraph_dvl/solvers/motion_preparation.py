"""From a trial without IMU to the problem that its smoothing starts from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes, rotation_from_rph
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.graph.motion_chain import ChainProcess, MotionChain, chain_nodes
from factorgraph_dvl.graph.motion_problem import ATTITUDE, CURRENT, MotionProblem
from factorgraph_dvl.graph.priors import prior_mean
from factorgraph_dvl.imu.attitude_record import AttitudeRecord, level_axes
from factorgraph_dvl.initialization.dvl_mounting import initial_mountings
from factorgraph_dvl.initialization.record_clocks import clock_lags
from factorgraph_dvl.initialization.track_velocity import Track, body_track
from factorgraph_dvl.sensors.attitude import Attitude
from factorgraph_dvl.sensors.finding import Code, Finding
from factorgraph_dvl.sensors.ins import Ins
from factorgraph_dvl.sensors.message import message
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Aid, Motion, Observation
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.trial import Trial

# Sensors that ask more of the motion than attitude records and a motion prior give.
_NEED_IMU = frozenset({"star", "turntable", "beacons"})
# Turn rate, averaged over seconds, from which on a vessel turns. Chosen: above yaw in a seaway.
_TURNING = 0.4 * DEG
TURN_SPAN = 10.0
# Nodes come at most so far apart, s, and so many.
_LONGEST = 10.0
_MOST_NODES = 60_000
# Share of a ping's noise that the motion between two nodes may add. Chosen: 4 % of its variance,
# as what neighbouring pings share of it counts as independent.
_BETWEEN = 0.2
# Longest spans, s, over which positions make a velocity, over ground and through water. Chosen:
# below the time in which a ship turns; through water noise makes wrong clocks more likely.
_GROUND_SPAN, _WATER_SPAN = 5.0, 15.0
# Density of acceleration, m²/s³: a start value where the log does not show one, and the least.
_DENSITY = 1e-3
_LEAST_DENSITY = 1e-9
# Spans, s, over which changes of velocity on legs show the density; in turns, in which velocity
# changes steadily, they are the intervals of the pings.
_LEG_SPANS = (2.0, 10.0)
# Fewest pings that show which speeds are far off, and by how much: in standard deviations of all,
# and at least, m/s. Chosen: lever arms, currents and clocks that are off by seconds make less.
_FEWEST, _FAR_OFF, _FAR_OFF_M_S = 20, 8.0, 2.0
# Start values of the current as a process: standard deviation, m/s, and correlation time, s.
_CURRENT_STD, _CURRENT_TIME = 0.1, 3600.0


@dataclass(frozen=True)
class MotionPreparation:
    """A problem, and where its minimisation starts.

    Parameters
    ----------
    problem : MotionProblem
        What to minimise.
    states : ndarray, shape (K, n)
        Of the nodes.
    values : dict of str to ndarray
        Of the parameters.
    turning : ndarray of bool, shape (K - 1,)
        Whether the vessel turns between nodes.
    interval : float, s
        Least time between nodes where it does not.
    estimated_noise : frozenset of str
        Labels of measurements whose stated noise is a start value.
    current_is_free : bool
        Whether the strength of the current is to be estimated.
    findings : tuple of Finding
        What the user must know.
    """

    problem: MotionProblem
    states: Array
    values: dict[str, Array]
    turning: np.ndarray
    interval: float
    estimated_noise: frozenset[str]
    current_is_free: bool
    findings: tuple[Finding, ...]


def prepare_motion(trial: Trial) -> MotionPreparation:
    """Return the problem of a trial without IMU.

    Raises
    ------
    ConfigError
        If sensors are missing, or ask for an IMU.
    DataError
        If records are too short.
    """
    sensor = trial.attitude
    source = trial.position_sensor
    if sensor is None or source is None:
        raise ConfigError(
            "nothing measures the position",
            where="trial.yaml",
            expected="with `attitude`, also `gnss` or `ins`",
        )
    for aid in trial.aids:
        if aid.section in _NEED_IMU:
            raise ConfigError(
                f"`{aid.section}` needs an IMU",
                where="trial.yaml",
                expected="an imu section, or no such sensor",
            )
    frame = trial.frame()
    record = AttitudeRecord(sensor, trial.body_axes, estimated=trial.estimates_noise(sensor))
    water = trial.dvl is not None and trial.dvl.settings.reference == "water"
    longest = _WATER_SPAN if water else _GROUND_SPAN
    track = body_track(source, frame, record, longest=longest)
    observations, processes, estimated = _observed(trial, frame)
    parameters = _parameters(trial)
    values = {p.name: prior_mean(p) for p in parameters}
    values |= _start_values(trial, record, track, frame, parameters)
    clock = _clock(trial, frame)
    late = float(values[record.sensor.clock.offset.name][0])
    lag = float(values[clock][0])
    times = _node_candidates(trial, record, track, late=late, lag=lag)
    on_legs, in_turns, sigma = _densities(trial, record, values, late)
    turning_at = turns(record, times + late - lag)
    spacing = _BETWEEN**2 * 16.0 * sigma**2 / max(float(on_legs[:2].max()), _LEAST_DENSITY)
    spacing = max(spacing, (times[-1] - times[0]) / _MOST_NODES)
    spacing = min(spacing, _LONGEST)
    nodes = chain_nodes(times, turning_at, spacing)
    turning = turns(record, 0.5 * (nodes[1:] + nodes[:-1]) + late - lag)
    density = np.where(turning[:, None], in_turns, on_legs)
    chain = MotionChain(nodes, density, processes)
    p_n, v_n, _ = track.at(nodes - lag)
    states = np.hstack([p_n, v_n, np.zeros((nodes.size, chain.size - 6))])
    problem = MotionProblem(chain, frame, record, observations, parameters, states, clock)
    return MotionPreparation(
        problem=problem,
        states=states,
        values=values,
        turning=turning,
        interval=spacing,
        estimated_noise=estimated,
        current_is_free=chain.has(CURRENT) and _current(trial)[2],
        findings=(*trial.notes, *_notes(trial), *_left_out(trial)),
    )


def motion_observations(
    aid: Aid, frame: LocalFrame, body_axes: BodyAxes
) -> tuple[Observation, ...]:
    """Return what a sensor measures of the motion; an attitude is known, and not measured."""
    if isinstance(aid, Attitude):
        return ()
    if isinstance(aid, Ins):
        return aid.motion_observations(frame)
    return aid.observations(frame, body_axes)


def _observed(
    trial: Trial, frame: LocalFrame
) -> tuple[tuple[Observation, ...], tuple[ChainProcess, ...], frozenset[str]]:
    """Return measurements, errors that last, and the labels whose noise may be estimated."""
    assert trial.attitude is not None
    observations: list[Observation] = []
    processes: list[ChainProcess] = []
    estimated: set[str] = set()
    error = trial.attitude.error
    if error.sigma.any():
        processes.append(ChainProcess(ATTITUDE, error.sigma, error.tau))
    if trial.dvl is not None and trial.dvl.settings.reference == "water":
        sigma, tau, _ = _current(trial)
        processes.append(ChainProcess(CURRENT, np.full(2, sigma), tau))
    for aid in trial.aids:
        own = motion_observations(aid, frame, trial.body_axes)
        observations += own
        if isinstance(aid, Ins):
            share = np.sqrt(aid.settings.correlated_share)
            total = np.median(aid.total_std, axis=0)
            for seen, std in zip(own, (total[:3], total[3:6]), strict=True):
                if share > 0.0:
                    tau = aid.settings.correlation_time_s
                    processes.append(ChainProcess(seen.label, share * std, tau))
            continue
        for o in own:
            correlated = getattr(o, "correlated", None)
            if correlated is not None and correlated.sigma is not None:
                processes.append(ChainProcess(o.label, correlated.sigma, correlated.time))
            if trial.estimates_noise(aid) and o.noise_groups:
                estimated.add(o.label)
    return tuple(observations), tuple(processes), frozenset(estimated)


def _current(trial: Trial) -> tuple[float, float, bool]:
    """Return standard deviation, correlation time, and whether they are to be estimated."""
    assert trial.dvl is not None
    s = trial.dvl.settings
    sigma = s.current_variation_std_m_s
    tau = s.current_correlation_time_s
    known = isinstance(sigma, float) and isinstance(tau, float)
    return (
        sigma if isinstance(sigma, float) else _CURRENT_STD,
        tau if isinstance(tau, float) else _CURRENT_TIME,
        not known,
    )


def _parameters(trial: Trial) -> tuple[Parameter, ...]:
    """Return the parameters of all sensors; the clock of the positions is that of the trial.

    Without an IMU only differences of clocks show.
    """
    section = "ins" if trial.gnss is None else "gnss"
    out = []
    for aid in trial.aids:
        for p in aid.parameters():
            reference = aid.section == section and p.stem.endswith(("time_offset", "clock_rate"))
            out.append(replace(p, sigma=np.zeros_like(p.sigma)) if reference else p)
    return tuple(out)


def _start_values(
    trial: Trial,
    record: AttitudeRecord,
    track: Track,
    frame: LocalFrame,
    parameters: Sequence[Parameter],
) -> dict[str, Array]:
    """Return values of clocks and DVL that fit the track and the attitudes."""
    dvl = trial.log
    by_name = {p.name: p for p in parameters}
    attitude_clock = by_name[record.sensor.clock.offset.name]
    if dvl is None or not dvl.locked.any():
        return {}
    late = float(attitude_clock.mean[0])

    def motion_at(time: Array, attitude_late: float) -> tuple[Motion, np.ndarray]:
        p_n, v_n, known = track.at(time)
        stamp = time + attitude_late
        body = record.at(stamp, np.zeros((time.size, 3)), level_axes(frame, p_n))
        none = np.zeros_like(p_n)
        motion = Motion(body.nRb, p_n, v_n, body.omega_eb_b, none, body.alpha_b, body.omega_sigma)
        return motion, np.asarray(known & record.covers(stamp))

    dvl = rows_of(dvl, _without_gross_errors(dvl.time, dvl.velocity, dvl.locked, track))
    pings = np.flatnonzero(dvl.locked)
    pings = pings[:: max(pings.size // 3000, 1)]
    through_water = dvl.settings.reference == "water"
    clock = next(p for p in dvl.parameters() if p.name == "time_offset_s")
    lag, late = clock_lags(
        dvl.time[pings], dvl.velocity[pings], motion_at, clock, attitude_clock,
        current=through_water,
    )  # fmt: skip
    found = {attitude_clock.name: np.array([late])}
    if trial.dvl is None:
        return found
    settings = dvl.settings
    if through_water:
        # A mounting that fits better with another clock makes up for the current.
        settings = msgspec.structs.replace(settings, time_offset_std_s=0.0)
    shifted = replace(dvl, settings=settings, time=dvl.time - lag + float(clock.mean[0]))
    best = initial_mountings(shifted, lambda time: motion_at(time, late))[0]
    found |= {name: value for name, value in best.items() if name in by_name}
    if clock.name in found:
        found[clock.name] = found[clock.name] + lag - clock.mean
    return found


def _without_gross_errors(
    time: Array, velocity: Array, locked: Array, track: Track
) -> NDArray[np.intp]:
    """Return the pings whose speed is about that of the track: one that is far off turns a fit.

    No mounting changes a speed.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Of the pings.
    velocity : ndarray, shape (M, 3), m/s
        By the DVL.
    locked : ndarray of bool, shape (M,)
        Whether there is a velocity.
    track : Track
        Of the body.
    """
    _, v_n, covered = track.at(time)
    known = np.flatnonzero(covered & (locked > 0))
    if known.size < _FEWEST:
        return np.asarray(np.flatnonzero(locked))
    off = np.linalg.norm(velocity[known], axis=1) - np.linalg.norm(v_n[known], axis=1)
    off = np.abs(off - np.median(off))
    gate = max(_FAR_OFF * 1.4826 * float(np.median(off)), _FAR_OFF_M_S)
    return np.asarray(known[off < gate])


def _clock(trial: Trial, frame: LocalFrame) -> str:
    """Return the time offset of the clock of the nodes: that of the sensor they are tied to."""
    sensor = trial.find(Ins) or trial.dvl or trial.beams or trial.gnss
    assert sensor is not None
    clock = sensor.observations(frame, trial.body_axes)[0].clock
    assert clock is not None
    return clock.names[0]


def _node_candidates(
    trial: Trial, record: AttitudeRecord, track: Track, *, late: float, lag: float
) -> Array:
    """Return the times where nodes may be, and others in long gaps.

    An INS knows the motion at its samples: they are there. Fixes do not: they are between pings,
    as what the motion adds to a ping alone in its interval is independent of the others.

    Parameters
    ----------
    trial : Trial
        Without IMU.
    record : AttitudeRecord
        How the body points.
    track : Track
        Of the body.
    late, lag : float, s
        Time offsets of the attitude and of the nodes.
    """
    first = lag + max(track.time[0], record.time[0] - late) - 1.0
    last = lag + min(track.time[-1], record.time[-1] - late) + 1.0
    if last - first < 10.0:
        raise DataError(
            "positions and attitudes have less than 10 s in common",
            where=record.sensor.source,
            expected="records of the same time, by one clock",
        )
    own = own_times(trial, track.time)
    own = own[(own > first) & (own < last)]
    times = without_long_gaps(np.concatenate([[first], own, [last]]))
    return np.asarray(times[np.concatenate([[True], np.diff(times) > 1e-3])])


def own_times(trial: Trial, track_time: Array) -> Array:
    """Return the times at samples of an INS, between pings, or else between positions, s.

    Parameters
    ----------
    trial : Trial
        Without IMU.
    track_time : ndarray, shape (M,), s
        When positions were measured.
    """
    log, ins = trial.log, trial.find(Ins)
    if ins is not None:
        return np.asarray(ins.time[~np.isnan(ins.geodetic[:, 0])])
    own = track_time if log is None or log.locked.sum() < 2 else log.time[log.locked]
    return np.asarray(0.5 * (own[1:] + own[:-1]))


def without_long_gaps(edges: Array) -> Array:
    """Return times, s, with others in between where they are far apart."""
    wide = np.flatnonzero(np.diff(edges) > _LONGEST)
    more = [np.linspace(edges[i], edges[i + 1],
                        int(np.ceil((edges[i + 1] - edges[i]) / 5.0)) + 1)[1:-1]
            for i in wide]  # fmt: skip
    return np.unique(np.concatenate([edges, *more]))


def turns(record: AttitudeRecord, time: Array) -> np.ndarray:
    """Whether the heading changes over seconds about stamps (M,) of the attitude."""
    ahead = record.rph_at(time + 0.5 * TURN_SPAN)[:, 2]
    behind = record.rph_at(time - 0.5 * TURN_SPAN)[:, 2]
    return np.abs(ahead - behind) / TURN_SPAN > _TURNING


def _densities(
    trial: Trial, record: AttitudeRecord, values: dict[str, Array], late: float
) -> tuple[Array, Array, float]:
    """Return the density of acceleration east, north, up on legs and in turns, and a ping's noise.

    Stamps of the attitude are late by so many seconds.
    Velocities that are L apart differ by the density times L and by twice the noise: from two L
    both follow.
    """
    log = trial.log
    if log is None or log.locked.sum() < 50:
        return np.full(3, _DENSITY), np.full(3, _DENSITY), 0.1
    rows = np.flatnonzero(log.locked)
    time = log.time[rows] - float(values["time_offset_s"][0])
    rph = record.rph_at(time + late)
    bRd = values.get("misalignment_deg", np.eye(3)).T
    v_n = rotate(rotation_from_rph(rph, record.body_axes), log.velocity[rows] @ bRd.T)
    interval = float(np.median(np.diff(time)))
    turning = turns(record, time + late)

    def density(wanted: np.ndarray, spans: tuple[float, float]) -> Array:
        squares = []
        for span in spans:
            step = min(max(1, round(span / interval)), time.size - 1)
            alike = wanted[step:] & wanted[:-step]
            if step < round(span / interval) or alike.sum() < 20:
                return np.full(3, _DENSITY)
            squares.append(np.mean((v_n[step:] - v_n[:-step])[alike] ** 2, axis=0))
        found = np.maximum((squares[1] - squares[0]) / (spans[1] - spans[0]), 0.0)
        found[:2] = found[:2].mean()
        return np.maximum(found, 1e-6)

    on_legs = density(np.logical_not(turning), _LEG_SPANS)
    in_turns = density(turning, (interval, 2.0 * interval))
    return on_legs, in_turns, float(np.median(log.sigma()))


def _left_out(trial: Trial) -> list[Finding]:
    """Name errors that the trial states and that are not estimated without an IMU."""
    return [
        Finding(
            Code.ERROR_LEFT_OUT,
            message("error_left_out.change", section=aid.section, name=key),
            sensor=aid.label,
        )
        for aid in trial.aids
        for key in aid.settings.left_out
    ]


def _notes(trial: Trial) -> tuple[Finding, ...]:
    """Return what is left out, for the user."""
    if trial.find(Ins) is None or trial.find(Attitude) is None:
        return ()
    text = message("unused.ins_attitude")
    return (Finding(Code.UNUSED, text, sensor="INS"),)
