"""The incremental smoother against GTSAM's own."""

from __future__ import annotations

import gtsam
import numpy as np

from factorgraph_dvl.graph import keys
from factorgraph_dvl.replay.smoother import Smoother


def chain_of_states(count):
    """A prior, and for each further state a factor to the one before and a measurement."""
    prior, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    bias = gtsam.imuBias.ConstantBias()
    state = gtsam.NavState()
    loose = gtsam.noiseModel.Isotropic.Sigma
    prior.add(gtsam.PriorFactorNavState(keys.node(0), state, loose(9, 0.1)))
    prior.add(gtsam.PriorFactorConstantBias(keys.bias(0), bias, loose(6, 1e-3)))
    values.insert(keys.node(0), state)
    values.insert(keys.bias(0), bias)
    params = gtsam.PreintegrationParams.MakeSharedU(9.8)
    params.setGyroscopeCovariance(1e-6 * np.eye(3))
    params.setAccelerometerCovariance(1e-4 * np.eye(3))
    params.setIntegrationCovariance(1e-8 * np.eye(3))
    pim = gtsam.PreintegratedImuMeasurementsG(params)
    for _ in range(20):
        pim.integrateMeasurement(np.array([0.3, 0.1, 9.9]), np.array([0.05, 0.1, 0.2]), 0.01)
    rng = np.random.default_rng(1)
    steps = []
    for k in range(1, count):
        graph, new = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.add(gtsam.GalileanImuFactor2(keys.node(k - 1), keys.node(k), keys.bias(0), pim))
        state = pim.predict(state, bias)
        noisy = state.retract(rng.normal(0.0, 0.05, 9))
        graph.add(gtsam.PriorFactorNavState(keys.node(k), noisy, loose(9, 0.1)))
        new.insert(keys.node(k), state)
        steps.append((0.2 * k, graph, new))
    return prior, values, steps


def test_the_lag_is_that_of_the_incremental_fixed_lag_smoother():
    prior, values, steps = chain_of_states(60)
    ours = Smoother(prior, values, node=0, time=0.0, parameters=(), walking=False, lag=4.0)
    settings = gtsam.ISAM2Params()
    settings.setFactorization("QR")
    settings.relinearizeSkip = 1
    settings.setRelinearizeThreshold(1e-3)
    theirs = gtsam.IncrementalFixedLagSmoother(4.0, settings)
    bias = keys.bias(0)
    theirs.update(prior, values, {keys.node(0): 0.0, bias: 0.0})
    for k, (time, graph, new) in enumerate(steps, start=1):
        ours.extend(time, graph, new)
        theirs.update(graph, new, {keys.node(k): time, bias: time})
    k = len(steps)
    sigma = np.sqrt(np.diag(theirs.marginalCovariance(keys.node(k))))
    P = ours.joint_covariance()
    np.testing.assert_allclose(np.sqrt(np.diag(P))[:9], sigma, rtol=1e-3)
    apart = theirs.calculateEstimateNavState(keys.node(k)).localCoordinates(ours.state(k))
    assert np.abs(apart / sigma).max() < 0.02
    assert len(ours.times) == len(theirs.timestamps()) - 1
    old = ours.oldest + 3
    found = ours.state_covariances([old])[0]
    np.testing.assert_allclose(
        np.sqrt(np.diag(found)),
        np.sqrt(np.diag(theirs.marginalCovariance(keys.node(old)))),
        rtol=1e-3,
    )


def test_covariances_of_all_states_are_their_marginals_where_biases_walk():
    prior, values, steps = chain_of_states(12)
    walk = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
    none = gtsam.imuBias.ConstantBias()
    ours = Smoother(prior, values, node=0, time=0.0, parameters=(), walking=True, lag=100.0)
    whole = gtsam.NonlinearFactorGraph(prior)
    for k, (time, graph, new) in enumerate(steps):
        imu, measured = graph.at(0), graph.at(1)
        own = gtsam.NonlinearFactorGraph()
        x, y, b = keys.node(k), keys.node(k + 1), keys.bias(k)
        own.add(gtsam.GalileanImuFactor2(x, y, b, imu.preintegratedMeasurements()))
        own.add(gtsam.BetweenFactorConstantBias(b, keys.bias(k + 1), none, walk))
        own.add(measured)
        new.insert(keys.bias(k + 1), none)
        ours.extend(time, own, new)
        whole.push_back(own)
    marginals = gtsam.Marginals(whole, ours._isam.getLinearizationPoint())
    found = ours.state_covariances(list(ours.times))
    assert len(found) == 12
    for k, P in zip(ours.times, found, strict=True):
        np.testing.assert_allclose(P, marginals.marginalCovariance(keys.node(k)), atol=1e-9)


