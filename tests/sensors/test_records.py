"""Tests of what sensors' records have in common."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.sensors.records import check_range, white_noise


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (100.0, r"may be in cm/s \(divide it by 100\) or mm/s \(divide it by 1000\)$"),
        (5e3, r"may be in mm/s \(divide it by 1000\)$"),
    ],
)
def test_a_column_in_another_unit_is_recognised(factor: float, words: str) -> None:
    speed = factor * np.linspace(0.51, 2.0, 100)
    with pytest.raises(DataError, match=f"100 of 100 values are outside: the column {words}"):
        check_range({"vel_x_m_s": speed}, -50.0, 50.0, "m/s", "dvl")


def test_single_values_out_of_range_say_nothing_of_the_unit() -> None:
    speed = np.linspace(0.1, 2.0, 100)
    speed[[3, 50]] = 400.0
    with pytest.raises(DataError, match=r"dvl line 5: .*expected -50 to 50 m/s$"):
        check_range({"vel_x_m_s": speed}, -50.0, 50.0, "m/s", "dvl")


def test_infinite_values_are_out_of_range_and_in_no_unit() -> None:
    with pytest.raises(DataError, match=r"expected -50 to 50 m/s$"):
        check_range({"vel_x_m_s": np.array([0.0, np.inf])}, -50.0, 50.0, "m/s", "dvl")


def test_white_noise_is_found_beside_slow_motion() -> None:
    noise = np.random.default_rng(0).standard_normal((20_000, 2))
    motion = 30.0 * np.sin(0.15 * np.arange(20_000.0))[:, None]
    np.testing.assert_allclose(white_noise(noise + motion), 1.0, rtol=0.05)
