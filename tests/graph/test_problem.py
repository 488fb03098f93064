"""The graph: bulk-linearised blocks, cost, rows, arcs, biases, priors."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from problems import ALL_FREE, IMU_ERRORS, SHORT, prior_cost, problem_of, walking
from truth import scenario

from factorgraph_dvl.geometry.rotations import exp_so3, rotation_from_rph
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.clocks import parameters_of, true_time
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.sensors.imu import ERRORS
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.levenberg_marquardt import factorized


def measurement_factors(problem, gaussian):
    return [gaussian.at(i) for i in range(problem.graph.size(), gaussian.size())]


def rows_by_factor(problem, evaluation):
    """Which whitened residuals stand in which measurement factor, in their order.

    One factor per node and set of parameters, its measurements in the order of the
    observations: the layout that `Problem` documents.
    """
    groups = {}
    for i, (o, at) in enumerate(zip(problem.observations, evaluation.attached, strict=True)):
        own = (*parameters_of(o), *ERRORS)
        names = tuple(p.name for p in problem.parameters if p.name in own)
        groups.setdefault(names, []).append((i, at.node))
    out = []
    for names, members in groups.items():
        for k in np.unique(np.concatenate([node for _, node in members])):
            out.append((names, int(k), [(i, np.flatnonzero(node == k)) for i, node in members]))
    return out


def stacked(evaluation, members):
    return np.concatenate([evaluation.residuals[i][rows].ravel() for i, rows in members])


def keyed(problem, names, k):
    around = problem.chain.variables(np.array([[k]]))
    return [*(int(key[0]) for key in around), *(problem.key(n) for n in names)]


def jacobians(problem, evaluation):
    factors = measurement_factors(problem, problem.linearize(evaluation))
    return [factor.augmentedJacobian() for factor in factors]


def test_measurements_at_the_same_times_are_attached_once():
    problem, values = problem_of(scenario(manoeuvres=SHORT, trial=ALL_FREE))
    here = problem.evaluate(values)
    at = problem.arrays(values)[1] | {"time_offset_s": np.array([0.01])}
    moved = problem.evaluate(problem.values(here.states, at))
    other = Problem(problem.chain, problem.observations, problem.all_parameters)
    again = other.evaluate(values)
    for o, one, two, three in zip(
        problem.observations, here.attached, moved.attached, again.attached, strict=True
    ):
        assert (one is two) == (o.label != "DVL velocity")
        assert one is three


def test_released_factors_come_back_the_same():
    problem, values = problem_of(scenario(manoeuvres=SHORT, trial={"imu": IMU_ERRORS}))
    problem.weigh(problem.evaluate(values))
    evaluation = problem.evaluate(values)
    before = jacobians(problem, evaluation)
    problem.release()
    after = jacobians(problem, evaluation)
    for a, b in zip(before, after, strict=True):
        np.testing.assert_array_equal(a, b)


def test_rows_of_some_measurements_at_a_time_are_those_of_all(monkeypatch):
    problem, values = problem_of(scenario(manoeuvres=SHORT, trial=ALL_FREE | {"imu": IMU_ERRORS}))
    problem.weigh(problem.evaluate(values))
    evaluation = problem.evaluate(values)
    at_once = jacobians(problem, evaluation)
    problem.release()
    for module in ("factor_layout", "measurement_factors"):
        monkeypatch.setattr(f"factorgraph_dvl.graph.{module}.CHUNK", 7)
    in_parts = jacobians(problem, evaluation)
    for a, b in zip(at_once, in_parts, strict=True):
        np.testing.assert_array_equal(a, b)


def test_nothing_holds_factors_that_are_eliminated():
    problem, values = problem_of(scenario(manoeuvres=SHORT))
    problem.weigh(problem.evaluate(values))
    evaluation = problem.evaluate(values)
    before = factorized(problem, evaluation)[1]
    assert not any(block.factors for block in problem._factors.blocks)
    after = factorized(problem, evaluation)[1]
    assert after.equals(before, 0.0)


def test_noise_that_a_window_averages_has_a_gradient():
    """Half of Σ density (L / 6) / σ², for pings far from nodes: and the same in the graph."""
    means = {"dvl": ALL_FREE["dvl"] | {"averaging_s": 0.2, "averaging_std_s": 0.1}}
    problem, values = problem_of(scenario(manoeuvres=SHORT, trial=ALL_FREE | means))
    problem.weigh(problem.evaluate(values))
    at = problem.evaluate(values)
    own = problem.columns["averaging_s"]
    gradient = problem.tilt.gradient[own]
    (i,) = (i for i, o in enumerate(problem.observations) if o.averaging == "averaging_s")
    density = problem.chain.imu.accel_noise_root_psd**2
    most = 0.5 * np.sum(problem.weights[i] ** 2) * density / 6.0
    assert 0.3 * most < gradient < 1.1 * most
    assert not np.delete(problem.tilt.gradient, np.arange(own.start, own.stop)).any()

    def there():
        moved = problem.values(at.states, at.parameters | {"averaging_s": np.array([0.3])})
        slope = problem.linearize(at).gradientAtZero().at(problem.key("averaging_s"))[0]
        return np.array([problem.evaluate(moved).cost, slope])

    tilted, problem.tilt = there(), None
    # The cost counts from what is stated.
    expected = gradient[0] * np.array([0.3 - 0.2, 1.0])
    np.testing.assert_allclose(tilted - there(), expected, rtol=0.02)


@pytest.mark.parametrize("kind", ["constant", "walking", "IMU errors", "means"])
def test_blocks_equal_custom_factors_with_numerical_jacobians(kind):
    more = {"imu": IMU_ERRORS} if kind == "IMU errors" else {}
    if kind == "means":
        more = {"dvl": ALL_FREE["dvl"] | {"averaging_s": 0.4, "averaging_std_s": 0.1}}
    scene = walking() if kind == "walking" else scenario(manoeuvres=SHORT, trial=ALL_FREE | more)
    problem, values = problem_of(scene)
    assert problem.chain.walking == (kind == "walking")
    problem.weigh(problem.evaluate(values))
    # That of a window is a factor of its own.
    problem.tilt = None
    evaluation = problem.evaluate(values)
    factors = measurement_factors(problem, problem.linearize(evaluation))
    layout = rows_by_factor(problem, evaluation)
    assert len(factors) == len(layout)
    dims = values.dims()
    clocks = {problem.key(p.name) for p in problem.parameters if p.name.endswith("offset_s")}

    def whitened(members, key, h):
        delta = gtsam.VectorValues()
        delta.insert(key, h)
        return stacked(problem.evaluate(values.retract(delta)), members)

    checked = 0
    # One node in turns with every kind of measurement, and the first.
    for factor, (names, k, members) in zip(factors, layout, strict=True):
        if k not in (0, 5):
            continue
        checked += 1
        wanted = keyed(problem, names, k)
        assert list(factor.keys()) == wanted

        def error(this, at, jacobians, members=members, wanted=wanted):
            if jacobians is not None:
                for i, key in enumerate(wanted):
                    columns = []
                    # States are known to 1e-3; the bias of a gyro shifts them by 1e-6.
                    # The motion bends where a sample ends, as pings are, so that differences in
                    # time must be short.
                    size = 1e-6 if key in clocks else 1e-5
                    for j in range(dims[key]):
                        h = np.zeros(dims[key])
                        h[j] = size
                        ahead, behind = whitened(members, key, h), whitened(members, key, -h)
                        columns.append((ahead - behind) / (2.0 * size))
                    jacobians[i] = np.asfortranarray(np.stack(columns, axis=1))
            return stacked(problem.evaluate(at), members)

        noise = gtsam.noiseModel.Unit.Create(factor.rows())
        custom = gtsam.CustomFactor(noise, wanted, error).linearize(values)
        np.testing.assert_allclose(factor.getb(), custom.getb(), atol=1e-9)
        scale = np.maximum(np.abs(custom.getA()).max(axis=0), 1.0)
        # The derivative by the gyro bias is that of a motion of constant rate and force;
        # the Earth's rate times what a bias moves in a segment is left out: 1e-4.
        # Means are sums over samples, their derivatives by time and length are of the motion.
        tolerance = 1e-3 if kind == "means" else 2e-4
        assert (np.abs(factor.getA() - custom.getA()) / scale).max() < tolerance
    assert checked == 4
    problem.evaluate(values)


def test_the_linear_cost_with_imu_errors_is_that_of_the_evaluations():
    problem, values = problem_of(scenario(manoeuvres=SHORT, trial=ALL_FREE | {"imu": IMU_ERRORS}))
    problem.weigh(problem.evaluate(values))
    evaluation = problem.evaluate(values)
    gaussian = problem.linearize(evaluation)
    rng = np.random.default_rng(1)
    sigma = {problem.key(p.name): p.sigma for p in problem.parameters if p.name in ERRORS}
    step = gtsam.VectorValues()
    for key, size in values.dims().items():
        step.insert(key, 1e-3 * rng.normal(0.0, sigma.get(key, np.full(size, 1e-6))))
    zero = gtsam.VectorValues.Zero(step)
    assert gaussian.error(zero) == pytest.approx(evaluation.cost, rel=1e-9)
    change = problem.evaluate(values.retract(step)).cost - evaluation.cost
    assert abs(change) > 1e-3
    assert gaussian.error(step) - gaussian.error(zero) == pytest.approx(change, rel=0.02)


def test_cost_is_the_sum_of_squares_by_hand():
    problem, values = problem_of(scenario(manoeuvres=SHORT, trial=ALL_FREE))
    problem.weigh(problem.evaluate(values))
    evaluation = problem.evaluate(values)
    by_hand = sum(problem.graph.at(i).error(values) for i in range(problem.graph.size()))
    settings = problem.chain.imu
    for o, at, motion, weight in zip(
        problem.observations,
        evaluation.attached,
        evaluation.motions,
        problem.weights,
        strict=True,
    ):
        sigma = o.sigma(motion, evaluation.parameters)
        lin = o.linearize(motion, evaluation.parameters, ())
        if lin.d_v is not None:
            # White noise between two nodes, of force as velocity and of rate as angle: half-way a
            # quarter of what it is from node to node.
            sigma2 = settings.accel_noise_root_psd**2 * np.sum(lin.d_v**2, axis=2)
            sigma2 += settings.gyro_noise_root_psd**2 * np.sum(lin.d_theta**2, axis=2)
            to, rest, s = at.forward.tau, -at.backward.tau, at.share
            sigma = np.sqrt(sigma**2 + ((1 - s) ** 2 * to + s**2 * rest)[:, None] * sigma2)
        used = weight[:, 0] > 0.0
        assert used.all()
        np.testing.assert_allclose(weight[used], 1.0 / sigma[used])
        residual = o.residual(motion, evaluation.parameters)
        by_hand += 0.5 * np.sum((residual / sigma)[used] ** 2)
    assert evaluation.cost == pytest.approx(by_hand, rel=1e-12)
    gaussian = problem.linearize(evaluation)
    zero = gtsam.VectorValues.Zero(gtsam.VectorValues())
    for key, size in values.dims().items():
        zero.insert(key, np.zeros(size))
    assert gaussian.error(zero) == pytest.approx(by_hand, rel=1e-9)


@pytest.mark.parametrize("gap", [None, (3.0, 5.0)])
def test_every_measurement_has_its_rows_once(gap):
    imu = {} if gap is None else {"gaps_s": [list(gap)]}
    scene = scenario(manoeuvres=SHORT, imu=imu, trial=ALL_FREE)
    problem, values = problem_of(scene)
    trial_end = problem.chain.segments.node_time[-1]
    problem.weigh(problem.evaluate(values))
    evaluation = problem.evaluate(values)
    factors = measurement_factors(problem, problem.linearize(evaluation))
    b = np.sort(np.concatenate([-f.getb() for f in factors]))
    expected = np.sort(np.concatenate([r.ravel() for r in evaluation.residuals]))
    np.testing.assert_allclose(b, expected, atol=1e-12)
    for o, weight in zip(problem.observations, problem.weights, strict=True):
        # The sample at the end of a gap averages over its own period only.
        time = true_time(o, evaluation.parameters, problem.clock_zero)
        covered = np.ones(time.size, dtype=bool)
        if gap is not None:
            covered = ~((time > gap[0] - 0.005) & (time < gap[1] - 0.005))
        covered &= (time >= 0.0) & (time <= trial_end)
        # Rounding and, at a gap, the period of a sample.
        ends = np.array([0.0, trial_end, *(gap or ())])
        far = np.min(np.abs(time[:, None] - ends), axis=1) > 0.02
        assert np.all((weight[:, 0] > 0.0)[far] == covered[far])
        assert problem.uncovered.get(o.label, 0) == int((weight[:, 0] == 0.0).sum())
    if gap is not None:
        assert len(problem.chain.segments.arc_nodes) == 2
    assert set(problem.uncovered) <= {o.label for o in problem.observations}
    assert bool(problem.uncovered) == (gap is not None)


def kinds(graph):
    out = {}
    for i in range(graph.size()):
        name = type(graph.at(i)).__name__
        out.setdefault(name, []).append(list(graph.at(i).keys()))
    return out


def test_arcs_are_chains_of_their_own():
    scene = scenario(manoeuvres=SHORT, imu={"gaps_s": [[3.0, 5.0]]})
    problem, _ = problem_of(scene)
    seg = problem.chain.segments
    (a, b), (c, d) = seg.arc_nodes
    assert (a, c) == (0, b + 1)
    found = kinds(problem.graph)
    bound = sorted(k[:2] for k in found["GalileanImuFactor2"])
    expected = [*range(a, b), *range(c, d)]
    assert bound == [[keys.node(k), keys.node(k + 1)] for k in expected]
    assert found["PriorFactorNavState"] == [[keys.node(0)], [keys.node(c)]]
    assert len(found["PriorFactorConstantBias"]) == 1
    assert "BetweenFactorConstantBias" not in found


def test_walking_biases_have_a_node_each_and_walk_over_gaps():
    scene = walking({"imu": {"gyro_bias_walk_deg_h_sqrt_h": 1.0, "gaps_s": [[3.0, 5.0]]}})
    problem, values = problem_of(scene)
    n = problem.chain.segments.node_time.size
    found = kinds(problem.graph)
    steps = found["BetweenFactorConstantBias"]
    assert steps == [[keys.bias(k), keys.bias(k + 1)] for k in range(n - 1)]
    used = [k[2] for k in found["GalileanImuFactor2"]]
    origin = problem.chain.segments.origin
    assert used == [keys.bias(k) for k in origin.tolist()]
    # 1 deg/h in an hour: over 1 s a 60th, over the gap of 2 s more.
    step = np.diff(problem.chain.segments.node_time)
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), np.array([1e-6, 0.0, 0.0]))
    moved = gtsam.Values()
    moved.insert(keys.bias(0), gtsam.imuBias.ConstantBias())
    for k in range(1, n):
        moved.insert(keys.bias(k), bias)
    between = [
        problem.graph.at(i)
        for i in range(problem.graph.size())
        if type(problem.graph.at(i)).__name__ == "BetweenFactorConstantBias"
    ]
    sigma = 1.0 * DEG / 3600.0 * np.sqrt(step[0] / 3600.0)
    assert between[0].error(moved) == pytest.approx(0.5 * (1e-6 / sigma) ** 2, rel=1e-9)
    assert problem.evaluate(values).cost > 0.0


@pytest.mark.parametrize("mean", [[0, 0, 0], [5, 30, -10], [0, 30, 0], [-100, 80, 40]], ids=str)
def test_misalignment_prior_is_that_of_the_rotation_vector(mean):
    sigma = np.array([1.0, 4.0, 0.2])
    claims = {"dvl": {"misalignment_deg": mean, "misalignment_std_deg": sigma.tolist()}}
    problem, _ = problem_of(scenario(manoeuvres=SHORT, trial=claims))
    rng = np.random.default_rng(0)
    for _ in range(5):
        # First order: a thousandth of sigma.
        step = rng.normal(0.0, 1e-3, 3) * sigma
        value = exp_so3((np.array(mean) + step) * DEG)
        expected = 0.5 * np.sum((step / sigma) ** 2)
        found = prior_cost(problem, "misalignment_deg", value)
        assert found == pytest.approx(expected, rel=2e-3)


def test_initial_priors_are_east_north_up_and_roll_pitch_heading():
    claims = {
        "initial": {
            "attitude_std_deg": [0.5, 1.0, 5.0],
            "position_std_m": [5.0, 3.0, 1.0],
            "velocity_error_m_s": [0.3, -0.2, 0.1],
            "velocity_std_m_s": [0.5, 0.2, 0.1],
        }
    }
    scene = scenario(manoeuvres=SHORT, trial=claims, start={"heading_deg": 137})
    trial = simulate(scene)
    problem, _ = problem_of(scene, trial)
    (prior,) = [
        problem.graph.at(i)
        for i in range(problem.graph.size())
        if type(problem.graph.at(i)).__name__ == "PriorFactorNavState"
    ]
    nRb = prior.prior().attitude().matrix()
    for axis, sigma in enumerate([5.0, 3.0, 1.0]):
        shift = np.zeros(3)
        shift[axis] = 2.0
        state = gtsam.NavState(
            gtsam.Rot3(nRb), prior.prior().position() + shift, prior.prior().velocity()
        )
        values = gtsam.Values()
        values.insert(keys.node(0), state)
        assert prior.error(values) == pytest.approx(0.5 * (2.0 / sigma) ** 2, rel=1e-6)
    for axis, sigma in enumerate([0.5, 0.2, 0.1]):
        shift = np.zeros(3)
        shift[axis] = 0.05
        state = gtsam.NavState(
            gtsam.Rot3(nRb), prior.prior().position(), prior.prior().velocity() + shift
        )
        values = gtsam.Values()
        values.insert(keys.node(0), state)
        assert prior.error(values) == pytest.approx(0.5 * (0.05 / sigma) ** 2, rel=1e-6)
    # At the start of the first sample, 10 ms before: the vessel accelerates by less than 1 m/s².
    known = trial.reference.velocity[0] + [0.3, -0.2, 0.1]
    np.testing.assert_allclose(prior.prior().velocity(), known, atol=0.01)
    rph = trial.initial_attitude.rph
    # The prior holds at the end of the first sample, the node is at its start.
    phi, _ = problem.chain.segments.increments.over(np.zeros(1, dtype=int))
    back = exp_so3(-phi[0])
    for axis, sigma in enumerate([0.5, 1.0, 5.0]):
        step = np.zeros(3)
        step[axis] = 1e-3 * sigma
        turned = rotation_from_rph(rph + step * DEG, "RFU")
        state = gtsam.NavState(
            gtsam.Rot3(turned @ back), prior.prior().position(), prior.prior().velocity()
        )
        values = gtsam.Values()
        values.insert(keys.node(0), state)
        assert prior.error(values) == pytest.approx(0.5e-6, rel=1e-3)


def test_problems_with_a_ping_more_and_less_compare():
    """By another clock, the chain does not cover the last pings, of which each is no evidence."""
    scene = scenario(manoeuvres=SHORT)
    problem, values = problem_of(scene)
    costs, counts = [], []
    for offset in (0.0, -0.3):
        start = problem.prior_values() | {"time_offset_s": np.array([offset])}
        each = Problem(problem.chain, problem.observations, problem.all_parameters, start=start)
        evaluation = each.evaluate(values)
        each.weigh(evaluation)
        (log_sigma,) = (
            part
            for part, o in zip(each.log_sigma(evaluation), each.observations, strict=True)
            if o.label == "DVL velocity"
        )
        costs.append(log_sigma.sum())
        counts.append(each.usable["DVL velocity"].sum())
    fewer = counts[0] - counts[1]
    assert fewer > 0
    # Three velocities of about 1 cm/s each were worth 14 for each ping.
    assert costs[1] - costs[0] == pytest.approx(1.5 * fewer, abs=0.1 * fewer)


def test_costs_of_noise_are_those_that_measurements_count_by():
    problem, values = problem_of(scenario(manoeuvres=SHORT))
    problem.weigh(problem.evaluate(values))
    faster = dict(zip(problem.usable, problem.weights, strict=True))
    by_name = {p.name: p for p in problem.parameters}
    moved = gtsam.Values(values)
    moved.update(problem.key("scale_error"), by_name["scale_error"].mean + 0.1)
    for label, log_sigma in zip(
        problem.usable, problem.log_sigma(problem.evaluate(moved)), strict=True
    ):
        used = problem.usable[label]
        expected = -np.log(faster[label][used]).sum(axis=1)
        np.testing.assert_allclose(log_sigma[used], expected)


def test_a_rejected_measurement_costs_a_gross_error_in_place_of_its_log_sigma():
    problem, values = problem_of(scenario(manoeuvres=SHORT))
    evaluation = problem.evaluate(values)
    before = dict(zip(problem.usable, problem.log_sigma(evaluation), strict=True))
    weights = np.ones((before["DVL velocity"].size, 1))
    weights[3] = 0.0
    problem.robust_weights = {"DVL velocity": weights}
    after = dict(zip(problem.usable, problem.log_sigma(evaluation), strict=True))
    # One ping in a hundred, three velocities uniform over 20 m/s, beside the sqrt(2 pi) of all.
    expected = np.log(20.0**3 / 0.01) - 1.5 * np.log(2.0 * np.pi)
    assert after["DVL velocity"][3] == pytest.approx(expected)
    changed = {label for label in before if np.any(before[label] != after[label])}
    assert changed == {"DVL velocity"}
    assert np.count_nonzero(before["DVL velocity"] != after["DVL velocity"]) == 1
