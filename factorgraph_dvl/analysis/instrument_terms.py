"""A calibration in the terms of instruments: angles, %, ppm, TRDI's alignment commands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.rotations import exp_so3, frd_from_body, wrapped
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.verdict import Grade, grades
from factorgraph_dvl.sensors.dvl import LEVER_ARM, MISALIGNMENT, SCALE_ERROR
from factorgraph_dvl.sensors.dvl_beams import DIRECTION
from factorgraph_dvl.solution import Calibration, Solution

# Intrinsic orders: ZYX is yaw, then pitch, then roll; the angles are given as roll, pitch, yaw.
Order = Literal["ZYX", "XYZ"]
ORDERS: tuple[Order, ...] = ("ZYX", "XYZ")
NEEDED = (MISALIGNMENT, SCALE_ERROR, LEVER_ARM)
# Chosen: step, deg, of the numerical derivative; the cube root of a double's precision.
_STEP = 1e-6


@dataclass(frozen=True)
class Angles:
    """Roll, pitch, yaw of a rotation, deg, with standard deviations; nan if not known.

    Roll is about the forward, pitch about the starboard, yaw about the downward axis:
    starboard down, bow up and clockwise from above are positive, whatever the body axes.
    """

    value: Array
    std: Array
    grade: tuple[Grade, ...]


# What lever arms start from: the first of these records that a trial has, else the antenna.
ORIGINS = {"imu": "IMU", "ins": "INS"}
ANTENNA = "GNSS antenna"


@dataclass(frozen=True)
class InstrumentTerms:
    """Mounting angles, scale and lever arm as instruments define them.

    Parameters
    ----------
    dvl_in_body, body_to_dvl : dict of Order to Angles
        Angles of C_d^b, the attitude of the DVL in the vehicle, and of C_b^d, by order.
    scale_error, scale_std : ndarray, shape (n,)
        Dimensionless.
    scale_grade : tuple of Grade
        Grade of each scale error.
    lever_arm, lever_arm_std : ndarray, shape (3,)
        `origin` to DVL, forward, starboard, down, m.
    lever_arm_covariance : ndarray, shape (3, 3), m²
        Covariance of `lever_arm`.
    lever_arm_grade : tuple of Grade
        Grades of the components of the lever arm.
    origin : str
        Where the lever arm starts: `IMU`, `INS` or `GNSS antenna`.
    alignment : ndarray, shape (3,)
        TRDI's EA, EI, EJ, deg: with the axes of TRDI's instrument coordinates for d, C_b^d =
        Rz(-EA) Ry(EJ) Rx(EI) in forward, starboard, down.
    alignment_std : ndarray, shape (3,), deg
        Standard deviations of `alignment`.
    axes : ndarray, shape (3, 3)
        Axes x, y, z of the DVL as it was recorded, a row each, in forward, starboard, down of the
        vehicle.
    """

    dvl_in_body: dict[Order, Angles]
    body_to_dvl: dict[Order, Angles]
    scale_error: Array
    scale_std: Array
    scale_grade: tuple[Grade, ...]
    lever_arm: Array
    lever_arm_std: Array
    lever_arm_covariance: Array
    lever_arm_grade: tuple[Grade, ...]
    origin: str
    alignment: Array
    alignment_std: Array
    axes: Array

    @property
    def attitude(self) -> Array:
        """C_d^b, the attitude of the DVL in the vehicle, (3, 3), in forward, starboard, down."""
        angles = self.dvl_in_body["ZYX"].value[::-1]
        return np.asarray(Rotation.from_euler("ZYX", angles, degrees=True).as_matrix())


def has_instrument_terms(calibration: Calibration | Solution) -> bool:
    """Return whether a calibration is that of a DVL, with mounting, scale and lever arm."""
    return set(NEEDED) <= {e.name for e in calibration.estimates}


def instrument_of(calibration: Calibration | Solution) -> InstrumentTerms:
    """Return a calibration in the terms of instruments.

    Raises
    ------
    DataError
        If it has no misalignment, scale error or lever arm.
    """
    parts: dict[str, tuple[Array, Array]] = {}
    at = 0
    for e in calibration.estimates:
        rows = slice(at, at + e.value.size)
        parts[e.name] = (e.value, calibration.covariance[rows, rows])
        at = rows.stop
    for name in NEEDED:
        if name not in parts:
            beams = DIRECTION in parts
            raise DataError(
                f"the calibration has no {name}{': it calibrates single beams' if beams else ''}",
                expected="the calibration of a DVL",
                hint="Write the matrix of the beams with: factorgraph-dvl correct TRIAL "
                "CALIBRATION --out DIR" if beams else "",
            )  # fmt: skip
    alpha, covariance = parts[MISALIGNMENT]
    seen = next(e.observable for e in calibration.estimates if e.name == MISALIGNMENT)
    limit = calibration.limits.get(MISALIGNMENT, np.inf)
    frd = frd_from_body(calibration.body_axes)
    # TRDI's instrument axes of a DVL that looks down, aligned: starboard, forward, up.
    trdi = frd_from_body("RFU")

    def angles(of: Callable[[Array], Array]) -> Angles:
        """Return angles that depend on the rotation vector, and their standard deviations."""
        value = of(alpha)
        steps = np.eye(3) * _STEP
        J = np.stack(
            [wrapped((of(alpha + h) - of(alpha - h)) * DEG) / DEG for h in steps], axis=1
        ) / (2.0 * _STEP)
        std = np.sqrt(np.maximum(np.diag(J @ covariance @ J.T), 0.0))
        # An angle is as observable as the component that adds most to its standard deviation.
        most = np.argmax(np.abs(J) * np.sqrt(np.diag(covariance)), axis=1)
        return Angles(value, std, grades(std, seen[most], limit))

    def rpy(order: Order, *, inverse: bool) -> Angles:
        def of(vector: Array) -> Array:
            C = frd @ exp_so3(vector * DEG) @ frd.T
            return euler(C.T if inverse else C, order)

        return angles(of)

    def trdi_angles(vector: Array) -> Array:
        roll, pitch, yaw = euler(trdi @ exp_so3(vector * DEG) @ frd.T, "ZYX")
        return np.array([-yaw, roll, pitch])

    alignment = angles(trdi_angles)
    lever_arm, lever_covariance = parts[LEVER_ARM]
    lever_covariance = frd @ lever_covariance @ frd.T
    graded = calibration.grades
    scale, scale_covariance = parts[SCALE_ERROR]
    return InstrumentTerms(
        dvl_in_body={order: rpy(order, inverse=True) for order in ORDERS},
        body_to_dvl={order: rpy(order, inverse=False) for order in ORDERS},
        scale_error=scale,
        scale_std=np.sqrt(np.diag(scale_covariance)),
        scale_grade=graded[SCALE_ERROR],
        lever_arm=frd @ lever_arm,
        lever_arm_std=np.sqrt(np.diag(lever_covariance)),
        lever_arm_covariance=lever_covariance,
        lever_arm_grade=tuple(graded[LEVER_ARM][i] for i in np.argmax(np.abs(frd), axis=1)),
        origin=_origin(calibration.inputs),
        alignment=alignment.value,
        alignment_std=alignment.std,
        axes=exp_so3(alpha * DEG) @ frd.T,
    )


def _origin(inputs: Sequence[str]) -> str:
    """Return where lever arms start, from the fingerprints of the records of a trial."""
    sections = {text.partition(":")[0] for text in inputs}
    known = next((name for section, name in ORIGINS.items() if section in sections), None)
    # Without fingerprints, records are unknown, and body quantities start from the IMU.
    return known or (ANTENNA if sections else ORIGINS["imu"])


def euler(matrix: Array, order: Order) -> Array:
    """Return roll, pitch, yaw (3,), deg, of a rotation in forward, starboard, down.

    ZYX: Rz(yaw) Ry(pitch) Rx(roll). XYZ: Rx(roll) Ry(pitch) Rz(yaw).
    """
    found = Rotation.from_matrix(matrix).as_euler(order, degrees=True)
    return np.asarray(found[::-1] if order == "ZYX" else found)
