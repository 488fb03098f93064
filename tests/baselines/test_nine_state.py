"""The nine-state filter: when bias and scale separate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from findings import of_code
from kalman_trials import MISALIGNMENT, NO_ARM, SCALE, VARIED, exact_points, parameter
from truth import SWELL, scenario

from factorgraph_dvl.baselines import calibrate, kalman
from factorgraph_dvl.baselines.nine_state import nine_state
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import simulate


def nine_state_trial(manoeuvres, sway=SWELL):
    return simulate(
        scenario(
            noise=True,
            manoeuvres=manoeuvres,
            sway=sway,
            gnss={"position_std_m": [0.02, 0.02, 0.04], "velocity_std_m_s": [0.02, 0.02, 0.02]},
            dvl={
                "misalignment_deg": [1, -1, 2],
                "scale_error": [0.01, -0.02, 0.005],
                "bias_m_s": [0.02, -0.03, 0.01],
                **NO_ARM,
            },
            trial={"dvl": {"bias_std_m_s": [0.2, 0.2, 0.2]}},
        ),
        2,
    )


def test_nine_states_separate_bias_and_scale_when_the_speed_varies():
    solution, history = calibrate(nine_state_trial(VARIED), "nine-state")
    bias, scale = solution.estimate("dvl_bias_m_s"), solution.estimate("scale_error")
    assert bias.observable[1]
    assert scale.observable[1]
    np.testing.assert_allclose(bias.value[1], -0.03, atol=0.01)
    np.testing.assert_allclose(scale.value[1], -0.02, atol=0.003)
    np.testing.assert_allclose(history.values[-1, :3], solution.estimates[0].value, atol=1e-6)


def test_nine_states_say_when_bias_and_scale_do_not_separate():
    solution = kalman(nine_state_trial([{"straight_s": 60}], sway={}), "nine-state")
    assert not solution.estimate("dvl_bias_m_s").observable[1]
    assert not solution.estimate("scale_error").observable[1]
    assert of_code(solution.findings, Code.NOT_OBSERVABLE)


def test_without_noise_nine_states_are_exact():
    scale, bias = np.array([0.01, -0.02, 0.03]), np.array([0.05, 0.02, -0.1])
    points = exact_points(misalignment=[0.2, -0.1, 0.4], scale=scale, bias=bias)
    # Priors so wide that they move nothing.
    wide = (
        replace(MISALIGNMENT, sigma=np.full(3, 0.5)),
        parameter("scale_error", scale, np.full(3, 0.1)),
        parameter("dvl_bias", bias, np.full(3, 0.1)),
    )
    outcome = nine_state(points, *wide, np.zeros(3))
    assert outcome.converged
    assert not outcome.unseparated
    np.testing.assert_allclose(outcome.estimated.values[0], exp_so3([0.2, -0.1, 0.4]), atol=1e-5)
    np.testing.assert_allclose(outcome.estimated.values[1], scale, atol=1e-5)
    np.testing.assert_allclose(outcome.estimated.values[2], bias, atol=1e-5)


def test_a_bias_that_the_trial_fixes_is_estimated_and_said():
    fixed = parameter("dvl_bias", np.zeros(3), np.zeros(3))
    points = exact_points(misalignment=[0.01, 0.0, 0.02])
    outcome = nine_state(points, MISALIGNMENT, SCALE, fixed, np.zeros(3), iterated=False)
    assert "0.5 m/s" in outcome.findings[0].text
    assert outcome.iterations == 1
