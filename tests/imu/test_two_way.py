"""Motion between two nodes: no jump in value or slope, and what the noise leaves of it."""

from __future__ import annotations

import numpy as np
import pytest
from jacobians import differentiate
from problems import SHORT, problem_of
from truth import scenario

from factorgraph_dvl.imu.two_way import attach_two_way, noise_averaged, noise_between, noise_curved

CLOCKS = {
    "imu": {"accel_noise_ug_sqrt_hz": 500.0},
    "dvl": {"time_offset_std_s": 0.1},
    "gnss": {"time_offset_std_s": 0.1},
}


@pytest.fixture(scope="module", params=["mean", "instantaneous"])
def noisy(request):
    """Return a problem away from its minimum, where IMU and nodes do not agree."""
    scene = scenario(manoeuvres=SHORT, noise=True, trial=CLOCKS, imu={"sampling": request.param})
    problem, values = problem_of(scene)
    return problem, problem.weighed(problem.evaluate(values))


@pytest.mark.parametrize("clock", ["time_offset_s", "gnss_time_offset_s"])
@pytest.mark.parametrize("place", [0.0, 0.005, -0.4], ids=["node", "in a sample", "others"])
def test_the_cost_has_no_jump_in_value_or_slope(noisy, clock, place):
    problem, evaluation = noisy

    def residuals(late):
        at = evaluation.parameters | {clock: np.array([place + late])}
        found = problem.evaluate(problem.values(evaluation.states, at)).residuals
        return np.concatenate([each.ravel() for each in found])

    here = residuals(0.0)

    def cost(late):
        # Less that at the place: a difference of two costs has no digits left.
        there = residuals(late)
        return 0.5 * float((there - here) @ (there + here))

    # Beyond what rounds times to samples. Slopes at d and 2 d on both sides, taken to 0.
    d = 2e-5
    slope = {
        side: [
            side * (cost(side * k * d * 1.1) - cost(side * k * d * 0.9)) / (0.2 * k * d)
            for k in (1, 2)
        ]
        for side in (-1, 1)
    }
    before, after = (2.0 * near - far for near, far in (slope[-1], slope[1]))
    # Of what the slope would be if no residual made up for another.
    changing = (residuals(2.0 * d) - residuals(d)) / d
    size = float(np.linalg.norm(changing) * np.linalg.norm(here))
    assert abs(cost(2e-6) - cost(-2e-6) - 4e-6 * before) < 1e-6 * float(here @ here)
    assert abs(after - before) < 1e-6 * size


@pytest.mark.parametrize("clock", ["time_offset_s", "gnss_time_offset_s"])
def test_derivatives_by_a_clock_are_those_of_residuals(noisy, clock):
    assert_derivatives(*noisy, clock)


def assert_derivatives(problem, evaluation, clock):
    at = evaluation.parameters | {clock: np.array([0.0437])}
    here = problem.evaluate(problem.values(evaluation.states, at))
    for k, bound in enumerate(problem.bound):
        if clock not in bound.clocks:
            continue

        def residual(h, k=k):
            moved = at | {clock: at[clock] + h}
            return problem.evaluate(problem.values(evaluation.states, moved)).residuals[k]

        expected = differentiate(residual, 1, 1e-6)
        (rows,) = (
            r for r in problem.observation_rows(here) if r.source == bound.observation.label
        )
        place = list(rows.keys[0]).index(problem.key(clock))
        first = sum(rows.sizes[:place])
        found = rows.matrix[:, :, first : first + 1]
        assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()


def test_at_nodes_the_motion_is_theirs(noisy):
    problem, evaluation = noisy
    seg, states = problem.chain.segments, evaluation.states
    at = attach_two_way(seg, seg.node_time, problem.chain.frame.earth_rate)
    motion = problem.chain.motion(at, states)
    np.testing.assert_allclose(motion.p_n, states.p_n, atol=1e-8)
    np.testing.assert_allclose(motion.v_n, states.v_n, atol=1e-8)
    np.testing.assert_allclose(motion.nRb, states.nRb, atol=1e-10)
    # Transposed, attitudes of 30 deg are not theirs.
    assert np.abs(motion.nRb.transpose(0, 2, 1) - states.nRb).max() > 0.1


def test_windows_average_noise_by_hand_and_by_chance(noisy):
    """In a second: a sixth of 0.3 s half way, and none at a node; and of walks drawn."""
    problem, _ = noisy
    seg, rate = problem.chain.segments, problem.chain.frame.earth_rate
    begin, span = seg.node_time[1], seg.duration[1]
    tau = np.array([0.0, 0.1, 0.25, 0.5, 0.8]) * span
    at = attach_two_way(seg, begin + tau, rate)
    np.testing.assert_allclose(noise_averaged(at, 0.3)[3], 0.3 / 6.0, rtol=1e-6)
    assert noise_averaged(at, 0.3)[0] == 0.0
    np.testing.assert_allclose(
        noise_curved(at, 0.1), np.minimum(np.minimum(tau, span - tau), 0.1), atol=1e-6
    )
    # From two seconds before the node to two after the next.
    steps, dt = np.arange(-2.0, 3.0 * span, 0.01), 0.01
    rng = np.random.default_rng(0)
    walk = np.cumsum(np.sqrt(dt) * rng.standard_normal((20_000, steps.size)), axis=1)
    walk -= walk[:, [int(np.argmin(np.abs(steps)))]]
    there = walk[:, int(np.argmin(np.abs(steps - span)))]
    for length in (0.3, 1.6):
        for i, t in enumerate(tau):
            inside = np.abs(steps - t) <= 0.5 * length + 1e-9
            left = walk[:, inside].mean(axis=1) - at.share[i] * there
            taken = noise_between(at)[i] - np.mean(left**2)
            assert noise_averaged(at, length)[i] == pytest.approx(max(taken, 0.0), abs=0.01)


def test_half_way_it_is_the_mean_of_both_and_a_quarter_of_the_noise_by_hand(noisy):
    problem, evaluation = noisy
    chain, states = problem.chain, evaluation.states
    seg = chain.segments
    middle = seg.node_time[:-1] + 0.5 * np.diff(seg.node_time)
    at = attach_two_way(seg, middle, chain.frame.earth_rate)
    np.testing.assert_allclose(at.share, 0.5)
    np.testing.assert_allclose(noise_between(at), 0.25 * seg.duration)
    # Velocities carried from either side differ by as much as the nodes disagree.
    whole = seg.ends
    pushed = np.einsum("kij,kj->ki", states.nRb[:-1], whole.dV)
    miss = states.v_n[1:] - states.v_n[:-1] - pushed - chain.gravity_n * seg.duration[:, None]
    forward = np.einsum("kij,kj->ki", states.nRb[:-1], at.forward.dV)
    forward += states.v_n[:-1] + 0.5 * chain.gravity_n * seg.duration[:, None]
    # To what attitudes of 0.01 rad that differ do to 9.8 m/s² in half a second.
    found = chain.motion(at, states).v_n - forward
    np.testing.assert_allclose(found, 0.5 * miss, atol=0.12)
    assert np.abs(found).max() > 0.01
