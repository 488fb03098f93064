"""Single beams: geometry, factor, lost beams, turntable, gauge, conversions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from jacobians import check_jacobians, differentiate
from test_observations import random_motion
from truth import exact_motion, scenario

from factorgraph_dvl.conventions import DEG, exp_so3
from factorgraph_dvl.directions import tangent_axes, turned, turned_jacobian, turns_to
from factorgraph_dvl.sensors.dvl_beams import DvlBeams, DvlBeamsSettings
from factorgraph_dvl.sensors.protocol import Motion
from factorgraph_dvl.simulation import plan_motion, simulate

JANUS_X = ((30.0, 45.0), (30.0, 315.0), (30.0, 225.0), (30.0, 135.0))
JANUS_PLUS = ((25.0, 0.0), (25.0, 90.0), (25.0, 180.0), (25.0, 270.0))
FOUR_AND_ONE = (*JANUS_PLUS, (0.0, 0.0))
THREE = ((30.0, 0.0), (30.0, 120.0), (30.0, 240.0))
SCALES = (0.01, -0.004, 0.002, -0.009)
ERRORS = ((0.9, -0.3), (-0.2, 0.5), (0.1, 0.8), (-0.6, -0.6))


def settings(slants=JANUS_X, **changes):
    return DvlBeamsSettings(slant_azimuth_deg=slants, **changes)


def beams(velocity, slants=JANUS_X, **changes):
    velocity = np.asarray(velocity, dtype=float)
    return DvlBeams(settings(slants, **changes), np.arange(len(velocity)) * 0.2, velocity)


def observation(m=5, *, values=None, lost=(), seed=0, **changes):
    """Return an observation of beams with random numbers, and values of its parameters."""
    rng = np.random.default_rng(seed)
    velocity = rng.normal(0.0, 2.0, (m, 4))
    for ping, beam in lost:
        velocity[ping, beam] = np.nan
    sensor = beams(velocity, **changes)
    (found,) = sensor.observations(None)
    return found, sensor.parameters()


def beam_values(**changes):
    return {
        "beam_direction_b": np.array(ERRORS).ravel() * DEG,
        "beam_scale_error": np.array(SCALES),
        "lever_arm_m": np.array([1.0, -1.2, 1.4]),
    } | changes


@pytest.mark.parametrize("degrees", [0.0, 1e-6, 3.0, 60.0])
def test_a_direction_and_its_coordinates_are_one(degrees):
    rng = np.random.default_rng(0)
    nominal = rng.normal(size=(50, 3))
    nominal[:2] = [[0, 0, -1], [0, 0, 1]]
    nominal /= np.linalg.norm(nominal, axis=1)[:, None]
    bearing = rng.uniform(0.0, 7.0, 50)
    eta = degrees * DEG * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    directions = turned(nominal, eta)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-14)
    angle = np.arccos(np.clip(np.sum(nominal * directions, axis=1), -1.0, 1.0))
    np.testing.assert_allclose(angle, degrees * DEG, atol=1e-7)
    np.testing.assert_allclose(turns_to(nominal, 3.0 * directions), eta, atol=1e-13)
    numerical = differentiate(lambda h: turned(nominal, eta + h), 2)
    np.testing.assert_allclose(turned_jacobian(nominal, eta), numerical, atol=1e-9)


def test_the_axes_of_a_direction_by_hand():
    # Straight down they are x and y. Of a beam 30 deg ahead of that, x stays, and y tilts
    # down with it.
    s, c = np.sin(30 * DEG), np.cos(30 * DEG)
    found = tangent_axes(np.array([[0.0, 0.0, -1.0], [0.0, s, -c]]))
    np.testing.assert_allclose(found[0], [[1, 0], [0, 1], [0, 0]], atol=1e-15)
    np.testing.assert_allclose(found[1], [[1, 0], [0, c], [0, s]], atol=1e-15)


def test_nominal_directions_three_ways_are_the_same_beams():
    vectors = settings().nominal_d
    root = np.sqrt(0.125)
    by_hand = [[1, 1], [-1, 1], [-1, -1], [1, -1]]
    np.testing.assert_allclose(vectors[:, :2], np.array(by_hand) * root, atol=1e-15)
    np.testing.assert_allclose(vectors[:, 2], -np.cos(30 * DEG), atol=1e-15)
    alpha, theta = np.arcsin(root) / DEG, 60.0
    patent = DvlBeamsSettings(alpha_theta_deg=((alpha, theta),) * 4)
    np.testing.assert_allclose(patent.nominal_d, vectors, atol=1e-14)
    given = DvlBeamsSettings(directions=tuple(map(tuple, (1.002 * vectors).tolist())))
    np.testing.assert_allclose(given.nominal_d, vectors, atol=1e-15)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, "given one way"),
        ({"slant_azimuth_deg": JANUS_X, "directions": ((0, 0, -1),) * 3}, "found"),
        ({"slant_azimuth_deg": JANUS_X[:2]}, "three or more"),
        ({"slant_azimuth_deg": ((10, 0), (20, 0), (30, 180))}, "in one plane"),
        ({"directions": ((1, 0, -1), (0, 1, -1), (-1, 0, -1))}, "unit vectors"),
        ({"alpha_theta_deg": ((20, 60),) * 3}, "four beams"),
        ({"alpha_theta_deg": ((40, 60),) * 4}, "add up"),
        ({"slant_azimuth_deg": JANUS_X, "scale_error": (0.1, 0.2)}, "one number, or 4"),
        ({"slant_azimuth_deg": JANUS_X, "misalignment_std_deg": (1, 1, 1)}, "common"),
    ],
)
def test_settings_that_cannot_be(changes, message):
    with pytest.raises(ValueError, match=message):
        DvlBeamsSettings(**changes)


def test_beam_velocity_by_hand():
    # Heading north at 2 m/s, turning about the vertical at 0.1 rad/s, DVL 3 m ahead: it
    # moves 0.3 m/s to port as well.
    o, _ = observation(1)
    motion = Motion(
        nRb=np.eye(3)[None],
        p_n=np.zeros((1, 3)),
        v_n=np.array([[0.0, 2.0, 0.0]]),
        omega_eb_b=np.array([[0.0, 0.0, 0.1]]),
        a_n=np.zeros((1, 3)),
        alpha_b=np.zeros((1, 3)),
        omega_sigma=np.zeros((1, 3)),
    )
    values = {
        "beam_direction_b": np.zeros(8),
        "beam_scale_error": np.array([0.1, 0.0, 0.0, 0.0]),
        "lever_arm_m": np.array([0.0, 3.0, 0.0]),
    }
    r = np.sqrt(0.125)
    predicted = o.residual(motion, values) + o.measured
    by_hand = [[1.1 * (2.0 - 0.3) * r, (2.0 + 0.3) * r, (-2.0 + 0.3) * r, (-2.0 - 0.3) * r]]
    np.testing.assert_allclose(predicted, by_hand, atol=1e-15)


@pytest.mark.parametrize("lost", [(), ((0, 1), (2, 0), (2, 3))])
def test_beam_velocity_jacobians(lost):
    o, parameters = observation(lost=lost, misalignment_deg=(5.0, -4.0, 100.0))
    check_jacobians(o, random_motion(), beam_values(), parameters)


def test_common_parametrisation_jacobians():
    o, parameters = observation(parametrisation="common")
    values = {
        "misalignment_deg": exp_so3(np.array([10.0, -25.0, 130.0]) * DEG),
        "scale_error": np.array([0.03]),
        "lever_arm_m": np.array([1.0, -1.2, 1.4]),
    }
    check_jacobians(o, random_motion(), values, parameters)


def test_both_parametrisations_predict_the_same():
    turn, scale = exp_so3(np.array([0.5, -0.4, 0.8]) * DEG), 0.012
    motion, lever_arm = random_motion(), np.array([1.0, -1.2, 1.4])
    free, _ = observation()
    common, _ = observation(parametrisation="common")
    nominal = settings().nominal_d
    eta = turns_to(nominal, nominal @ turn)
    a = free.residual(
        motion, beam_values(beam_direction_b=eta.ravel(), beam_scale_error=np.full(4, scale))
    )
    b = common.residual(
        motion,
        {"misalignment_deg": turn, "scale_error": np.array([scale]), "lever_arm_m": lever_arm},
    )
    np.testing.assert_allclose(a, b, atol=1e-14)


def test_a_lost_beam_counts_nothing_and_the_others_as_before():
    whole, _ = observation(3)
    part, _ = observation(3, lost=((1, 2),))
    motion, values = random_motion(3), beam_values()
    assert np.isinf(part.sigma(motion, values)[1, 2])
    assert np.isfinite(part.residual(motion, values)).all()
    others = np.ones((3, 4), dtype=bool)
    others[1, 2] = False
    for method in ("residual", "sigma"):
        a, b = (getattr(o, method)(motion, values)[others] for o in (whole, part))
        np.testing.assert_array_equal(a, b)


def scene(slants=JANUS_X, **changes):
    n = len(slants)
    truth = {
        "rate_hz": 5,
        "slant_azimuth_deg": slants,
        "direction_error_deg": ERRORS[:1] * n if n > 4 else ERRORS[:n],
        "scale_error": SCALES[:1] * n if n > 4 else SCALES[:n],
        "lever_arm_m": [1.0, -1.2, 1.4],
        "velocity_std_m_s": 0.005,
        "velocity_std_fraction": 0.002,
    }
    turns = {
        "rate_hz": 10,
        "turns": [{"at_s": 20.3, "turn_deg": 90, "duration_s": 15, "ramp_s": 3}],
    }
    base = {
        "dvl": None,
        "dvl_beams": truth,
        "turntable": turns,
        "gnss": {"lever_arm_m": [0.3, -1.5, 4.0]},
        "trial": {"dvl": None},
    }
    return scenario(**(base | changes))


@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
@pytest.mark.parametrize("slants", [JANUS_X, FOUR_AND_ONE, THREE])
def test_zero_error_at_the_truth_on_a_turntable(slants, body_axes):
    scn = scene(slants, body_axes=body_axes)
    trial = simulate(scn)
    frame = trial.frame()
    found = {o.label: o for aid in trial.aids for o in aid.observations(frame)}
    truth = trial.calibration_truth
    eta = turns_to(trial.beams.nominal_b, truth["beam_direction_b"]).ravel()
    values = {**truth, "beam_direction_b": eta}
    for label, limit in (
        ("Beam velocity", 1e-13),
        # The monotone cubics of the estimator through the angle's samples, times 4 m.
        ("GNSS position", 2e-4),
        ("GNSS velocity", 5e-3),
    ):
        o = found[label]
        motion = exact_motion(plan_motion(scn), frame, o.time)
        assert np.abs(o.residual(motion, values)).max() < limit, label


def test_the_antenna_does_not_turn_with_the_body():
    scn = scene()
    trial = simulate(scn)
    frame = trial.frame()
    fixed = replace(trial.gnss, turning=None).observations(frame)
    motion = exact_motion(plan_motion(scn), frame, fixed[0].time)
    error = fixed[0].residual(motion, trial.calibration_truth)
    late = fixed[0].time > 36.0
    # Turned by 90 deg, the level part of the lever arm is off by its length times sqrt 2.
    np.testing.assert_allclose(
        np.linalg.norm(error[late], axis=1), np.sqrt(2.0) * np.hypot(0.3, 1.5), atol=0.02
    )


def test_antenna_jacobians_on_a_turntable():
    scn = scene()
    trial = simulate(scn)
    during = (trial.gnss.time > 25.0) & (trial.gnss.time < 26.0)
    names = ("time", "geodetic", "velocity", "position_std", "velocity_std")
    few = replace(trial.gnss, **{name: getattr(trial.gnss, name)[during] for name in names})
    assert np.abs(few.carrier(few.time)[1]).max() > 0.05
    for o in few.observations(trial.frame()):
        motion = exact_motion(plan_motion(scn), trial.frame(), o.time)
        values = {"gnss_lever_arm_m": np.array([0.3, -1.5, 4.0])}
        check_jacobians(o, motion, values, few.parameters(), tolerance=1e-7)
