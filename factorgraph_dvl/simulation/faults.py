"""Errors of real instruments, added to a simulated trial one by one.

Each fault is a function `fault(trial, rng) -> trial` made by one of the functions below;
`with_faults` applies several. They change records as an instrument or its user would and share
no model with the estimator. The true calibration moves along where a fault changes it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_dvl.geometry.rotations import BodyAxes, frd_from_body
from factorgraph_dvl.geometry.units import DEG_PER_HOUR, HOUR, MICRO_G
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.simulation.measurements import displaced
from factorgraph_dvl.trial import Trial

Fault = Callable[[Trial, np.random.Generator], Trial]


def with_faults(trial: Trial, faults: Sequence[Fault], seed: int = 0) -> Trial:
    """Return a trial with faults, in their order.

    Parameters
    ----------
    trial : Trial
        A simulated trial.
    faults : sequence of Fault
        What to add. Each draws from a random stream of its own, so that one more fault at the
        end leaves the others as they were.
    seed : int, default 0
        Random seed.
    """
    rngs = np.random.default_rng(seed).spawn(len(faults))
    for fault, rng in zip(faults, rngs, strict=True):
        trial = fault(trial, rng)
    return trial


def gauss_markov(
    time: Array, tau_s: float | Sequence[float], components: int, rng: np.random.Generator
) -> Array:
    """Return a stationary first-order Gauss-Markov process of unit variance, (M, components).

    Exact at any times: c(t + d) = exp(-d / tau) c(t) + sqrt(1 - exp(-2 d / tau)) w. Of tau there
    may be one for each component.
    """
    tau = np.broadcast_to(np.asarray(tau_s, dtype=float), components)
    decay = np.exp(-np.diff(time)[:, None] / tau)
    noise = rng.standard_normal((time.size, components))
    noise[1:] *= np.sqrt(1.0 - decay**2)
    for k, phi in enumerate(decay):
        noise[k + 1] += phi * noise[k]
    return noise


def late(section: str, delay_s: float) -> Fault:
    """Stamp the record of a sensor late by a constant time, s.

    A late IMU makes all other sensors early. The reference goes with it: the clock of the IMU is
    that of a solution.
    """

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        return _stamped(trial, section, lambda time: time + delay_s, offset_s=delay_s)

    return fault


def clock_rate(section: str, rate_ppm: float) -> Fault:
    """Let the clock of a sensor run fast by a rate, right at the middle of the trial."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        record = trial.body_sensor
        middle = 0.5 * (record.time[0] + record.time[-1])
        return _stamped(
            trial, section, lambda t: t + 1e-6 * rate_ppm * (t - middle), rate_ppm=rate_ppm
        )

    return fault


def clock_step(section: str, step_s: float, share: float = 0.5) -> Fault:
    """Let the clock of a sensor jump after a share of the trial, of half its size to each side."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        time = trial.body_sensor.time
        at = time[0] + share * (time[-1] - time[0])
        return _stamped(trial, section, lambda t: t + step_s * (t > at) - 0.5 * step_s)

    return fault


def jitter(section: str, std_s: float) -> Fault:
    """Scatter the stamps of a sensor; they stay in order."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        def scattered(time: Array) -> Array:
            moved = np.sort(time + std_s * rng.standard_normal(time.size))
            return moved + 1e-9 * np.arange(time.size)

        return with_arrays(trial, section, time=scattered(record_of(trial, section).time))

    return fault


def correlated_gnss(
    position_std_m: Sequence[float] = (0.0, 0.0, 0.0),
    velocity_std_m_s: Sequence[float] = (0.0, 0.0, 0.0),
    position_tau_s: float | Sequence[float] = 100.0,
    velocity_tau_s: float | Sequence[float] = 2.0,
) -> Fault:
    """Add Gauss-Markov errors to position and velocity of GNSS, east, north and up."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        gnss = record_of(trial, "gnss")
        wander = gauss_markov(gnss.time, position_tau_s, 3, rng) * position_std_m
        change = gauss_markov(gnss.time, velocity_tau_s, 3, rng) * velocity_std_m_s
        # A displacement by zero would change the last digits.
        geodetic = displaced(gnss.geodetic, wander) if wander.any() else gnss.geodetic
        return with_arrays(trial, "gnss", geodetic=geodetic, velocity=gnss.velocity + change)

    return fault


def gnss_jumps(size_m: float = 10.0, duration_s: float = 30.0, count: int = 3) -> Fault:
    """Move the position of GNSS to a random side, some times for a while."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        gnss = record_of(trial, "gnss")
        moved = np.zeros_like(gnss.geodetic)
        for inside in _spans(gnss.time, duration_s, count, rng):
            side = rng.uniform(0.0, 2.0 * np.pi)
            moved[inside, :2] = size_m * np.array([np.cos(side), np.sin(side)])
        return with_arrays(trial, "gnss", geodetic=displaced(gnss.geodetic, moved))

    return fault


