"""The compass as a sensor: its equation, its files, its bias. From the root of factorgraph-dvl:

pip install examples/compass-plugin && pytest examples/compass-plugin/tests
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from factorgraph_dvl_compass import Compass, CompassSettings
from scipy.stats import binom

import factorgraph_dvl as fd
from factorgraph_dvl.geometry.rotations import rotation_from_rph, wrapped
from factorgraph_dvl.sensors.protocol import Motion

SEEDS = int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "20"))
FRAME = fd.LocalFrame(0.6, 2.1, 0.0)
BIAS_DEG = 4.0
EXAMPLES = Path(__file__).resolve().parents[2]


def motion_of(rph, body_axes):
    zero = np.zeros(rph.shape)
    nRb = rotation_from_rph(rph, body_axes)
    return Motion(nRb, zero, zero, zero, zero, zero, zero)


def trial_with_compass(seed, declination_deg=-5.0):
    """The short run with a compass of 1 deg noise and a bias, through north if it turns there."""
    trial = fd.simulate(EXAMPLES / "short.yaml", seed=seed)
    rng = np.random.default_rng(1000 + seed)
    rows = slice(0, None, max(trial.reference.time.size // 86, 1))
    heading = trial.reference.rph[rows, 2] + np.radians(BIAS_DEG - declination_deg)
    heading = wrapped(heading + np.radians(1.0) * rng.standard_normal(heading.size))
    settings = CompassSettings(declination_deg=declination_deg)
    compass = Compass(settings, trial.reference.time[rows], heading)
    truth = trial.calibration_truth | {"compass_bias_deg": np.array([BIAS_DEG])}
    return replace(trial, others=(compass,), calibration_truth=truth)


@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
def test_the_residual_by_hand(body_axes):
    rph = np.radians([[3.0, -2.0, 359.0]])
    compass = Compass(CompassSettings(declination_deg=2.0), np.zeros(1), np.radians([357.5]))
    (heading,) = compass.observations(FRAME, body_axes)
    # 359 + 1.5 - (357.5 + 2) = 1, also across north.
    values = {"compass_bias_deg": np.radians([1.5])}
    np.testing.assert_allclose(heading.residual(motion_of(rph, body_axes), values), [[1.0]])


@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
def test_shapes_and_derivatives(body_axes):
    heading = np.radians([10.0, 100.0, 190.0, 359.0])
    fd.check_sensor(Compass(CompassSettings(), np.arange(4.0), heading), FRAME, body_axes)


def test_the_compass_is_read_from_a_folder_and_its_bias_found(tmp_path):
    trial = trial_with_compass(1)
    fd.save_trial(trial, tmp_path / "trial")
    assert (tmp_path / "trial" / "compass.csv").read_text().startswith("time_s,heading_deg")
    loaded = fd.load_trial(tmp_path / "trial")
    (compass,) = loaded.others
    np.testing.assert_allclose(compass.heading, trial.others[0].heading)
    bias = fd.solve(loaded).estimate("compass_bias_deg")
    assert abs(bias.value[0] - BIAS_DEG) < 3.0 * bias.std[0] < 1.0
    assert bias.observable.all()


@pytest.mark.slow
def test_the_bias_is_as_good_as_it_says():
    off = []
    for seed in range(SEEDS):
        bias = fd.solve(trial_with_compass(seed)).estimate("compass_bias_deg")
        off.append((bias.value[0] - BIAS_DEG) / bias.std[0])
    off = np.array(off)
    print(f"rms of error/σ {np.sqrt(np.mean(off**2)):.2f}, within 2σ {np.sum(np.abs(off) < 2)}")
    # By chance fewer are within 2σ in one of a hundred such tests.
    assert np.sum(np.abs(off) < 2.0) >= binom.ppf(0.01, SEEDS, 0.9545)
