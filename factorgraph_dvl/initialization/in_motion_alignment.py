"""Initial states from the data alone, at any heading.

Optimisation-based in-motion alignment: over a window the gyros give the rotation since
its start and the accelerometers the velocity change in the body axes at its start; GNSS
(or the DVL) and gravity give the same velocity change in axes fixed in space. The
rotation between the two sets of vectors is Wahba's problem (Wu and Pan,
Velocity/position integration formula, IEEE T-AES 49(2), 2013).

A sensor of attitude gives it at once, at rest too. If its mounting is not known, the
rotations that it sees are those of the gyros in other axes, which gives the mounting.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_trapezoid

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import (
    best_rotation,
    exp_so3,
    frd_from_body,
    rotation_from_rph,
)
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, interpolate, rotate
from factorgraph_dvl.imu.preintegration import Segments
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.initialization.attitude_sensors import attitude_at_start, known_mountings
from factorgraph_dvl.initialization.dead_reckoned_spans import DeadReckonedSpan, arc_from_start
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.dvl import (
    BIAS,
    LEVER_ARM,
    MISALIGNMENT,
    SCALE_ERROR,
    TIME_OFFSET,
    Dvl,
)
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.trial import Trial

# Velocity error, m/s, that a gyro bias may cause over a window through tilted gravity, and
# lengths of windows, s. Chosen: small against the changes of a vessel's velocity.
_WINDOW_ERROR = 0.2
_WINDOW_LIMITS = (30.0, 1000.0)
# Heading standard deviation, rad, up to which a window's heading is taken. Chosen: the solver
# converges from there.
_HEADING_LIMIT = 5.0 * DEG
# Fixes this far apart, s, give a mean velocity where the receiver reports none. Chosen: a
# metre of noise is then 0.3 m/s.
_BASELINE = 5.0
# Below this speed, m/s, the course says nothing about the heading. Chosen: drift by wind and sea.
_LEAST_SPEED = 0.3
# Between fixes further apart than this, s, the DVL gives the velocity to start from. Chosen:
# GNSS at 1 Hz may lose two fixes.
_GNSS_GAP = 3.0
# Velocities that an alignment takes at least. Chosen.
_LEAST_PAIRS = 10


@dataclass(frozen=True)
class AlignedStates:
    """Where the solver starts.

    Parameters
    ----------
    states : States
        States at the nodes.
    mountings : dict of str to ndarray
        Mountings by parameter name, sRb of sensors of attitude where the gyros determine it.
    findings : tuple of Finding
        What the user must know of how they were found.
    """

    states: States
    mountings: dict[str, Array]
    findings: tuple[Finding, ...]


@dataclass(frozen=True)
class _Pairs:
    """Velocities with C body + constant = space, where C is the attitude at the start.

    `time` (M,) s; `body`, `space` (M, 3) m/s; `sigma` (M,) of their difference; `course`
    (M, 3) velocity in n, zero where not known.
    """

    time: Array
    body: Array
    space: Array
    sigma: Array
    course: Array


def initial_states(trial: Trial, frame: LocalFrame, seg: Segments) -> AlignedStates:
    """Return states at the nodes: attitude by alignment, position and velocity from the aids.

    Raises
    ------
    DataError
        If there is nothing to align with: neither GNSS nor DVL nor a sensor of attitude nor
        `initial`.
    """
    n = seg.node_time.size
    nRb = np.empty((n, 3, 3))
    findings: list[Finding] = []
    p_rough = np.zeros((n, 3))
    fixed = np.zeros(n, dtype=bool)
    if trial.gnss is not None:
        time, p_n = _fixes(trial.gnss, frame)
        p_rough = _interpolate(seg.node_time, time, p_n)
        fixed = seg.increments.locate(time)[2]
    if trial.initial_position is None and trial.beacons is None and not fixed.any():
        raise DataError(
            "no position while the IMU runs",
            where=trial.inertial.source,
            expected="GNSS between its first and last sample, initial.position, or beacons",
            hint="Check that all clocks start together",
        )
    arcs = [arc_from_start(seg, a, frame, p_rough) for a in range(len(seg.arc_nodes))]
    mountings = known_mountings(trial, frame, arcs)
    for a, arc in enumerate(arcs):
        spin = exp_so3(-arc.since[:, None] * arc.earth_rate)
        if a == 0 and trial.initial_attitude is not None:
            at_start = rotation_from_rph(trial.initial_attitude.rph, trial.body_axes)
            if seg.increments.averaged:
                phi, _ = seg.increments.over(np.zeros(1, dtype=int))
                at_start = at_start @ exp_so3(-phi[0])
            nRb[arc.nodes] = spin @ at_start @ arc.turn
            continue
        seen = attitude_at_start(trial, frame, arc, mountings)
        if seen is not None:
            nRb[arc.nodes] = spin @ seen @ arc.turn
            continue
        pairs = _pairs(trial, frame, arc)
        if pairs is None and a > 0:
            nRb[arc.nodes] = spin @ nRb[arc.nodes[0] - 1] @ arc.turn
            continue
        if pairs is None:
            raise DataError(
                f"there are no data to find the attitude from {arc.start:z.1f} s on",
                where=trial.inertial.source,
                expected="GNSS or DVL data there, or `initial` in trial.yaml",
            )
        before = nRb[arc.nodes[0] - 1] if a > 0 else None
        aligned, found = _align(trial, arc, pairs, before)
        nRb[arc.nodes] = spin @ aligned @ arc.turn
        if not found and before is None:
            findings.append(
                Finding(Code.HEADING_UNKNOWN, message("heading_unknown.from", time=arc.start))
            )
    p_n, v_n = _kinematics(trial, frame, seg, nRb)
    zero = np.zeros((n, 3))
    return AlignedStates(States(nRb, p_n, v_n, zero, zero), mountings, tuple(findings))


def _pairs(trial: Trial, frame: LocalFrame, arc: DeadReckonedSpan) -> _Pairs | None:
    """Return pairs from GNSS velocity, else GNSS positions, else the DVL, else None."""
    if trial.gnss is not None:
        for make in (_from_velocity, _from_position):
            pairs = make(trial.gnss, frame, arc)
            if pairs is not None:
                return pairs
    log = trial.log
    return _from_dvl(log, arc) if log is not None else None


def _from_velocity(gnss: Gnss, frame: LocalFrame, arc: DeadReckonedSpan) -> _Pairs | None:
    use = ~np.isnan(gnss.velocity[:, 0]) & arc.covers(gnss.time)
    fix_time, fix = _fixes(gnss, frame)
    if use.sum() < _LEAST_PAIRS:
        return None
    time = gnss.time[use]
    at, body_R, velocity, _ = arc.carry(time)
    p_n = _interpolate(time, fix_time, fix)
    lat, lon, _ = frame.geodetic(p_n)
    v_n = rotate(frame.level_from_tangent(lat, lon).transpose(0, 2, 1), gnss.velocity[use])
    arm, omega_cb_b = gnss.lever_arm(time)
    turning = np.cross(at.gyro - omega_cb_b, arm)
    space = rotate(arc.to_space(time), v_n + np.cross(arc.earth_rate, p_n))
    return _Pairs(
        time,
        velocity + rotate(body_R, turning),
        space - arc.gravity_integrals(at)[0],
        gnss.mean_velocity_std[use],
        v_n,
    )


def _from_position(gnss: Gnss, frame: LocalFrame, arc: DeadReckonedSpan) -> _Pairs | None:
    """Return mean velocities between fixes some seconds apart, on both sides."""
    fix_time, fix = _fixes(gnss, frame)
    use = arc.covers(fix_time)
    time, p_n = fix_time[use], fix[use]
    later = np.searchsorted(time, time + _BASELINE)
    earlier = np.flatnonzero(later < time.size)
    if earlier.size < _LEAST_PAIRS:
        return None
    later = later[earlier]
    span = (time[later] - time[earlier])[:, None]
    at, body_R, _, displacement = arc.carry(time)
    body = displacement + rotate(body_R, gnss.lever_arm(time)[0])
    space = rotate(arc.to_space(time), p_n) - arc.gravity_integrals(at)[1]
    sigma = np.sqrt((gnss.position_std**2).mean()) * np.sqrt(2.0) / span[:, 0]
    return _Pairs(
        0.5 * (time[later] + time[earlier]),
        (body[later] - body[earlier]) / span,
        (space[later] - space[earlier]) / span,
        sigma,
        (p_n[later] - p_n[earlier]) / span,
    )


def _from_dvl(dvl: Dvl, arc: DeadReckonedSpan) -> _Pairs | None:
    true_time = dvl.time - dvl.prior_means()[TIME_OFFSET][0]
    use = dvl.locked & arc.covers(true_time)
    if use.sum() < _LEAST_PAIRS:
        return None
    time = true_time[use]
    at, body_R, velocity, _ = arc.carry(time)
    v_b = _nominal_velocity(dvl, use, at.gyro)
    # A mounting that is not known turns the velocity as well as the wanted attitude does.
    sigma_of = {p.name: p.sigma for p in dvl.parameters()}
    turned = min(float(np.max(sigma_of[MISALIGNMENT])), 1.0)
    sigma = np.hypot(dvl.sigma()[use].mean(axis=1), turned * np.linalg.norm(v_b, axis=1))
    # What the motion adds to the Earth's turn of the velocity is below the mounting's error.
    return _Pairs(
        time,
        velocity - rotate(body_R, v_b),
        -arc.gravity_integrals(at)[0],
        sigma,
        np.zeros_like(v_b),
    )


def _nominal_velocity(dvl: Dvl, use: np.ndarray, omega_b: Array) -> Array:
    """Return the velocity of the IMU in body if the mounting were as the prior says."""
    mean = dvl.prior_means()
    unscaled = (dvl.velocity[use] - mean[BIAS]) / (1.0 + mean[SCALE_ERROR])
    return unscaled @ exp_so3(mean[MISALIGNMENT]) - np.cross(omega_b, mean[LEVER_ARM])


def _align(
    trial: Trial, arc: DeadReckonedSpan, pairs: _Pairs, before: Array | None
) -> tuple[Array, bool]:
    """Return the attitude at the start as each node sees it, and whether heading is found.

    Gyro biases turn the body axes of the start with time: so each window has its own
    rotation, and windows that do not show the heading take that of the nearest which does.
    """
    bias = trial.inertial.settings.gyro_bias_std_deg_h * DEG / 3600.0
    length = float(np.clip(np.sqrt(12.0 * _WINDOW_ERROR / (9.8 * bias)), *_WINDOW_LIMITS))
    count = max(round(arc.since[-1] / length), 1)
    edges = arc.start + arc.since[-1] * np.arange(count + 1) / count
    rotations, found = [], []
    for a, b in itertools.pairwise(edges):
        use = (pairs.time >= a) & (pairs.time <= b)
        if use.sum() < _LEAST_PAIRS:
            rotations.append(np.eye(3))
            found.append(False)
            continue
        rotation, heading_sigma = _wahba(pairs, use)
        rotations.append(rotation)
        found.append(heading_sigma < _HEADING_LIMIT)
    if any(found):
        good = np.flatnonzero(found)
        nearest = good[np.argmin(np.abs(np.arange(count)[:, None] - good), axis=1)]
        chosen = [rotations[i] for i in nearest]
    else:
        chosen = [_towards(trial, arc, pairs, rotations[0], before)] * count
    window = np.clip(np.searchsorted(edges, arc.start + arc.since, side="right") - 1, 0, count - 1)
    return np.array(chosen)[window], any(found)


def _wahba(pairs: _Pairs, use: np.ndarray) -> tuple[Array, float]:
    """Return the rotation body to space, and the standard deviation about the vertical."""
    weight = 1.0 / (pairs.sigma[use] ** 2 + _WINDOW_ERROR**2)
    weight_sum = weight.sum()
    body = pairs.body[use] - weight @ pairs.body[use] / weight_sum
    space = pairs.space[use] - weight @ pairs.space[use] / weight_sum
    rotation = best_rotation((space * weight[:, None]).T @ body)
    turned = body @ rotation.T
    outer = (turned * weight[:, None]).T @ turned
    information = np.trace(outer) * np.eye(3) - outer
    covariance = np.linalg.inv(information + 1e-6 * np.eye(3))
    return rotation, float(np.sqrt(covariance[2, 2]))


def _towards(
    trial: Trial, arc: DeadReckonedSpan, pairs: _Pairs, rotation: Array, before: Array | None
) -> Array:
    """Turn an attitude at the start about the vertical until the bow points where it should.

    Where it pointed at the end of the arc before; on the first arc, along the course at the
    highest speed. Without a course it stays, for want of anything better.
    """
    forward_b = frd_from_body(trial.body_axes)[0]
    if before is not None:
        return _turned_to(rotation @ forward_b, before @ forward_b) @ rotation
    speed = np.linalg.norm(pairs.course[:, :2], axis=1)
    i = int(np.argmax(speed))
    if speed[i] < _LEAST_SPEED:
        return rotation
    _, body_R, _, _ = arc.carry(pairs.time[i : i + 1])
    spin = arc.to_space(pairs.time[i : i + 1])[0].T
    return _turned_to(spin @ rotation @ body_R[0] @ forward_b, pairs.course[i]) @ rotation


def _turned_to(bow: Array, wanted: Array) -> Array:
    """Return the rotation about the vertical that takes one horizontal direction to another."""
    angle = np.arctan2(wanted[1], wanted[0]) - np.arctan2(bow[1], bow[0])
    return exp_so3(np.array([0.0, 0.0, angle]))


def _kinematics(trial: Trial, frame: LocalFrame, seg: Segments, nRb: Array) -> tuple[Array, Array]:
    """Return position and velocity at the nodes.

    Velocity from GNSS, in its gaps from the DVL with its nominal mounting; position as
    its integral, pulled to the fixes.
    """
    gnss, dvl, time = trial.gnss, trial.log, seg.node_time
    v_n = np.zeros((time.size, 3))
    far = np.full(time.size, True)
    index, since, _ = seg.increments.locate(time)
    gyro = seg.increments.partial(index, np.clip(since, 0.0, None)).omega
    if gnss is not None:
        use = ~np.isnan(gnss.velocity[:, 0])
        fix_time, fix = _fixes(gnss, frame)
        if use.any():
            v_time, v_level = gnss.time[use], gnss.velocity[use]
            lat, lon, _ = frame.geodetic(_interpolate(v_time, fix_time, fix))
            v_antenna = rotate(frame.level_from_tangent(lat, lon).transpose(0, 2, 1), v_level)
        elif fix_time.size > 1:
            v_time, v_antenna = fix_time, np.gradient(fix, fix_time, axis=0)
        else:
            v_time = np.empty(0)
        if v_time.size:
            arm, omega_cb_b = gnss.lever_arm(time)
            turning = rotate(nRb, np.cross(gyro - omega_cb_b, arm))
            v_n = _interpolate(time, v_time, v_antenna) - turning
            far = _distance(time, v_time) > _GNSS_GAP
    if dvl is not None and dvl.locked.any() and far.any():
        ping_time = dvl.time[dvl.locked] - dvl.prior_means()[TIME_OFFSET][0]
        index, since, _ = seg.increments.locate(ping_time)
        since = np.clip(since, 0.0, seg.increments.dt[index])
        omega = seg.increments.partial(index, since).omega
        v_b = _interpolate(time, ping_time, _nominal_velocity(dvl, dvl.locked, omega))
        v_n = np.where(far[:, None], rotate(nRb, v_b), v_n)
    p_n = cumulative_trapezoid(v_n, time, axis=0, initial=0)
    if gnss is not None and fix_time.size:
        arm_n = rotate(nRb, gnss.lever_arm(time)[0])
        miss = fix - _interpolate(fix_time, time, p_n + arm_n)
        p_n = p_n + _interpolate(time, fix_time, miss)
    return p_n, v_n


def _fixes(gnss: Gnss, frame: LocalFrame) -> tuple[Array, Array]:
    """Return times and positions in n of the fixes."""
    use = ~np.isnan(gnss.geodetic[:, 0])
    return gnss.time[use], frame.position(*gnss.geodetic[use].T)


def _interpolate(time: Array, at: Array, values: Array) -> Array:
    """Return values (M, 3) at times by linear interpolation; the origin if there are none."""
    if at.size == 0:
        return np.zeros((time.size, 3))
    return interpolate(time, at, values)


def _distance(time: Array, grid: Array) -> Array:
    right = np.clip(np.searchsorted(grid, time), 1, max(grid.size - 1, 1))
    right = np.minimum(right, grid.size - 1)
    return np.minimum(np.abs(time - grid[right - 1]), np.abs(time - grid[right]))
