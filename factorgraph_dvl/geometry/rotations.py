"""Rotations: exponential map, Euler angles, body axes."""

from __future__ import annotations

from typing import Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import IDENTITY, Array, skew

BodyAxes = Literal["RFU", "FRD", "FLU"]
_Angle = TypeVar("_Angle", float, Array)

# Keeps the axis of no rotation finite. Chosen: its square is next to nothing in a double.
_NO_ANGLE = 1e-150
# Rotations up to which Rodrigues' formula takes less time than SciPy takes to begin. Measured: a
# third of it in a replay, which turns few at a time.
_FEW = 100

# By definition: components forward, right, down of body axes, and ENU of NED.
_FRD_FROM_BODY: dict[str, Array] = {
    "FRD": np.eye(3),
    "RFU": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    "FLU": np.diag([1.0, -1.0, -1.0]),
}
_ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# Names of the axes that `frd_from_body` leads to.
FRD_NAMES = ("forward", "starboard", "down")


def frd_from_body(body_axes: BodyAxes) -> Array:
    """Return the (3, 3) matrix that takes body components to forward, right, down."""
    return _FRD_FROM_BODY[body_axes]


def wrapped(angle: _Angle) -> _Angle:
    """Return angles, rad, in [-pi, pi); those that are there already to the last digit."""
    return angle - 2.0 * np.pi * np.floor((angle + np.pi) / (2.0 * np.pi))


def best_rotation(moments: Array) -> Array:
    """Return the rotations R, (..., 3, 3), that maximise tr(Rᵀ M) of matrices M (..., 3, 3).

    With M = sum w y xᵀ it is the rotation that best takes vectors x to y, sum w |y - R x|² = min:
    Wahba's problem, by singular values (Markley, J. Astronautical Sciences 36(3), 1988). With
    any M it is the rotation that is nearest in the Frobenius norm.
    """
    u, _, vt = np.linalg.svd(moments)
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return np.asarray(u @ vt)


def exp_so3(phi: ArrayLike) -> Array:
    """Return the rotation matrices Exp([phi x]) of rotation vectors (..., 3), rad."""
    phi = np.asarray(phi, dtype=float)
    if phi.size > 3 * _FEW:
        flat = Rotation.from_rotvec(phi.reshape(-1, 3)).as_matrix()
        return flat.reshape(*phi.shape, 3)
    angle = np.sqrt(phi[..., None, :] @ phi[..., :, None]) + _NO_ANGLE
    half = np.sin(0.5 * angle) / angle
    matrix = skew(phi)
    return np.asarray(
        IDENTITY + (np.sin(angle) / angle) * matrix + (2.0 * half * half) * (matrix @ matrix)
    )