def gnss_outliers(share: float = 0.1, sigmas: tuple[float, float] = (10.0, 100.0)) -> Fault:
    """Move a share of the fixes by so many stated standard deviations, in random directions."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        gnss = record_of(trial, "gnss")
        step = _gross(gnss.time.size, share, sigmas, rng) * gnss.settings.position_std_m
        return with_arrays(trial, "gnss", geodetic=displaced(gnss.geodetic, step))

    return fault


def datum(shift_m: Sequence[float]) -> Fault:
    """Give the fixes in another datum: shifted east, north and up, all by the same vector."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        gnss = record_of(trial, "gnss")
        shift = np.tile(np.asarray(shift_m, float), (gnss.time.size, 1))
        return with_arrays(trial, "gnss", geodetic=displaced(gnss.geodetic, shift))

    return fault


def fixes_swapped() -> Fault:
    """Write latitude and longitude into each other's column."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        gnss = record_of(trial, "gnss")
        return with_arrays(trial, "gnss", geodetic=gnss.geodetic[:, [1, 0, 2]])

    return fault


def wrong_antenna(error_m: Sequence[float]) -> Fault:
    """State a lever arm of the antenna that is off by a vector in body axes."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        settings = record_of(trial, "gnss").settings
        stated = tuple((np.array(settings.lever_arm_m) + error_m).tolist())
        return with_arrays(
            trial, "gnss", settings=msgspec.structs.replace(settings, lever_arm_m=stated)
        )

    return fault


def dvl_bias(bias_m_s: Sequence[float]) -> Fault:
    """Add a constant velocity in the axes of the DVL."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        dvl = record_of(trial, "dvl")
        out = with_arrays(trial, "dvl", velocity=dvl.velocity + np.asarray(bias_m_s))
        return with_truth(out, "dvl_bias_m_s", np.asarray(bias_m_s, float))

    return fault


def dvl_scale_drift(total: float) -> Fault:
    """Let the scale of the DVL grow linearly by a total over the trial, zero at the middle."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        dvl = record_of(trial, "dvl")
        drift = total * ((dvl.time - dvl.time.mean()) / np.ptp(dvl.time))
        return with_arrays(trial, "dvl", velocity=dvl.velocity * (1.0 + drift)[:, None])

    return fault


def dvl_scale_walk(std_sqrt_h: float) -> Fault:
    """Let the scale of the DVL walk at random, by a standard deviation per √h, zero on average."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        dvl = record_of(trial, "dvl")
        steps = rng.standard_normal(dvl.time.size) * std_sqrt_h
        steps[1:] *= np.sqrt(np.diff(dvl.time) / HOUR)
        steps[0] = 0.0
        walk = np.cumsum(steps)
        return with_arrays(
            trial, "dvl", velocity=dvl.velocity * (1.0 + walk - walk.mean())[:, None]
        )

    return fault


def correlated_dvl(std_m_s: float, tau_s: float = 5.0, std_fraction: float = 0.0) -> Fault:
    """Add a first-order Gauss-Markov error to each axis of the DVL.

    Its variance is std_m_s² + (std_fraction · speed)², as that of the white noise.
    """

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        dvl = record_of(trial, "dvl")
        speed = np.linalg.norm(dvl.velocity, axis=1, keepdims=True)
        std = np.hypot(std_m_s, std_fraction * speed)
        error = std * gauss_markov(dvl.time, tau_s, 3, rng)
        return with_arrays(trial, "dvl", velocity=dvl.velocity + error)

    return fault


def dvl_outliers(share: float = 0.1, sigmas: tuple[float, float] = (10.0, 300.0)) -> Fault:
    """Move a share of the pings by so many stated standard deviations, in random directions."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        dvl = record_of(trial, "dvl")
        speed = np.linalg.norm(dvl.velocity, axis=1, keepdims=True)
        stated = dvl.settings
        std = np.hypot(stated.velocity_std_m_s, stated.velocity_std_fraction * speed)
        step = _gross(dvl.time.size, share, sigmas, rng) * std
        return with_arrays(trial, "dvl", velocity=dvl.velocity + step)

    return fault


