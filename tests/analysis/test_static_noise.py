"""Noise figures from a static record: known ones are found, to their standard deviations."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from running import Run, run

from factorgraph_dvl.analysis.static_noise import StaticNoise, static_noise
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.tables import write_table
from factorgraph_dvl.geometry.units import DEG_PER_HOUR, DEG_PER_SQRT_HOUR, MICRO_G
from factorgraph_dvl.report.files.imu_noise import imu_yaml
from factorgraph_dvl.sensors.imu import Imu, ImuSettings

__all__ = ["run"]

# Rate; angle random walk, bias instability and rate random walk of the gyros, SI. The
# accelerometers' are ten times as large.
RATE = 20.0
N, B, K = 1e-4, 4e-5, 3e-6


def flicker(count: int, dt: float, rng: np.random.Generator) -> np.ndarray:
    """Return noise of unit bias instability, (count, 3): the two-sided density 1 / (2 pi f)."""
    frequency = np.fft.rfftfreq(2 * count, dt)
    frequency[0] = frequency[1]
    root = np.sqrt(2 * count / dt / (2.0 * np.pi * frequency) / 2.0)[:, None]
    shape = (frequency.size, 3)
    amplitude = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    return np.fft.irfft(amplitude * root, 2 * count, axis=0)[:count]


def at_rest(seconds: float, n: float, b: float, k: float) -> Imu:
    rng = np.random.default_rng(4)
    count, dt = round(seconds * RATE), 1.0 / RATE

    def noise() -> np.ndarray:
        white, steps = rng.standard_normal((2, count, 3))
        return (
            n / np.sqrt(dt) * white
            + b * flicker(count, dt, rng)
            + k * np.sqrt(dt) * np.cumsum(steps, axis=0)
        )

    time = np.arange(1, count + 1) * dt
    force = 10.0 * noise() + [0.0, 0.0, 9.8]
    return Imu(ImuSettings(grade="mems"), time, noise(), force, source="still.csv")


@pytest.fixture(scope="module")
def known() -> StaticNoise:
    pytest.importorskip("allantools")
    return static_noise(at_rest(10_000.0, N, B, K))


def test_known_figures_are_found(known: StaticNoise) -> None:
    for axes, scale in ((known.gyro, 1.0), (known.accel, 10.0)):
        for axis in axes:
            for figure, true in ((axis.white, N), (axis.instability, B), (axis.walk, K)):
                assert figure.seen
                assert abs(figure.value - scale * true) < 4.0 * figure.std
                assert figure.std < 0.35 * figure.value
            assert axis.white.std < 0.01 * axis.white.value


def test_keys_hold_the_mean_of_the_axes_and_a_walk_for_the_hour(known: StaticNoise) -> None:
    keys = yaml.safe_load(imu_yaml(known))["imu"]
    assert keys["gyro_noise_deg_sqrt_h"] == pytest.approx(N / DEG_PER_SQRT_HOUR, rel=0.01)
    assert keys["accel_noise_ug_sqrt_hz"] == pytest.approx(10 * N / MICRO_G, rel=0.01)
    # Within an hour flicker wanders by 0.664 B, a walk by K sqrt(T / 3).
    hour = np.hypot(0.664 * B, K * np.sqrt(1200.0)) * np.sqrt(3.0) / DEG_PER_HOUR
    assert keys["gyro_bias_walk_deg_h_sqrt_h"] == pytest.approx(hour, rel=0.2)
    ImuSettings(**keys, gyro_bias_std_deg_h=1.0, accel_bias_std_ug=1.0)


def test_what_a_short_record_does_not_show_is_a_limit() -> None:
    pytest.importorskip("allantools")
    noise = static_noise(at_rest(300.0, N, 0.0, 0.0))
    for axis in noise.gyro:
        assert axis.white.value == pytest.approx(N, rel=0.05)
        assert axis.instability.limit < 3.0 * N
        assert axis.walk.limit < N
    assert sum(axis.instability.seen + axis.walk.seen for axis in noise.gyro) <= 1


def test_the_longest_stretch_without_gaps_is_used() -> None:
    pytest.importorskip("allantools")
    imu = at_rest(400.0, N, 0.0, 0.0)
    time = imu.time.copy()
    time[2000:] += 7.0
    noise = static_noise(Imu(imu.settings, time, imu.gyro, imu.accel))
    assert noise.duration == pytest.approx(300.0)


def test_records_that_do_not_serve_are_refused() -> None:
    imu = at_rest(120.0, N, 0.0, 0.0)
    swaying = imu.gyro + 0.05 * np.sin(imu.time)[:, None]
    with pytest.raises(DataError, match=r"the IMU moves: its rate changes by .* deg/s"):
        static_noise(Imu(imu.settings, imu.time, swaying, imu.accel))
    with pytest.raises(DataError, match="the longest stretch without gaps lasts 50 s"):
        static_noise(Imu(imu.settings, imu.time[:1000], imu.gyro[:1000], imu.accel[:1000]))


def write(path: Path) -> Path:
    write_table(path, at_rest(120.0, N, 0.0, 0.0).columns())
    return path


def test_the_command_prints_and_writes(tmp_path: Path, run: Run) -> None:
    pytest.importorskip("allantools")
    file, out = write(tmp_path / "still.parquet"), tmp_path / "out"
    result = run("allan", file, "--out", out)
    assert result.code == 0
    assert "gyro x" in result.out
    assert "accel z" in result.out
    keys = (out / "imu.yaml").read_text(encoding="utf-8")
    assert keys in result.out
    assert (out / "allan.png").stat().st_size > 10_000
    assert run("allan", file, "--out", out).code == 2
    assert run("allan", file).out == result.out.partition("Wrote")[0].rstrip() + "\n"


def test_what_is_missing_is_named_with_the_command_that_installs_it(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "allantools", None)
    result = run("allan", write(tmp_path / "still.parquet"), "--out", tmp_path / "out")
    assert result.code == 2
    assert "allantools is not installed" in result.err
    assert "pip install 'factorgraph-dvl[allan]'" in result.err
    assert not (tmp_path / "out").exists()
