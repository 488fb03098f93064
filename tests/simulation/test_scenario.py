from __future__ import annotations

import numpy as np
import pytest
import yaml
from planar import trial as planar_trial
from simulated import CONFIGS, constant, run, scenario_dict
from truth import scenario

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.simulation import load_scenario, plan_motion, simulate

BAD = {
    "unknown key": (lambda d: d.update(speed=1), r"line \d+: unknown key `speed`"),
    "unknown inner key": (lambda d: d["imu"].update(rate=1), r"line \d+: unknown key `imu.rate`"),
    "missing": (lambda d: d.pop("start"), "missing key `start`"),
    "wrong type": (
        lambda d: d["imu"].update(rate_hz="x"),
        r"line \d+: imu.rate_hz is .x.; expected a number",
    ),
    "out of range": (
        lambda d: d["start"].update(lat_deg=95),
        r"line \d+: start.lat_deg is 95; expected .*89",
    ),
    "not finite": (
        lambda d: d["start"].update(height_m=float("nan")),
        r"line \d+: start.*height_m.*finite",
    ),
    "no manoeuvre": (lambda d: d.update(manoeuvres=[]), "key manoeuvres: there is no"),
    "strange manoeuvre": (lambda d: d["manoeuvres"].append({"jump_m": 1}), r"manoeuvres\[6\]"),
    "ambiguous manoeuvre": (
        lambda d: d["manoeuvres"].append({"straight_s": 1, "turn_deg_s": 2}),
        r"manoeuvres\[6\].*exactly one of",
    ),
    "inner manoeuvre": (
        lambda d: d["manoeuvres"].append({"repeat": 2, "manoeuvres": [{"straight_s": -1}]}),
        r"manoeuvres\[6\]\.manoeuvres\[0\]\.straight_s",
    ),
    "endless": (
        lambda d: d["manoeuvres"].append({"repeat": 10**9, "manoeuvres": [{"straight_s": 1}]}),
        "too many",
    ),
    "long ramp": (
        lambda d: d["manoeuvres"].append({"turn_deg_s": 1, "duration_s": 2, "ramp_s": 3}),
        "ramp_s",
    ),
    "reversed gap": (lambda d: d["imu"].update(gaps_s=[[2, 1]]), "gaps_s"),
    "wide jitter": (lambda d: d["imu"].update(jitter_s=0.005), "jitter_s"),
    "draw without std": (lambda d: d["imu"].update(gyro_bias_deg_h="draw"), "gyro_bias_std_deg_h"),
    "bad claim": (lambda d: d["trial"].update(dvl={"scale": 1}), "key trial.dvl: .*`scale`"),
    "missing claim": (lambda d: d.pop("trial"), "key trial.imu: .*gyro_bias_std_deg_h"),
    "claim without sensor": (
        lambda d: (d.pop("gnss"), d["trial"].update(gnss={"lever_arm_m": [0, 0, 0]})),
        "key trial.gnss",
    ),
    "internal name": (lambda d: d.update(source="x"), "unknown key `source`"),
}


def test_the_trial_claims_what_is_simulated_by_default():
    trial = run(
        gnss={"lever_arm_m": [0.3, -1.5, 4]},
        imu={"gyro_noise_deg_sqrt_h": 0.3},
        trial={
            "imu": {"gyro_bias_std_deg_h": 1, "accel_bias_std_ug": 7, "accel_noise_ug_sqrt_hz": 9},
            "dvl": {"velocity_std_m_s": 0.01, "lever_arm_std_m": [1, 1, 0]},
        },
    )
    assert trial.imu.settings.gyro_noise_deg_sqrt_h == 0.3
    assert trial.imu.settings.accel_noise_ug_sqrt_hz == 9
    assert trial.gnss.settings.lever_arm_m == (0.3, -1.5, 4)
    np.testing.assert_array_equal(trial.gnss.position_std[0], [1, 1, 2])
    assert trial.dvl.settings.velocity_std_fraction == 0.002
    assert trial.dvl.settings.velocity_std_m_s == 0.01
    assert trial.dvl.settings.lever_arm_std_m == (1, 1, 0)
    assert trial.initial_attitude is None


