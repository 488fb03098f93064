"""Singular values of solutions: the current, an estimated bias, the noise of rates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truth import CONING, SWELL, scenario

from factorgraph_dvl.analysis.information.observability import observability
from factorgraph_dvl.geometry.rotations import exp_so3, rotation_from_rph
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.planning import predict
from factorgraph_dvl.simulation import plan_motion, simulate
from factorgraph_dvl.solvers.batch import solve

CURRENT = [0.2, 0.0, 0.0]
WATER = {"dvl": {"reference": "water"}}
BIASED = {"trial": {"dvl": {"bias_std_m_s": [1, 1, 1]}}}
MEMS = {"imu": {"gyro_noise_deg_sqrt_h": 0.3, "accel_noise_ug_sqrt_hz": 100}}


def straight(seconds=60.0, **changes):
    calm = {"sway": {}, "current_m_s": CURRENT, "manoeuvres": [{"straight_s": seconds}]}
    return simulate(scenario(**{**calm, "noise": True, **changes}), 1)


def observed(stack):
    return {name for i in np.flatnonzero(stack.observed) for name in stack.dominant(i)}


def test_every_column_against_numerical_derivatives():
    # The whole stack, from the exact motion and the model as a function of all 12 states.
    scene = scenario(current_m_s=[0.4, -0.3, 0], **WATER, **BIASED)
    prediction = predict(scene)
    view = observability(prediction.solution, trial=prediction.trial, kind="plan")
    assert view.point_set is not None
    found = view.point_set.cumulative[-1]
    time = prediction.trial.dvl.time
    exact = plan_motion(scene).at(time)
    bRn = rotation_from_rph(exact.rph, "RFU").transpose(0, 2, 1)

    def measured(x):
        through_water = exact.v_n - np.append(x[10:], 0.0)
        dvl_b = np.einsum("mij,mj->mi", bRn, through_water) + np.cross(exact.omega_eb_b, x[4:7])
        return (1.0 + x[3]) * dvl_b @ exp_so3(x[:3] * DEG).T + x[7:10]

    start = np.array([2.0, 2.0, 30.0, 0.005, 1.0, 1.2, 1.4, 0, 0, 0, 0.4, -0.3])
    step = 1e-5
    rows = np.stack(
        [
            (measured(start + h) - measured(start - h)) / (2.0 * step)
            for h in step * np.eye(start.size)
        ],
        axis=2,
    )
    scale = np.array([180.0] * 3 + [0.1] + [10.0] * 3 + [1.0] * 3 + [0.5] * 2)
    np.testing.assert_allclose(view.point_set.scale, scale)
    rows = rows * scale / prediction.trial.dvl.sigma()[:, :, None]
    expected = np.linalg.svd(rows.reshape(-1, start.size), compute_uv=False)
    assert found.pings == time.size
    # What remains is of the differences and splines of attitudes at 20 Hz.
    np.testing.assert_allclose(found.values, expected, rtol=1e-4)


def test_at_rest_in_the_water_a_current_shows_no_mounting():
    # A DVL has noise at rest too. If it reads exactly zero, a scale error of -1 is more probable
    # than noise far below what is stated.
    noisy = {"dvl": {"reference": "water", "velocity_std_m_s": 0.001}}
    trial = straight(**noisy, current_m_s=[0.8, 0, 0], start={"speed_m_s": 0})
    solution = solve(trial)
    assert abs(solution.estimate("scale_error").value[0]) < 0.01
    assert not solution.estimate("scale_error").observable.any()
    view = observability(solution, trial=trial)
    assert view.point_set is not None
    (stack,) = view.point_set.segments
    assert observed(stack) == {"current_e_m_s", "current_n_m_s"}
    # Over the bottom it drifts at 0.8 m/s, which shows three directions.
    ashore = straight(current_m_s=[0.8, 0, 0], start={"speed_m_s": 0})
    view = observability(solve(ashore), trial=ashore)
    assert view.point_set is not None
    assert int(view.point_set.segments[0].observed.sum()) == 3


@pytest.mark.slow
def test_a_current_that_was_not_estimated_is_named():
    trial = straight(35.0, **WATER)
    solution = solve(trial)
    kept = tuple(e for e in solution.estimates if e.name != "current_m_s")
    size = sum(e.value.size for e in kept)
    other = replace(solution, estimates=kept, covariance=solution.covariance[:size, :size])
    view = observability(other, trial=trial)
    assert any("current_m_s in the singular values" in text for text in view.missing)


def test_an_estimated_bias_takes_the_scale_from_a_straight_run():
    trial = straight(**BIASED)
    view = observability(solve(trial), trial=trial)
    assert view.point_set is not None
    (stack,) = view.point_set.segments
    assert "dvl_bias_x_m_s" in view.point_set.states
    # As by hand: rank 3 of the constant rows [-[v x], v, 0, I], whatever is estimated.
    assert int(stack.observed.sum()) == 3
    open_ones = [stack.dominant(i) for i in np.flatnonzero(~stack.observed)]
    assert ("scale_error",) in open_ones
    assert view.marginals is not None
    at = view.marginals.names.index("scale_error")
    assert view.marginals.ratio[at] > 0.9


@pytest.mark.slow
def test_a_time_offset_is_named_as_taken_for_known():
    trial = straight(35.0, trial={"dvl": {"time_offset_std_s": 0.1}})
    view = observability(solve(trial), trial=trial)
    assert any("time_offset_s in the singular values" in text for text in view.missing)
    assert not any(
        "in the singular values" in t for t in observability(solve(straight(35.0))).missing
    )


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [5.0, 20.0])
def test_noise_of_rates_is_no_lever_arm(rate_hz):
    solution = solve(straight(120.0, **MEMS), rate_hz=rate_hz)
    view = observability(solution)
    assert view.point_set is not None
    (stack,) = view.point_set.segments
    assert int(stack.observed.sum()) == 3
    assert not any("lever_arm" in name for name in observed(stack))
    # What is there is what is expected of the noise, to the scatter of its estimate.
    arms = [i for i in range(7) if stack.dominant(i)[0].startswith("lever_arm")]
    np.testing.assert_allclose(stack.spurious[arms], 1.0, atol=0.4)


@pytest.mark.parametrize("sea", [SWELL, CONING], ids=["swell", "2 Hz"])
def test_sway_is_no_noise_of_rates(sea):
    view = observability(solve(straight(60.0, sway=sea, **MEMS)))
    assert view.point_set is not None
    (stack,) = view.point_set.segments
    assert stack.observed.all()
    assert stack.spurious.max() < 0.02