def dvl_false_lock(speed_m_s: float = 0.3, duration_s: float = 60.0) -> Fault:
    """Lock on something that moves, such as a layer of fish: a constant velocity for a while."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        dvl = record_of(trial, "dvl")
        (inside,) = _spans(dvl.time, duration_s, 1, rng)
        moving = speed_m_s * _directions(1, rng)
        return with_arrays(trial, "dvl", velocity=dvl.velocity + moving * inside[:, None])

    return fault


def dvl_slipped(turn_deg: Sequence[float], share: float = 0.5) -> Fault:
    """Turn the DVL in its mount after a share of the record, by a rotation vector in its axes."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        dvl = record_of(trial, "dvl")
        after = dvl.time > dvl.time[0] + share * np.ptp(dvl.time)
        turn = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
        velocity = np.where(after[:, None], dvl.velocity @ turn.T, dvl.velocity)
        return with_arrays(trial, "dvl", velocity=velocity)

    return fault


def dvl_water_track(
    current_m_s: Sequence[float], duration_s: float = 60.0, share: float = 0.0
) -> Fault:
    """Measure against a layer of water, which a current, east, north, up, moves.

    For a while; with an infinite duration, all the time. Or for a share of the record, from a
    third of it on.
    """

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        dvl, reference = record_of(trial, "dvl"), trial.reference
        assert reference is not None
        inside = np.ones(dvl.time.size, dtype=bool)
        if share > 0.0:
            since = (dvl.time - dvl.time[0]) / np.ptp(dvl.time) - 1.0 / 3.0
            inside = (since >= 0.0) & (since < share)
        elif np.isfinite(duration_s):
            (inside,) = _spans(dvl.time, duration_s, 1, rng)
        rph = [np.interp(dvl.time, reference.time, angle) for angle in np.unwrap(reference.rph.T)]
        roll, pitch, heading = rph
        # Axes forward, starboard and down to north, east and down.
        level = Rotation.from_euler("ZYX", np.stack([heading, pitch, roll], axis=1))
        east, north, up = current_m_s
        in_frd = level.inv().apply([north, east, -up])
        in_body = in_frd @ frd_from_body(trial.body_axes)
        moved = dvl.velocity - mounting_of(trial).apply(in_body) * inside[:, None]
        return with_arrays(trial, "dvl", velocity=moved)

    return fault


def frozen(section: str, duration_s: float = 30.0, field: str = "velocity") -> Fault:
    """Repeat the value that a sensor had at the start of a random span."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        record = record_of(trial, section)
        values = getattr(record, field).copy()
        (inside,) = _spans(record.time, duration_s, 1, rng)
        values[inside] = values[np.argmax(inside)]
        return with_arrays(trial, section, **{field: values})

    return fault


def filled(section: str, share: float, value: float = 0.0, field: str = "velocity") -> Fault:
    """Replace a share of the measurements by one value, as instruments do where they have none."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        record = record_of(trial, section)
        values = getattr(record, field).copy()
        values[rng.uniform(size=record.time.size) < share] = value
        return with_arrays(trial, section, **{field: values})

    return fault