def cumulative_products(matrices: Array) -> Array:
    """Return the products M_0 M_1 … M_i of matrices (N, 3, 3) up to each."""
    count = len(matrices)
    size = max(int(np.sqrt(count)), 1)
    runs = -(-count // size)
    out = np.tile(IDENTITY, (runs * size, 1, 1))
    out[:count] = matrices
    out = out.reshape(runs, size, 3, 3)
    for i in range(1, size):
        out[:, i] = out[:, i - 1] @ out[:, i]
    for k in range(1, runs):
        out[k] = out[k - 1, -1] @ out[k]
    return np.asarray(out.reshape(-1, 3, 3)[:count])


def log_so3(matrix: ArrayLike) -> Array:
    """Return the rotation vectors (..., 3), rad, of rotation matrices (..., 3, 3)."""
    matrix = np.asarray(matrix, dtype=float)
    trace = matrix[..., 0, 0] + matrix[..., 1, 1] + matrix[..., 2, 2]
    # Towards 180 degrees the sine of the angle loses digits.
    if (trace < 0.0).any():
        flat = Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_rotvec()
        return flat.reshape(matrix.shape[:-1])
    # A tenth of the time of SciPy's.
    twice = matrix[..., [2, 0, 1], [1, 2, 0]] - matrix[..., [1, 2, 0], [2, 0, 1]]
    sine = 0.5 * np.sqrt((twice * twice).sum(axis=-1)) + _NO_ANGLE
    angle = np.arctan2(sine, 0.5 * (trace - 1.0))
    return np.asarray((0.5 * angle / sine)[..., None] * twice)


def right_jacobian(phi: ArrayLike) -> Array:
    """Return Jr(phi), (3, 3), of Exp(phi + d) = Exp(phi) Exp(Jr(phi) d).

    Chirikjian, Stochastic Models, Information Theory, and Lie Groups 2, eq. 10.86.
    """
    phi = np.asarray(phi, dtype=float)
    angle = float(np.linalg.norm(phi))
    cross = skew(phi)
    if angle < 1e-4:
        return IDENTITY - cross / 2.0 + cross @ cross / 6.0
    return (
        IDENTITY
        - (1.0 - np.cos(angle)) / angle**2 * cross
        + (angle - np.sin(angle)) / angle**3 * cross @ cross
    )


def inverse_right_jacobian(phi: ArrayLike) -> Array:
    """Return the inverses of `right_jacobian` of phi (..., 3), as (..., 3, 3).

    Finite for |phi| < 2 pi.
    """
    phi = np.asarray(phi, dtype=float)
    angle = np.sqrt((phi * phi).sum(axis=-1))[..., None, None]
    cross = skew(phi)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    half = safe / 2.0
    gain = np.where(small, 1.0 / 12.0, (1.0 - half / np.tan(half)) / safe**2)
    return np.asarray(IDENTITY + cross / 2.0 + gain * (cross @ cross))


def reported_rotation_vector(matrix: ArrayLike, near: ArrayLike) -> Array:
    """Return the rotation vector of a rotation, in the branch closest to `near`.

    Close to 180 degrees two vectors of opposite sign describe almost the same
    rotation. The one nearer to `near` is taken; where that does not decide, the one
    whose largest component is positive, so that an estimate which scatters about
    180 degrees does not jump between the two.

    Parameters
    ----------
    matrix : array_like
        (3, 3) rotation.
    near : array_like
        (3,) rotation vector, rad.
    """
    phi = log_so3(matrix)
    angle = float(np.linalg.norm(phi))
    if angle < 0.9 * np.pi:
        return phi
    other = phi * (1.0 - 2.0 * np.pi / angle)
    near = np.asarray(near, dtype=float)
    gain = float(np.linalg.norm(other - near) - np.linalg.norm(phi - near))
    if abs(gain) > 0.2:
        return other if gain < 0 else phi
    if angle < np.pi - 5.0 * DEG:
        return phi
    return phi if phi[np.argmax(np.abs(phi))] > 0 else other


def rotation_from_rph(rph: ArrayLike, body_axes: BodyAxes) -> Array:
    """Return nRb (local-level ENU) from roll, pitch, heading.

    nRb = E Rz(heading) Ry(pitch) Rx(roll) F, with F body to forward-right-down and E
    north-east-down to east-north-up: heading clockwise from true north, pitch bow up,
    roll starboard down.

    Parameters
    ----------
    rph : array_like
        (..., 3) roll, pitch, heading, rad.
    body_axes : BodyAxes
        Axes of the body frame.

    Returns
    -------
    ndarray, shape (..., 3, 3)
        Rotation matrices.
    """
    rph = np.asarray(rph, dtype=float)
    (sr, sp, sh), (cr, cp, ch) = (np.moveaxis(f(rph), -1, 0) for f in (np.sin, np.cos))
    out = np.empty((*rph.shape, 3))
    out[..., 0, 0] = cp * sh
    out[..., 0, 1] = sr * sp * sh + cr * ch
    out[..., 0, 2] = cr * sp * sh - sr * ch
    out[..., 1, 0] = cp * ch
    out[..., 1, 1] = sr * sp * ch - cr * sh
    out[..., 1, 2] = cr * sp * ch + sr * sh
    out[..., 2, 0] = sp
    out[..., 2, 1] = -sr * cp
    out[..., 2, 2] = -cr * cp
    return out @ _FRD_FROM_BODY[body_axes]


def rph_from_rotation(nRb: ArrayLike, body_axes: BodyAxes) -> Array:
    """Return roll, pitch, heading (..., 3), rad, of nRb; heading in [0, 2 pi)."""
    nRb = np.asarray(nRb, dtype=float)
    frd = _ENU_FROM_NED.T @ nRb @ _FRD_FROM_BODY[body_axes].T
    rph = np.empty(nRb.shape[:-1])
    rph[..., 0] = np.arctan2(frd[..., 2, 1], frd[..., 2, 2])
    rph[..., 1] = np.arcsin(np.maximum(np.minimum(-frd[..., 2, 0], 1.0), -1.0))
    rph[..., 2] = np.arctan2(frd[..., 1, 0], frd[..., 0, 0]) % (2.0 * np.pi)
    return rph


def rph_jacobian(rph: ArrayLike, body_axes: BodyAxes) -> Array:
    """Return d(roll, pitch, heading) / d(theta), (..., 3, 3), for nRb Exp(theta).

    The kinematic equation of the ZYX Euler angles; singular at a pitch of 90 degrees.
    """
    rph = np.asarray(rph, dtype=float)
    sr, cr = np.sin(rph[..., 0]), np.cos(rph[..., 0])
    tp, cp = np.tan(rph[..., 1]), np.cos(rph[..., 1])
    out = np.zeros((*rph.shape, 3))
    out[..., 0, 0] = 1.0
    out[..., 0, 1] = sr * tp
    out[..., 0, 2] = cr * tp
    out[..., 1, 1] = cr
    out[..., 1, 2] = -sr
    out[..., 2, 1] = sr / cp
    out[..., 2, 2] = cr / cp
    return out @ _FRD_FROM_BODY[body_axes]


def theta_by_rph(rph: ArrayLike, body_axes: BodyAxes) -> Array:
    """Return d(theta) / d(roll, pitch, heading), (..., 3, 3), for nRb Exp(theta).

    The inverse of `rph_jacobian`, regular at every pitch.
    """
    rph = np.asarray(rph, dtype=float)
    sr, cr = np.sin(rph[..., 0]), np.cos(rph[..., 0])
    sp, cp = np.sin(rph[..., 1]), np.cos(rph[..., 1])
    out = np.zeros((*rph.shape, 3))
    out[..., 0, 0] = 1.0
    out[..., 0, 2] = -sp
    out[..., 1, 1] = cr
    out[..., 1, 2] = sr * cp
    out[..., 2, 1] = -sr
    out[..., 2, 2] = cr * cp
    return np.asarray(_FRD_FROM_BODY[body_axes].T @ out)