def test_an_initial_claim_is_the_truth_plus_its_error():
    claim = {
        "attitude_error_deg": [0.5, 0.5, 2],
        "attitude_std_deg": [0.5, 0.5, 2],
        "position_error_m": [3, 0, -1],
        "position_std_m": [3, 3, 3],
        "velocity_error_m_s": [0.1, 0, -0.2],
        "velocity_std_m_s": [0.1, 0.1, 0.1],
    }
    at_rest = {"manoeuvres": [{"straight_s": 1}], "sway": {"roll": constant(1)}}
    trial = run(
        trial={"imu": {"gyro_bias_std_deg_h": 1, "accel_bias_std_ug": 100}, "initial": claim},
        **at_rest,
    )
    np.testing.assert_allclose(trial.initial_attitude.rph / DEG, [1.5, 0.5, 32])
    frame = LocalFrame(*trial.reference.geodetic[0])
    offset = frame.position(*trial.initial_position.geodetic)
    np.testing.assert_allclose(offset, [3, 0, -1], atol=1e-6)
    off = trial.initial_velocity.velocity - trial.reference.velocity[0]
    np.testing.assert_allclose(off, [0.1, 0, -0.2], atol=1e-9)


def test_the_scenario_of_luo_et_al():
    trial = simulate(CONFIGS / "seed-a-phase-90.yaml", seed=1)
    assert (trial.imu.time.size, trial.gnss.time.size, trial.dvl.time.size) == (45300, 2265, 2265)
    assert trial.reference.time[-1] == 453
    heading = np.interp([50, 170, 300, 451], trial.reference.time, trial.reference.rph[:, 2] / DEG)
    np.testing.assert_allclose(heading, [0, 270, 0, 90], atol=1e-9)
    np.testing.assert_allclose(trial.reference.velocity[-1], [0.1, 0.1, 0], atol=1e-12)
    np.testing.assert_array_equal(trial.calibration_truth["misalignment_deg"], [2, 2, 30])
    np.testing.assert_allclose(np.max(trial.reference.rph[:, :2], axis=0) / DEG, [4, 4], atol=0.3)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda p: p.stem)
def test_shipped_scenarios_are_valid(path):
    data = yaml.safe_load(path.read_text())
    if "manoeuvres" not in data:
        pytest.skip("not a scenario")
    scenario = load_scenario(path)
    assert scenario.name == path.stem
    duration = plan_motion(scenario).duration
    if path.stem.startswith("cruise"):
        assert duration == pytest.approx(4800, abs=1e-9)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"sway": {"roll": [{"amplitude_deg": 1, "frequency_hz": 1e4}]}}, "sway"),
        ({"imu": {"rate_hz": 1e5}}, "imu.rate_hz"),
        ({"reference_rate_hz": 1e5}, "reference_rate_hz"),
        ({"dvl": {"rate_hz": 1e5}}, "dvl.rate_hz"),
    ],
)
def test_what_cannot_be_in_memory_is_refused(change, key):
    with pytest.raises(ConfigError, match=rf"key {key}: .* GB of memory, and there are .* GB"):
        simulate(scenario(manoeuvres=[{"straight_s": 1e7}], **change))


def test_a_planar_trial_that_cannot_be_in_memory_is_refused():
    with pytest.raises(ConfigError, match=r"key log\.rate_hz: .* steps"):
        planar_trial(manoeuvres=[{"straight_s": 1e7}], log={"rate_hz": 1e5})


@pytest.mark.parametrize("case", BAD)
def test_bad_scenarios_name_file_and_key(case, tmp_path):
    spoil, message = BAD[case]
    data = scenario_dict()
    spoil(data)
    path = tmp_path / "bad.yaml"
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(ConfigError, match=message) as caught:
        load_scenario(path)
    assert str(path) in str(caught.value)


def test_numbers_may_be_written_as_engineers_do(tmp_path):
    path = tmp_path / "scenario.yaml"
    path.write_text(yaml.safe_dump(scenario_dict()) + "reference_rate_hz: 1e-1\n")
    assert load_scenario(path).reference_rate_hz == 0.1


def test_unreadable_files_are_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.yaml"):
        load_scenario(tmp_path / "none.yaml")
    path = tmp_path / "bad.yaml"
    path.write_text("a: [1\nb: 2")
    with pytest.raises(ConfigError, match="line 2"):
        load_scenario(path)
    path.write_text("- 1")
    with pytest.raises(ConfigError, match="is not a mapping"):
        load_scenario(path)
