"""Whether units and axes of an IMU agree with gravity."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from factorgraph_dvl.geometry.rotations import BodyAxes, exp_so3, frd_from_body
from factorgraph_dvl.geometry.units import DEG, STANDARD_GRAVITY
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.axis_permutations import NAMES, in_words, mirrored, swapped
from factorgraph_dvl.quality.records import WINDOW_S
from factorgraph_dvl.sensors.finding import Code, Finding
from factorgraph_dvl.sensors.imu import Imu

# Stretches over which the size of the force is compared, at most. Chosen: they show a drift.
_WINDOWS = 20
_AXIS_NAMES = ("+x", "+y", "+z", "-x", "-y", "-z")


def force_findings(imu: Imu, body_axes: BodyAxes) -> Iterator[Finding]:
    """Yield whether the specific force has the size and direction of gravity."""
    size = float(np.median(np.linalg.norm(imu.accel, axis=1)))
    interval = float(np.median(np.diff(imu.time))) if imu.time.size > 1 else np.nan
    looks = f"the specific force is {size:.4g} in the median, not about 9.8 m/s²"
    for unit, gravity in (
        ("g; multiply by 9.80665", 1.0),
        ("mg; multiply by 0.00980665", 1000.0),
        ("ft/s²; multiply by 0.3048", STANDARD_GRAVITY / 0.3048),
        ("velocity increments; divide by the sample interval", STANDARD_GRAVITY * interval),
    ):
        if abs(size / gravity - 1.0) < 0.05:
            yield Finding(
                Code.FORCE_UNIT, f"{looks}: it looks like {unit}", "IMU", severity="error"
            )
            return
    if abs(size / STANDARD_GRAVITY - 1.0) > 0.05:
        removed = ": was gravity removed? Specific force includes it" if size < 3.0 else ""
        yield Finding(Code.FORCE_UNIT, looks + removed, "IMU", severity="error")
        return
    yield Finding(
        Code.FORCE_UNIT, f"specific force {size:.4g} m/s² in the median", "IMU", severity="ok"
    )
    yield from _axes_findings(imu, body_axes)


def _axes_findings(imu: Imu, body_axes: BodyAxes) -> Iterator[Finding]:
    mean = imu.accel.mean(axis=0)
    mean /= np.linalg.norm(mean)
    up_b = -frd_from_body(body_axes)[2]
    tilt = float(np.degrees(np.arccos(np.clip(mean @ up_b, -1.0, 1.0))))
    if tilt < 30.0:
        yield Finding(
            Code.BODY_AXES,
            f"gravity fits body_axes {body_axes} to {tilt:.2g} deg",
            "IMU",
            severity="ok",
        )
        return
    k = int(np.argmax(np.concatenate([mean, -mean])))
    expected = _AXIS_NAMES[int(np.argmax(np.concatenate([up_b, -up_b])))]
    text = (
        f"the mean specific force points along {_AXIS_NAMES[k]} of the IMU; at rest it points "
        f"up, which body_axes {body_axes} says is {expected}"
    )
    if tilt > 150.0:
        other = "RFU or FLU" if body_axes == "FRD" else "FRD"
        question = f"are the axes {other}, or is the force that of gravity?"
        yield Finding(Code.BODY_AXES, f"{text}: {question}", "IMU", severity="error")
    else:
        yield Finding(
            Code.BODY_AXES,
            f"{text}: is the IMU mounted {tilt:.0f} deg off level?",
            "IMU",
            severity="warning",
        )


def gyro_findings(imu: Imu) -> Iterator[Finding]:
    """Yield whether the angular rate turns the specific force as it should."""
    rms = float(np.sqrt(np.mean(np.sum(imu.gyro**2, axis=1))))
    if rms == 0.0:
        yield Finding(
            Code.GYRO_FROZEN, "the angular rate is zero throughout", "IMU", severity="error"
        )
        return
    loss = 1.0 - _force_steadiness(imu, np.eye(3))
    # Turned by a right gyro, the force keeps the direction of gravity.
    cause = _steadier(imu, 0.25 * loss) if loss > 0.001 else ""
    if cause:
        yield Finding(
            Code.GYRO_UNIT,
            f"the angular rate contradicts the rotation of the specific force: it looks {cause}",
            "IMU",
            severity="error",
        )
    elif rms > 3.0:
        text = f"the angular rate is {rms:.3g} rad/s rms: is it in deg/s?"
        yield Finding(Code.GYRO_UNIT, text, "IMU", severity="error")
    else:
        yield Finding(
            Code.GYRO_UNIT,
            f"angular rate {rms / DEG:.3g} deg/s rms, fits gravity",
            "IMU",
            severity="ok",
        )


def _steadier(imu: Imu, enough: float) -> str:
    """Return what the angular rate looks like if that turns the force better, else nothing."""
    eye = np.eye(3)
    rate = 1.0 / float(np.median(np.diff(imu.time))) if imu.time.size > 1 else 1.0
    candidates = {
        "in deg/s; multiply by pi/180": DEG * eye,
        "in angle increments; divide by the sample interval": rate * eye,
        "of the opposite sign, or in other axes than the specific force": -eye,
    }
    for P in (*(mirrored(k) for k in range(3)), *(swapped(k) for k in range(3))):
        candidates[f"as if {in_words(P)}"] = P
    # Turned about a horizontal axis, a mirrored force looks the same.
    up = int(np.argmax(np.abs(imu.accel.mean(axis=0))))
    for k in {0, 1, 2} - {up}:
        (other,) = {0, 1, 2} - {up, k}
        del candidates[f"as if {in_words(mirrored(k))}"]
        text = f"as if axis {NAMES[k]} is mirrored, or axis {NAMES[other]} of the accelerometers"
        candidates[text] = mirrored(k)
    losses = {text: 1.0 - _force_steadiness(imu, matrix) for text, matrix in candidates.items()}
    best = min(losses, key=lambda text: losses[text])
    return best if losses[best] < enough else ""


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
