"""A calibration in the terms of instruments: angles, %, ppm, TRDI's alignment commands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_dvl.analysis.mount import looks_down
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.rotations import BodyAxes, exp_so3, frd_from_body, wrapped
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, BoolArray
from factorgraph_dvl.quality.verdict import Grade, grades
from factorgraph_dvl.sensors.dvl import LEVER_ARM, MISALIGNMENT, SCALE_ERROR
from factorgraph_dvl.sensors.dvl_beams import DIRECTION
from factorgraph_dvl.sensors.usbl import MISALIGNMENT as USBL_MISALIGNMENT
from factorgraph_dvl.sensors.usbl import SOUND_SPEED_ERROR as USBL_SOUND_SPEED_ERROR
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


@dataclass(frozen=True)
class TransceiverTerms:
    """How the transceiver of a USBL is mounted on its ship.

    Parameters
    ----------
    attitude : Angles
        Attitude of the transceiver in the ship, ZYX.
    range_error : tuple of float or None
        Share by which ranges are too long, and its standard deviation; None if not estimated.
    range_grade : tuple of Grade
        Grade of `range_error`.
    """

    attitude: Angles
    range_error: tuple[float, float] | None
    range_grade: tuple[Grade, ...]


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
    as_frd : Angles
        Angles of C_d^b, ZYX, for makers whose axes are forward, starboard, down: with the recorded
        axes named as `axes_as` does it for them.
    after_offset : Angles
        Angles, ZYX, that are left of `as_frd` once the DVL turns its velocities by
        `rotation_offset`, exactly.
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
    body_axes : BodyAxes
        Names of the axes of the vehicle.
    alignment : ndarray, shape (3,)
        TRDI's EA, EI, EJ, deg: C_b^d = Rz(-EA) Ry(EJ) Rx(EI) in forward, starboard, down, with
        the recorded axes named as `axes_as` does it for TRDI.
    alignment_std : ndarray, shape (3,), deg
        Standard deviations of `alignment`.
    axes : ndarray, shape (3, 3)
        Axes x, y, z of the DVL as it was recorded, a row each, in forward, starboard, down of the
        vehicle.
    """

    dvl_in_body: dict[Order, Angles]
    body_to_dvl: dict[Order, Angles]
    as_frd: Angles
    after_offset: Angles
    scale_error: Array
    scale_std: Array
    scale_grade: tuple[Grade, ...]
    lever_arm: Array
    lever_arm_std: Array
    lever_arm_covariance: Array
    lever_arm_grade: tuple[Grade, ...]
    origin: str
    body_axes: BodyAxes
    alignment: Array
    alignment_std: Array
    axes: Array

    @property
    def attitude(self) -> Array:
        """C_d^b, the attitude of the DVL in the vehicle, (3, 3), in forward, starboard, down."""
        return attitude_of(self.axes, self.body_axes)

    def axes_as(self, maker: BodyAxes) -> BodyAxes:
        """Return the names of the recorded axes: a maker's if it then looks down, else the body's.

        Parameters
        ----------
        maker : BodyAxes
            Names of the axes in which an aligned DVL of this maker measures.
        """
        return axes_as(self.axes, maker, self.body_axes)

    def attitude_as(self, maker: BodyAxes) -> Array:
        """Return C_d^b, (3, 3), in forward, starboard, down, with axes named by `axes_as`."""
        return attitude_of(self.axes, self.axes_as(maker))

    @property
    def rotation_offset(self) -> float:
        """Water Linked's angle from the vehicle's forward axis to that of the DVL, deg, clockwise.

        It is from 0 to 360.
        """
        return float(self.as_frd.value[2]) % 360.0


# Axes of an aligned DVL that looks down, by maker.
TRDI_AXES: BodyAxes = "RFU"
NORTEK_AXES: BodyAxes = "FRD"
WATER_LINKED_AXES: BodyAxes = "FRD"


def attitude_of(axes: Array, named: BodyAxes) -> Array:
    """Return C_d^b, (3, 3), in forward, starboard, down, of recorded axes with these names."""
    return np.asarray((frd_from_body(named) @ axes).T)


