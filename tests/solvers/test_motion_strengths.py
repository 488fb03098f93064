"""A trial without IMU on the graph: noise and strengths by likelihood, and what is found."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from truth import CONFIGS

from factorgraph_dvl.geometry.rotations import log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.simulation import load_scenario, simulate
from factorgraph_dvl.solvers import motion_strengths
from factorgraph_dvl.solvers.preparation_without_imu import prepare_without_imu
from factorgraph_dvl.solvers.rounds import settle

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def trial():
    scenario = load_scenario(CONFIGS / "ship.yaml")
    legs = scenario.manoeuvres[0]["manoeuvres"]
    return simulate(
        msgspec.structs.replace(scenario, manoeuvres=[{"repeat": 1, "manoeuvres": legs}]), 1
    )


@pytest.fixture(scope="module")
def settled(trial):
    prepared = prepare_without_imu(trial)
    return settle(prepared, prepared.states, lambda *_: None)


def sigma_of(settled, name):
    problem, information = settled.problem, settled.minimum.information
    size = problem.columns[name].stop - problem.columns[name].start
    P = information.covariance_of([{problem.key(name): np.eye(size)}])
    return np.sqrt(np.diag(P))


def test_it_settles_near_the_truth(trial, settled):
    assert settled.minimum.converged
    values, truth = settled.minimum.evaluation.parameters, trial.calibration_truth
    off = log_so3(values["misalignment_deg"]) - truth["misalignment_deg"] * DEG
    assert np.abs(off / sigma_of(settled, "misalignment_deg")).max() < 5.0
    for name in ("scale_error", "lever_arm_m", "time_offset_s", "attitude_time_offset_s"):
        off = values[name] - truth.get(name, 0.0)
        assert np.abs(off / sigma_of(settled, name)).max() < 5.0, name


def test_lasting_errors_of_attitudes_leave_what_is_fast_to_the_motion():
    """Nodes 8 s apart took the place of the motion in waves: 0.7 deg of heading, falsely."""
    scenario = load_scenario(CONFIGS / "ship-water.yaml")
    trial = simulate(msgspec.structs.replace(scenario, manoeuvres=[{"straight_s": 900}]), 0)
    prepared = prepare_without_imu(trial)
    settled = settle(prepared, prepared.states, lambda *_: None, roughly=True)
    (lasting,) = (p for p in settled.problem.processes if p.label == "Attitude")
    assert np.diff(lasting.time).min() > 0.3 * lasting.tau.min()


def test_the_noise_is_found(settled):
    factors = settled.problem.noise_factors
    sigma = dict(
        zip(
            (o.label for o in settled.problem.observations),
            settled.problem.sigma(settled.minimum.evaluation),
            strict=True,
        )
    )
    # As simulated, where the settings state or start with others.
    np.testing.assert_allclose(
        np.median(sigma["Attitude"], axis=0) / DEG, [0.01, 0.01, 0.02], rtol=0.15
    )
    np.testing.assert_allclose(np.median(sigma["DVL velocity"], axis=0), 0.05, rtol=0.2)
    assert factors["Attitude"].max() < 1.0


@pytest.mark.parametrize("at_bound", [True, False])
def test_a_density_at_its_bound_changes_no_more(settled, monkeypatch, at_bound):
    """Residuals may ask for less for ever: another estimate would be the same."""
    problem, density = settled.problem, settled.problem.chain.density

    def less(strengths, score):
        wanted = np.array([-1.0 * s.name.endswith(" 0") for s in strengths])
        return wanted, 100.0 * np.abs(wanted)

    monkeypatch.setattr(motion_strengths, "_step", less)
    if at_bound:
        monkeypatch.setattr(motion_strengths, "_LEAST", density[0])
    phase = np.zeros((len(density), 6), dtype=int)
    found = motion_strengths.motion_strengths(problem, settled.minimum, phase)
    assert found.same == at_bound
    assert np.array_equal(found.chain.density[0], density[0]) == at_bound