def stuck(section: str, axis: int, field: str = "velocity") -> Fault:
    """Let one axis of a sensor repeat its first value throughout."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        values = getattr(record_of(trial, section), field).copy()
        values[:, axis] = values[0, axis]
        return with_arrays(trial, section, **{field: values})

    return fault


def axes_changed(section: str, matrix: Sequence[Sequence[float]], *fields: str) -> Fault:
    """Multiply vectors of a sensor by a matrix: mirrored or swapped axes, signs, units.

    Parameters
    ----------
    section : str
        Sensor, `imu` included.
    matrix : sequence of sequence of float
        Takes what was measured to what is recorded, (3, 3).
    *fields : str
        Arrays of the record; `gyro` and `accel` of the IMU where none is named, else `velocity`.
    """

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        record = record_of(trial, section)
        names = fields or (("gyro", "accel") if section == "imu" else ("velocity",))
        turned = {name: getattr(record, name) @ np.asarray(matrix, float).T for name in names}
        return with_arrays(trial, section, **turned)

    return fault


def imu_errors(
    gyro: Sequence[Sequence[float]],
    g_sensitivity: Sequence[Sequence[float]],
    accel: Sequence[Sequence[float]],
) -> Fault:
    """Add scale factors, axis misalignment and g-sensitivity to the samples of the IMU.

    Parameters
    ----------
    gyro : sequence of sequence of float, shape (3, 3)
        What is recorded = (I + matrix) what is true, scale factors on the diagonal.
    g_sensitivity : sequence of sequence of float, shape (3, 3)
        What each component of the specific force adds to the gyros, (rad/s)/(m/s²).
    accel : sequence of sequence of float, shape (3, 3)
        Accelerometer as `gyro`.
    """

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        imu, truth = trial.inertial, trial.calibration_truth
        added = imu.gyro @ np.transpose(gyro) + imu.accel @ np.transpose(g_sensitivity)
        out = with_arrays(
            trial, "imu", gyro=imu.gyro + added, accel=imu.accel + imu.accel @ np.transpose(accel)
        )
        # The biases in the samples are changed as well.
        gyro_bias = np.asarray(truth.get("gyro_bias_deg_h", np.zeros(3)))
        accel_bias = np.asarray(truth.get("accel_bias_ug", np.zeros(3)))
        leaked = np.asarray(g_sensitivity) @ accel_bias * (MICRO_G / DEG_PER_HOUR)
        out = with_truth(out, "gyro_bias_deg_h", np.asarray(gyro) @ gyro_bias + leaked)
        return with_truth(out, "accel_bias_ug", np.asarray(accel) @ accel_bias)

    return fault


def imu_bias_walk(gyro_deg_h_sqrt_h: float, accel_ug_sqrt_h: float = 0.0) -> Fault:
    """Let the biases of the IMU walk at random from zero, by standard deviations per √h."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        imu = trial.inertial
        root = np.sqrt(np.diff(imu.time, prepend=imu.time[0]) / HOUR)[:, None]
        walk = np.cumsum(root * rng.standard_normal((imu.time.size, 6)), axis=0)
        gyro, accel = gyro_deg_h_sqrt_h * walk[:, :3], accel_ug_sqrt_h * walk[:, 3:]
        # The truth of a bias that walks is its mean.
        trial = with_truth(trial, "gyro_bias_deg_h", gyro.mean(axis=0))
        trial = with_truth(trial, "accel_bias_ug", accel.mean(axis=0))
        return with_arrays(
            trial,
            "imu",
            gyro=imu.gyro + DEG_PER_HOUR * gyro,
            accel=imu.accel + MICRO_G * accel,
        )

    return fault


def imu_bias_step(
    gyro_deg_h: Sequence[float], accel_ug: Sequence[float], share: float = 0.5
) -> Fault:
    """Change the biases of the IMU at once, after a share of the trial."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        imu = trial.inertial
        after = (imu.time > imu.time[0] + share * np.ptp(imu.time))[:, None]
        # The truth of a bias that changes is its mean.
        mean = float(after.mean())
        trial = with_truth(trial, "gyro_bias_deg_h", mean * np.asarray(gyro_deg_h))
        trial = with_truth(trial, "accel_bias_ug", mean * np.asarray(accel_ug))
        return with_arrays(
            trial,
            "imu",
            gyro=imu.gyro + DEG_PER_HOUR * after * np.asarray(gyro_deg_h),
            accel=imu.accel + MICRO_G * after * np.asarray(accel_ug),
        )

    return fault


def imu_spikes(share: float, gyro_rad_s: float = 1.0, accel_m_s2: float = 10.0) -> Fault:
    """Add spikes of a size, in random directions, to a share of the samples of the IMU."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        imu = trial.inertial
        hit = (rng.uniform(size=imu.time.size) < share)[:, None]
        gyro, accel = (hit * _directions(imu.time.size, rng) for _ in range(2))
        return with_arrays(
            trial, "imu", gyro=imu.gyro + gyro_rad_s * gyro, accel=imu.accel + accel_m_s2 * accel
        )

    return fault