def axes_as(axes: Array, maker: BodyAxes, body: BodyAxes) -> BodyAxes:
    """Return the names of recorded axes: a maker's if the DVL looks down so, or the body's."""
    return maker if looks_down(attitude_of(axes, maker)) else body


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
    parts = _parts(calibration)
    alpha, covariance = parts[MISALIGNMENT]
    seen = next(e.observable for e in calibration.estimates if e.name == MISALIGNMENT)
    limit = calibration.limits.get(MISALIGNMENT, np.inf)
    frd = frd_from_body(calibration.body_axes)
    recorded = exp_so3(alpha * DEG) @ frd.T
    trdi = frd_from_body(axes_as(recorded, TRDI_AXES, calibration.body_axes))
    named = axes_as(recorded, "FRD", calibration.body_axes)

    def angles(of: Callable[[Array], Array]) -> Angles:
        return _angles(of, alpha, covariance, seen, limit)

    def frd_attitude(vector: Array) -> Array:
        return attitude_of(exp_so3(vector * DEG) @ frd.T, named)

    as_frd = angles(lambda vector: euler(frd_attitude(vector), "ZYX"))
    turned_back = Rotation.from_euler("z", -as_frd.value[2], degrees=True).as_matrix()
    after_offset = angles(lambda vector: euler(frd_attitude(vector) @ turned_back, "ZYX"))

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
        as_frd=as_frd,
        after_offset=after_offset,
        scale_error=scale,
        scale_std=np.sqrt(np.diag(scale_covariance)),
        scale_grade=graded[SCALE_ERROR],
        lever_arm=frd @ lever_arm,
        lever_arm_std=np.sqrt(np.diag(lever_covariance)),
        lever_arm_covariance=lever_covariance,
        lever_arm_grade=tuple(graded[LEVER_ARM][i] for i in np.argmax(np.abs(frd), axis=1)),
        origin=_origin(calibration.inputs),
        body_axes=calibration.body_axes,
        alignment=alignment.value,
        alignment_std=alignment.std,
        axes=recorded,
    )


def transceiver_of(calibration: Calibration | Solution) -> TransceiverTerms | None:
    """Return how the transceiver of a USBL is mounted, None if it was not estimated."""
    parts = _values(calibration)
    if USBL_MISALIGNMENT not in parts:
        return None
    seen = next(e.observable for e in calibration.estimates if e.name == USBL_MISALIGNMENT)
    frd = frd_from_body(calibration.body_axes)

    def attitude(vector: Array) -> Array:
        return euler(frd @ exp_so3(vector * DEG).T @ frd.T, "ZYX")

    limit = calibration.limits.get(USBL_MISALIGNMENT, np.inf)
    angles = _angles(attitude, *parts[USBL_MISALIGNMENT], seen, limit)
    known = parts.get(USBL_SOUND_SPEED_ERROR)
    if known is None:
        return TransceiverTerms(angles, None, ())
    value, covariance = known
    error = (float(value[0]), float(np.sqrt(covariance[0, 0])))
    return TransceiverTerms(angles, error, calibration.grades[USBL_SOUND_SPEED_ERROR])


def _angles(
    of: Callable[[Array], Array], alpha: Array, covariance: Array, seen: BoolArray, limit: float
) -> Angles:
    """Return angles that depend on a rotation vector, deg, and their standard deviations."""
    value = of(alpha)
    steps = np.eye(3) * _STEP
    J = np.stack([wrapped((of(alpha + h) - of(alpha - h)) * DEG) / DEG for h in steps], axis=1) / (
        2.0 * _STEP
    )
    std = np.sqrt(np.maximum(np.diag(J @ covariance @ J.T), 0.0))
    # An angle is as observable as the component that adds most to its standard deviation.
    most = np.argmax(np.abs(J) * np.sqrt(np.diag(covariance)), axis=1)
    return Angles(value, std, grades(std, seen[most], limit))


def _values(calibration: Calibration | Solution) -> dict[str, tuple[Array, Array]]:
    """Return value and covariance of each parameter."""
    parts: dict[str, tuple[Array, Array]] = {}
    at = 0
    for e in calibration.estimates:
        rows = slice(at, at + e.value.size)
        parts[e.name] = (e.value, calibration.covariance[rows, rows])
        at = rows.stop
    return parts


def _parts(calibration: Calibration | Solution) -> dict[str, tuple[Array, Array]]:
    """Return value and covariance of each parameter, those that a DVL needs among them."""
    parts = _values(calibration)
    for name in NEEDED:
        if name not in parts:
            beams = DIRECTION in parts
            raise DataError(
                f"the calibration has no {name}{': it calibrates single beams' if beams else ''}",
                expected="the calibration of a DVL",
                hint="Write the matrix of the beams with: factorgraph-dvl correct TRIAL "
                "CALIBRATION --out DIR" if beams else "",
            )  # fmt: skip
    return parts


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
