"""The first position of a trial from the ranges to beacons.

Alignment leaves a dead-reckoned track without a position. Solved with the ranges as a planar
problem, it gives all tracks that they allow and the ranges that are outliers. Where the position
is known, only the latter are of use.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from factorgraph_dvl.estimates import Hypothesis
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, interpolate, rotate
from factorgraph_dvl.imu.preintegration import Segments
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.results import mostly_rejected
from factorgraph_dvl.ranging.hypotheses import TrackedHypothesis, follow
from factorgraph_dvl.ranging.model import EARTH_RADIUS
from factorgraph_dvl.ranging.planar_solution import measurements, reported_hypothesis, schedule
from factorgraph_dvl.ranging.planar_track import PlanarTrack
from factorgraph_dvl.ranging.problem import RangingSetup, ranging_setup
from factorgraph_dvl.sensors.beacon import Beacons
from factorgraph_dvl.sensors.dvl import CURRENT_SPEC
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.speed_log import HEADING_BIAS_SPEC, LOG_SCALE_SPEC
from factorgraph_dvl.trial import InitialPosition, Trial

# Chosen: standard deviations of dead reckoning before anything is solved, wide of what alignment
# and a DVL's data sheet promise: heading, rad, scale of the speed, noise of the velocity, m/s in
# 1 s, and current, m/s.
_HEADING = 2.0 * DEG
_SCALE = 0.02
_VELOCITY = 0.05
_CURRENT = 0.5
# Chosen: standard deviation of a first fix of GNSS, m, that of a single fix without corrections.
_FIX = 10.0


@dataclass(frozen=True)
class StartPositions:
    """Possible first positions of a trial.

    Parameters
    ----------
    states : tuple of object
        Motion of the nodes, as their chain has it, of each living hypothesis, most probable first;
        at least one.
    hypotheses : tuple of Hypothesis, optional
        The living ones, in the same order, then the dead; empty if a position is known.
    rejected : mapping of str to ndarray, optional
        Times of the outliers, by label.
    findings : tuple of Finding, optional
        What the user must know.
    """

    states: tuple[Any, ...]
    hypotheses: tuple[Hypothesis, ...] = ()
    rejected: Mapping[str, Array] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()


def positions_from_ranges(
    trial: Trial, frame: LocalFrame, seg: Segments, states: States
) -> StartPositions:
    """Return states that fit the ranges.

    Parameters
    ----------
    trial : Trial
        With a record of ranges, or with a known position.
    frame : LocalFrame
        Tangent frame of the trial.
    seg : Segments
        Preintegrated segments of the IMU.
    states : States
        From alignment; without a known position, from an arbitrary one.

    Raises
    ------
    DataError
        If there is no range while the IMU runs, and nothing else to begin with.
    """
    beacons = trial.beacons
    if beacons is None:
        return StartPositions((states,))
    # A first fix or a stated position is where the track already starts.
    first = trial.initial_position
    if first is None and trial.gnss is not None:
        geodetic = np.array(frame.geodetic(states.p_n[0]))
        first = InitialPosition(geodetic, np.full(3, _FIX))
    heard = beacons.time[~beacons.missing]
    if first is not None and not np.any(
        (heard >= seg.node_time[0]) & (heard <= seg.node_time[-1])
    ):
        return StartPositions((states,))
    setup = _setup_of(trial, frame, seg, states, beacons, first)
    if trial.gnss is not None:
        return StartPositions((states,), rejected=_outliers(beacons, setup))
    updates, searches = schedule(setup.problem)
    found = follow(setup.problem, updates, searches)
    living = [c for c in found if c.died is None]
    if not living:
        few = Finding(Code.FEW_RANGES, message("few_ranges.too_few"))
        return StartPositions((states,), findings=(few,))
    rejected = {r.label: r.time for r in measurements(beacons, setup, living[0].fit)[1]}
    return StartPositions(
        tuple(_moved(setup, c, states, seg.node_time) for c in living),
        tuple(reported_hypothesis(setup, c, _depth_std(trial)) for c in found),
        rejected,
    )


def _outliers(beacons: Beacons, setup: RangingSetup) -> dict[str, Array]:
    """Return times of outliers, by label, on the only track that starts where GNSS says."""
    updates, _ = schedule(setup.problem)
    # Where dead reckoning is good, one fit of all data finds them; else the track is followed.
    for steps in (updates[-1:], updates):
        (found,) = follow(setup.problem, steps, ())
        used, rejected = measurements(beacons, setup, found.fit)
        if found.fit.converged and not mostly_rejected(used, rejected):
            break
    return {r.label: r.time for r in rejected}


def _setup_of(
    trial: Trial,
    frame: LocalFrame,
    seg: Segments,
    states: States,
    beacons: Beacons,
    first: InitialPosition | None,
) -> RangingSetup:
    time = seg.node_time
    height = _height(trial, frame, time, states)
    bow = np.unwrap(np.arctan2(states.v_n[:, 0], states.v_n[:, 1]))
    wander = (_VELOCITY**2 * np.eye(2)) * (time - time[0])[:, None, None]
    track = PlanarTrack(
        time=time,
        displacement=states.p_n[:, :2] - states.p_n[0, :2],
        velocity=states.v_n[:, :2],
        height=height,
        climb=np.gradient(height, time),
        noise=wander,
        velocity_cov=np.broadcast_to(_VELOCITY**2 * np.eye(2), (time.size, 2, 2)),
        heading=bow,
        heading_std=_HEADING,
        interval=1.0,
        tangent=True,
    )
    drifts = trial.dvl is not None and trial.dvl.settings.reference == "water"
    scale = np.array([_SCALE])
    parameters = (
        *beacons.parameters(),
        Parameter(LOG_SCALE_SPEC, np.zeros(1), scale),
        Parameter(HEADING_BIAS_SPEC, np.zeros(1), np.array([_HEADING])),
        Parameter(CURRENT_SPEC, np.zeros(2), np.full(2, _CURRENT * drifts)),
    )
    arm_n = states.nRb @ np.array(beacons.settings.lever_arm_m)
    return ranging_setup(track, arm_n, beacons, parameters, frame, first)


def _height(trial: Trial, frame: LocalFrame, time: Array, states: States) -> Array:
    """Return heights above the ellipsoid: by the depth sensor, else as the states have them."""
    depth = trial.depth
    if depth is not None and not depth.missing.all():
        known = np.logical_not(depth.missing)
        surface = depth.settings.sea_surface_height_m
        return surface - np.interp(time, depth.time[known], depth.depth[known])
    height = frame.geodetic(states.p_n)[2]
    if trial.gnss is None and trial.initial_position is None:
        # Nothing gives a height: take the start to be at the surface.
        return height - height[0]
    return height


def _depth_std(trial: Trial) -> float:
    return trial.depth.settings.std_m if trial.depth is not None else np.nan


def _moved(
    setup: RangingSetup, hypothesis: TrackedHypothesis, states: States, time: Array
) -> States:
    """Return states on the track of a hypothesis, turned by its error of the heading."""
    problem, fit = setup.problem, hypothesis.fit
    dead_reckoned = setup.track.at(problem.time).displacement
    correction = interpolate(time, problem.time, fit.p - dead_reckoned)
    p_n = states.p_n.copy()
    p_n[:, :2] = setup.track.displacement + correction
    down = np.sum(p_n[:, :2] ** 2, axis=1) / (2.0 * EARTH_RADIUS)
    p_n[:, 2] = setup.track.height - setup.frame.height - down
    turn = exp_so3(np.array([0.0, 0.0, problem.value(fit.theta, "heading_bias")[0]]))
    scale = 1.0 / (1.0 + problem.value(fit.theta, "log_scale_error")[0])
    v_n = scale * rotate(np.broadcast_to(turn, states.nRb.shape), states.v_n)
    v_n[:, :2] += problem.value(fit.theta, "current", 2)
    return States(turn @ states.nRb, p_n, v_n, states.gyro_bias, states.accel_bias)
