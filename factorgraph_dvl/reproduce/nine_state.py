"""A nine-state filter of bias, scale and misalignment of a DVL, as published without reference."""

from __future__ import annotations

from functools import cache

import numpy as np

from factorgraph_dvl.baselines.nine_state import nine_state, unscented, with_bias
from factorgraph_dvl.baselines.outcome import Outcome, prior_of
from factorgraph_dvl.baselines.point_sets import Points
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, rotate, skew
from factorgraph_dvl.report.figures.drawing import (
    ACCENT,
    DARK,
    GREY,
    new_figure,
    new_grid,
    style,
)
from factorgraph_dvl.reproduce.entry import Entry, Paper, Result, counted, judged, table
from factorgraph_dvl.sensors.dvl import BIAS_SPEC, MISALIGNMENT_SPEC, SCALE_SPEC
from factorgraph_dvl.sensors.parameters import Parameter

# True bias, m/s, scale error and misalignment of what is simulated. Chosen: of usual size.
_BIAS = np.array([0.02, -0.03, 0.01])
_SCALE = np.array([0.01, -0.02, 0.005])
_SMALL = np.array([1.0, -1.0, 2.0]) * DEG
# Noise of DVL and reference, m/s, where nothing else is said.
_DVL_STD, _REFERENCE_STD = 0.005, 0.01
# Pings. Chosen: two minutes at 5 Hz.
_COUNT = 600
_NO_ARM = np.zeros(3)


def _speeds(motion: str, count: int = _COUNT) -> Array:
    """Return velocities in body, (M, 3), m/s, of a vessel in a light sea."""
    t = np.arange(count, dtype=float)
    ahead = {
        "constant speed": np.full(count, 4.0),
        "two speeds": np.where(t < count / 2, 2.0, 4.0),
        "speeds and turns": 3.0 + np.sin(2.0 * np.pi * t / 300.0),
    }[motion]
    across = 0.02 * np.sin(0.7 * t)
    if motion == "speeds and turns":
        across = across + 0.3 * np.sin(2.0 * np.pi * t / 90.0)
    return np.column_stack([across, ahead, 0.1 * np.sin(0.9 * t)])


def _points(
    v: Array,
    seed: int,
    *,
    turn: Array = _SMALL,
    reference_std: float = _REFERENCE_STD,
    constant: float = 0.0,
    noise: bool = True,
) -> Points:
    """Return the two point sets of a motion; the reference may have a constant error."""
    rng = np.random.default_rng(seed)
    n = len(v)
    dvl_noise = noise * rng.normal(0.0, _DVL_STD, (n, 3))
    wrong = noise * rng.normal(0.0, reference_std, (n, 3)) + constant * rng.normal(size=3)
    v_d = (1.0 + _SCALE) * rotate(exp_so3(turn)[None], v) + _BIAS + dvl_noise
    spread = max(reference_std, 1e-6) ** 2 + constant**2
    P = np.broadcast_to(spread * np.eye(3), (n, 3, 3))
    zero = np.zeros((n, 3))
    return Points(np.arange(float(n)), v + wrong, P, zero, zero, v_d, np.full((n, 3), _DVL_STD))


def _priors(angle: float = 30.0) -> tuple[Parameter, Parameter, Parameter]:
    return (
        Parameter(MISALIGNMENT_SPEC, np.zeros(3), np.full(3, angle * DEG)),
        Parameter(SCALE_SPEC, np.zeros(1), np.full(1, 0.1)),
        Parameter(BIAS_SPEC, np.zeros(3), np.full(3, 0.2)),
    )


def _calibrate(points: Points, method: str) -> Outcome:
    priors = _priors()
    if method == "unscented":
        three, findings = with_bias(*priors)
        return unscented(points, three, _NO_ARM, findings)
    return nine_state(points, *priors, _NO_ARM, iterated=method == "iterated")


def _errors(outcome: Outcome, turn: Array = _SMALL) -> tuple[Array, Array]:
    """Return errors of the nine, rad, 1 and m/s, and their standard deviations."""
    dRb, scale, bias = outcome.estimated.values
    error = np.concatenate([log_so3(exp_so3(turn).T @ dRb), scale - _SCALE, bias - _BIAS])
    return error, np.sqrt(np.diag(outcome.estimated.covariance))


def _states(seeds: int) -> Result:
    outcome = _calibrate(_points(_speeds("speeds and turns"), 0), "linear")
    size = sum(v.size if v.ndim == 1 else 3 for v in outcome.estimated.values)
    return Result(f"{size} states: 3 of bias, 3 of scale, 3 of misalignment", judged(size == 9))


def _transition(seeds: int) -> Result:
    points = _points(_speeds("speeds and turns"), 0)
    whole, _ = _errors(_calibrate(points, "linear"))
    shuffled = points.take(np.random.default_rng(1).permutation(len(points)))
    other, _ = _errors(_calibrate(shuffled, "linear"))
    apart = float(np.max(np.abs(whole - other)))
    return Result(
        f"states are constant: pings in any order give the same to {apart:.0e}",
        judged(apart < 1e-9),
    )


