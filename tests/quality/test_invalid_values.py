"""Values with which instruments mark what they have not measured."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.quality.invalid_values import without_invalid_values
from factorgraph_dvl.sensors.dvl import VELOCITY_COLUMNS
from factorgraph_dvl.sensors.gnss import POSITION_COLUMNS
from factorgraph_dvl.sensors.imu import COLUMNS


def dvl_table(rows=200, seed=0):
    rng = np.random.default_rng(seed)
    time = np.arange(rows) * 0.2
    velocity = np.array([3.0, 0.2, 0.0]) + 0.05 * rng.standard_normal((rows, 3))
    return {"time_s": time, **{n: velocity[:, i] for i, n in enumerate(VELOCITY_COLUMNS)}}


def missing(columns, names=VELOCITY_COLUMNS):
    return np.flatnonzero(np.isnan(np.stack([columns[n] for n in names])).all(axis=0)).tolist()


def test_a_right_table_stays_as_it_is():
    table = dvl_table()
    out, found = without_invalid_values("dvl", table, "dvl.csv")
    assert found == []
    for name, values in table.items():
        np.testing.assert_array_equal(out[name], values)


@pytest.mark.parametrize("value", [-32.768, -32768.0, 88.888, 99.99, -99.99])
def test_sentinels_are_missing_and_counted(value):
    table = dvl_table()
    table["vel_y_m_s"][[5, 90]] = value
    out, (finding,) = without_invalid_values("dvl", table, "dvl.csv")
    assert missing(out) == [5, 90]
    assert f"2 of {value:g} in dvl.csv" in finding.text
    assert table["vel_y_m_s"][5] == value


def test_zeros_amid_motion_are_missing_and_at_rest_are_not():
    table = dvl_table()
    for name in VELOCITY_COLUMNS:
        table[name][[20, 21]] = 0.0
    out, (finding,) = without_invalid_values("dvl", table, "dvl.csv")
    assert missing(out) == [20, 21]
    assert "2 of zeros" in finding.text
    slow = {n: (v if n == "time_s" else 0.02 * v) for n, v in table.items()}
    assert without_invalid_values("dvl", slow, "dvl.csv")[1] == []


def test_frozen_velocities_are_missing():
    table = dvl_table()
    for name in VELOCITY_COLUMNS:
        table[name] += 0.01 * np.arange(200)
        table[name][50:120] = table[name][50]
    out, (finding,) = without_invalid_values("dvl", table, "dvl.csv")
    assert missing(out) == list(range(51, 120))
    assert "69 that repeat" in finding.text


def test_frozen_velocities_need_no_step_where_no_row_repeats_another_by_chance():
    table = dvl_table()
    for name in VELOCITY_COLUMNS:
        table[name][50:60] = table[name][50]
    out, (finding,) = without_invalid_values("dvl", table, "dvl.csv")
    assert missing(out) == list(range(51, 60))
    assert "9 that repeat" in finding.text


def test_coarse_velocities_that_repeat_by_chance_stay():
    table = dvl_table()
    for name in VELOCITY_COLUMNS:
        table[name] = np.round(table[name], 1)
    table["vel_z_m_s"] *= 0.0
    assert without_invalid_values("dvl", table, "dvl.csv")[1] == []


def test_a_lost_beam_does_not_take_the_others_along():
    time = np.arange(50) * 1.0
    rng = np.random.default_rng(0)
    table = {
        "time_s": time,
        **{f"beam{i}_m_s": 1.0 + rng.standard_normal(50) for i in range(1, 5)},
    }
    table["beam2_m_s"][7] = -32.768
    out, (_,) = without_invalid_values("dvl_beams", table, "b.csv")
    assert missing(out, ["beam2_m_s"]) == [7]
    assert missing(out, ["beam1_m_s"]) == []


@pytest.mark.parametrize("times", [2, 5])
def test_values_that_a_faster_log_writes_again_are_missing(times):
    table = dvl_table()
    table |= {name: np.repeat(table[name], times)[:200] for name in VELOCITY_COLUMNS}
    out, (finding,) = without_invalid_values("dvl", table, "dvl.csv")
    assert missing(out) == [i for i in range(200) if i % times]
    assert f"{200 - 200 // times} that repeat" in finding.text
    assert "faster than the instrument" in finding.text


def test_a_log_at_5_hz_of_an_instrument_at_4_is_faster_too():
    table = dvl_table()
    rows = np.arange(200) * 4 // 5
    table |= {name: table[name][rows] for name in VELOCITY_COLUMNS}
    out, _ = without_invalid_values("dvl", table, "dvl.csv")
    assert missing(out) == np.flatnonzero(np.diff(rows, prepend=-1) == 0).tolist()


@pytest.mark.parametrize("rate_hz", [1.0, 5.0])
@pytest.mark.parametrize("noise", [0.001, 0.002, 0.003])
def test_coarse_digits_of_a_smooth_motion_are_measured(rate_hz, noise):
    time = np.arange(900 * rate_hz) / rate_hz
    straight = 0.3 * np.sin(2.0 * np.pi * time / 300.0), 0.0 * time
    turns = ((time // 60.0) % 2.0) * np.sin(2.0 * np.pi * time / 60.0)
    for ahead, aside in (straight, (0.2 * turns, 0.1 * turns)):
        motion = np.stack([1.0 + ahead, aside, 0.0 * time], axis=1)
        motion += noise * np.random.default_rng(0).standard_normal(motion.shape)
        table = {"time_s": time}
        table |= dict(zip(VELOCITY_COLUMNS, np.round(motion, 2).T, strict=True))
        out, found = without_invalid_values("dvl", table, "dvl.csv")
        assert (missing(out), found) == ([], [])


def test_fixes_that_a_faster_log_writes_again_are_missing_and_one_held_at_rest_is_not():
    time = np.arange(300) * 0.2
    since = np.floor(time)
    table = {"time_s": time, "lat_deg": 36.0 + 2e-5 * since, "lon_deg": 121.0 + 0.0 * since}
    table["height_m"] = 10.0 + 0.1 * np.sin(since)
    out, (finding,) = without_invalid_values("gnss", table, "gnss.csv")
    assert (
        missing(out, POSITION_COLUMNS) == np.flatnonzero(np.diff(since, prepend=-1) == 0).tolist()
    )
    assert "240 that repeat" in finding.text
    rest = {
        n: np.where(time > 30.0, v[-1], 1.0 * np.round(v + 1e-5 * time, 9))
        for n, v in table.items()
    }
    rest["time_s"] = time
    assert without_invalid_values("gnss", rest, "gnss.csv")[1] == []


def test_fixes_at_zero_and_frozen_fixes_are_missing():
    time = np.arange(100) * 1.0
    table = {"time_s": time, "lat_deg": 36.0 + 2e-5 * time, "lon_deg": 121.0 + 0.0 * time}
    table["height_m"] = 10.0 + 0.1 * np.sin(time)
    table["lat_deg"][10] = table["lon_deg"][10] = 0.0
    for name in POSITION_COLUMNS:
        table[name][40:60] = table[name][40]
    out, (finding,) = without_invalid_values("gnss", table, "gnss.csv")
    assert missing(out, POSITION_COLUMNS) == [10, *range(41, 60)]
    assert "1 fixes at 0, 0, 19 fixes that repeat" in finding.text


def test_zero_rows_of_the_imu_are_left_out():
    rng = np.random.default_rng(0)
    table = {name: rng.standard_normal(100) for name in COLUMNS}
    table["time_s"] = np.arange(100) * 0.01
    for name in COLUMNS[1:]:
        table[name][30:33] = 0.0
    out, (finding,) = without_invalid_values("imu", table, "imu.csv")
    assert out["time_s"].size == 97
    assert "3 samples of zeros" in finding.text


def imu_table(rows=400, seed=0):
    rng = np.random.default_rng(seed)
    names = COLUMNS[1:]
    return {"time_s": 0.01 * np.arange(rows), **{n: rng.standard_normal(rows) for n in names}}


@pytest.mark.parametrize("triad", [COLUMNS[1:4], COLUMNS[4:]])
def test_frozen_samples_of_a_triad_are_left_out(triad):
    table = imu_table()
    for name in triad:
        table[name][50:60] = table[name][50]
    out, (finding,) = without_invalid_values("imu", table, "imu.csv")
    np.testing.assert_array_equal(np.delete(table["time_s"], np.arange(51, 60)), out["time_s"])
    assert "9 samples that repeat the one before in imu.csv" in finding.text


def test_coarse_digits_and_samples_written_twice_are_not_frozen():
    coarse = imu_table()
    coarse |= {name: np.round(5.0 + coarse[name] / 3.0) for name in COLUMNS[1:]}
    assert without_invalid_values("imu", coarse, "imu.csv")[1] == []
    for times in (2, 8):
        table = imu_table(400 // times)
        written = {n: np.repeat(v, times) for n, v in table.items()}
        written["time_s"] = 0.01 * np.arange(written["time_s"].size)
        assert without_invalid_values("imu", written, "imu.csv")[1] == []
