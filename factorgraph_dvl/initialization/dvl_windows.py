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
        Residual of the DVL's velocity, in the axes of the window's start, polynomial taken out; 0
        where there is none.
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
        Handedness of the DVL's axes: 1 right-handed, -1 mirrored, 0 whichever fits better.
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
        carried = self.carried(self.later).speed
        return np.asarray(np.sum(self.without_trend(carried) ** 2, axis=(1, 2)))

    def residual(self, offset: float | Array) -> Array:
        """Return what is left of the velocities if the DVL is late by offsets, (..., W, n, 3)."""
        kept, x = self._best(offset)
        return np.asarray((kept @ x[..., None, None, :, None])[..., 0])

    def fit(self, offset: float | Array) -> DvlFit:
        """Return how the DVL fits if it is late by an offset, s, constant or (W, n)."""
        kept, x = self._best(offset)
        c = x[-1] if abs(x[-1]) > 1e-9 else 1e-9
        return DvlFit(
            residual=kept @ x,
            dRb=np.sign(c) * x[:_AXES].reshape(3, 3).T,
            scale_error=float(1.0 / abs(c) - 1.0),
            lever_arm=x[_AXES:-1] / c,
        )

    def _best(self, offset: float | Array) -> tuple[Array, Array]:
        """Return the columns of the model (..., W, n, 3, 13), and what fits best (..., 13)."""
        at = self.carried(offset)
        shape = at.speed.shape
        axes = at.turn[..., None] * self.velocity[self.rows][..., None, None, :]
        arm = -at.turn @ skew(at.rate)
        columns = np.concatenate([axes.reshape(*shape, _AXES), arm, -at.speed[..., None]], axis=-1)
        kept = self.without_trend(columns.reshape(*shape[:-1], -1)).reshape(columns.shape)
        flat = kept.reshape(*shape[:-3], -1, _AXES + _REST)
        form, linear = _eliminated(flat.swapaxes(-1, -2) @ flat)
        minima = _minima(form)
        cost = np.sum((minima @ form) * minima, axis=-1)
        scale = (minima @ linear)[..., -1]
        allowed = self.handedness * scale >= 0.0
        # Without a minimum of that handedness, the one nearest to it.
        nearest = np.argmax(self.handedness * scale, axis=-1)
        best = np.argmin(np.where(allowed, cost, np.inf), axis=-1)
        best = np.where(allowed.any(axis=-1), best, nearest)
        C = np.take_along_axis(minima, best[..., None, None], axis=-2)
        return kept, np.concatenate([C, C @ linear], axis=-1)[..., 0, :]


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
    """Return the quadratic form of the axes (..., 9, 9), and what takes them to the rest.

    From sums of products (..., 13, 13); the latter is (..., 9, 4).
    """
    rest = gram[..., _AXES:, _AXES:]
    diagonal = np.maximum(np.diagonal(rest, axis1=-2, axis2=-1), 1e-9)
    rest = rest + 1e-9 * diagonal[..., None] * np.eye(_REST)
    back = np.asarray(-np.linalg.solve(rest, gram[..., _AXES:, :_AXES]), dtype=float)
    form = gram[..., :_AXES, :_AXES] + gram[..., :_AXES, _AXES:] @ back
    return 0.5 * (form + form.swapaxes(-1, -2)), back.swapaxes(-1, -2)


def _minima(form: Array) -> Array:
    """Return rotations, (..., 24, 9), where Gauss-Newton steps on a form end from 24 starts."""
    count = len(_STARTS)
    C = np.broadcast_to(_STARTS, (*form.shape[:-2], count, 3, 3))
    for _ in range(_STEPS):
        change = (C[..., None, :, :] @ _TURNS).reshape(*C.shape[:-2], 3, _AXES)
        weighed = (change.reshape(*form.shape[:-2], -1, _AXES) @ form).reshape(change.shape)
        gradient = weighed @ C.reshape(*C.shape[:-2], _AXES, 1)
        curvature = weighed @ change.swapaxes(-1, -2)
        trace = np.trace(curvature, axis1=-2, axis2=-1)[..., None, None]
        # At rest all velocities may be exactly zero, and no rotation is better than another.
        damping = np.maximum(1e-6 * trace, np.finfo(float).tiny)
        step = -np.linalg.solve(curvature + damping * np.eye(3), gradient)[..., 0]
        size = np.sqrt(np.sum(step**2, axis=-1, keepdims=True))
        step *= np.minimum(1.0, _LARGEST_STEP / np.maximum(size, 1e-12))
        C = C @ exp_so3(step)
    return C.reshape(*form.shape[:-2], count, _AXES)