def sampling_misstated() -> Fault:
    """State that the IMU samples the other way: means for instants, or instants for means."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        stated = trial.inertial.settings
        other = "mean" if stated.sampling == "instantaneous" else "instantaneous"
        return with_arrays(trial, "imu", settings=msgspec.structs.replace(stated, sampling=other))

    return fault


def body_axes_misstated(body_axes: BodyAxes) -> Fault:
    """State other axes of the body than those of the records."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        return replace(trial, body_axes=body_axes)

    return fault


def saturated(gyro_rad_s: float = np.inf, accel_m_s2: float = np.inf) -> Fault:
    """Clip the samples of the IMU at the ends of its range."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        imu = trial.inertial
        return with_arrays(
            trial,
            "imu",
            gyro=np.clip(imu.gyro, -gyro_rad_s, gyro_rad_s),
            accel=np.clip(imu.accel, -accel_m_s2, accel_m_s2),
        )

    return fault


def _stamped(
    trial: Trial,
    section: str,
    clock: Callable[[Array], Array],
    *,
    offset_s: float = 0.0,
    rate_ppm: float = 0.0,
) -> Trial:
    out = with_arrays(trial, section, time=clock(record_of(trial, section).time))
    moved = {section: 1.0}
    if section == "imu":
        moved = {aid.section: -1.0 for aid in trial.aids}
        if out.reference is not None:
            reference = replace(out.reference, time=clock(out.reference.time))
            out = replace(out, reference=reference)
    for aid, sign in moved.items():
        offset, rate = _clock_names(trial, aid)
        out = with_truth(out, offset, np.array([sign * offset_s]))
        out = with_truth(out, rate, np.array([sign * rate_ppm]))
    return out


def _clock_names(trial: Trial, section: str) -> tuple[str, str]:
    """Return the reported names of the offset and the rate of a sensor's clock."""
    if section == "dvl" or (section == "dvl_beams" and trial.dvl is None):
        return "time_offset_s", "dvl_clock_rate_ppm"
    stem = {"dvl_beams": "beam", "beacons": "beacon"}.get(section, section)
    return f"{stem}_time_offset_s", f"{stem}_clock_rate_ppm"


def with_truth(trial: Trial, name: str, change: Array) -> Trial:
    """Return a trial whose true parameter has changed; one without a truth was zero before."""
    if not np.any(change):
        return trial
    truth = dict(trial.calibration_truth)
    truth[name] = truth.get(name, 0.0) + change
    return replace(trial, calibration_truth=truth)


def mounting_of(trial: Trial) -> Rotation:
    """Return the true rotation from body axes to those of the DVL."""
    return Rotation.from_rotvec(trial.calibration_truth["misalignment_deg"], degrees=True)


def record_of(trial: Trial, section: str) -> Any:
    """Return the record of a section of a trial."""
    records = {record.section: record for record in trial.records}
    return records[section]


def with_arrays(trial: Trial, section: str, **arrays: Any) -> Trial:
    """Return a trial with other arrays or settings in the record of a section."""
    record = replace(record_of(trial, section), **arrays)
    if section in ("imu", "gnss", "dvl"):
        return replace(trial, **{section: record})
    others = tuple(record if aid.section == section else aid for aid in trial.others)
    return replace(trial, others=others)


def _spans(
    time: Array, duration_s: float, count: int, rng: np.random.Generator
) -> Iterator[Array]:
    """Yield which times (M,) are inside spans, one in each part of the record."""
    part = np.ptp(time) / count
    for i in range(count):
        start = time[0] + (i + rng.uniform(0.2, 0.8)) * part
        yield (time >= start) & (time < start + duration_s)


def _gross(
    size: int, share: float, sigmas: tuple[float, float], rng: np.random.Generator
) -> Array:
    bad = rng.uniform(size=size) < share
    length = rng.uniform(*sigmas, size) * bad
    return np.asarray(_directions(size, rng) * length[:, None])


def _directions(size: int, rng: np.random.Generator) -> Array:
    out = rng.standard_normal((size, 3))
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))
