"""Position and velocity of a point on the body: an antenna, or what an INS reports."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, cross, rotate, skew
from factorgraph_dvl.sensors.clock import Clock
from factorgraph_dvl.sensors.protocol import (
    ExpectedCorrelation,
    Linearization,
    Motion,
    ObservationByRows,
    Values,
    lever_arm_sigma,
)


@dataclass(frozen=True, kw_only=True)
class _OfPoint(ObservationByRows):
    """What position and velocity of a point have in common."""

    time: Array
    lRn: Array
    std: Array
    label: str
    clock: Clock
    lever_arm: Array | str
    bRc: Array = field(default_factory=lambda: np.eye(3))
    components: tuple[str, ...] = ("east", "north", "up")
    noise_groups: tuple[tuple[int, ...], ...] = ()
    correlated: ExpectedCorrelation | None = None
    # Parameters with their derivatives (M, 3, n), where the measurement errs by their sum.
    errors: Mapping[str, Array] = field(default_factory=dict)

    @property
    def parameters(self) -> tuple[str, ...]:
        """The lever arm, where it is a parameter, and the errors."""
        return ((self.lever_arm,) if isinstance(self.lever_arm, str) else ()) + tuple(self.errors)

    def error(self, values: Values) -> Array:
        """Return measured minus true by the parameters, (M, 3)."""
        out = np.zeros((self.time.size, 3))
        for name, by in self.errors.items():
            if name in values:
                out += by @ values[name]
        return out

    def _derivatives(self, by_lever_arm: Array, wanted: Collection[str]) -> dict[str, Array]:
        """Return those by the parameters, of which that by a lever arm is given."""
        own = {n: self.errors.get(n, by_lever_arm) for n in self.parameters}
        return {name: by for name, by in own.items() if name in wanted}

    def lever_arm_b(self, values: Values) -> Array:
        """Return the lever arm in body, (3,) or (M, 3), m."""
        own = self.lever_arm
        return np.asarray(self.bRc @ (values[own] if isinstance(own, str) else own))


@dataclass(frozen=True, kw_only=True)
class PointPosition(_OfPoint):
    """Position of a point; zero error where measured = p_n + nRb bRc l.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times of the fixes.
    measured_n : ndarray, shape (M, 3), m
        Position in n.
    lRn : ndarray, shape (M, 3, 3)
        N to the local-level axes for which `std` is right.
    std : ndarray, shape (M, 3), m
        East, north, up.
    label : str
        Name of the measurement.
    clock : Clock
        Clock of the sensor.
    lever_arm : ndarray or str
        Lever arm to the point, (3,), m, in the axes of its carrier; or the parameter that it is.
    bRc : ndarray, shape (M, 3, 3) or (3, 3), optional
        Axes of that carrier to body.
    components, noise_groups, correlated : optional
        Components, noise groups and correlated as in `Observation`.
    errors : mapping of str to ndarray, optional
        Parameters whose sum, by these derivatives (M, 3, n), is what is measured too much.
    """

    measured_n: Array
    unit: str = "m"

    def sigma(self, motion: Motion, values: Values, factor: Array | float = 1.0) -> Array:
        """Return the stated standard deviations, (M, 3), m."""
        return self.std * factor

    def residual(self, motion: Motion, values: Values) -> Array:
        """Return predicted - measured in local-level east, north, up, (M, 3), m."""
        point_n = motion.p_n + rotate(motion.nRb, self.lever_arm_b(values))
        return rotate(self.lRn, point_n - self.measured_n) + self.error(values)

    def linearize(self, motion: Motion, values: Values, wanted: Collection[str]) -> Linearization:
        """Return the residual and its Jacobians."""
        lRb = self.lRn @ motion.nRb
        return Linearization(
            residual=self.residual(motion, values),
            d_theta=-lRb @ skew(self.lever_arm_b(values)),
            d_p=self.lRn,
            d_parameters=self._derivatives(lRb @ self.bRc, wanted),
        )


@dataclass(frozen=True, kw_only=True)
class PointVelocity(_OfPoint):
    """Velocity of a point.

    The error is zero where

        measured = v_n + nRb (omega_ec_b x bRc l),    omega_ec_b = omega_eb_b - omega_cb_b.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times of the fixes.
    measured_l : ndarray, shape (M, 3), m/s
        East, north, up at the vehicle.
    lRn : ndarray, shape (M, 3, 3)
        N to local-level axes.
    std : ndarray, shape (M, 3), m/s
        East, north, up.
    label : str
        Name of the measurement.
    clock : Clock
        Clock of the sensor.
    lever_arm : ndarray or str
        Lever arm to the point, (3,), m, in the axes of its carrier; or the parameter that it is.
    bRc : ndarray, shape (M, 3, 3) or (3, 3), optional
        Axes of that carrier to body.
    omega_cb_b : ndarray, shape (M, 3) or (3,), rad/s, optional
        Rate of the body relative to that carrier.
    components, noise_groups, correlated : optional
        Components, noise groups and correlated as in `Observation`.
    averaging, averages_in_body : optional
        Length and kind of the window over which it averages, as in `Observation`.
    errors : mapping of str to ndarray, optional
        Parameters whose sum, by these derivatives (M, 3, n), is what is measured too much.
    """

    measured_l: Array
    omega_cb_b: Array = field(default_factory=lambda: np.zeros(3))
    unit: str = "m/s"
    averaging: str | None = None
    averages_in_body: bool = True

    def sigma(self, motion: Motion, values: Values, factor: Array | float = 1.0) -> Array:
        """Return the standard deviations, the gyro's share through the lever arm included."""
        # A component that was never measured has no factor either.
        scaled = self.std * np.where(np.isinf(self.std), 1.0, factor)
        return np.hypot(scaled, lever_arm_sigma(motion, self.lever_arm_b(values))[:, None])

    def residual(self, motion: Motion, values: Values) -> Array:
        """Return predicted - measured in local-level east, north, up, (M, 3), m/s."""
        turning_b = cross(motion.omega_eb_b - self.omega_cb_b, self.lever_arm_b(values))
        predicted = rotate(self.lRn, motion.v_n + rotate(motion.nRb, turning_b))
        return predicted - self.measured_l + self.error(values)

    def linearize(self, motion: Motion, values: Values, wanted: Collection[str]) -> Linearization:
        """Return the residual and its Jacobians."""
        lever_arm = self.lever_arm_b(values)
        omega_ec_b = motion.omega_eb_b - self.omega_cb_b
        lRb = self.lRn @ motion.nRb
        return Linearization(
            residual=self.residual(motion, values),
            d_theta=-lRb @ skew(cross(omega_ec_b, lever_arm)),
            d_v=self.lRn,
            d_omega=-lRb @ skew(lever_arm),
            d_parameters=self._derivatives(lRb @ skew(omega_ec_b) @ self.bRc, wanted),
        )
