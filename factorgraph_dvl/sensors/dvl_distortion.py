"""What a DVL's mount and electronics do to a velocity beyond one misalignment and one scale.

With u the velocity at the DVL in body, its speed s, A the axes, E the flex of the mount and k the
scale, each axis of d reports

    (1 + k) A dRb E u,    E = Exp(F_t z + F_r omega + F_s s)

where z are the x and y components of the vertical in body, the sines of its tilt, and omega those
of the rate. k grows with speed, place and time. All of it is zero where a trial does not state it.

What an axis reports, w, may then lose digits. Cut off towards zero, it is too small by half a
digit c on average, or zero below that. A record has w - c w / sqrt(w^2 + c^2).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array, rotate, skew
from factorgraph_dvl.sensors.parameters import SCALAR, XYZ, Frame, ParameterSpec
from factorgraph_dvl.sensors.protocol import Motion

_BY_XY = tuple(f"{turned}{by}" for turned in "xyz" for by in "xy")


def _spec(
    stem: str,
    unit: str,
    labels: tuple[str, ...],
    plausible: float,
    frame: Frame = "d",
    key: str = "",
) -> ParameterSpec:
    return ParameterSpec(
        f"dvl_{stem}",
        unit,
        labels=labels,
        frame=frame,
        nuisance=True,
        plausible=plausible,
        of_record=True,
        key=key,
    )


# Plausible sizes. Chosen: of a mount that one would send back, of water from the tropics to ice.
AXES_SPEC = _spec("axes", "deg", ("xy", "xz", "yz"), 1.0, key="dvl: axes_std_deg")
SCALE_DIFFERENCE_SPEC = _spec("scale_difference", "", ("y", "z"), 0.01, key="dvl: scale_error_std")
FLEX_BY_TILT_SPEC = _spec("flex_by_tilt", "", _BY_XY, 0.1, "b")
FLEX_BY_RATE_SPEC = _spec("flex_by_rate", "s", _BY_XY, 0.1, "b")
FLEX_BY_SPEED_SPEC = _spec("flex_by_speed", "deg_s_m", XYZ, 0.5, "b")
SCALE_BY_SPEED_SPEC = _spec("scale_by_speed", "s_m", SCALAR, 0.01)
SCALE_BY_PLACE_SPEC = _spec("scale_by_place", "1_km", ("e", "n", "u"), 0.1, "n")
SCALE_BY_TIME_SPEC = _spec("scale_by_time", "1_h", SCALAR, 0.05)
TRUNCATION_SPEC = _spec("truncation", "m_s", SCALAR, 0.01)

SPECS = (
    *(AXES_SPEC, SCALE_DIFFERENCE_SPEC),
    *(FLEX_BY_TILT_SPEC, FLEX_BY_RATE_SPEC, FLEX_BY_SPEED_SPEC),
    *(SCALE_BY_SPEED_SPEC, SCALE_BY_PLACE_SPEC, SCALE_BY_TIME_SPEC),
    TRUNCATION_SPEC,
)
NAMES = tuple(spec.name for spec in SPECS)
AXES, SCALE_DIFFERENCE = NAMES[:2]
FLEX_BY_TILT, FLEX_BY_RATE, FLEX_BY_SPEED = NAMES[2:5]
SCALE_BY_SPEED, SCALE_BY_PLACE, SCALE_BY_TIME = NAMES[5:8]
TRUNCATION = NAMES[8]
# Pairs of axes by the labels of their angles.
_PAIRS = ((0, 1), (0, 2), (1, 2))
# Least speed, m/s, that has a direction. Chosen: far below that of any ping.
_AT_REST = 1e-9
# Terms of a series in a flex of the mount. Chosen: of 0.1 rad, the next is 1e-8.
_TERMS = 4


@dataclass(frozen=True)
class Distortion:
    """What becomes of M velocities at the DVL, and how that depends on the motion.

    Parameters
    ----------
    values : mapping of str to ndarray
        Parameters, SI; those that are not there are zero.
    motion : Motion
        Motion of the body.
    velocity_b : ndarray, shape (M, 3), m/s
        Velocity at the DVL, in body.
    since : ndarray, shape (M,), s
        Time since the middle of the record.
    uniform : ndarray, shape (n,) or (M, n)
        Scale error of all axes, or of each.
    """

    values: Mapping[str, Array]
    motion: Motion
    velocity_b: Array
    since: Array
    uniform: Array

    def _value(self, spec: ParameterSpec) -> Array:
        return self.values.get(spec.name, np.zeros(spec.size))

    @property
    def _speed(self) -> Array:
        """Speed, (M, 1), m/s."""
        return np.maximum(np.linalg.norm(self.velocity_b, axis=1, keepdims=True), _AT_REST)

    @property
    def _tilt(self) -> Array:
        """Components x and y of the vertical in body, (M, 2)."""
        return self.motion.nRb[:, 2, :2]

    @property
    def _matrices(self) -> tuple[Array, Array]:
        """Turns of the mount by tilt and by rate, (3, 2) each."""
        by_tilt, by_rate = self._value(FLEX_BY_TILT_SPEC), self._value(FLEX_BY_RATE_SPEC)
        return by_tilt.reshape(3, 2), by_rate.reshape(3, 2)

    @property
    def turn(self) -> Array:
        """Rotation vector of the mount's flex, (M, 3), rad."""
        by_tilt, by_rate = self._matrices
        out = self._tilt @ by_tilt.T + self.motion.omega_eb_b[:, :2] @ by_rate.T
        return out + self._speed * self._value(FLEX_BY_SPEED_SPEC)

    @property
    def axes(self) -> Array:
        """Directions that the axes measure along, in rows, (3, 3).

        An angle is what is missing to 90 degrees between two; each of both takes half of it.
        """
        out = np.eye(3)
        for (i, j), angle in zip(_PAIRS, self._value(AXES_SPEC), strict=True):
            out[i, j] = out[j, i] = 0.5 * angle
        return out

    @property
    def scale(self) -> Array:
        """Scale error, (M, 3)."""
        along = (
            self._speed * self._value(SCALE_BY_SPEED_SPEC)
            + self.motion.p_n @ self._value(SCALE_BY_PLACE_SPEC)[:, None]
            + self.since[:, None] * self._value(SCALE_BY_TIME_SPEC)
        )
        return self.uniform + along + np.concatenate([[0.0], self._value(SCALE_DIFFERENCE_SPEC)])

    def turned(self) -> Array:
        """Return the velocity as the flexed mount turns it, E u, (M, 3), m/s."""
        return rotate(exp_so3(self.turn), self.velocity_b)

    def truncated(self, scaled_d: Array) -> Array:
        """Return what the record has of velocities (1 + k) A dRb E u, (M, 3), m/s."""
        cut = self._value(TRUNCATION_SPEC)
        return scaled_d - cut * scaled_d / _length(scaled_d, cut)

    def passed(self, scaled_d: Array) -> Array:
        """Return the derivative of `truncated` by its argument, (M, 3)."""
        cut = self._value(TRUNCATION_SPEC)
        return 1.0 - (cut / _length(scaled_d, cut)) ** 3

    def derivatives(self, unscaled_d: Array, dMb: Array, passed: Array) -> DistortionDerivatives:
        """Return the derivatives of what the record has.

        Parameters
        ----------
        unscaled_d : ndarray, shape (M, 3), m/s
            A dRb E u.
        dMb : ndarray, shape (M, 3, 3)
            (1 + k) A dRb, what passes of it.
        passed : ndarray, shape (M, 3)
            What passes.
        """
        scaled_d = unscaled_d * (1.0 + self.scale)
        turn, speed, motion = self.turn, self._speed, self.motion
        flexed = dMb @ exp_so3(turn)
        by_turn = -flexed @ skew(self.velocity_b) @ _right_jacobians(turn)
        by_tilt, by_rate = self._matrices
        by_speed = by_turn @ self._value(FLEX_BY_SPEED_SPEC)
        by_speed = by_speed + passed * unscaled_d * self._value(SCALE_BY_SPEED_SPEC)
        along = (passed * unscaled_d)[:, :, None]
        return DistortionDerivatives(
            velocity=flexed + by_speed[:, :, None] * (self.velocity_b / speed)[:, None, :],
            theta=by_turn @ by_tilt @ skew(motion.nRb[:, 2])[:, :2],
            omega=np.pad(by_turn @ by_rate, ((0, 0), (0, 0), (0, 1))),
            place=along * self._value(SCALE_BY_PLACE_SPEC),
            parameters={
                AXES: lambda: passed[:, :, None] * self._by_axes(unscaled_d),
                SCALE_DIFFERENCE: lambda: along * np.eye(3)[:, 1:],
                FLEX_BY_TILT: lambda: _times(by_turn, self._tilt),
                FLEX_BY_RATE: lambda: _times(by_turn, motion.omega_eb_b[:, :2]),
                FLEX_BY_SPEED: lambda: by_turn * speed[:, :, None],
                SCALE_BY_SPEED: lambda: along * speed[:, :, None],
                SCALE_BY_PLACE: lambda: along * motion.p_n[:, None, :],
                SCALE_BY_TIME: lambda: along * self.since[:, None, None],
                TRUNCATION: lambda: self._by_truncation(scaled_d)[:, :, None],
            },
        )

    def _by_truncation(self, scaled_d: Array) -> Array:
        return -((scaled_d / _length(scaled_d, self._value(TRUNCATION_SPEC))) ** 3)

    def _by_axes(self, unscaled_d: Array) -> Array:
        """Return the derivatives by the angles between axes, (M, 3, 3)."""
        seen = unscaled_d @ np.linalg.inv(self.axes).T
        out = np.zeros((*seen.shape, len(_PAIRS)))
        for k, (i, j) in enumerate(_PAIRS):
            out[:, i, k], out[:, j, k] = 0.5 * seen[:, j], 0.5 * seen[:, i]
        return out * (1.0 + self.scale)[:, :, None]


