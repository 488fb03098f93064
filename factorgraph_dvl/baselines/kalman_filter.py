"""What the Kalman filters share: measurement update and Rauch-Tung-Striebel smoother."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from factorgraph_dvl.geometry.vectors import Array

# Chosen: events whose gains are taken at once; bounds the memory at 9 MB for 15 states.
_CHUNK = 5000


class _HasCovariance(Protocol):
    @property
    def covariance(self) -> Array: ...


TrackT = TypeVar("TrackT", bound=_HasCovariance)


@dataclass(frozen=True)
class ForwardPass(Generic[TrackT]):
    """What a filter of K events leaves for its smoother.

    Parameters
    ----------
    track : TrackT
        Filtered states, after the measurement of each event.
    transition : ndarray, shape (K, n, n)
        Transition of the step that ends at each event; the first is not used.
    predicted : ndarray, shape (K, n, n)
        Covariance before the measurement.
    correction : ndarray, shape (K, n)
        Errors that the measurement fed back.
    """

    track: TrackT
    transition: Array
    predicted: Array
    correction: Array


def update(P: Array, H: Array, R: Array) -> tuple[Array, Array]:
    """Return gain (n, m) and covariance (n, n) after a measurement.

    Parameters
    ----------
    P : ndarray, shape (n, n)
        Covariance before the measurement.
    H : ndarray, shape (m, n)
        Derivative of the measurement by the states.
    R : ndarray, shape (m, m) or (m,)
        Covariance of the measurement, or its diagonal.
    """
    PH = P @ H.T
    S = H @ PH
    if R.ndim == 1:
        S.flat[:: len(S) + 1] += R
    else:
        S = S + R
    K = np.asarray(np.linalg.solve(S, PH.T).T, dtype=float)
    P = P - K @ PH.T
    return K, 0.5 * (P + P.T)


def smoothed_errors(
    forward: ForwardPass[TrackT], added: Callable[[Array, Array], Array] = np.add
) -> tuple[Array, Array]:
    """Return errors (K, n) of the filtered states given all data, and their covariance.

    Rauch, Tung, Striebel, AIAA J. 3(8), 1965, on the errors: what the measurement at an
    event fed back is part of the error at the event before.

    Parameters
    ----------
    forward : ForwardPass
        Forward pass of the filter.
    added : callable, optional
        Returns the sum of the correction at an event and the smoothed error there.
    """
    filtered, predicted = forward.track.covariance, forward.predicted
    gain = _gains(filtered, predicted, forward.transition)
    error, smoothed = np.zeros_like(forward.correction), filtered.copy()
    for k in range(len(gain) - 1, -1, -1):
        G = gain[k]
        error[k] = G @ added(forward.correction[k + 1], error[k + 1])
        P = smoothed[k] + G @ (smoothed[k + 1] - predicted[k + 1]) @ G.T
        smoothed[k] = 0.5 * (P + P.T)
    return error, smoothed


def _gains(filtered: Array, predicted: Array, transition: Array) -> Array:
    """Return P F' P⁻, (K - 1, n, n), with P⁻ factored as a correlation matrix."""
    out = np.empty_like(filtered[:-1])
    for a in range(0, out.shape[0], _CHUNK):
        b = min(a + _CHUNK, out.shape[0])
        FP = transition[a + 1 : b + 1] @ filtered[a:b]
        P = predicted[a + 1 : b + 1]
        std = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        correlation = P / (std[:, :, None] * std[:, None, :])
        solved = np.linalg.solve(correlation, FP / std[:, :, None]) / std[:, :, None]
        out[a:b] = solved.transpose(0, 2, 1)
    return out
