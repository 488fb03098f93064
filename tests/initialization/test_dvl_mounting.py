"""The DVL's mounting to start from: large misalignments, clocks, poor motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truth import CONING, SWELL, exact_states, scenario

from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import segments
from factorgraph_dvl.imu.propagation import attach_inside, motion_at
from factorgraph_dvl.initialization.dvl_mounting import initial_mountings
from factorgraph_dvl.simulation import simulate


def mounting_of(scene, *, waver=0.0, seed=1):
    """Return the mounting that is found with the true motion, its velocity off by `waver`."""
    trial = simulate(scene, seed)
    frame = trial.frame()
    inc, _ = increments(trial.imu)
    seg = segments(inc, 1.0)
    states = exact_states(scene, frame, seg.node_time)
    noise = np.random.default_rng(seed).normal(0.0, 1.0, states.v_n.shape)
    states = replace(states, v_n=states.v_n + waver * noise)
    gravity_n = frame.gravity_without_rotation(states.p_n[seg.origin])

    def motion(time):
        at, covered = attach_inside(seg, time, frame.earth_rate)
        return motion_at(at, states, gravity_n, frame.earth_rate), covered

    return initial_mountings(trial.dvl, motion)[0]


def turned_deg(values, misalignment_deg):
    true = exp_so3(np.array(misalignment_deg) * DEG)
    return np.linalg.norm(log_so3(true.T @ values["misalignment_deg"])) / DEG


@pytest.mark.parametrize("angle", [30, 90, 180])
@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [-2, 1, 0]], ids=str)
def test_large_misalignments(axis, angle):
    misalignment = (np.array(axis) / np.linalg.norm(axis) * angle).tolist()
    scene = scenario(
        noise=True,
        sway=CONING,
        dvl={
            "misalignment_deg": misalignment,
            "scale_error": [0.01, -0.02, 0.03],
            "bias_m_s": [0.02, -0.01, 0.03],
        },
        trial={"dvl": {"scale_error_std": [0.1] * 3, "bias_std_m_s": [0.1] * 3}},
    )
    values = mounting_of(scene, waver=0.003)
    # Velocities that are 3 mm/s off shift the mounting by tenths of a degree and some
    # centimetres; a wrong minimum is 90 or 180 deg off.
    assert turned_deg(values, misalignment) < 0.7
    np.testing.assert_allclose(values["lever_arm_m"], [1.0, 1.2, 1.4], atol=0.08)
    np.testing.assert_allclose(values["scale_error"], [0.01, -0.02, 0.03], atol=0.02)
    np.testing.assert_allclose(values["dvl_bias_m_s"], [0.02, -0.01, 0.03], atol=0.03)


@pytest.mark.parametrize("sway", [CONING, SWELL], ids=["2 Hz", "swell"])
@pytest.mark.parametrize(("offset", "std"), [(0.08, 0.1), (-0.45, 0.3), (-0.45, 0.5)])
def test_time_offset(sway, offset, std):
    scene = scenario(
        noise=True,
        sway=sway,
        dvl={"misalignment_deg": [2, 2, 90], "time_offset_s": offset},
        trial={"dvl": {"time_offset_std_s": std}},
    )
    values = mounting_of(scene, waver=0.003)
    # The grid's step; one period of the sway, 0.5 s, further it fits almost as well.
    assert abs(values["time_offset_s"][0] - offset) <= 0.005 + 1e-9
    # About the velocity little but the swing of the lever arm is to be seen.
    assert turned_deg(values, [2, 2, 90]) < 0.5


def test_without_noise_the_mounting_is_exact():
    values = mounting_of(scenario())
    # Left to the ridge and the priors.
    assert turned_deg(values, [2, 2, 30]) < 1e-3
    np.testing.assert_allclose(values["lever_arm_m"], [1.0, 1.2, 1.4], atol=1e-3)
    np.testing.assert_allclose(values["scale_error"], [0.005], atol=1e-5)
    np.testing.assert_allclose(values["dvl_bias_m_s"], np.zeros(3), atol=1e-9)
    assert "time_offset_s" not in values or values["time_offset_s"][0] == 0.0


def test_a_straight_run_respects_the_priors():
    claims = {
        "misalignment_deg": [0, 0, 25],
        "misalignment_std_deg": [5, 5, 10],
        "lever_arm_m": [0.8, 1, 1.5],
        "lever_arm_std_m": [0.5, 0.5, 0.5],
        "scale_error_std": 0.02,
    }
    scene = scenario(noise=True, manoeuvres=[{"straight_s": 60}], sway={}, trial={"dvl": claims})
    values = mounting_of(scene, waver=0.03)
    away = log_so3(exp_so3(np.array([0, 0, 25]) * DEG).T @ values["misalignment_deg"]) / DEG
    assert np.all(np.abs(away) < [8, 8, 10])
    # The direction of the velocity is seen all the same: forward appears in d as it is.
    forward = values["misalignment_deg"] @ [0.0, 1.0, 0.0]
    true = exp_so3(np.array([2, 2, 30]) * DEG) @ [0.0, 1.0, 0.0]
    assert np.degrees(np.arccos(forward @ true)) < 0.3
    # Nothing turns, so the lever arm stays.
    np.testing.assert_allclose(values["lever_arm_m"], [0.8, 1.0, 1.5], atol=0.05)


def test_at_rest_the_priors_stay():
    scene = scenario(noise=True, manoeuvres=[{"straight_s": 20}], sway={}, start={"speed_m_s": 0})
    values = mounting_of(scene)
    assert np.all(np.isfinite(values["misalignment_deg"]))
    assert np.abs(values["scale_error"]).max() < 0.1
    assert np.abs(values["lever_arm_m"]).max() < 10.0


def test_without_a_lock_there_are_the_priors():
    claims = {"misalignment_deg": [0, 0, 25]}
    scene = scenario(dvl={"no_lock_s": [[0.0, 100.0]]}, trial={"dvl": claims})
    values = mounting_of(scene)
    assert turned_deg(values, [0, 0, 25]) < 1e-12
    np.testing.assert_array_equal(values["lever_arm_m"], np.zeros(3))


def test_parameters_without_freedom_are_held():
    claims = {
        "misalignment_deg": [2, 2, 30],
        "misalignment_std_deg": [0, 0, 0],
        "scale_error": 0.01,
        "scale_error_std": 0,
        "lever_arm_m": [1, 1.2, 1],
        "lever_arm_std_m": [0, 0, 1],
    }
    values = mounting_of(scenario(noise=True, trial={"dvl": claims}))
    assert turned_deg(values, [2, 2, 30]) < 0.01
    np.testing.assert_allclose(values["scale_error"], [0.01], atol=1e-6)
    np.testing.assert_allclose(values["lever_arm_m"][:2], [1.0, 1.2], atol=1e-6)
    assert values["lever_arm_m"][2] == pytest.approx(1.4, abs=0.05)
