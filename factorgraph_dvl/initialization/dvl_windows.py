"""DVL velocities against the carried IMU, window by window, without any other sensor.

In the axes at the start of a window the IMU carries the velocity u, which with the axes C of the
DVL (DVL to body), its scale 1 / c and its lever arm l is

    c u(t) = R(t) (C v_d(t) - omega(t) x c l) + polynomial.

The polynomial takes gravity, start and biases in. All but C is linear and is eliminated, so that
C minimises a quadratic form over rotations. The form is even: a minimum with c < 0 is one of
mirrored axes, -C. That the noise is the DVL's and not the IMU's is why c stands on the left.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array, skew
from factorgraph_dvl.initialization.carried_windows import CarriedWindows
from factorgraph_dvl.initialization.velocity_windows import (
    VelocityWindows,
    sorted_into,
    steady,
)
from factorgraph_dvl.sensors.dvl import Dvl

# Elements of C, and of what enters linearly: c l and c.
_AXES = 9
_REST = 4
# Where the search for C starts, and the derivatives of a rotation.
_STARTS = Rotation.create_group("O").as_matrix()
_TURNS = skew(np.eye(3))
# Gauss-Newton steps from each start. Chosen: starts are 60 degrees off at most.
_STEPS = 8
# Largest of them, rad.
_LARGEST_STEP = 0.5


@dataclass(frozen=True)
class DvlFit:
    """How pings fit the carried IMU.

    Parameters
    ----------
    residual : ndarray, shape (W, n, 3), m/s
        Of the DVL's velocity, in the axes of the window's start, polynomial taken out; 0 where
        there is none.
    dRb : ndarray, shape (3, 3)
        Body to DVL; of determinant -1 where the axes are mirrored.
    scale_error : float
        Scale error that fits.
    lever_arm : ndarray, shape (3,), m
        Lever arm from the IMU that fits, in body.
    """

    residual: Array
    dRb: Array
    scale_error: float
    lever_arm: Array


@dataclass(frozen=True)
class DvlWindows(VelocityWindows):
    """Pings, sorted into the windows of the carried IMU; velocities in the axes of the DVL.

    Parameters
    ----------
    handedness : {0, 1, -1}
        Of the DVL's axes: 1 right-handed, -1 mirrored, 0 whichever fits better.
    later : float, s
        Offset of its clock around which others are tried.
    """

    handedness: int = 0
    later: float = 0.0

    @property
    def count(self) -> Array:
        """Degrees of freedom of each window, (W,)."""
        return self.freedom(9)

    @cached_property
    def signal(self) -> Array:
        """Sum of squares of the velocity's changes in each window, (W,)."""
        carried = self.carried(self.later).speed.reshape(*self.rows.shape, 3)
        return np.asarray(np.sum(self.without_trend(carried) ** 2, axis=(1, 2)))

    def residual(self, offset: float | Array) -> Array:
        """Return what is left of the velocities if the DVL is late by an offset, (W, n, 3)."""
        return self.fit(offset).residual

    def fit(self, offset: float | Array) -> DvlFit:
        """Return how the DVL fits if it is late by an offset, s, constant or (W, n)."""
        shape = self.rows.shape
        at = self.carried(offset)
        turn = at.turn.reshape(*shape, 3, 3)
        velocity = self.velocity[self.rows]
        axes = np.einsum("wnij,wnk->wnijk", turn, velocity).reshape(*shape, 3, 9)
        arm = -turn @ skew(at.rate).reshape(*shape, 3, 3)
        speed = at.speed.reshape(*shape, 3, 1)
        columns = np.concatenate([axes, arm, -speed], axis=3)
        kept = self.without_trend(columns.reshape(*shape, -1)).reshape(columns.shape)
        flat = kept.reshape(-1, _AXES + _REST)
        gram = flat.T @ flat
        form, linear = _eliminated(gram)
        minima = _minima(form)
        cost = np.sum((minima @ form) * minima, axis=1)
        scale = minima @ linear[:, -1]
        allowed = self.handedness * scale >= 0.0
        # Without a minimum of that handedness, the one nearest to it.
        nearest = int(np.argmax(self.handedness * scale))
        best = int(np.argmin(np.where(allowed, cost, np.inf))) if allowed.any() else nearest
        x = np.concatenate([minima[best], minima[best] @ linear])
        c = x[-1] if abs(x[-1]) > 1e-9 else 1e-9
        return DvlFit(
            residual=kept @ x,
            dRb=np.sign(c) * minima[best].reshape(3, 3).T,
            scale_error=float(1.0 / abs(c) - 1.0),
            lever_arm=x[_AXES:-1] / c,
        )


def dvl_windows(windows: CarriedWindows, dvl: Dvl, later: float = 0.0) -> DvlWindows | None:
    """Sort the pings of a DVL into windows.

    Parameters
    ----------
    windows : CarriedWindows
        The carried IMU.
    dvl : Dvl
        Record of the DVL.
    later : float
        Offset of its clock around which others are tried, s.

    Returns
    -------
    DvlWindows or None
        The comparison, None where no window has enough pings.
    """
    locked = dvl.locked.copy()
    locked[locked] = steady(dvl.velocity[locked])
    time = dvl.time[locked]
    table = sorted_into(windows, time - later)
    if table is None:
        return None
    sigma = np.sqrt(np.mean(dvl.sigma()[locked] ** 2, axis=1))
    return DvlWindows(windows, time, dvl.velocity[locked], sigma, *table, later=later)


def _eliminated(gram: Array) -> tuple[Array, Array]:
    """Return the quadratic form of the axes (9, 9), and what takes them to the rest, (9, 4)."""
    rest = gram[_AXES:, _AXES:]
    rest = rest + 1e-9 * np.diag(np.maximum(np.diag(rest), 1e-9))
    linear = -np.linalg.solve(rest, gram[_AXES:, :_AXES]).T
    form = gram[:_AXES, :_AXES] + gram[:_AXES, _AXES:] @ linear.T
    return np.asarray(0.5 * (form + form.T)), np.asarray(linear, dtype=float)


def _minima(form: Array) -> Array:
    """Return rotations, (24, 9), where Gauss-Newton steps on a form end from 24 starts."""
    C = _STARTS
    for _ in range(_STEPS):
        change = (C[:, None] @ _TURNS).reshape(-1, 3, _AXES)
        weighed = change @ form
        gradient = weighed @ C.reshape(-1, _AXES, 1)
        curvature = weighed @ change.transpose(0, 2, 1)
        trace = np.trace(curvature, axis1=1, axis2=2)[:, None, None]
        step = -np.linalg.solve(curvature + 1e-6 * trace * np.eye(3), gradient)[..., 0]
        size = np.sqrt(np.sum(step**2, axis=1, keepdims=True))
        step *= np.minimum(1.0, _LARGEST_STEP / np.maximum(size, 1e-12))
        C = C @ exp_so3(step)
    return C.reshape(-1, _AXES)
