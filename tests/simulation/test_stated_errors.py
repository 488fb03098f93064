"""Errors that a scenario states: their sizes, and that none changes what is not its own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from truth import merged, scenario

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.units import DEG, DEG_PER_HOUR, STANDARD_GRAVITY
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.trial import Trial

SHORT: dict[str, Any] = {"noise": True, "manoeuvres": [{"straight_s": 60}], "imu": {"rate_hz": 10}}
LONG: dict[str, Any] = {
    "noise": True,
    "manoeuvres": [{"straight_s": 8000}],
    "sway": {},
    "imu": {"rate_hz": 1},
    "gnss": {"rate_hz": 1},
    "dvl": {"rate_hz": 1},
}
# What is added, and the arrays that it may change.
ERRORS: dict[str, tuple[dict[str, Any], set[str]]] = {
    "antenna": ({"gnss": {"lever_arm_error_m": [0.1, 0, 0]}}, set()),
    "gnss position": ({"gnss": {"correlated_share": 0.7}}, {"gnss geodetic"}),
    "gnss velocity": ({"gnss": {"velocity_correlated_share": 0.5}}, {"gnss velocity"}),
    "gnss outliers": ({"gnss": {"outliers": {"share": 0.1}}}, {"gnss geodetic"}),
    "gnss jumps": ({"gnss": {"jumps": {"count": 1}}}, {"gnss geodetic"}),
    "gnss late": ({"gnss": {"time_offset_s": 0.02}}, {"gnss time"}),
    "gnss fast": ({"gnss": {"clock_rate_ppm": 50}}, {"gnss time"}),
    "bias": ({"dvl": {"bias_m_s": "draw", "bias_std_m_s": 0.001}}, {"dvl velocity"}),
    "dvl noise": ({"dvl": {"correlated_share": 0.5}}, {"dvl velocity"}),
    "dvl drift": ({"dvl": {"scale_drift": 0.0005}}, {"dvl velocity"}),
    "dvl walk": ({"dvl": {"scale_walk_sqrt_h": 0.001}}, {"dvl velocity"}),
    "dvl outliers": ({"dvl": {"outliers": {"share": 0.1}}}, {"dvl velocity"}),
    "false lock": ({"dvl": {"false_lock": {"duration_s": 20}}}, {"dvl velocity"}),
    "dvl late": ({"dvl": {"time_offset_s": "draw", "time_offset_std_s": 0.01}}, {"dvl time"}),
    "scale": ({"imu": {"gyro_scale_ppm": [100, 0, 0]}}, {"imu gyro"}),
    "axes": ({"imu": {"accel_misalignment_deg": [0.1, 0, 0]}}, {"imu accel"}),
    "imu late": ({"imu": {"time_offset_s": 0.01}}, {"imu time"}),
}


def arrays(trial: Trial) -> dict[str, np.ndarray]:
    assert trial.gnss is not None
    assert trial.dvl is not None
    return {
        "gnss time": trial.gnss.time,
        "gnss geodetic": trial.gnss.geodetic,
        "gnss velocity": trial.gnss.velocity,
        "dvl time": trial.dvl.time,
        "dvl velocity": trial.dvl.velocity,
        "imu time": trial.imu.time,
        "imu gyro": trial.imu.gyro,
        "imu accel": trial.imu.accel,
    }


def metres(trial: Trial, exact: Trial) -> np.ndarray:
    """Errors of fixes east, north, up, (M, 3), m, by the radii of the Earth at 36 deg."""
    assert trial.gnss is not None
    assert exact.gnss is not None
    d = trial.gnss.geodetic - exact.gnss.geodetic
    lat = exact.gnss.geodetic[:, 0]
    return np.stack([d[:, 1] * 6.3855e6 * np.cos(lat), d[:, 0] * 6.3575e6, d[:, 2]], axis=1)


def correlation(x: np.ndarray, lag: int) -> np.ndarray:
    """Correlation of the columns of (M, 3) with themselves, `lag` rows later."""
    return np.mean(x[lag:] * x[:-lag], axis=0) / np.mean(x**2, axis=0)


@pytest.fixture(scope="module")
def clean() -> Trial:
    return simulate(scenario(**SHORT), seed=3)


@pytest.mark.parametrize("name", ERRORS)
def test_an_error_changes_only_its_own(clean: Trial, name: str) -> None:
    changes, own = ERRORS[name]
    trial = simulate(scenario(**merged(SHORT, changes)), seed=3)
    before, after = arrays(clean), arrays(trial)
    assert {key for key in before if not np.array_equal(before[key], after[key])} == own


def test_two_errors_are_the_sum_of_each_alone(clean: Trial) -> None:
    one, two = ERRORS["bias"][0], ERRORS["dvl drift"][0]
    added = [
        arrays(simulate(scenario(**merged(SHORT, changes)), seed=3))["dvl velocity"]
        - arrays(clean)["dvl velocity"]
        for changes in (one, two, merged(one, two))
    ]
    np.testing.assert_allclose(added[0] + added[1], added[2], atol=1e-12)


@pytest.fixture(scope="module")
def noisy() -> tuple[Trial, Trial]:
    """A long straight trial with correlated noise, and the same without noise."""
    shares = {
        "gnss": {
            "correlated_share": 0.7,
            "correlation_time_s": [10, 10, 40],
            "velocity_correlated_share": 0.5,
        },
        "dvl": {"correlated_share": 0.6, "correlation_time_s": 5},
    }
    exact = simulate(scenario(**merged(LONG, {"noise": False})))
    return simulate(scenario(**merged(LONG, shares)), seed=1), exact


def test_correlated_positions_keep_their_variance(noisy: tuple[Trial, Trial]) -> None:
    error = metres(*noisy)
    assert error.std(axis=0) == pytest.approx([0.5, 0.5, 1.0], rel=0.1)
    assert correlation(error, 10) == pytest.approx(0.7 * np.exp([-1, -1, -0.25]), abs=0.1)
    assert np.abs(correlation(error, 300)).max() < 0.15


def test_correlated_velocities_keep_their_variance(noisy: tuple[Trial, Trial]) -> None:
    for sensor, size, share, lag, tau in (("gnss", 0.1, 0.5, 1, 2.0), ("dvl", 0.008, 0.6, 5, 5.0)):
        noise, exact = (arrays(trial)[f"{sensor} velocity"] for trial in noisy)
        error = noise - exact
        assert error.std(axis=0) == pytest.approx([size] * 3, rel=0.05)
        assert correlation(error, lag) == pytest.approx([share * np.exp(-lag / tau)] * 3, abs=0.07)


def test_without_noise_only_constant_errors_are_left() -> None:
    changes: dict[str, Any] = {}
    for change, _ in ERRORS.values():
        changes = merged(changes, change)
    quiet = merged(SHORT, {"noise": False})
    exact, trial = (
        simulate(scenario(**merged(quiet, more)), seed=5)
        for more in ({}, merged(changes, {"dvl": {"bias_m_s": [0.002, 0, 0]}}))
    )
    before, after = arrays(exact), arrays(trial)
    np.testing.assert_array_equal(before["gnss geodetic"], after["gnss geodetic"])
    added = after["dvl velocity"] - before["dvl velocity"]
    np.testing.assert_allclose(added, np.broadcast_to([0.002, 0, 0], added.shape), atol=1e-12)


def test_errors_of_the_imu_are_as_their_truth_says() -> None:
    std = {
        "gyro_scale": ("ppm", 300),
        "gyro_misalignment": ("deg", 0.02),
        "gyro_g_sensitivity": ("deg_h_g", 2.0),
        "accel_scale": ("ppm", 200),
        "accel_misalignment": ("deg", 0.03),
    }
    imu: dict[str, Any] = {}
    for stem, (unit, size) in std.items():
        imu |= {f"{stem}_{unit}": "draw", f"{stem}_std_{unit}": size}
    quiet = merged(SHORT, {"noise": False})
    exact = simulate(scenario(**quiet)).imu
    trial = simulate(scenario(**merged(quiet, {"imu": imu})), seed=2)
    truth = {stem: trial.calibration_truth[f"{stem}_{unit}"] for stem, (unit, _) in std.items()}
    sx, sy, sz = 1e-6 * truth["gyro_scale"]
    xy, xz, yx, yz, zx, zy = truth["gyro_misalignment"] * DEG
    gyro = np.array([[sx, xy, xz], [yx, sy, yz], [zx, zy, sz]])
    leak = truth["gyro_g_sensitivity"].reshape(3, 3) * DEG_PER_HOUR / STANDARD_GRAVITY
    ax, ay, az = 1e-6 * truth["accel_scale"]
    yx, zx, zy = truth["accel_misalignment"] * DEG
    accel = np.array([[ax, 0, 0], [yx, ay, 0], [zx, zy, az]])
    np.testing.assert_allclose(
        trial.imu.gyro, exact.gyro + exact.gyro @ gyro.T + exact.accel @ leak.T, atol=1e-14
    )
    np.testing.assert_allclose(trial.imu.accel, exact.accel + exact.accel @ accel.T, atol=1e-12)
    settings = trial.imu.settings
    assert settings.gyro_misalignment_std_deg == 0.02
    assert settings.accel_scale_std_ppm == 200


def test_what_is_drawn_has_the_stated_size() -> None:
    tiny = {
        "manoeuvres": [{"straight_s": 0.4}],
        "sway": {},
        "imu": {"rate_hz": 10, "gyro_scale_ppm": "draw", "gyro_scale_std_ppm": 300},
        "gnss": {
            "lever_arm_error_m": "draw",
            "lever_arm_error_std_m": 0.02,
            "time_offset_s": "draw",
            "time_offset_std_s": 0.01,
        },
        "dvl": {"bias_m_s": "draw", "bias_std_m_s": 0.001},
    }
    runs = [simulate(scenario(**tiny), seed) for seed in range(80)]
    for size, draws in (
        (300.0, [run.calibration_truth["gyro_scale_ppm"] for run in runs]),
        (0.001, [run.calibration_truth["dvl_bias_m_s"] for run in runs]),
        (0.01, [run.calibration_truth["gnss_time_offset_s"] for run in runs]),
        (0.02, [run.gnss.settings.lever_arm_m for run in runs if run.gnss is not None]),
    ):
        spread = np.std(draws) / size
        assert spread == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * np.size(draws)))


def test_a_late_imu_makes_all_others_early(clean: Trial) -> None:
    clocks = {
        "imu": {"time_offset_s": 0.01, "clock_rate_ppm": 30},
        "gnss": {"time_offset_s": 0.03},
        "dvl": {"clock_rate_ppm": 100},
    }
    trial = simulate(scenario(**merged(SHORT, clocks)), seed=3)
    truth = trial.calibration_truth
    assert truth["gnss_time_offset_s"] == pytest.approx(0.02)
    assert truth["time_offset_s"] == pytest.approx(-0.01)
    assert truth["gnss_clock_rate_ppm"] == pytest.approx(-30.0)
    assert truth["dvl_clock_rate_ppm"] == pytest.approx(70.0)
    assert trial.reference is not None
    assert clean.reference is not None
    later = trial.reference.time - clean.reference.time
    middle = np.mean(clean.imu.time[[0, -1]])
    np.testing.assert_allclose(
        later, 0.01 + 30e-6 * (clean.reference.time - middle), rtol=0, atol=1e-9
    )


def test_a_walking_scale_is_right_on_average() -> None:
    quiet = {"noise": True, "sway": {}, "gnss": None, "manoeuvres": [{"straight_s": 3600}]}
    still = {"imu": {"rate_hz": 1}, "dvl": {"rate_hz": 1, "velocity_std_fraction": 0}}
    claims = {"trial": {"gnss": None}}
    changes = merged(merged(quiet, still), claims)
    exact, walking = (
        simulate(scenario(**merged(changes, {"dvl": {"scale_walk_sqrt_h": walk}})), seed=7)
        for walk in (0, 0.01)
    )
    assert exact.dvl is not None
    assert walking.dvl is not None
    ratio = (walking.dvl.velocity / exact.dvl.velocity)[:, 1] - 1.0
    assert abs(ratio.mean()) < 1e-12
    assert np.std(np.diff(ratio)) == pytest.approx(0.01 / 60.0, rel=0.05)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"gnss": {"lever_arm_error_m": "draw"}}, "`lever_arm_error_m: draw` needs"),
        ({"dvl": {"bias_m_s": "draw"}}, "`bias_m_s: draw` needs `bias_std_m_s`"),
        ({"imu": {"gyro_scale_ppm": "draw"}}, "needs `gyro_scale_std_ppm`"),
        ({"gnss": {"correlated_share": 1.2}}, "<= 1"),
        ({"gnss": {"correlation_time_s": [10, 0, 10]}}, "`correlation_time_s` must be above 0"),
        ({"dvl": {"outliers": {"sigmas": [1, 2]}}}, "share"),
    ],
)
def test_wrong_errors_are_named(changes: dict[str, Any], expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        scenario(**merged(SHORT, changes))
