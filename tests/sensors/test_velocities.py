"""Measurement models: zero error at the truth, Jacobians, numbers by hand, wrong rotations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from jacobians import check_jacobians, random_motion
from offsets import OFFSET_RAD
from truth import exact_motion, scenario

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.records import rows_of
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.graph.clocks import linearized, true_time
from factorgraph_dvl.sensors.carried_point import PointPosition, PointVelocity
from factorgraph_dvl.sensors.clock import Clock
from factorgraph_dvl.sensors.dvl import Dvl, DvlSettings, DvlVelocity
from factorgraph_dvl.sensors.dvl_distortion import SPECS
from factorgraph_dvl.sensors.gnss import LEVER_ARM, Gnss, GnssSettings
from factorgraph_dvl.sensors.protocol import Motion, lever_arm_sigma
from factorgraph_dvl.simulation import plan_motion, simulate

MISALIGNMENT_DEG = [10.0, -25.0, 130.0]


def dvl_values(**changes):
    return {
        "misalignment_deg": exp_so3(np.array(MISALIGNMENT_DEG) * DEG),
        "scale_error": np.array([0.03]),
        "lever_arm_m": np.array([1.0, -1.2, 1.4]),
        "dvl_bias_m_s": np.array([0.01, -0.02, 0.03]),
        "time_offset_s": np.array([0.08]),
        "dvl_clock_rate_ppm": np.zeros(1),
        "dvl_sawtooth_delay_s": np.zeros(1),
        "dvl_sawtooth_s": np.array([0.7, 0.1]),
        "current_m_s": np.zeros(2),
        "water_current_m_s": np.zeros(2),
        "water_span_s": np.array([0.5, 3.5]),
        "gnss_time_offset_s": np.zeros(1),
        "gnss_clock_rate_ppm": np.zeros(1),
        "gnss_velocity_delay_s": np.zeros(1),
        **{spec.name: np.zeros(spec.size) for spec in SPECS},
    } | changes


def scene(*, scale=0.03, reference="bottom", body_axes="RFU"):
    claims = {
        "velocity_std_m_s": 0.001,
        "bias_std_m_s": [1, 1, 1],
        "time_offset_std_s": 1,
        "scale_error_std": 0.1 if np.ndim(scale) == 0 else [0.1, 0.1, 0.1],
    }
    return scenario(
        body_axes=body_axes,
        current_m_s=[0.3, -0.2, 0.0],
        gnss={"lever_arm_m": [0.3, -1.5, 4.0]},
        dvl={
            "rate_hz": 7,
            "phase_s": 0.05,
            "misalignment_deg": MISALIGNMENT_DEG,
            "scale_error": scale,
            "lever_arm_m": [1.0, -1.2, 1.4],
            "bias_m_s": [0.01, -0.02, 0.03],
            "time_offset_s": 0.08,
            "reference": reference,
        },
        trial={"dvl": claims},
    )


def observed(scn):
    """Return exact motion, frame and observations by label."""
    trial = simulate(scn)
    fix = trial.gnss.geodetic[0]
    frame = LocalFrame(fix[0] - OFFSET_RAD, fix[1] + OFFSET_RAD, 0.0)
    out = {o.label: o for aid in trial.aids for o in aid.observations(frame, "RFU")}
    return plan_motion(scn), frame, out


@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
@pytest.mark.parametrize(
    ("scale", "reference"),
    [(0.03, "bottom"), ([0.03, -0.02, 0.01], "bottom"), (0.03, "water")],
)
def test_dvl_velocity_has_zero_error_at_the_truth(scale, reference, body_axes):
    exact, frame, observations = observed(
        scene(scale=scale, reference=reference, body_axes=body_axes)
    )
    o = observations["DVL velocity"]
    values = dvl_values(scale_error=np.atleast_1d(scale))
    if reference == "water":
        values["current_m_s"] = np.array([0.3, -0.2])
    motion = exact_motion(exact, frame, true_time(o, values, 0.0))
    # Through the water, the current keeps its east and north at the vehicle; the model
    # means those of the origin, 85 km away: 0.36 m/s times 0.0135 rad.
    limit = 1e-13 if reference == "bottom" else 5e-3
    assert np.abs(o.residual(motion, values)).max() < limit


def test_antenna_position_and_velocity_have_zero_error_at_the_truth():
    exact, frame, observations = observed(scene())
    values = {"gnss_lever_arm_m": np.array([0.3, -1.5, 4.0])}
    position, velocity = observations["GNSS position"], observations["GNSS velocity"]
    # Limited by geodetic coordinates in double precision: 1e-9 m each.
    error = position.residual(exact_motion(exact, frame, position.time), values)
    assert np.abs(error).max() < 1e-8
    # Velocity refers to the axes at the antenna, and the truth to those at the IMU, 4 m
    # away at most: 4 m/s times 6e-7 rad.
    error = velocity.residual(exact_motion(exact, frame, velocity.time), values)
    assert np.abs(error).max() < 5e-6


@pytest.mark.parametrize("scale", [[0.03], [0.03, -0.2, 0.1]])
@pytest.mark.parametrize("misalignment", [[0, 0, 0], MISALIGNMENT_DEG, [0, 0, 180]])
def test_dvl_velocity_jacobians(scale, misalignment):
    rng = np.random.default_rng(0)
    settings = DvlSettings(
        scale_error=scale[0] if len(scale) == 1 else tuple(scale), reference="water"
    )
    time = np.arange(5.0)
    dvl = Dvl(settings, time, rng.normal(0.0, 3.0, (5, 3)), np.full((5, 3), 0.01))
    (o,) = dvl.observations(LocalFrame(0.6, 2.1, 0.0), "RFU")
    values = dvl_values(
        scale_error=np.array(scale),
        misalignment_deg=exp_so3(np.array(misalignment) * DEG),
        current_m_s=np.array([0.4, -0.6]),
        water_current_m_s=np.array([-0.2, 0.1]),
        dvl_sawtooth_delay_s=np.array([0.05]),
    )
    # Truncation by nothing bends at rest: a difference there errs by the square of its step.
    check_jacobians(o, random_motion(), values, dvl.parameters(), tolerance=1e-7)
    distorted = values | {
        spec.name: 0.02 * spec.si * rng.standard_normal(spec.size) for spec in SPECS
    }
    # Less bends too much for a numerical derivative.
    distorted["dvl_truncation_m_s"] = np.array([0.3])
    check_jacobians(o, random_motion(), distorted, dvl.parameters(), tolerance=3e-8)


DISTORTED = {
    # At 2 m/s ahead, and no rate, the DVL sees (-2, 0, 0) in d, which is (0, 2, 0) in body.
    # 0.02 rad are missing between x and y: y sees 0.01 of what is along x.
    "dvl_axes_deg": ([0.02, 0.0, 0.0], [-2.0, -0.02, 0.0]),
    "dvl_scale_difference": ([0.01, 0.02], [-2.0, 0.0, 0.0]),
    # Level: no tilt turns anything.
    "dvl_flex_by_tilt": ([0.1] * 6, [-2.0, 0.0, 0.0]),
    # 0.01 rad for each m/s about body z: (-2 sin 0.02, 2 cos 0.02, 0) in body.
    "dvl_flex_by_speed_deg_s_m": (
        [0.0, 0.0, 0.01],
        [-2.0 * np.cos(0.02), -2.0 * np.sin(0.02), 0.0],
    ),
    "dvl_scale_by_speed_s_m": ([0.01], [-2.04, 0.0, 0.0]),
    # A kilometre east of the origin, 500 m below it.
    "dvl_scale_by_place_1_km": ([2e-5, 0.0, 1e-4], [-1.94, 0.0, 0.0]),
    # An hour after the middle.
    "dvl_scale_by_time_1_h": ([0.01 / 3600.0], [-2.02, 0.0, 0.0]),
    # Toward zero by 1.5 times 2 over the root of 4 + 2.25.
    "dvl_truncation_m_s": ([1.5], [-0.8, 0.0, 0.0]),
}


@pytest.mark.parametrize("name", DISTORTED)
def test_a_distortion_by_hand(name):
    stated, expected = DISTORTED[name]
    values = dvl_values(
        misalignment_deg=QUARTER,
        scale_error=np.zeros(1),
        lever_arm_m=np.zeros(3),
        dvl_bias_m_s=np.zeros(3),
    )
    values[name] = np.array(stated)
    measured = np.array([[-2.0, 0.0, 0.0]])
    o = DvlVelocity(np.array([3600.0]), measured, np.full((1, 3), 0.01))
    at = replace(hand_motion(), p_n=np.array([[1000.0, 0.0, -500.0]]))
    np.testing.assert_allclose(o.residual(at, values) + measured, [expected], atol=1e-12)


def test_water_that_is_seen_for_a_while_by_hand():
    """0.3 m/s along with the vehicle, at 2 m/s east and level: 1.7 m/s, from 10 to 20 s."""
    time = np.array([9.9, 10.0, 20.0, 20.1])
    at = rows_of(hand_motion(), np.zeros(4, dtype=int))
    values = dvl_values(
        misalignment_deg=QUARTER,
        scale_error=np.zeros(1),
        lever_arm_m=np.zeros(3),
        dvl_bias_m_s=np.zeros(3),
        water_current_m_s=np.array([0.3, 0.0]),
        water_span_s=np.array([10.0, 20.0]),
    )
    measured = np.tile([-2.0, 0.0, 0.0], (4, 1))
    o = DvlVelocity(time, measured, np.full((4, 3), 0.01))
    expected = [[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.0, 0.0]]
    np.testing.assert_allclose(o.residual(at, values), expected, atol=1e-12)


@pytest.mark.parametrize("turned", ["roll", "pitch"])
def test_a_mount_that_flexes_with_the_tilt_by_hand(turned):
    # Bow up by 0.1 rad: the vertical's component along y of body, to the bow, is sin 0.1. A gain
    # of 0.5 turns the mount by half of that about z. Starboard down: that along x is -sin 0.1.
    angle = {"roll": [0.0, 0.1, 0.0], "pitch": [0.1, 0.0, 0.0]}[turned]
    level = hand_motion()
    nRb = level.nRb @ exp_so3(np.array(angle))
    by = {"roll": 4, "pitch": 5}[turned]
    values = dvl_values(
        misalignment_deg=np.eye(3),
        scale_error=np.zeros(1),
        lever_arm_m=np.zeros(3),
        dvl_bias_m_s=np.zeros(3),
    )
    values["dvl_flex_by_tilt"] = 0.5 * (np.arange(6) == by)
    o = DvlVelocity(np.zeros(1), np.zeros((1, 3)), np.full((1, 3), 0.01))
    # Ahead at 2 m/s.
    motion = replace(level, nRb=nRb, v_n=nRb @ np.array([0.0, 2.0, 0.0]))
    turn = 0.5 * {"roll": -np.sin(0.1), "pitch": np.sin(0.1)}[turned]
    expected = [[-2.0 * np.sin(turn), 2.0 * np.cos(turn), 0.0]]
    np.testing.assert_allclose(o.residual(motion, values), expected, atol=1e-12)


def test_time_offset_derivative_is_that_of_the_true_motion():
    exact, frame, observations = observed(scene())
    o = observations["DVL velocity"]
    values = dvl_values()
    time = true_time(o, values, 0.0)
    smooth = np.min(np.abs(time[:, None] - exact.kinks), axis=1) > 0.01
    o = replace(o, time=o.time[smooth], measured_d=o.measured_d[smooth], std=o.std[smooth])
    motion = exact_motion(exact, frame, time[smooth])
    lin = linearized(o, motion, values, ["time_offset_s"], 0.0)
    h = 1e-4
    later, earlier = (
        o.residual(exact_motion(exact, frame, time[smooth] - s), values) for s in (h, -h)
    )
    # Third derivatives times h²/6, and 1e-10 of the differentiated acceleration.
    numerical = (later - earlier) / (2.0 * h)
    assert np.abs(lin.d_parameters["time_offset_s"][:, :, 0] - numerical).max() < 1e-7
    assert np.abs(numerical).max() > 0.5


def test_antenna_jacobians():
    rng = np.random.default_rng(1)
    geodetic = np.array([0.6, 2.1, 5.0]) + rng.normal(0.0, 0.05, (5, 3)) * [1, 1, 0]
    unknown = np.full((5, 3), np.nan)
    gnss = Gnss(
        GnssSettings(),
        np.arange(5.0),
        geodetic,
        rng.normal(0.0, 3.0, (5, 3)),
        unknown,
        unknown.copy(),
    )
    motion = random_motion()
    values = {"gnss_lever_arm_m": np.array([0.3, -1.5, 4.0])}
    for o in gnss.observations(LocalFrame(0.6, 2.1, 0.0), "RFU"):
        # Positions of 3e5 m leave central differences of 1e-6 with 1e-4 of noise.
        shift = 0.0 if o.label == "GNSS velocity" else o.measured_n
        near = replace(motion, p_n=motion.p_n + shift)
        check_jacobians(o, near, values, gnss.parameters(), tolerance=1e-4)


# Heading east: right is south, forward is east, up is up. Columns are the body axes in n.
EAST = np.array([[[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def hand_motion():
    zero = np.zeros((1, 3))
    return Motion(
        nRb=EAST,
        p_n=np.array([[10.0, 20.0, 30.0]]),
        v_n=np.array([[2.0, 0.0, 0.0]]),
        omega_eb_b=np.array([[0.0, 0.0, 0.1]]),
        a_n=zero,
        alpha_b=zero,
        omega_sigma=zero + 1e-3,
    )


def test_dvl_velocity_by_hand():
    # 2 m/s east is (0, 2, 0) in body. w x l = (0, 0, 0.1) x (1, 2, 3) = (-0.2, 0.1, 0).
    # Sum (-0.2, 2.1, 0). A quarter turn about z takes (x, y) to (-y, x): (-2.1, -0.2, 0).
    # Times 1.01: (-2.121, -0.202, 0). Plus the bias (0.001, 0.002, 0.003):
    # (-2.12, -0.2, 0.003).
    values = dvl_values(
        misalignment_deg=QUARTER,
        scale_error=np.array([0.01]),
        lever_arm_m=np.array([1.0, 2.0, 3.0]),
        dvl_bias_m_s=np.array([0.001, 0.002, 0.003]),
    )
    measured = np.array([[-2.0, 0.0, 0.0]])
    o = DvlVelocity(np.array([7.0]), measured, np.full((1, 3), 0.01))
    np.testing.assert_allclose(o.residual(hand_motion(), values), [[-0.12, -0.2, 0.003]])
    # The file's time is 80 ms late.
    np.testing.assert_allclose(true_time(o, values, 0.0), [6.92])
    # Per axis, the x scale acts on d's x: -2.1 · 1.1 = -2.31, -0.2 · 1 = -0.2, 0 · 0.9.
    values["scale_error"] = np.array([0.1, 0.0, -0.1])
    np.testing.assert_allclose(o.residual(hand_motion(), values), [[-0.309, -0.198, 0.003]])
    # Through water that flows 0.5 m/s east the bow moves at 1.5 m/s: (-0.2, 1.6, 0) in
    # body, (-1.6, -0.2, 0) in d.
    values["scale_error"] = np.array([0.0])
    values["current_m_s"] = np.array([0.5, 0.0])
    np.testing.assert_allclose(o.residual(hand_motion(), values), [[0.401, -0.198, 0.003]])


@pytest.mark.parametrize("lever_arm", [LEVER_ARM, np.array([1.0, 2.0, 3.0])], ids=type)
def test_a_point_by_hand(lever_arm):
    values = {LEVER_ARM: np.array([1.0, 2.0, 3.0])}
    of_point = {
        "time": np.zeros(1),
        "lRn": QUARTER.T[None],
        "std": np.full((1, 3), 0.5),
        "label": "point",
        "clock": Clock.of("gnss", prefix="gnss_"),
        "lever_arm": lever_arm,
    }
    # 1 m right is 1 m south, 2 m forward is 2 m east: the antenna is at (12, 19, 33).
    # Measured a metre further west; n's east is the level frame's -north.
    position = PointPosition(measured_n=np.array([[11.0, 19.0, 33.0]]), **of_point)
    np.testing.assert_allclose(
        position.residual(hand_motion(), values), [[0.0, -1.0, 0.0]], atol=1e-14
    )
    # w x l = (-0.2, 0.1, 0) in body: 0.2 m/s north and 0.1 m/s east. With 2 m/s east:
    # (2.1, 0.2, 0) in n, (0.2, -2.1, 0) in level axes.
    velocity = PointVelocity(measured_l=np.zeros((1, 3)), **of_point)
    np.testing.assert_allclose(
        velocity.residual(hand_motion(), values), [[0.2, -2.1, 0.0]], atol=1e-14
    )
    # Only what is estimated has derivatives; the noise of rates counts through any lever arm.
    known = () if position.parameters == () else (LEVER_ARM,)
    for o in (position, velocity):
        assert tuple(o.linearize(hand_motion(), values, [LEVER_ARM]).d_parameters) == known
    np.testing.assert_allclose(velocity.sigma(hand_motion(), values), np.sqrt(0.25 + 14e-6))


def test_uncertain_rates_add_to_the_noise_through_the_lever_arm():
    # 1e-3 rad/s on every axis and l = (1, 2, 3): the covariance of w x l has the trace
    # 1e-6 · 2 · 14, half of which stands across l.
    values = dvl_values(lever_arm_m=np.array([1.0, 2.0, 3.0]))
    o = DvlVelocity(np.zeros(1), np.zeros((1, 3)), np.full((1, 3), 3e-3))
    expected = np.sqrt(9e-6 + 14e-6)
    np.testing.assert_allclose(o.sigma(hand_motion(), values), np.full((1, 3), expected))
    # A factor is on the noise of the sensor itself.
    twice = np.sqrt([9e-6 + 14e-6, 4 * 9e-6 + 14e-6, 14e-6])
    found = o.sigma(hand_motion(), values, np.array([1.0, 2.0, 0.0]))
    np.testing.assert_allclose(found, twice[None])
    draws = np.random.default_rng(0).normal(0.0, 1e-3, (100_000, 3))
    swept = np.cross(draws, values["lever_arm_m"])
    across = swept @ np.linalg.svd(values["lever_arm_m"][None])[2][1]
    found = lever_arm_sigma(hand_motion(), values["lever_arm_m"])
    np.testing.assert_allclose(found, across.std(), rtol=0.01)


def test_a_transposed_rotation_shows():
    exact, frame, observations = observed(scene())
    values = dvl_values() | {"gnss_lever_arm_m": np.array([0.3, -1.5, 4.0])}

    def worst(o, motion, changed=None):
        return np.abs(o.residual(motion, changed or values)).max()

    for label in ("DVL velocity", "GNSS position", "GNSS velocity"):
        o = observations[label]
        motion = exact_motion(exact, frame, true_time(o, values, 0.0))
        assert worst(o, motion) < 1e-5
        assert worst(o, replace(motion, nRb=motion.nRb.transpose(0, 2, 1))) > 0.5
        if label == "DVL velocity":
            wrong = {**values, "misalignment_deg": values["misalignment_deg"].T}
            assert worst(o, motion, wrong) > 0.5
        else:
            # lRn turns by half a degree here: 4 m/s · 0.02; of a position, whose axes are
            # those of n, only its residual turns.
            shifted = replace(motion, p_n=motion.p_n + 100.0)
            transposed = replace(o, lRn=o.lRn.transpose(0, 2, 1))
            turned = transposed.residual(shifted, values) - o.residual(shifted, values)
            assert np.abs(turned).max() > 0.02


def test_a_receiver_without_position_keeps_the_level_axes_of_its_last_fix():
    frame = LocalFrame(0.6, 2.1, 0.0)
    nan = np.nan
    geodetic = np.array([[nan] * 3, [0.61, 2.12, 0.0], [nan] * 3])
    gnss = Gnss(
        GnssSettings(),
        np.arange(3.0),
        geodetic,
        np.ones((3, 3)),
        np.full((3, 3), nan),
        np.full((3, 3), nan),
    )
    position, velocity = gnss.observations(frame, "RFU")
    assert position.time.tolist() == [1.0]
    expected = frame.level_from_tangent(0.61, 2.12)
    np.testing.assert_allclose(velocity.lRn, np.tile(expected, (3, 1, 1)))
