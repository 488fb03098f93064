"""Whether units and axes of an IMU agree with gravity."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from factorgraph_dvl.geometry.rotations import BodyAxes, exp_so3, frd_from_body
from factorgraph_dvl.geometry.units import DEG, STANDARD_GRAVITY
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import Message, either, message
from factorgraph_dvl.plausibility.axis_permutations import NAMES, in_words, mirrored, swapped
from factorgraph_dvl.plausibility.records import WINDOW_S
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.imu import Imu

# Stretches over which the size of the force is compared, at most. Chosen: they show a drift.
_WINDOWS = 20
_AXIS_NAMES = ("+x", "+y", "+z", "-x", "-y", "-z")


def force_findings(imu: Imu, body_axes: BodyAxes) -> Iterator[Finding]:
    """Yield whether the specific force has the size and direction of gravity."""
    size = float(np.median(np.linalg.norm(imu.accel, axis=1)))
    interval = float(np.median(np.diff(imu.time))) if imu.time.size > 1 else np.nan
    for unit, gravity in (
        (message("force_unit.multiply", unit="g", factor="9.80665"), 1.0),
        (message("force_unit.multiply", unit="mg", factor="0.00980665"), 1000.0),
        (
            message("force_unit.multiply", unit="ft/s²", factor="0.3048"),
            STANDARD_GRAVITY / 0.3048,
        ),
        (message("force_unit.increments"), STANDARD_GRAVITY * interval),
    ):
        if abs(size / gravity - 1.0) < 0.05:
            text = message("force_unit.looks_like", size=size, unit=unit)
            yield Finding(Code.FORCE_UNIT, text, "IMU", severity="error")
            return
    if abs(size / STANDARD_GRAVITY - 1.0) > 0.05:
        text = message("force_unit.removed" if size < 3.0 else "force_unit.wrong", size=size)
        yield Finding(Code.FORCE_UNIT, text, "IMU", severity="error")
        return
    yield Finding(Code.FORCE_UNIT, message("force_unit.right", size=size), "IMU", severity="ok")
    yield from _axes_findings(imu, body_axes)


def _axes_findings(imu: Imu, body_axes: BodyAxes) -> Iterator[Finding]:
    mean = imu.accel.mean(axis=0)
    mean /= np.linalg.norm(mean)
    up_b = -frd_from_body(body_axes)[2]
    tilt = float(np.degrees(np.arccos(np.clip(mean @ up_b, -1.0, 1.0))))
    if tilt < 30.0:
        yield Finding(
            Code.BODY_AXES,
            message("body_axes.fit", axes=body_axes, tilt=tilt),
            "IMU",
            severity="ok",
        )
        return
    k = int(np.argmax(np.concatenate([mean, -mean])))
    expected = _AXIS_NAMES[int(np.argmax(np.concatenate([up_b, -up_b])))]
    upside_down = tilt > 150.0
    if upside_down:
        other = either(["RFU", "FLU"] if body_axes == "FRD" else ["FRD"])
        question = message("body_axes.other", axes=other)
    else:
        question = message("body_axes.off_level", tilt=tilt)
    text = message(
        "body_axes.points_along",
        along=_AXIS_NAMES[k],
        axes=body_axes,
        expected=expected,
        question=question,
    )
    yield Finding(Code.BODY_AXES, text, "IMU", severity="error" if upside_down else "warning")


def gyro_findings(imu: Imu) -> Iterator[Finding]:
    """Yield whether the angular rate turns the specific force as it should."""
    rms = float(np.sqrt(np.mean(np.sum(imu.gyro**2, axis=1))))
    if rms == 0.0:
        yield Finding(Code.GYRO_FROZEN, message("gyro_frozen.zero"), "IMU", severity="error")
        return
    loss = 1.0 - _force_steadiness(imu, np.eye(3))
    # Turned by a right gyro, the force keeps the direction of gravity.
    cause = _steadier(imu, 0.25 * loss) if loss > 0.001 else None
    if cause is not None:
        text = message("gyro_unit.contradicts", cause=cause)
        yield Finding(Code.GYRO_UNIT, text, "IMU", severity="error")
    elif rms > 3.0:
        text = message("gyro_unit.fast", rate=rms)
        yield Finding(Code.GYRO_UNIT, text, "IMU", severity="error")
    else:
        text = message("gyro_unit.right", rate=rms / DEG)
        yield Finding(Code.GYRO_UNIT, text, "IMU", severity="ok")


def _steadier(imu: Imu, enough: float) -> Message | None:
    """Return what the angular rate looks like if that turns the force better, else None."""
    eye = np.eye(3)
    rate = 1.0 / float(np.median(np.diff(imu.time))) if imu.time.size > 1 else 1.0
    candidates = {
        message("gyro_unit.in_degrees"): DEG * eye,
        message("gyro_unit.in_increments"): rate * eye,
        message("gyro_unit.opposite"): -eye,
    }
    # Turned about a horizontal axis, a mirrored force looks the same.
    up = int(np.argmax(np.abs(imu.accel.mean(axis=0))))
    for k in range(3):
        text = message("gyro_unit.as_if", axes=in_words(mirrored(k)))
        if k != up:
            (other,) = {0, 1, 2} - {up, k}
            text = message("gyro_unit.as_if_or", axis=NAMES[k], other=NAMES[other])
        candidates[text] = mirrored(k)
        candidates[message("gyro_unit.as_if", axes=in_words(swapped(k)))] = swapped(k)
    losses = {text: 1.0 - _force_steadiness(imu, matrix) for text, matrix in candidates.items()}
    best = min(losses, key=lambda text: losses[text])
    return best if losses[best] < enough else None


def _force_steadiness(imu: Imu, matrix: Array) -> float:
    """Return how well the force keeps its direction over 10 s when turned by matrix gyro.

    The ratio |mean of C f| / mean of |f|, averaged over windows; 1 = perfectly.
    """
    interval = float(np.median(np.diff(imu.time))) if imu.time.size > 1 else 1.0
    size = int(min(max(2, round(WINDOW_S / interval)), imu.time.size, 4000))
    starts = np.unique(np.linspace(0, imu.time.size - size, _WINDOWS).astype(int))
    rows = starts[:, None] + np.arange(size)
    turns = exp_so3(imu.gyro[rows] @ matrix.T * interval)
    attitude = np.broadcast_to(np.eye(3), (starts.size, 3, 3))
    total = np.zeros((starts.size, 3))
    for k in range(size):
        attitude = attitude @ turns[:, k]
        total += np.einsum("wij,wj->wi", attitude, imu.accel[rows[:, k]])
    magnitude = np.linalg.norm(imu.accel[rows], axis=2).sum(axis=1)
    return float(np.mean(np.linalg.norm(total, axis=1) / magnitude))