def _model(seeds: int) -> Result:
    v = _speeds("speeds and turns")
    turn = 1e-4 * np.array([1.0, -2.0, 3.0])
    a, b = 1e-4 * np.ones(3), 1e-4 * np.array([3.0, 1.0, -2.0])
    printed = (1.0 + a) * (v + b) + np.cross(turn, v)
    full = (1.0 + a) * (rotate(exp_so3(turn)[None], v) + b)
    apart = float(np.max(np.abs(printed - full)))
    larger = 10.0 * _SMALL
    large = (1.0 + _SCALE) * (rotate(exp_so3(larger)[None], v) + _BIAS)
    flat = (1.0 + _SCALE) * (v + _BIAS) + np.cross(larger, v)
    return Result(
        f"ε_i(θ) is not written out; θ × v_ref fits to {apart:.0e} m/s at 0.01°, and is off by "
        f"{np.max(np.abs(large - flat)):.2g} m/s at 10 to 20°",
        judged(False, apart < 1e-6),
    )


def _steps(seeds: int) -> Result:
    """Compare the recursion of section 4 with what the module adds up."""
    points = _points(_speeds("speeds and turns"), 0)
    three, _ = with_bias(*_priors())
    P, x = prior_of(three).covariance.copy(), np.zeros(9)
    for k in range(len(points)):
        v = points.v_b[k]
        H = np.hstack([-skew(v), np.diag(v), np.eye(3)])
        R = points.v_b_covariance[k] + np.diag(points.sigma_d[k] ** 2)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x = x + K @ (points.v_d[k] - v - H @ x)
        P = (np.eye(9) - K @ H) @ P
    outcome = _calibrate(points, "linear")
    dRb, scale, bias = outcome.estimated.values
    apart = float(np.max(np.abs(np.concatenate([log_so3(dRb), scale, bias]) - x)))
    return Result(
        f"the five steps, ping by ping, against `--linear`: {apart:.0e}", judged(apart < 1e-9)
    )


@cache
def _spread(motion: str) -> tuple[Array, float]:
    """Return σ of the nine, and the correlation of bias and scale ahead, without noise drawn."""
    P = _calibrate(_points(_speeds(motion), 0), "iterated").estimated.covariance
    sigma = np.sqrt(np.diag(P))
    return sigma, float(P[4, 7] / (sigma[4] * sigma[7]))


def _separation(seeds: int) -> Result:
    rows = []
    motions = ("constant speed", "two speeds", "speeds and turns")
    for motion in motions:
        sigma, correlation = _spread(motion)
        rows.append(
            [
                motion,
                f"{sigma[4]:.2g}",
                f"{sigma[7]:.2g}",
                f"{correlation:.4f}",
                *(f"{s / DEG:.2g}" for s in sigma[:3]),
            ]
        )
    still, moving = _spread("constant speed")[0], _spread("speeds and turns")[0]
    header = ["motion", "σ a_y", "σ b_y, m/s", "correlation", "σ θ_x, deg", "σ θ_y", "σ θ_z"]
    return Result(
        f"σ of bias ahead {still[7]:.2g} m/s at constant speed (prior 0.2), {moving[7]:.2g} m/s "
        "where the "
        "speed varies",
        judged(bool(still[7] > 0.05 and moving[7] < 0.01)),
        (
            *table(header, rows),
            "",
            "The source does not say so: at one speed only (1 + a) v + b is seen, and bias and "
            "scale "
            "cannot be separated.",
        ),
    )


def _convergence(seeds: int) -> Result:
    figure = new_figure(9.0, 4.0)
    grid = new_grid(figure, 1, 3)
    last = []
    points = _points(_speeds("speeds and turns"), 0)
    colors = {"linear": GREY, "iterated": ACCENT, "unscented": "tab:orange"}
    true = (_SMALL[2] / DEG, _SCALE[1], _BIAS[1])
    for method, color in colors.items():
        history = _calibrate(points, method).history
        rows = np.array(
            [[log_so3(e.values[0])[2] / DEG, e.values[1][1], e.values[2][1]] for _, e in history]
        )
        last.append(rows[-1])
        for i, label in enumerate(("θ_z, deg", "a_y", "b_y, m/s")):
            if method == "linear":
                ax = figure.add_subplot(grid[0, i])
                ax.axhline(true[i], color=DARK, lw=0.8, ls="--")
                ax.set_ylim(
                    true[i] - 0.04 * (25 if i == 0 else 1), true[i] + 0.04 * (25 if i == 0 else 1)
                )
                style(ax, "time, s", label)
            figure.axes[i].plot(
                [t for t, _ in history], rows[:, i], color=color, lw=0.9, label=method
            )
    figure.axes[0].legend(fontsize=7)
    off = np.abs(np.array(last) - true)
    return Result(
        f"after {_COUNT} pings the iterated filter is off by {off[1, 0]:.3f}°, {off[1, 1]:.4f} "
        "and "
        f"{off[1, 2]:.4f} m/s (θ_z, a_y, b_y)",
        judged(bool(off[1, 0] < 0.1 and off[1, 1] < 0.01 and off[1, 2] < 0.02)),
        (),
        figure,
    )


