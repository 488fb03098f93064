"""Singular values by segment: table 3 of Luo et al. (2024) again, and rank and basis by hand.

The derivations are in docs/observability.md.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truth import CONING, SWELL, scenario

from factorgraph_dvl.analysis.information.manoeuvres import Segment
from factorgraph_dvl.analysis.information.segment_singular_values import (
    BodyMotion,
    MountingModel,
    body_motion,
    point_set_rows,
    readable_basis,
    singular_values,
)
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import skew
from factorgraph_dvl.simulation import plan_motion, simulate

STATES = ("alpha_x", "alpha_y", "alpha_z", "scale", "l_x", "l_y", "l_z")
ALIGNED = MountingModel(np.zeros(3), np.zeros(1), np.zeros(3))
CURRENT = 0.2
RATE = 10.0 * DEG
# The four manoeuvres of table 3: heading north, current 0.2 m/s to the east.
MANOEUVRES = {
    "drifting": (0.0, [{"straight_s": 100}]),
    "steady": (4.0, [{"straight_s": 100}]),
    "accelerating": (0.0, [{"accelerate_m_s2": 0.1, "to_m_s": 4}]),
    "turning": (4.0, [{"turn_deg_s": -10, "duration_s": 36}]),
}


def motion_of(name, sway=None):
    speed, manoeuvres = MANOEUVRES[name]
    scene = scenario(
        start={"speed_m_s": speed, "heading_deg": 0},
        manoeuvres=manoeuvres,
        sway=sway or {},
        current_m_s=[CURRENT, 0, 0],
        reference_rate_hz=20,
    )
    return body_motion(simulate(scene).reference, "RFU")


def rows_of(name, sway=None):
    """Plain rows of eq. 10, and their number of pings."""
    motion = motion_of(name, sway)
    return point_set_rows(motion, ALIGNED), motion.time


def stacked(rows, time):
    whole = Segment(-1.0, 1e6, "whole")
    return singular_values(rows, time, [whole], STATES)[0][0]


def known(rows, i):
    """Information on state i with all others unknown: what is left of its column."""
    matrix = rows.reshape(-1, rows.shape[2])
    others = np.delete(matrix, i, axis=1)
    left, *_ = np.linalg.lstsq(others, matrix[:, i], rcond=1e-10)
    return float(np.linalg.norm(matrix[:, i] - others @ left))


def test_the_rows_are_those_of_the_paper():
    v, w = np.array([[0.3, 4.0, -0.1]]), np.array([[0.1, -0.2, 0.3]])
    rows = point_set_rows(BodyMotion(np.zeros(1), v, w), ALIGNED)[0]
    np.testing.assert_allclose(rows, np.hstack([-skew(v[0]), v.T, skew(w[0])]))


@pytest.mark.parametrize("scales", [1, 3])
@pytest.mark.parametrize("angle", [0.0, 30.0, 170.0])
def test_rows_against_numerical_derivatives(scales, angle):
    rng = np.random.default_rng(0)
    motion = BodyMotion(np.arange(5.0), rng.normal(size=(5, 3)) * 3, rng.normal(size=(5, 3)))
    alpha = angle * DEG * np.array([2.0, -1.0, 2.0]) / 3.0
    at = MountingModel(alpha, np.linspace(0.01, 0.05, scales), np.array([1.0, -2.0, 0.5]))
    start = np.concatenate([at.misalignment, at.scale_error, at.lever_arm])

    def measured(x):
        dvl_b = motion.v_b + np.cross(motion.omega_b, x[3 + scales :])
        return (1.0 + x[3 : 3 + scales]) * (dvl_b @ exp_so3(x[:3]).T)

    step = 1e-6
    expected = [
        (measured(start + h) - measured(start - h)) / (2.0 * step)
        for h in np.eye(start.size) * step
    ]
    np.testing.assert_allclose(point_set_rows(motion, at), np.stack(expected, axis=2), atol=1e-8)


@pytest.mark.parametrize("sway", [SWELL, CONING], ids=["swell", "2 Hz"])
def test_rates_from_attitudes(sway):
    scene = scenario(sway=sway, reference_rate_hz=20)
    found = body_motion(simulate(scene).reference, "RFU")
    exact = plan_motion(scene).at(found.time).omega_eb_b
    worst = np.abs(found.omega_b - exact)
    largest = np.abs(exact).max()
    # The step of the phase x = 2 pi 2 Hz / 20 Hz: x⁶ / 140 is left of centred differences,
    # x⁶ / 7 at the ends. Ramps of turns begin with a kink of 2 deg/s².
    x = 2.0 * np.pi * 2.0 / 20.0
    assert np.median(worst) < x**6 / 140.0 * largest
    assert worst[3:-3].max() < x**6 / 140.0 * largest + 0.05 * 2.0 * DEG
    assert worst.max() < 2.0 * x**6 / 7.0 * largest


def test_drifting_knows_as_many_directions_as_steady_but_a_twentieth_of_it():
    # Finding 1, "drifting observes nothing well": three directions with 0.2 sqrt(N).
    rows, time = rows_of("drifting")
    found = stacked(rows, time)
    np.testing.assert_allclose(found.values[:3] / np.sqrt(time.size), CURRENT, rtol=1e-3)
    np.testing.assert_allclose(found.values[3:], 0.0, atol=1e-6)
    # The velocity is the current, to the east, which is x: alpha_x is what it cannot show.
    assert found.dominant(3) == ("alpha_x",)


def test_steady_motion_is_not_blind():
    # Finding 2, "steady observes nothing well", is refuted: scale error and the two
    # misalignments across the velocity have |v| sqrt(N) each, at once.
    rows, time = rows_of("steady")
    found = stacked(rows, time)
    speed = np.hypot(4.0, CURRENT)
    np.testing.assert_allclose(found.values[:3] / np.sqrt(time.size), speed, rtol=1e-6)
    np.testing.assert_allclose(found.values[3:], 0.0, atol=1e-6)
    for i in (2, 3):
        assert known(rows, i) == pytest.approx(speed * np.sqrt(time.size), rel=1e-6)
    # Across the velocity, level: along it, 2.9 deg from y, nothing is known, so that x alone
    # is not either.
    assert found.dominant(3) == ("alpha_y",)
    np.testing.assert_allclose(np.abs(found.directions[3, :2]), [CURRENT / speed, 4.0 / speed])


def test_accelerating_makes_nothing_best_but_shows_the_fourth_direction():
    # Finding 3, "acceleration makes alpha_x, alpha_z and the scale best", is refuted: the
    # mean square of the speed is 4² / 3, so steady motion at 4 m/s has sqrt(3) as much.
    rows, time = rows_of("accelerating")
    found = stacked(rows, time)
    np.testing.assert_allclose(
        found.values[:3] / np.sqrt(time.size), 4.0 / np.sqrt(3.0), rtol=0.01
    )
    steady, steady_time = rows_of("steady")
    for i in (2, 3):
        ratio = known(rows, i) / known(steady, i) * np.sqrt(steady_time.size / time.size)
        assert ratio == pytest.approx(1.0 / np.sqrt(3.0), rel=0.01)
    # alpha_x beside an unknown alpha_y: 16/3 - (2 c)² / c² = 4/3; in a turn it is 16.
    assert known(rows, 0) == pytest.approx(np.sqrt(4.0 / 3.0 * time.size), rel=0.01)
    turn, turn_time = rows_of("turning")
    assert known(turn, 0) == pytest.approx(4.0 * np.sqrt(turn_time.size), rel=0.01)
    # Only against a turn that knows no lever arm is it better: that leaves alpha_z and the
    # scale no more than the current.
    for i in (2, 3):
        assert known(turn, i) == pytest.approx(CURRENT * np.sqrt(turn_time.size), rel=0.02)
    # In a cross current it turns the velocity, from the current's direction to the bow:
    # what is left of the constant 0.2 m/s beside a rising 0..4 is half of it.
    assert known(rows, 1) == pytest.approx(0.5 * CURRENT * np.sqrt(time.size), rel=0.01)
    np.testing.assert_allclose(found.values[4:], 0.0, atol=1e-5)


def test_turning_is_what_shows_the_horizontal_lever_arm():
    # Finding 4, "turning makes alpha_y, l_x and l_y best", is confirmed for l_x and l_y.
    rows, time = rows_of("turning")
    root_n = np.sqrt(time.size)
    for i in (4, 5):
        # w l_x stands in the row of v_y times the scale, and only the current, going
        # round, tells them apart: w c / 4, of the other row as well.
        assert known(rows, i) / root_n == pytest.approx(RATE * CURRENT / 4.0, rel=0.02)
        for other in ("drifting", "steady", "accelerating"):
            assert known(rows_of(other)[0], i) < 1e-4
    # Of the current's cosine across the bow, the mean square is a half.
    assert known(rows, 1) / root_n == pytest.approx(CURRENT / np.sqrt(2.0), rel=0.01)
    # alpha_y is refuted: sqrt(2) times as much as accelerating, but drifting, all of whose
    # current stands across the bow, has sqrt(2) times as much again. Steady has none.
    for other, ratio in (("drifting", np.sqrt(0.5)), ("accelerating", np.sqrt(2.0))):
        its_rows, its_time = rows_of(other)
        per_ping = known(its_rows, 1) / np.sqrt(its_time.size)
        assert known(rows, 1) / root_n == pytest.approx(ratio * per_ping, rel=0.01)
    assert known(rows_of("steady")[0], 1) < 1e-4
    # The only motion of the four that shows six directions.
    assert np.sum(stacked(rows, time).values > 1e-3 * root_n) == 6


def test_the_vertical_lever_arm_takes_sway():
    # Finding 5, "l_z in none of the four", is confirmed: its column is omega x z, zero
    # without roll or pitch rate. (What is left is the transport rate, 6e-7 rad/s.)
    for name in MANOEUVRES:
        rows, time = rows_of(name)
        assert np.linalg.norm(rows[:, :, 6]) < 2e-6 * np.sqrt(time.size)
        assert stacked(rows, time).dominant(6) == ("l_z",)
    for sway in (SWELL, CONING):
        rows, time = rows_of("steady", sway)
        assert known(rows, 6) > 0.01 * np.sqrt(time.size)
        assert stacked(rows, time).values[6] > 1e-3 * np.sqrt(time.size)


def test_a_straight_run_leaves_four_directions_open():
    # By hand: with v constant and omega = 0 the null space of [-[v x], v, 0] is
    # {(alpha along v, 0, 0)} and all of l: [v x] alpha and v k are at right angles, so
    # both must be zero. Rank 7 - 4 = 3.
    rows, time = rows_of("steady")
    matrix = rows.reshape(-1, 7)
    assert np.linalg.matrix_rank(matrix, tol=1e-4) == 3
    found = stacked(rows, time)
    v = np.array([CURRENT, 4.0, 0.0])
    by_hand = np.zeros((4, 7))
    by_hand[0, :3] = v / np.linalg.norm(v)
    by_hand[1:, 4:] = np.eye(3)
    open_ones = found.directions[3:]
    # The same subspace: each basis lies in the span of the other.
    for one, other in ((by_hand, open_ones), (open_ones, by_hand)):
        left, *_ = np.linalg.lstsq(other.T, one.T, rcond=None)
        np.testing.assert_allclose(other.T @ left, one.T, atol=1e-6)
    # And the same basis: single states where single states are open.
    assert [found.dominant(i) for i in (3, 4, 5, 6)] == [
        ("alpha_y",),
        ("l_x",),
        ("l_y",),
        ("l_z",),
    ]


def test_steady_and_turning_together():
    # Segments complete one another: the scale of the straight run is what l_x of the turn
    # lacks.
    straight, straight_time = rows_of("steady")
    turn, turn_time = rows_of("turning")
    both = np.concatenate([straight, turn])
    assert known(both, 4) > 10.0 * known(turn, 4)
    time = np.concatenate([straight_time, turn_time + straight_time[-1] + 0.05])
    parts = (
        Segment(-1.0, straight_time[-1], "steady"),
        Segment(straight_time[-1], time[-1], "turning"),
    )
    single, cumulative = singular_values(both, time, parts, STATES)
    np.testing.assert_allclose(single[1].values, stacked(turn, turn_time).values, atol=1e-6)
    np.testing.assert_allclose(
        cumulative[1].values, np.linalg.svd(both.reshape(-1, 7), compute_uv=False), atol=1e-6
    )
    assert cumulative[1].pings == time.size


def test_what_noise_feigns_is_not_observed():
    time = np.arange(1000.0)
    rng = np.random.default_rng(0)
    v = np.tile([0.0, 4.0, 0.0], (time.size, 1)) + rng.normal(0.0, 0.01, (time.size, 3))
    motion = BodyMotion(time, v, np.zeros_like(v))
    # A DVL of 1 mm/s and a prior of 1 rad: the noise of v looks like 316 changes of course.
    rows = point_set_rows(motion, ALIGNED) / 0.001
    wrong = [
        point_set_rows(replace(motion, v_b=0.0 * v + 0.01 * axis), ALIGNED) / 0.001
        for axis in np.eye(3)
    ]
    spurious = sum(w.transpose(0, 2, 1) @ w for w in wrong)
    whole = [Segment(-1.0, 1e6, "whole")]
    found = singular_values(rows, time, whole, STATES, spurious=spurious)[0][0]
    assert found.values[3] > 300.0
    assert found.dominant(3) == ("alpha_y",)
    assert found.observed.tolist() == [True, True, True, False, False, False, False]
    believed = singular_values(rows, time, whole, STATES)[0][0]
    assert believed.observed[3]


def test_a_readable_basis_spans_the_same():
    rng = np.random.default_rng(0)
    plain = np.zeros((3, 7))
    plain[0, 1] = plain[1, 4] = 1.0
    plain[2, [2, 6]] = 0.8, -0.6
    turned = np.linalg.qr(rng.normal(size=(3, 3)))[0] @ plain
    found = readable_basis(turned)
    for row in plain:
        assert np.any(np.all(np.abs(np.abs(found) - np.abs(row)) < 1e-9, axis=1)), found


def test_a_segment_without_pings():
    rows, time = rows_of("steady")
    segments = (Segment(-1.0, 50.0, "steady"), Segment(1e4, 2e4, "nothing"))
    single, cumulative = singular_values(rows, time, segments, STATES)
    assert single[1].pings == 0
    assert not single[1].values.any()
    assert cumulative[1].values == pytest.approx(cumulative[0].values)


def test_pings_at_a_border_stand_with_neither_side():
    rows, time = rows_of("steady")
    turn, _ = rows_of("turning")
    rows[1000:] = turn[5:6]
    parts = (Segment(-1.0, 50.1, "steady"), Segment(50.1, 1e6, "turning"))
    for margin, observed in ((0.0, 5), (5.0, 3)):
        single, cumulative = singular_values(rows, time, parts, STATES, margin=margin)
        assert np.sum(single[0].values > 1e-3) == observed
        assert cumulative[1].pings == time.size
    assert single[0].pings + single[1].pings == time.size - 200
