"""From a trial without IMU to where its minimisation starts: nodes, states, values of clocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes, rotation_from_rph
from factorgraph_dvl.geometry.vectors import Array, BoolArray, IntArray, spread
from factorgraph_dvl.graph.chain import Chain
from factorgraph_dvl.graph.priors import Tilt, prior_mean
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.graph.processes import Process, node_times
from factorgraph_dvl.graph.smooth_chain import (
    ChainStates,
    SmoothChain,
    far_apart,
    without_long_steps,
)
from factorgraph_dvl.graph.smooth_motion import SmoothStates
from factorgraph_dvl.imu.attitude_record import AttitudeRecord, level_axes
from factorgraph_dvl.initialization.dvl_mounting import initial_mountings
from factorgraph_dvl.initialization.mountings import strays
from factorgraph_dvl.initialization.record_clocks import clock_lags
from factorgraph_dvl.initialization.track_velocity import Track, body_track
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.results import errors_left_out
from factorgraph_dvl.sensors.attitude import Attitude
from factorgraph_dvl.sensors.clock import CLOCK_STEMS, on_shared_clocks
from factorgraph_dvl.sensors.ins import Ins
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Aid, Motion, Observation
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.solvers.correlated_noise import correlated_noise
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum
from factorgraph_dvl.solvers.motion_strengths import LEAST_GAIN, Strengths, motion_strengths
from factorgraph_dvl.solvers.phases import STAYS, each_phase, phases
from factorgraph_dvl.solvers.position_from_ranges import StartPositions
from factorgraph_dvl.solvers.preparation import MountedStart
from factorgraph_dvl.trial import Trial

CURRENT = "current"
# Sensors that ask more of the motion than a motion prior gives.
_NEED_IMU = frozenset({"star", "turntable"})
# Span, s, over which the heading of the track is averaged, and interval of its samples. Chosen:
# waves that move a ship are shorter, its turns longer.
WAVES, _GRID = 20.0, 0.5
# Longest time between nodes, s, and most nodes. Chosen: waves that move a ship are resolved.
LONGEST = 1.5
_MOST_NODES = 60_000
# Longest spans, s, over which positions make a velocity, over ground and through water. Chosen:
# below the time in which a ship turns; through water noise makes wrong clocks more likely.
_GROUND_SPAN, _WATER_SPAN = 5.0, 15.0
# Density of acceleration, m²/s³, where the log does not show one.
_DENSITY = 1e-3
# Share of the time between nodes by which their attitudes are earlier. Where a ping is at a node
# of attitudes, their acceleration jumps, and clocks may stay there: half-way is farthest.
_EARLY = 0.5
# Share of it by which clocks may move them before other nodes take their place: those have another
# likelihood, beside which strengths do not compare. Chosen: half the way to a ping.
_MOVED = 0.25
# Share of it from which on the interval of attitudes is about as long. Chosen: one in between.
_RARE = 0.7
# Least densities, m²/s³ and rad²/s³. Chosen: they keep the chain regular.
LEAST_DENSITY = np.repeat([1e-12, 1e-9], 3)
# Spans, s, over which changes of velocity on legs show the density; in turns, in which velocity
# changes steadily, they are the intervals of the pings.
_LEG_SPANS = (2.0, 10.0)
# Fewest pings that show which speeds are far off, and by how much: in standard deviations of all,
# and at least, m/s. Chosen: lever arms, currents and clocks that are off by seconds make less.
_FEWEST, _FAR_OFF, _FAR_OFF_M_S = 20, 8.0, 2.0
# Start values of the current as a process: standard deviation, m/s, and correlation time, s.
_CURRENT_STD, _CURRENT_TIME = 0.5, 3600.0
# Index of the current among processes. Chosen: after those of all observations.
_CURRENT_INDEX = 30


@dataclass(frozen=True)
class PreparationWithoutImu:
    """What every minimisation of a trial without IMU starts from.

    Parameters
    ----------
    trial : Trial
        The trial.
    first_chain : SmoothChain
        Nodes, with densities to start from.
    states : SmoothStates
        States of the nodes.
    record : AttitudeRecord
        Whose heading the track follows.
    values : dict of str to ndarray
        Values of clocks and mountings.
    phase : ndarray of int, shape (K - 1, 6)
        What heading and vertical speed do between nodes, for each acceleration.
    observations : tuple of Observation
        Measurements of all sensors.
    parameters : tuple of Parameter
        Calibration parameters of all sensors, fixed ones included.
    processes : tuple of Process
        Processes of the current, if the velocity is through water.
    estimated_noise : frozenset of str
        Labels of the observations whose stated noise is only where to start.
    findings : tuple of Finding
        What the user must know.
    noise_factors : mapping of str to ndarray, optional
        Factors (d,) of each label on stated noise to start from; by default none.
    least_gain : float, optional
        Gain of a strength from which on another estimate follows.
    tilt : Tilt, optional
        Where the minimisation starts; by default constants are fixed while states are found.
    """

    trial: Trial
    first_chain: SmoothChain
    states: SmoothStates
    record: AttitudeRecord
    values: dict[str, Array]
    phase: IntArray
    observations: tuple[Observation, ...]
    parameters: tuple[Parameter, ...]
    processes: tuple[Process, ...]
    estimated_noise: frozenset[str]
    findings: tuple[Finding, ...]
    noise_factors: Mapping[str, Array] = field(default_factory=dict)
    least_gain: float = LEAST_GAIN
    tilt: Tilt | None = None

    @property
    def start_positions(self) -> StartPositions:
        """States to start from: the records know the position."""
        return StartPositions((self.states,))

    @property
    def rejected(self) -> Mapping[str, Array]:
        """Return none: gross errors are found by the minimisation."""
        return {}

    def chain(self, states: SmoothStates) -> SmoothChain:
        """Return the nodes, with densities to start from."""
        return self.first_chain

    def stated_processes(
        self, chain: Chain, states: SmoothStates, values: Mapping[str, Array]
    ) -> tuple[Process, ...]:
        """Return the processes that the trial states, and those of what is no error."""
        problem = Problem(chain, self.observations, self.parameters, start=dict(values))
        every = problem.prior_values() | dict(values)
        evaluation = problem.evaluate(problem.values(states, every))
        problem.weigh(evaluation)
        return (*correlated_noise(problem, evaluation, ()).processes, *self.processes)

    def first_tilt(self, values: Mapping[str, Array]) -> Tilt:
        """Return the gradient of the states' volume by the constants to start from."""
        return self.tilt or Tilt.holding(self.parameters, values)

    def strengths(self, problem: Problem, minimum: Minimum) -> Strengths:
        """Return the strengths of motion and noise that residuals ask for."""
        found = motion_strengths(problem, minimum, self.phase, self.least_gain)
        chain, states = self.laid_by(minimum.evaluation.parameters, found.chain, found.states)
        return replace(found, chain=chain, states=states)

    def laid_by(
        self, values: Mapping[str, Array], chain: SmoothChain, states: SmoothStates
    ) -> tuple[SmoothChain, SmoothStates]:
        """Return a chain and its states, with attitudes where these clocks ask for them.

        Both are as they were where the clocks ask for about the same.
        """
        interval = float(np.median(np.diff(chain.node_time)))
        shift = chain.shift(values) - _EARLY * interval
        moved = abs(shift - chain.attitude_shift)
        if _sparse(self.record, interval) or moved < _MOVED * interval:
            return chain, states
        lag = 0.0 if chain.clock is None else float(values[chain.clock][0])
        late = float(values[self.record.sensor.clock.offset.name][0])
        axes = track_axes(self.record, chain.frame, self.states, chain.node_time - lag, late)
        return _anew(replace(chain, nRt=axes), chain.states(chain.values(states)), shift)

    def start(self, chain: Chain, states: SmoothStates, report: Progress) -> MountedStart:
        """Return where the minimisation starts: motion and mountings are known by the records."""
        return MountedStart(states, self.values, strays(self.trial), 0)


