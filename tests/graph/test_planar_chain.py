"""The planar chain: zero error at the truth, Jacobians, one motion by hand, GTSAM's optimisers."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from planar import ALL_CONSTANTS, evaluation_of, setup_of, trial, true_state

from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.planar_chain import EARTH_RADIUS, PlanarChain, Recorded
from factorgraph_dvl.sensors.protocol import Linearization
from factorgraph_dvl.sensors.speed_log import LogVelocity
from factorgraph_dvl.solvers.levenberg_marquardt import factorized, minimise

LAT, LON = 0.4, 2.3


def chain_of(frame, body_axes="FRD"):
    """Return two nodes two seconds apart, heading east, 3 m below the frame's origin."""
    time = np.array([0.0, 1.0, 2.0])
    recorded = Recorded(
        time,
        np.radians([90.0, 90.0, 90.0]),
        frame.height - np.array([3.0, 4.0, 5.0]),
        -np.ones(3),
        0.01,
        0.2,
        0.03,
    )
    density = np.array([[[0.3, 0.1], [0.1, 0.2]]])
    start = np.zeros(4)
    return PlanarChain(
        frame, time[[0, 2]], density, recorded, start, np.array([10.0, 10.0, 5.0, 5.0]), body_axes
    )


def test_a_motion_by_hand():
    frame = setup_of(trial()).chain.frame
    chain = chain_of(frame)
    # From rest to 2 m/s to the east, the velocity linear in time.
    states = chain.with_recorded(
        chain.node_time, np.array([[100.0, 0.0, 0.0, 0.0], [102.0, 0.0, 2.0, 0.0]])
    )
    motion = chain.motion(chain.attach(np.array([1.0])), states)
    down = 100.5**2 / (2.0 * EARTH_RADIUS)
    np.testing.assert_allclose(motion.p_n, [[100.5, 0.0, -4.0 - down]], atol=1e-9)
    np.testing.assert_allclose(motion.v_n, [[1.0, 0.0, -1.0]], atol=1e-12)
    np.testing.assert_allclose(motion.a_n, [[1.0, 0.0, 0.0]], atol=1e-12)
    # The bow points to the east, but for the meridians; a transposed attitude would point to
    # the west.
    np.testing.assert_allclose(motion.nRb[0, :, 0], [1.0, 0.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(motion.nRb[0, :, 1], [0.0, -1.0, 0.0], atol=1e-4)
    # An acceleration of 1 m/s² over 2 s is what the prior's steps are: by hand, isotropic.
    flat = replace(chain, density=np.eye(2)[None] * 0.5)
    (step,) = flat.steps(states)
    # Only the change of the velocity is unlikely: 2² / (0.5 2 s), the shift follows from it.
    assert np.sum(step.residual**2) == pytest.approx(2.0**2 / (0.5 * 2.0))


def test_what_nodes_leave_open_by_hand():
    chain = chain_of(setup_of(trial()).chain.frame)
    at = chain.attach(np.array([1.0, 0.0]))
    zero, east, up = np.zeros((2, 1, 3)), np.eye(3)[None, :1], np.eye(3)[None, 2:]
    # In the middle of a span T: T³ / 192 of the density for a position, nothing at a node.
    found = chain.missing(at, Linearization(zero[..., 0], d_p=np.tile(east, (2, 1, 1))))
    np.testing.assert_allclose(found, [[0.3 * 8.0 / 192.0], [0.0]], atol=1e-15)
    found = chain.missing(at, Linearization(zero[..., 0], d_p=np.tile(up, (2, 1, 1))))
    np.testing.assert_allclose(found, 0.2**2)
    found = chain.missing(at, Linearization(zero[..., 0], d_v=np.tile(up, (2, 1, 1))))
    np.testing.assert_allclose(found, 0.03**2)
    found = chain.missing(at, Linearization(zero[..., 0], d_theta=np.tile(up, (2, 1, 1))))
    np.testing.assert_allclose(found, 0.01**2)


@pytest.mark.parametrize("body_axes", ["FRD", "RFU"])
def test_jacobians_of_the_motion_against_differences(body_axes):
    chain = chain_of(setup_of(trial()).chain.frame, body_axes)
    rng = np.random.default_rng(1)
    x = rng.normal(0.0, [300.0, 300.0, 2.0, 2.0], (2, 4))
    at = chain.attach(np.array([0.3, 1.0, 1.9]))

    here = chain.motion(at, chain.with_recorded(chain.node_time, x)).nRb

    def motion(x):
        m = chain.motion(at, chain.with_recorded(chain.node_time, x))
        turned = log_so3(here.transpose(0, 2, 1) @ m.nRb)
        return np.hstack([1e4 * turned, m.p_n, m.v_n])

    found = chain.transition(at, chain.with_recorded(chain.node_time, x)).by_nodes
    for i in range(8):
        h = np.zeros(8)
        h[i] = 1.0
        expected = (motion(x + h.reshape(2, 4)) - motion(x - h.reshape(2, 4))) / 2.0
        # Meridians turn by 1e-7 rad in a metre.
        own = found[:, :, i] * np.repeat([1e4, 1.0, 1.0], 3)
        np.testing.assert_allclose(own, expected, atol=1e-6)


def test_the_log_by_hand_and_against_differences():
    chain = chain_of(setup_of(trial()).chain.frame)
    x = np.array([[0.0, 0.0, 3.0, 1.0], [6.0, 2.0, 3.0, 1.0]])
    motion = chain.motion(chain.attach(np.array([1.0])), chain.with_recorded(chain.node_time, x))
    log = LogVelocity(np.array([1.0]), np.zeros((1, 2)), np.ones((1, 2)), "FRD")
    values = {
        "log_scale_error": np.array([0.1]),
        "heading_bias_deg": np.zeros(1),
        "current_m_s": np.array([0.5, 0.0]),
    }
    # Heading east: 2.5 m/s ahead, 1 m/s to the north is to port.
    np.testing.assert_allclose(log.residual(motion, values), [[2.75, -1.1]], atol=1e-4)
    # A heading that is 90 degrees too large: the bow was to the north.
    north = values | {"heading_bias_deg": np.array([np.pi / 2.0])}
    np.testing.assert_allclose(log.residual(motion, north), [[1.1, 2.75]], atol=1e-4)
    values |= {"heading_bias_deg": np.array([0.2])}
    lin = log.linearize(motion, values, tuple(values))
    for name, jacobian in lin.d_parameters.items():
        for i in range(jacobian.shape[2]):
            h = 1e-6 * np.eye(jacobian.shape[2])[i]
            ends = [log.residual(motion, values | {name: values[name] + s * h}) for s in (1, -1)]
            np.testing.assert_allclose(jacobian[:, :, i], (ends[0] - ends[1]) / 2e-6, atol=1e-8)
    for i in range(3):
        h = 1e-6 * np.eye(3)[i]
        ends = [log.residual(replace(motion, v_n=motion.v_n + s * h), values) for s in (1, -1)]
        np.testing.assert_allclose(lin.d_v[:, :, i], (ends[0] - ends[1]) / 2e-6, atol=1e-8)
        turned = [
            log.residual(replace(motion, nRb=motion.nRb @ exp_so3(s * h)), values) for s in (1, -1)
        ]
        expected = (turned[0] - turned[1]) / 2e-6
        np.testing.assert_allclose(lin.d_theta[:, :, i], expected, atol=1e-8)


@pytest.mark.parametrize("constant", ["heading", "beacons"])
def test_zero_error_at_the_truth(constant):
    # The lever arm lies along the heading as it is measured, so not both at once.
    others = {name: ALL_CONSTANTS[name] for name in ("log", constant)}
    t = trial(noise=False, **others)
    setup = setup_of(t)
    problem, at = evaluation_of(t, setup, *true_state(t, setup))
    # The turn is abrupt: where it begins and ends, halfway between samples, the motion misses by
    # centimetres, and the reference is interpolated as well.
    for o, residual, weight in zip(
        problem.observations, at.residuals, problem.weights, strict=True
    ):
        off = np.abs(residual / np.maximum(weight, 1e-9))[2:-2]
        assert np.median(off) < 2e-3, o.label
        assert off.max() < (2e-2 if o.unit == "m" else 6e-2), o.label


def small():
    t = trial(1, **ALL_CONSTANTS)
    setup = setup_of(t)
    x, values = true_state(t, setup)
    problem, at = evaluation_of(t, setup, x[:60], values)
    return problem, at


def test_cost_and_jacobians_of_the_native_graph():
    problem, at = small()
    graph, start = problem.nonlinear_graph()
    assert graph.error(start) == pytest.approx(at.cost, rel=1e-12)
    ordering = problem.ordering()
    expected, _ = problem.linearize(at).hessian(ordering)
    found, _ = graph.linearize(start).hessian(ordering)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((found - expected) / scale).max() < 1e-9


def test_gtsams_own_optimisers_and_marginals_agree():
    problem, at = small()
    graph, start = problem.nonlinear_graph()
    strict = gtsam.LevenbergMarquardtParams()
    strict.setRelativeErrorTol(1e-12)
    strict.setAbsoluteErrorTol(1e-9)
    strict.setMaxIterations(50)
    strict.setLinearSolverType("MULTIFRONTAL_QR")
    found = gtsam.LevenbergMarquardtOptimizer(graph, start, strict).optimize()
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.setRelinearizeThreshold(1e-9)
    parameters.relinearizeSkip = 1
    isam = gtsam.ISAM2(parameters)
    isam.update(graph, start)
    for _ in range(8):
        isam.update()
    # Weights are those of the start in all.
    minimum = minimise(problem, at.values, stage="test", tolerance=1e-9)
    best = minimum.evaluation
    information, _ = factorized(problem, best)
    every = [keys.node(0), keys.node(30), keys.node(59)]
    every += [problem.key(p.name) for p in problem.parameters]
    own = information.marginals(every)
    marginals = gtsam.Marginals(graph, best.values)
    for key in every:
        sigma = np.sqrt(np.diag(own[key]))
        native = np.sqrt(np.diag(marginals.marginalCovariance(key)))
        np.testing.assert_allclose(native, sigma, rtol=0.01)
        np.testing.assert_allclose(
            np.sqrt(np.diag(isam.marginalCovariance(key))), sigma, rtol=0.01
        )
        for other in (found, isam.calculateEstimate()):
            off = other.atVector(key) - best.values.atVector(key)
            assert np.abs(off / sigma).max() < 0.01
