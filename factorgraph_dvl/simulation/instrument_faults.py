"""Errors of mounts, water and electronics that grow with the motion, as `simulation.faults`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import frd_from_body
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.attitude import Attitude, AttitudeSettings
from factorgraph_dvl.simulation.faults import Fault, mounting_of, record_of, with_arrays
from factorgraph_dvl.trial import Reference, Trial


def dvl_flexes(turn_deg_per_deg: Sequence[float], by: str = "roll") -> Fault:
    """Turn the DVL in its mount in proportion to roll or pitch of the vehicle.

    Parameters
    ----------
    turn_deg_per_deg : sequence of float, shape (3,)
        Rotation vector about the axes of the DVL for each degree.
    by : {'roll', 'pitch'}
        What it grows with.
    """

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        dvl = record_of(trial, "dvl")
        angle = _along(trial, dvl.time, _reference(trial).rph[:, ("roll", "pitch").index(by)])
        turn = Rotation.from_rotvec(angle[:, None] * np.asarray(turn_deg_per_deg, float))
        return with_arrays(trial, "dvl", velocity=turn.apply(dvl.velocity))

    return fault


def dvl_levelled(share: float = 1.0) -> Fault:
    """Let the DVL take a share of roll and pitch out of its velocities."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        dvl, rph = record_of(trial, "dvl"), _reference(trial).rph
        tilt = np.stack([_along(trial, dvl.time, rph[:, i]) for i in range(2)], axis=1)
        mounted, to_frd = mounting_of(trial), frd_from_body(trial.body_axes)
        in_frd = mounted.inv().apply(dvl.velocity) @ to_frd.T
        level = Rotation.from_euler("xy", share * tilt).apply(in_frd)
        return with_arrays(trial, "dvl", velocity=mounted.apply(level @ to_frd))

    return fault


def dvl_slow_water(share: float, length_m: float) -> Fault:
    """Let the speed of sound, and with it the scale, vary along east as a wave with mean zero."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        dvl, fixes = record_of(trial, "dvl"), _reference(trial).geodetic
        at = LocalFrame(*fixes[0]).position(*fixes.T)
        wave = np.sin(2.0 * np.pi * _along(trial, dvl.time, at[:, 0]) / length_m)
        scale = 1.0 + share * (wave - wave.mean())
        return with_arrays(trial, "dvl", velocity=dvl.velocity * scale[:, None])

    return fault


def dvl_scale_by_speed(per_m_s: float) -> Fault:
    """Let the scale of the DVL grow with the speed, zero at the mean speed."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        dvl = record_of(trial, "dvl")
        speed = np.linalg.norm(dvl.velocity, axis=1)
        scale = 1.0 + per_m_s * (speed - np.nanmean(speed))
        return with_arrays(trial, "dvl", velocity=dvl.velocity * scale[:, None])

    return fault


def dvl_averages(length_s: float) -> Fault:
    """Give for each ping the mean of those in a window about it.

    The mean of n pings is that over a window whose times have the same variance.
    """

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        dvl = record_of(trial, "dvl")
        first = np.searchsorted(dvl.time, dvl.time - 0.5 * length_s)
        last = np.searchsorted(dvl.time, dvl.time + 0.5 * length_s, side="right")
        sums = np.concatenate([np.zeros((1, 3)), np.cumsum(dvl.velocity, axis=0)])
        velocity = (sums[last] - sums[first]) / (last - first)[:, None]
        count, interval = np.median(last - first), np.median(np.diff(dvl.time))
        length = interval * np.sqrt(count**2 - 1.0)
        truth = trial.calibration_truth | {"averaging_s": np.array([length])}
        return replace(with_arrays(trial, "dvl", velocity=velocity), calibration_truth=truth)

    return fault


def saw_of_delays(section: str, longest_s: float, period_s: float = 10.0) -> Fault:
    """Stamp a record later and later up to a delay, and in time again, as a filling buffer does.

    The delay is zero on average, and stamps stay in order.
    """

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        time = record_of(trial, section).time
        phase = np.mod(time / period_s + rng.uniform(), 1.0)
        moved = np.sort(time + longest_s * (phase - 0.5))
        return with_arrays(trial, section, time=moved + 1e-9 * np.arange(time.size))

    return fault


def compass_deviates(deviation_deg: Sequence[float], std_deg: float = 0.2) -> Fault:
    """Add a compass, once a second, whose heading is off by what depends on the heading.

    Parameters
    ----------
    deviation_deg : sequence of float, shape (4,)
        Amplitudes of sine and cosine of the heading, and of twice the heading.
    std_deg : float, default 0.2
        Standard deviation of the white noise of each heading.
    """

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        reference = _reference(trial)
        time = np.arange(reference.time[0], reference.time[-1], 1.0)
        heading = np.interp(time, reference.time, np.unwrap(reference.rph[:, 2]))
        h = heading[:, None] * [1.0, 1.0, 2.0, 2.0]
        waves = np.where([True, False, True, False], np.sin(h), np.cos(h))
        noise = std_deg * rng.standard_normal(time.size)
        measured = heading + np.radians(waves @ np.asarray(deviation_deg, float) + noise)
        # Tilt is not measured.
        rph = np.column_stack([np.full((time.size, 2), np.nan), measured % (2.0 * np.pi)])
        settings = AttitudeSettings(std_deg=(2.0, 2.0, std_deg), correlated_share=0.0)
        return replace(trial, others=(*trial.others, Attitude(settings, time, rph)))

    return fault


def gyros_late(delay_s: float) -> Fault:
    """Give each sample of the gyros as it was some time before, beside accelerometers in time."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        imu = trial.inertial
        # Straight lines between samples would be a low pass.
        before = np.maximum(imu.time - delay_s, imu.time[0])
        return with_arrays(trial, "imu", gyro=CubicSpline(imu.time, imu.gyro)(before))

    return fault


def gyros_lag(time_constant_s: float) -> Fault:
    """Pass the gyros through a filter of first order."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        imu = trial.inertial
        gain = -np.expm1(-np.diff(imu.time) / time_constant_s)
        gyro = imu.gyro.copy()
        for k, share in enumerate(gain):
            gyro[k + 1] = gyro[k] + share * (imu.gyro[k + 1] - gyro[k])
        return with_arrays(trial, "imu", gyro=gyro)

    return fault


def truncated(section: str, step: float, field: str = "velocity") -> Fault:
    """Write values with few digits, truncated towards zero."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        values = getattr(record_of(trial, section), field)
        return with_arrays(trial, section, **{field: step * np.trunc(values / step)})

    return fault


def dvl_noise(std_m_s: float) -> Fault:
    """Add white noise to the velocities of the DVL that is the same at any speed."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        velocity = record_of(trial, "dvl").velocity
        return with_arrays(
            trial, "dvl", velocity=velocity + std_m_s * rng.standard_normal(velocity.shape)
        )

    return fault


def written_again(section: str, times: int, field: str = "velocity") -> Fault:
    """Let a record have each of its values several times, as of a log that is faster."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        values = getattr(record_of(trial, section), field)
        last = np.arange(len(values)) // times * times
        return with_arrays(trial, section, **{field: values[last]})

    return fault


def _along(trial: Trial, time: Array, values: Array) -> Array:
    """Return values of the reference at other times."""
    return np.interp(time, _reference(trial).time, values)


def _reference(trial: Trial) -> Reference:
    assert trial.reference is not None
    return trial.reference