def test_a_range_is_linearised_where_the_position_is_found_to_be():
    """A vehicle 30 m off its reckoned place hears two beacons after a long outages."""
    sigma = 0.5

    def range_of_100_m(beacon):
        def error(this, at, jacobians):
            state = at.atNavState(keys.node(0))
            away = state.position() - beacon
            distance = np.linalg.norm(away)
            if jacobians is not None:
                J = np.zeros((1, 9))
                J[0, 3:6] = away / distance @ state.attitude().matrix()
                jacobians[0] = np.asfortranarray(J / sigma)
            return np.array([(distance - 100.0) / sigma])

        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [keys.node(0)], error)

    diagonal = gtsam.noiseModel.Diagonal.Sigmas
    bias = gtsam.imuBias.ConstantBias()
    prior, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    begun = gtsam.NavState(gtsam.Rot3(), np.array([0.0, 30.0, 0.0]), np.zeros(3))
    known = np.full(3, 1e-3)
    sigmas = np.concatenate([known, [5.0, 40.0, 1e-3], known])
    prior.add(gtsam.PriorFactorNavState(keys.node(0), begun, diagonal(sigmas)))
    prior.add(gtsam.PriorFactorConstantBias(keys.bias(0), bias, diagonal(np.full(6, 1e-3))))
    values.insert(keys.node(0), begun)
    values.insert(keys.bias(0), bias)
    smoother = Smoother(
        prior, values, node=0, time=0.0, parameters=(), walking=False, lag=30.0, ranges=True
    )
    for k in range(1, 6):
        graph, new = gtsam.NonlinearFactorGraph(), gtsam.Values()
        still = diagonal(np.full(9, 1e-3))
        graph.add(
            gtsam.BetweenFactorNavState(keys.node(k - 1), keys.node(k), gtsam.NavState(), still)
        )
        if k == 1:
            for place in ([100.0, 0.0, 0.0], [0.0, -100.0, 0.0]):
                graph.add(range_of_100_m(np.array(place)))
        new.insert(keys.node(k), smoother.state(k - 1))
        smoother.extend(float(k), graph, new)
    # Linearised at the reckoned place, it ends 4 m off.
    assert np.abs(smoother.state(5).position()).max() < sigma


def test_the_oldest_state_stays_a_leaf_when_old_states_are_corrected():
    prior, values, steps = chain_of_states(80)
    smoother = Smoother(prior, values, node=0, time=0.0, parameters=(), walking=False, lag=4.0)
    for k, (time, graph, new) in enumerate(steps, start=1):
        smoother.extend(time, graph, new)
        late = gtsam.NonlinearFactorGraph()
        old = max(smoother.oldest + k % 15, 0)
        if old <= smoother.node:
            noise = gtsam.noiseModel.Isotropic.Sigma(9, 0.5)
            late.add(gtsam.PriorFactorNavState(keys.node(old), smoother.state(old), noise))
            smoother.correct(late, old)
    assert len(smoother.times) == 21


def test_what_is_kept_of_old_states_is_what_the_tree_has():
    prior, values, steps = chain_of_states(60)
    smoother = Smoother(prior, values, node=0, time=0.0, parameters=(), walking=False, lag=4.0)
    for time, graph, new in steps:
        smoother.extend(time, graph, new)
    wanted = list(smoother.times)
    kept = smoother.state_covariances(wanted)
    estimates = smoother.states(wanted)
    # A correction that says nothing makes it look again.
    none = gtsam.noiseModel.Isotropic.Sigma(9, 1e9)
    nothing = gtsam.NonlinearFactorGraph()
    nothing.add(gtsam.PriorFactorNavState(keys.node(wanted[5]), smoother.state(wanted[5]), none))
    smoother.correct(nothing, wanted[5])
    np.testing.assert_allclose(smoother.state_covariances(wanted), kept, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(smoother.states(wanted).p_n, estimates.p_n, atol=1e-9)