@dataclass(frozen=True)
class DistortionDerivatives:
    """Derivatives of a distorted velocity.

    Parameters
    ----------
    velocity, theta, omega, place : ndarray, shape (M, 3, 3)
        Those by the velocity at the DVL; those by attitude, rate and position beside what these
        do to it.
    parameters : dict of str to callable
        What returns those by each parameter, (M, 3, n).
    """

    velocity: Array
    theta: Array
    omega: Array
    place: Array
    parameters: dict[str, Callable[[], Array]]


def _length(velocity: Array, cut: Array) -> Array:
    """Return the root of the sum of two squares, (M, 3), never zero."""
    return np.maximum(np.hypot(velocity, cut), _AT_REST)


def _times(by_turn: Array, signals: Array) -> Array:
    """Return the derivatives by a matrix (3, 2) of turns by signals (M, 2), row by row."""
    out = by_turn[:, :, :, None] * signals[:, None, None, :]
    return out.reshape(*by_turn.shape[:2], -1)


def _right_jacobians(phi: Array) -> Array:
    """Return Jr (M, 3, 3) of small rotation vectors (M, 3): the series in their cross product."""
    across = skew(phi)
    term = out = np.broadcast_to(np.eye(3), across.shape)
    for k in range(2, _TERMS + 2):
        term = term @ across / -k
        out = out + term
    return np.asarray(out)


def is_distorted(values: Mapping[str, Array]) -> bool:
    """Whether any parameter of a distortion is other than zero."""
    return any(name in values and values[name].any() for name in NAMES)