def prepare_without_imu(trial: Trial) -> PreparationWithoutImu:
    """Return nodes, start states and measurements of a trial without IMU.

    Raises
    ------
    ConfigError
        If sensors are missing, or ask for an IMU.
    DataError
        If records are too short.
    """
    sensor, source = trial.attitude, trial.with_fixes().gnss or trial.find(Ins)
    if sensor is None or source is None:
        raise ConfigError(
            "nothing measures the position",
            where="trial.yaml",
            expected="with `attitude`, also `gnss`, `usbl` or `ins`",
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
    track = body_track(source, frame, record, longest=_WATER_SPAN if water else _GROUND_SPAN)
    parameters = _parameters(trial)
    values = {p.name: prior_mean(p) for p in parameters}
    values |= _start_values(trial, record, track, frame, parameters)
    clock = node_clock(trial, frame)
    late = float(values[record.sensor.clock.offset.name][0])
    lag = float(values[clock][0])
    nodes = _nodes(trial, record, track, late=late, lag=lag)
    mounting = values.get("misalignment_deg", np.eye(3))
    ping_lag = float(values["time_offset_s"][0]) if trial.log is not None else 0.0
    middle = 0.5 * (nodes[1:] + nodes[:-1]) + late - lag
    phase = phases(record, middle, trial, mounting, late - ping_lag)
    early = _early(record, nodes + late - lag)
    states = _states(record, track, frame, nodes - lag, late, early)
    chain = SmoothChain(
        frame=frame,
        node_time=nodes,
        attitude_time=nodes + late - lag - early,
        density=_densities(trial, record, values, states, nodes, phase, late),
        start=states,
        nRt=track_axes(record, frame, states, nodes - lag, late),
        clock=clock if any(p.name == clock and p.estimated for p in parameters) else None,
        attitude_clock=record.sensor.clock.offset.name,
        resolution=record.interval,
    )
    if chain.clock is None:
        chain = replace(chain, node_time=nodes - lag)
    by_aid = [
        (aid, lasting_observations(aid, frame, trial.body_axes, trial)) for aid in trial.aids
    ]
    return PreparationWithoutImu(
        trial=trial,
        first_chain=chain,
        states=states,
        record=record,
        values=values,
        phase=phase,
        observations=tuple(o for _, every in by_aid for o in every),
        parameters=parameters,
        processes=_currents(trial, chain) if water else (),
        estimated_noise=frozenset(
            o.label
            for aid, every in by_aid
            if trial.estimates_noise(aid)
            for o in every
            if o.noise_groups and not _followed(o, nodes)
        ),
        findings=(*trial.notes, *_notes(trial), *errors_left_out(trial.aids)),
    )


def lasting_observations(
    aid: Aid, frame: LocalFrame, body_axes: BodyAxes, trial: Trial
) -> tuple[Observation, ...]:
    """Return all that a sensor measured: errors that last are processes here."""
    if isinstance(aid, Attitude):
        return aid.dense_observations(frame, body_axes)
    if isinstance(aid, Ins):
        found = aid.dense_observations(frame, body_axes)
        return found[:2] if trial.find(Attitude) is not None else found
    return aid.observations(frame, body_axes)


def _currents(trial: Trial, chain: SmoothChain) -> tuple[Process, ...]:
    """Return the current as a process about its mean."""
    assert trial.dvl is not None
    s = trial.dvl.settings
    sigma, tau = s.current_variation_std_m_s, s.current_correlation_time_s
    known = isinstance(sigma, float) and isinstance(tau, float)
    std = np.full(2, sigma if isinstance(sigma, float) else _CURRENT_STD)
    time = tau if isinstance(tau, float) else _CURRENT_TIME
    if not std.any():
        return ()
    noise = np.full(2, float(np.median(trial.dvl.sigma())))
    nodes = node_times(chain.node_time, time, std, noise)
    return (
        Process(
            CURRENT,
            _CURRENT_INDEX,
            std,
            np.full(2, time),
            nodes,
            parameter="current_m_s",
            free=not known,
        ),
    )


def _followed(o: Observation, nodes: Array) -> bool:
    """Whether attitudes come no more often than nodes: the motion between them follows each.

    What is noise of theirs, and what motion, they do not show.
    """
    interval = float(np.median(np.diff(o.time))) if o.time.size > 1 else np.inf
    return o.unit == "rad" and interval > 0.5 * float(np.median(np.diff(nodes)))


def _anew(
    chain: SmoothChain, states: ChainStates, shift: float
) -> tuple[SmoothChain, SmoothStates]:
    """Return a chain whose attitudes are later than its nodes by a shift, s, and its states.

    Clocks have moved pings between nodes of the attitude; at a node they would stay.
    """
    motion = chain.motion(chain.attach(chain.node_time, shift), states)
    own = SmoothStates(motion.nRb, states.p_n, states.v_n, motion.omega_eb_b)
    return replace(chain, attitude_time=chain.node_time + shift), own


def _early(record: AttitudeRecord, stamps: Array) -> float:
    """Return by how much attitudes of nodes are earlier than the rest of them, s.

    Where attitudes are as rare as nodes, those of nodes are when one was measured: between them
    rates are known less well, and by that clocks move.

    Parameters
    ----------
    record : AttitudeRecord
        Attitudes.
    stamps : ndarray, shape (K,), s
        Times of the nodes by the clock of attitudes.
    """
    interval = float(np.median(np.diff(stamps)))
    if not _sparse(record, interval):
        return _EARLY * interval
    before = np.searchsorted(record.time, stamps, side="right") - 1
    turn = 2.0 * np.pi / record.interval
    since = turn * (stamps - record.time[np.maximum(before, 0)])
    return float(np.angle(np.mean(np.exp(1j * since))) % (2.0 * np.pi)) / turn


def _sparse(record: AttitudeRecord, interval: float) -> bool:
    """Whether attitudes are about as rare as nodes at an interval, s."""
    return record.interval > _RARE * interval


def _states(
    record: AttitudeRecord,
    track: Track,
    frame: LocalFrame,
    time: Array,
    late: float,
    early: float,
) -> SmoothStates:
    """Return states at true times (M,) by records alone, attitudes `early` s before these."""
    p_n, v_n, _ = track.at(time)
    stamp = np.clip(time + late - early, record.time[0], record.time[-1])
    body = record.at(stamp, np.zeros((time.size, 3)), level_axes(frame, p_n))
    return SmoothStates(body.nRb, p_n, v_n, body.omega_eb_b)


def track_axes(
    record: AttitudeRecord, frame: LocalFrame, states: SmoothStates, time: Array, late: float
) -> Array:
    """Return level axes that turn with the heading averaged over waves, at true times (K,)."""
    grid = np.arange(time[0] - WAVES, time[-1] + WAVES + _GRID, _GRID)
    heading = record.rph_at(grid + late)[:, 2]
    width = 2 * round(0.25 * WAVES / _GRID) + 1

    def mean(angle: Array) -> Array:
        # Three times: what is left of waves is a thirtieth.
        for _ in range(3):
            padded = np.pad(angle, width // 2, mode="reflect", reflect_type="odd")
            angle = np.convolve(padded, np.full(width, 1.0 / width), mode="valid")
        return angle

    # What the mean leaves over is averaged too, so that it follows where a turn begins (Tukey's
    # twicing).
    heading = mean(2.0 * heading - mean(heading))
    angle = np.interp(time, grid, heading)
    rph = np.column_stack([np.zeros((time.size, 2)), angle])
    return level_axes(frame, states.p_n) @ rotation_from_rph(rph, "FRD")


def _parameters(trial: Trial) -> tuple[Parameter, ...]:
    """Return the parameters of all sensors; the clock of the positions is that of the trial.

    Without an IMU only differences of clocks show, and of lever arms: where the position is
    stated to be that of the body, it makes the origin, and no misfit shows another one.
    """
    assert trial.positioning is not None
    section = trial.positioning.section
    out = []
    for aid in trial.aids:
        for p in aid.parameters():
            reference = aid.section == section and p.stem.endswith(CLOCK_STEMS)
            if aid.section == section and _is_origin(p):
                p = replace(p, spec=replace(p.spec, plausible=None))
            out.append(replace(p, sigma=np.zeros_like(p.sigma)) if reference else p)
    return tuple(on_shared_clocks(out, trial.aids))


def _is_origin(p: Parameter) -> bool:
    """Whether it is a lever arm that is stated to be zero for certain."""
    return p.stem.endswith("lever_arm") and not (p.mean.any() or p.sigma.any())


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


def _without_gross_errors(time: Array, velocity: Array, locked: Array, track: Track) -> IntArray:
    """Return the pings whose speed is about that of the track: one that is far off turns a fit.

    No mounting changes a speed.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times of the pings.
    velocity : ndarray, shape (M, 3), m/s
        Velocities by the DVL.
    locked : ndarray of bool, shape (M,)
        Whether there is a velocity.
    track : Track
        Track of the body.
    """
    _, v_n, covered = track.at(time)
    known = np.flatnonzero(covered & (locked > 0))
    if known.size < _FEWEST:
        return np.asarray(np.flatnonzero(locked))
    off = np.linalg.norm(velocity[known], axis=1) - np.linalg.norm(v_n[known], axis=1)
    off -= np.median(off)
    gate = max(_FAR_OFF * float(spread(off)), _FAR_OFF_M_S)
    return np.asarray(known[np.abs(off) < gate])


def node_clock(trial: Trial, frame: LocalFrame) -> str:
    """Return the time offset of the clock of the nodes: of what measures the velocity most often.

    Its measurements stay where they are between nodes when its clock moves; with weights of the
    clock before, that of a DVL was damped 13 times as strongly as the data pulled it.
    """
    sensor = trial.dvl or trial.beams or trial.find(Ins) or trial.positioning
    assert sensor is not None
    clock = sensor.observations(frame, trial.body_axes)[0].clock
    assert clock is not None
    return clock.names[0]


def _nodes(
    trial: Trial, record: AttitudeRecord, track: Track, *, late: float, lag: float
) -> Array:
    """Return the times of the nodes by their clock: those of pings, and others in between.

    Parameters
    ----------
    trial : Trial
        Trial without IMU.
    record : AttitudeRecord
        How the body points.
    track : Track
        Track of the body.
    late, lag : float, s
        Time offsets of the attitude and of the nodes.
    """
    first = lag + max(track.time[0], record.time[0] - late)
    last = lag + min(track.time[-1], record.time[-1] - late)
    if last - first < 10.0:
        raise DataError(
            "positions and attitudes have less than 10 s in common",
            where=record.sensor.source,
            expected="records of the same time, by one clock",
        )
    log = trial.log
    own = track.time + lag if log is None or log.locked.sum() < 2 else log.time[log.locked]
    own = own[(own > first) & (own < last)]
    longest = max(LONGEST, (last - first) / _MOST_NODES)
    if not own.size:
        own = np.array([0.5 * (first + last)])
    kept = far_apart(own[0], own[1:], longest)
    # Before and after the pings as between them, and one more: the attitude of the last ping is
    # between two nodes.
    step = min(longest, float(np.median(np.diff(kept)))) if kept.size > 1 else longest
    before = kept[0] - step * np.arange((kept[0] - first) // step + 1.0, 0.0, -1.0)
    after = kept[-1] + step * np.arange(1.0, (last - kept[-1]) // step + 3.0)
    return without_long_steps(np.concatenate([before, kept, after]), longest)


def _densities(
    trial: Trial,
    record: AttitudeRecord,
    values: dict[str, Array],
    states: SmoothStates,
    nodes: Array,
    phase: IntArray,
    late: float,
) -> Array:
    """Return densities of acceleration to start from, (K - 1, 6), by phase.

    Velocities that are L apart differ by the density times L and by twice the noise: from two L
    both follow. Rates are those of the record.
    """
    out = np.tile(np.repeat([0.0, _DENSITY], 3), (nodes.size - 1, 1))
    step, change = np.diff(nodes)[:, None], np.diff(states.omega_b, axis=0)
    for _, i, where in each_phase(phase[:, :3]):
        out[where, i] = np.mean((change**2 / step)[where, i])
    log = trial.log
    if log is not None and log.locked.sum() >= 50:
        rows = np.flatnonzero(log.locked)
        lag = float(values["time_offset_s"][0])
        time = log.time[rows] - lag
        mounting = values.get("misalignment_deg", np.eye(3))
        v_b = log.velocity[rows] @ mounting
        interval = float(np.median(np.diff(time)))
        at_pings = phases(record, time + late, trial, mounting, late - lag)[:, 3:]
        for kind, i, where in each_phase(phase[:, 3:]):
            spans = _LEG_SPANS if kind == STAYS else (interval, 2.0 * interval)
            own = _density(v_b[:, i], at_pings[:, i] == kind, spans, interval)
            out[where, 3 + i] = own
    return np.maximum(out, LEAST_DENSITY)


def _density(v: Array, wanted: BoolArray, spans: tuple[float, float], interval: float) -> float:
    """Return the density of what changes a component (M,) of velocity over two spans, s."""
    squares = []
    for span in spans:
        step = min(max(1, round(span / interval)), len(v) - 1)
        alike = wanted[step:] & wanted[:-step]
        if step < round(span / interval) or alike.sum() < 20:
            return _DENSITY
        squares.append(float(np.mean((v[step:] - v[:-step])[alike] ** 2)))
    return max(squares[1] / spans[1], 1e-6)


def _notes(trial: Trial) -> tuple[Finding, ...]:
    """Name attitudes that another sensor of attitude takes the place of."""
    if trial.find(Ins) is None or trial.find(Attitude) is None:
        return ()
    text = message("unused.ins_attitude")
    return (Finding(Code.UNUSED, text, sensor="INS"),)
