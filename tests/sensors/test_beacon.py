"""Ranges to beacons: measurement models, records, trials without a position, echoes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders import edit
from jacobians import check_jacobians, random_motion
from truth import exact_motion, scenario

from factorgraph_dvl.errors import DataError, FactorgraphDvlError
from factorgraph_dvl.files.solution_folder import save_solution
from factorgraph_dvl.files.trial_folder import load_trial, save_trial
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.graph.inertial_chain import inertial_chain
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import segments
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.replay import replay
from factorgraph_dvl.sensors.beacon import Beacons, BeaconSettings, bias_name, offset_name
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.settings.convert import convert
from factorgraph_dvl.simulation import plan_motion, simulate
from factorgraph_dvl.solvers.batch import solve

PLACE = {"lat_deg": 36.002, "lon_deg": 121.003, "height_m": -60}
ARM = [0.5, 2.0, -1.0]


def beacons(**changes):
    return {
        "rate_hz": 2,
        "positions": {"B1": PLACE},
        "range_std_m": 0.5,
        "range_rate_std_m_s": 0.05,
        "lever_arm_m": ARM,
        **changes,
    }


def record(m=5):
    positions = {"B1": PLACE, "far": {**PLACE, "lat_deg": 36.001}}
    settings = parsed(positions=positions, lever_arm_m=ARM)
    name = np.array(["B1", "far"] * m)[:m]
    return Beacons(settings, np.arange(float(m)), name, np.full(m, 80.0), np.full(m, 0.5))


def parsed(**settings):
    return convert(settings, BeaconSettings, "beacons", "test")


@pytest.mark.parametrize("body_axes", ["RFU", "FRD"])
def test_zero_error_at_the_truth(body_axes):
    truth = {"sound_speed_error": 0.002}
    scene = scenario(
        body_axes=body_axes,
        beacons=beacons(
            positions={"B1": PLACE, "B2": {**PLACE, "lon_deg": 121.2, "std_m": 3}}, **truth
        ),
    )
    exact, trial = plan_motion(scene), simulate(scene, seed=5)
    frame = LocalFrame(*exact.at(np.array([0.0])).geodetic[0])
    values = {name: value for name, value in trial.calibration_truth.items()}
    assert np.linalg.norm(values["beacon_B2_offset_m"]) > 0.1
    observations = trial.beacons.observations(frame, "RFU")
    assert len(observations) == 4
    for o in observations:
        smooth = np.min(np.abs(o.time[:, None] - exact.kinks), axis=1) > 0.01
        o = replace(o, time=o.time[smooth], measured=o.measured[smooth])
        error = o.residual(exact_motion(exact, frame, o.time), values)
        # The simulation places beacons by local axes at their own place, 1e-8 m off; rates
        # have theirs at the vehicle's IMU and not at its transponder, 4e-7 rad off.
        assert np.abs(error).max() < (1e-6 if o.unit == "m" else 2e-6), o.label


def test_a_wrong_sign_of_rotation_or_rate_shows():
    scene = scenario(beacons=beacons())
    exact, trial = plan_motion(scene), simulate(scene)
    frame = LocalFrame(*exact.at(np.array([0.0])).geodetic[0])
    for o in trial.beacons.observations(frame, "RFU"):
        motion = exact_motion(exact, frame, o.time)
        turned = replace(motion, nRb=motion.nRb.transpose(0, 2, 1))
        assert np.abs(o.residual(turned, trial.calibration_truth)).max() > 0.1
    rates = trial.beacons.range_rate
    grows = np.gradient(trial.beacons.range, trial.beacons.time)
    assert np.corrcoef(rates, grows)[0, 1] > 0.95


def test_jacobians():
    r = record()
    settings = parsed(
        positions={"B1": {**PLACE, "std_m": 2}, "far": {**PLACE, "lat_deg": 36.001, "std_m": 1}},
        lever_arm_m=ARM,
        sound_speed_error_std=0.01,
    )
    r = replace(r, settings=settings)
    frame = LocalFrame(np.radians(36.0), np.radians(121.0), 0.0)
    for o in r.observations(frame, "RFU"):
        motion = random_motion(o.time.size)
        values = {
            "sound_speed_error": np.array([0.01]),
            offset_name("B1"): np.array([1.0, -2.0, 0.5]),
            offset_name("far"): np.array([0.3, 0.1, -2.0]),
            bias_name("B1"): np.array([0.7]),
            bias_name("far"): np.array([-0.4]),
        }
        check_jacobians(o, motion, values, r.parameters(), tolerance=1e-6)


def test_by_hand():
    frame = LocalFrame(np.radians(36.0), np.radians(121.0), 0.0)
    settings = parsed(
        positions={"B1": {"lat_deg": 36.0, "lon_deg": 121.0, "height_m": 0}},
        lever_arm_m=[0, 2, 0],
    )
    one = np.ones(1)
    r = Beacons(settings, one, np.array(["B1"]), one * 0.0, one * 0.0)
    # Body x right, y ahead; the bow points east, so the lever arm does; it turns to port.
    motion = replace(
        random_motion(1),
        nRb=np.array([[[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]]),
        p_n=np.array([[1.0, 4.0, 0.0]]),
        v_n=np.array([[3.0, 0.0, 0.0]]),
        omega_eb_b=np.array([[0.0, 0.0, 0.5]]),
    )
    values = {"sound_speed_error": np.array([0.1]), offset_name("B1"): np.zeros(3)}
    values[bias_name("B1")] = np.array([0.2])
    distance, rate = r.observations(frame, "RFU")
    # The transponder is at (3, 4), 5 m away, and moves with (3, 0) + 0.5 · 2 to the north.
    np.testing.assert_allclose(distance.residual(motion, values), [[1.1 * 5.0 + 0.2]], atol=1e-8)
    np.testing.assert_allclose(rate.residual(motion, values), [[1.1 * (9.0 + 4.0) / 5.0]])


def test_a_two_way_range_is_that_of_its_middle():
    frame = LocalFrame(np.radians(36.0), np.radians(121.0), 0.0)
    settings = parsed(positions={"B1": {"lat_deg": 36.0, "lon_deg": 121.0, "height_m": 0}})
    sound, v = 1500.0, np.array([2.0, 1.0, 0.0])
    asked = np.array([1000.0, -400.0, -50.0])
    out = np.linalg.norm(asked) / sound
    back = out
    for _ in range(20):
        back = np.linalg.norm(asked + v * (out + back)) / sound
    one = np.ones(1)
    r = Beacons(
        settings, one, np.array(["B1"]), 0.5 * sound * (out + back) * one, np.full(1, np.nan)
    )
    values = {"sound_speed_error": np.zeros(1), offset_name("B1"): np.zeros(3)}
    values[bias_name("B1")] = np.zeros(1)
    (o, *_) = r.observations(frame, "RFU")

    def error(since):
        motion = replace(random_motion(1), nRb=np.eye(3)[None], p_n=(asked + v * since)[None])
        return float(np.abs(replace(o, arm_b=np.zeros(3)).residual(motion, values)[0, 0]))

    assert error(0.5 * (out + back)) < 2e-3
    assert error(out + back) > 1.0


def test_stamps_of_reception_and_delays_are_those_of_the_simulated_sound():
    """Ranges there and back, stamped when they come, too long by an unknown delay."""
    scene = scenario(
        beacons=beacons(
            positions={"B1": PLACE, "B2": {**PLACE, "lon_deg": 121.01}},
            stamp="reception",
            turn_around_s=0.3,
            range_bias_std_m=2.0,
        )
    )
    exact, trial = plan_motion(scene), simulate(scene, seed=5)
    frame = LocalFrame(*exact.at(np.array([0.0])).geodetic[0])
    values = trial.calibration_truth
    assert trial.beacons.settings.range_bias_std_m == 2.0
    assert abs(values["beacon_B1_range_bias_m"][0]) > 0.1
    for o in trial.beacons.observations(frame, "RFU"):
        if o.unit == "m":
            error = o.residual(exact_motion(exact, frame, o.time), values)
            # The bias is no way of the sound: 2 m of it are 1.3 ms, at up to 5 m/s.
            assert np.abs(error).max() < 5.0 * 2.0 / 1500.0 * abs(values[o.bias][0])


def dive(**changes):
    """A vehicle that starts from nowhere, 700 m from a beacon, with one turn by 90 degrees."""
    return scenario(
        noise=True,
        start={"lat_deg": 35.9946, "lon_deg": 121.003, "height_m": 0, "heading_deg": 20,
               "speed_m_s": 2},
        manoeuvres=[{"straight_s": 100}, {"turn_deg_s": 3, "duration_s": 30, "ramp_s": 3},
                    {"straight_s": 100}],
        sway={},
        gnss=None,
        current_m_s=[0.2, -0.15, 0],
        imu={"rate_hz": 20},
        dvl={"rate_hz": 1, "misalignment_deg": [0, 0, 0], "scale_error": 0,
             "lever_arm_m": [0, 0, 0], "velocity_std_m_s": 0.005},
        beacons=beacons(rate_hz=1, positions={"B1": {"lat_deg": 36, "lon_deg": 121,
                                                     "height_m": -80}}, multipath=0.2),
        trial={
            "imu": {"gyro_bias_std_deg_h": 0.05, "accel_bias_std_ug": 100},
            "dvl": {"velocity_std_m_s": 0.005, "misalignment_std_deg": [0.05] * 3,
                    "scale_error_std": 0.001, "lever_arm_std_m": [0, 0, 0]},
            "initial": {"attitude_std_deg": [0.05, 0.05, 0.2]},
        },
        **changes,
    )  # fmt: skip


@pytest.mark.slow
def test_a_trial_without_a_position_is_solved_and_echoes_are_named(tmp_path):
    trial = simulate(dive(), seed=2)
    solution = solve(trial, rate_hz=1.0)
    assert solution.converged
    assert [h.died is None for h in solution.hypotheses] == [True, False]
    assert 100.0 < solution.hypotheses[1].died < 135.0
    t = solution.trajectory
    at = np.isin(trial.reference.time, t.time)
    frame = LocalFrame(*trial.reference.geodetic[0])
    error = frame.position(*t.geodetic.T) - frame.position(*trial.reference.geodetic[at].T)
    assert np.abs(error[:, :2]).max() < 5.0
    assert np.mean(np.abs(error[:, :2]) < 2.0 * t.position_std[:, :2]) > 0.9
    (rejected,) = [r for r in solution.rejected if r.unit == "m"]
    truth = exact_motion(plan_motion(dive()), frame, trial.beacons.time)
    place = frame.position(*np.array([np.radians(36.0), np.radians(121.0), -80.0]))
    away = truth.p_n + truth.nRb @ np.array(ARM) - place
    echo = trial.beacons.range - np.linalg.norm(away, axis=1) > 5.0
    assert echo.sum() > 20
    np.testing.assert_array_equal(rejected.time, trial.beacons.time[echo])
    save_solution(solution, tmp_path / "out")
    lines = (tmp_path / "out" / "rejected.csv").read_text().splitlines()
    assert lines[0] == "time_s,sensor,component,reason,residual,std,unit"
    assert '"Beacon B1 range","range","echo"' in lines[1]
    assert (tmp_path / "out" / "hypotheses" / "2.csv").exists()


def test_files(tmp_path):
    trial = simulate(scenario(beacons=beacons(missed=0.3), noise=True))
    assert np.isnan(trial.beacons.range).any()
    for parquet in (False, True):
        save_trial(trial, tmp_path / "t", parquet=parquet, force=True)
        loaded = load_trial(tmp_path / "t").beacons
        np.testing.assert_array_equal(loaded.range, trial.beacons.range)
        np.testing.assert_array_equal(loaded.range_rate, trial.beacons.range_rate)
        np.testing.assert_array_equal(loaded.name, trial.beacons.name)


@pytest.mark.parametrize(
    ("file", "old", "new", "says"),
    [
        ("beacons.csv", '"B1"', '"B7"', "line 2: the beacon is 'B7'; expected one of"),
        ("beacons.csv", "beacon,", "buoy,", "missing column beacon"),
        ("trial.yaml", "B1:", "B 1:", "a name has letters"),
        ("trial.yaml", "range_std_m: 0.5", "range_std_m: 0", "range_std_m is 0"),
        (
            "trial.yaml",
            "lat_deg: 36.002",
            "lat_deg: 136",
            "`lat_deg` must be -90 to 90 deg, not 136",
        ),
        ("trial.yaml", "positions:", "places:", "places"),
    ],
)
def test_bad_input_is_named(tmp_path, file, old, new, says):
    save_trial(simulate(scenario(beacons=beacons())), tmp_path / "t")
    edit(tmp_path / "t" / file, old, new)
    with pytest.raises(FactorgraphDvlError, match=r"\w") as error:
        load_trial(tmp_path / "t")
    assert says in str(error.value)


def test_columns_of_either_measurement_may_be_absent(tmp_path):
    r = record()
    with pytest.raises(DataError, match="the beacon is 'x'"):
        replace(r, name=np.array(["x"] * 5))
    none = Beacons.from_columns(
        r.settings, {"time_s": r.time, "beacon": r.name, "range_m": r.range,
                     "range_rate_m_s": np.full(5, np.nan)}, "beacon.csv"
    )  # fmt: skip
    assert [o.unit for o in none.observations(LocalFrame(0.6, 2.1, 0.0), "RFU")] == ["m", "m"]


def crowd(count):
    """So many beacons of which the places are not known well, few ranges to each."""
    places = {
        f"B{i}": {"lat_deg": 36.002 + 1e-4 * (i % 20), "lon_deg": 121.003 + 1e-4 * (i // 20),
                  "height_m": -60, "std_m": 1}
        for i in range(count)
    }  # fmt: skip
    return simulate(
        scenario(noise=True, beacons=beacons(positions=places, rate_hz=max(4.0, count / 20))),
        seed=1,
    )


@pytest.mark.slow
def test_thirty_uncertain_beacons_are_estimated():
    trial = crowd(30)
    solution = solve(trial, rate_hz=1.0)
    assert solution.converged
    own = [e for e in solution.estimates if e.name.startswith("beacon_")]
    assert len(own) == 30
    away = np.concatenate([(e.value - trial.calibration_truth[e.name]) / e.std for e in own])
    assert 0.7 < np.sqrt(np.mean(away**2)) < 1.3
    early = replace(trial, imu=rows_of(trial.imu, trial.imu.time < 45.0))
    live, _ = replay(early, rate_hz=1.0)
    assert sum(e.name.startswith("beacon_") for e in live.estimates) == 30


def test_each_of_three_hundred_beacons_has_a_variable_of_its_own():
    trial = crowd(300)
    frame = trial.frame()
    inc, _ = increments(trial.imu)
    seg = segments(inc, 5.0, np.empty(0))
    zero = np.zeros((seg.node_time.size, 3))
    states = States(np.broadcast_to(np.eye(3), (zero.shape[0], 3, 3)), zero, zero, zero, zero)
    beacon = trial.beacons
    problem = Problem(
        inertial_chain(trial, frame, seg, states),
        beacon.observations(frame, "RFU"),
        beacon.parameters(),
    )
    values = problem.values(states, problem.prior_values())
    assert values.size() == 300 + zero.shape[0] + 1
    assert np.isfinite(problem.evaluate(values).cost)