def _reference(seeds: int) -> Result:
    rows, ratios = [], {}
    count = max(seeds, 4)
    for name, std, constant in (
        ("white, 0.01 m/s", 0.01, 0.0),
        ("white, 0.1 m/s", 0.1, 0.0),
        ("constant, 0.02 m/s", 0.01, 0.02),
    ):
        found = [
            _errors(
                _calibrate(
                    _points(_speeds("speeds and turns"), s, reference_std=std, constant=constant),
                    "iterated",
                )
            )
            for s in range(count)
        ]
        error = np.sqrt(np.mean([e**2 for e, _ in found], axis=0))
        ratio = np.sqrt(np.mean([(e / s) ** 2 for e, s in found], axis=0))
        ratios[name] = float(np.sqrt(np.mean(ratio**2)))
        rows.append(
            [
                name,
                f"{error[2] / DEG:.2g}",
                f"{error[4]:.2g}",
                f"{error[7]:.2g}",
                f"{ratios[name]:.1f}",
            ]
        )
    header = ["error of the reference", "θ_z, deg", "a_y", "b_y, m/s", "RMS(error / σ)"]
    white, constant = ratios["white, 0.01 m/s"], ratios["constant, 0.02 m/s"]
    return Result(
        f"RMS(error / σ) {white:.1f} with white errors of the reference, {constant:.1f} with a "
        "constant one "
        "of which R knows the size",
        judged(constant > 2.0 * white),
        (
            *table(header, rows),
            "",
            f"RMS errors over {count} seeds. A constant error of the reference goes into the "
            "bias in full, "
            "and no R that is white makes its σ right.",
        ),
    )


def _noise_matrix(seeds: int) -> Result:
    points = _points(_speeds("speeds and turns"), 0)
    found = []
    for factor in (0.1, 1.0, 10.0):
        scaled = Points(
            points.time,
            points.v_b,
            factor**2 * points.v_b_covariance,
            points.omega_b,
            points.omega_sigma,
            points.v_d,
            factor * points.sigma_d,
        )
        found.append(_errors(_calibrate(scaled, "iterated")))
    shift = float(np.max(np.abs(found[2][0] - found[0][0]) / found[1][1]))
    scale = found[2][1][7] / found[1][1][7]
    return Result(
        f"R ten times too large makes σ {scale:.1f} times as large, and moves the estimates by "
        f"{shift:.2f} σ",
        judged(bool(5.0 < scale < 10.5)),
    )


def _large_angles(seeds: int) -> Result:
    rows, worst = [], {}
    methods = ("linear", "iterated", "unscented")
    direction = np.array([0.3, -0.4, 0.866])
    v = _speeds("speeds and turns")
    for angle in (1.0, 5.0, 10.0, 30.0, 60.0):
        turn = angle * DEG * direction / np.linalg.norm(direction)
        cells = []
        for method in methods:
            off = []
            for seed in range(seeds):
                outcome = _calibrate(_points(v, seed, turn=turn), method)
                off.append(np.linalg.norm(_errors(outcome, turn)[0][:3]) / DEG)
            worst[method, angle] = float(np.sqrt(np.mean(np.square(off))))
            cells.append(f"{worst[method, angle]:.3f}")
        rows.append([f"{angle:g}", *cells])
    return Result(
        f"at 30° the linear filter is off by {worst['linear', 30.0]:.2g}°, the iterated by "
        f"{worst['iterated', 30.0]:.2g}°, the unscented by {worst['unscented', 30.0]:.2g}°",
        judged(
            worst["linear", 30.0] > 10.0 * worst["iterated", 30.0]
            and worst["unscented", 30.0] < 0.5 * worst["linear", 30.0]
        ),
        (
            *table(["misalignment, deg", *(f"{m}: error, deg" for m in methods)], rows),
            "",
            f"RMS over {counted(seeds)} of the angle between estimate and truth; prior 30° about "
            "each axis.",
        ),
    )


_LINEAR = "`kalman --method nine-state --linear`"
_ITERATED = "`kalman --method nine-state`"
NINE_STATE = Paper(
    "nine-state",
    "A nine-state Kalman filter of a DVL's bias, scale and misalignment (without author or year)",
    (
        Entry("section 1", "X = [b, α, θ]", _LINEAR, _states),
        Entry("section 2", "X_{k+1} = X_k, no noise", _LINEAR, _transition),
        Entry("section 3", "v_d = (1 + α)(v_ref + b) + ε(θ)", _LINEAR, _model),
        Entry("section 4", "predict, gain, update", _LINEAR, _steps),
        Entry("claim 1 (section 5)", "estimates converge", _ITERATED, _convergence),
        Entry("claim 2 (section 5)", "all nine are found", _ITERATED, _separation),
        Entry("claim 3 (section 6)", "the reference limits the result", _ITERATED, _reference),
        Entry("claim 4 (section 6)", "R matters", _ITERATED, _noise_matrix),
        Entry(
            "claim 5 (section 6)",
            "EKF or UKF for large angles",
            "`kalman --method nine-state-ukf`",
            _large_angles,
        ),
    ),
)
