"""Further manoeuvres: by how much each would lower the standard deviations of a calibration.

A bound, not a prediction: the motion is taken as known, so a real manoeuvre lowers them less.
`plan` predicts a whole trial.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.rotations import exp_so3, frd_from_body
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.dvl import BIAS, LEVER_ARM, MISALIGNMENT, SCALE_ERROR
from factorgraph_dvl.solution import Solution

_PARAMETERS = (MISALIGNMENT, SCALE_ERROR, LEVER_ARM, BIAS)
# Chosen: duration of each manoeuvre, s, and time between pings, s.
_DURATION_S = 120.0
_PING_S = 0.5
# Chosen: rates of turn and of pitch, deg/s, and depth of a swing, deg, that most vessels reach.
_TURN_DEG_S = 3.0
_PITCH_DEG = 10.0
_PITCH_PERIOD_S = 20.0
# Chosen: slowest and usual speed, m/s, where the trial had none.
_SPEED_M_S = 2.0
# Chosen: noise of a ping, m/s, where the solution keeps no residuals of the DVL.
_NOISE_M_S = 0.01
# A manoeuvre helps a component if it leaves less than this share of its σ. Chosen: smaller
# gains are within what the bound neglects.
_HELPS = 0.8


@dataclass(frozen=True)
class FurtherManoeuvre:
    """What a further manoeuvre would do to a calibration.

    Parameters
    ----------
    name : str
        One of `straight`, `speed`, `turns`, `pitching`.
    duration : float
        Duration, s.
    names : tuple of str
        Components that it helps.
    before, after : ndarray, shape (n,)
        Their standard deviations now, and at best with it, in reported units.
    """

    name: str
    duration: float
    names: tuple[str, ...]
    before: Array
    after: Array


def further_manoeuvres(solution: Solution) -> tuple[FurtherManoeuvre, ...]:
    """Return manoeuvres that would lower standard deviations above their limits.

    Parameters
    ----------
    solution : Solution
        Solution with misalignment, scale error and lever arm of a DVL; of any other there is
        nothing to return.

    Returns
    -------
    tuple of FurtherManoeuvre
        Those that help, the most helpful first.
    """
    own = [e for e in solution.estimates if e.name in _PARAMETERS]
    if not {MISALIGNMENT, SCALE_ERROR, LEVER_ARM} <= {e.name for e in own}:
        return ()
    order = list(solution.order)
    names = [name for e in own for name in e.component_names]
    rows = np.array([order.index(name) for name in names])
    std = np.sqrt(np.maximum(np.diag(solution.covariance)[rows], 0.0))
    limit = np.array([solution.limits.get(e.name, np.inf) for e in own for _ in e.component_names])
    weak = std > limit
    free = std > 0.0
    if not weak.any():
        return ()
    P = solution.covariance[np.ix_(rows[free], rows[free])]
    values = {e.name: e.value for e in own}
    noise = _noise(solution)
    found = []
    for name, velocity, rate in _motions(solution):
        J = _jacobian(values, velocity, rate)[:, free]
        # P − P Jᵀ (σ² + J P Jᵀ)⁻¹ J P, in the form that needs no inverse of P.
        root = np.linalg.cholesky(P + 1e-12 * np.diag(np.diag(P)))
        scaled = J @ root / noise
        after = np.zeros(std.size)
        inner = np.linalg.inv(np.eye(root.shape[0]) + scaled.T @ scaled)
        after[free] = np.sqrt(np.diag(root @ inner @ root.T))
        helped = weak & (after < _HELPS * std)
        if helped.any():
            chosen = tuple(n for n, h in zip(names, helped, strict=True) if h)
            found.append(FurtherManoeuvre(name, _DURATION_S, chosen, std[helped], after[helped]))
    return tuple(sorted(found, key=lambda m: -float(np.log(m.before / m.after).sum())))


def _noise(solution: Solution) -> float:
    """Return the standard deviation of a DVL velocity, m/s."""
    for r in solution.residuals:
        if r.unit == "m/s" and r.label.startswith("DVL"):
            return float(np.nanmedian(r.sigma))
    return _NOISE_M_S


def _motions(solution: Solution) -> Iterator[tuple[str, Array, Array]]:
    """Yield name, velocity (M, 3) and angular rate (M, 3) in body of each manoeuvre."""
    trajectory = solution.trajectory
    speeds = np.linalg.norm(trajectory.velocity, axis=1)
    speed = float(np.median(speeds[speeds > 0.1])) if np.any(speeds > 0.1) else _SPEED_M_S
    time = np.arange(0.0, _DURATION_S, _PING_S)
    ahead = np.stack([np.full(time.size, speed), 0.0 * time, 0.0 * time], axis=1)
    still = np.zeros_like(ahead)
    body = frd_from_body(solution.body_axes)
    half = time < 0.5 * _DURATION_S
    yield "straight", ahead @ body, still
    yield "speed", (ahead * np.where(half, 0.5, 1.0)[:, None]) @ body, still
    turning = still.copy()
    turning[:, 2] = np.where(half, 1.0, -1.0) * _TURN_DEG_S * DEG
    yield "turns", ahead @ body, turning @ body
    omega = 2.0 * np.pi / _PITCH_PERIOD_S
    pitching = still.copy()
    pitching[:, 1] = _PITCH_DEG * DEG * omega * np.cos(omega * time)
    yield "pitching", ahead @ body, pitching @ body


def _jacobian(values: dict[str, Array], velocity: Array, rate: Array) -> Array:
    """Return the derivatives (3 M, n) of the DVL's velocity by the components of `values`."""

    def measured(x: Array) -> Array:
        parts = dict(zip(values, np.split(x, ends), strict=True))
        v = velocity + np.cross(rate, parts[LEVER_ARM])
        v_d = v @ exp_so3(parts[MISALIGNMENT] * DEG).T
        out = (1.0 + parts[SCALE_ERROR]) * v_d + parts.get(BIAS, np.zeros(3))
        return np.asarray(out).ravel()

    ends = np.cumsum([v.size for v in values.values()])[:-1]
    at = np.concatenate(list(values.values()))
    step = 1e-5
    columns = [
        (measured(at + step * e) - measured(at - step * e)) / (2.0 * step) for e in np.eye(at.size)
    ]
    return np.stack(columns, axis=1)
