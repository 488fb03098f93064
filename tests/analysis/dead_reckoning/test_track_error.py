"""Errors of a dead-reckoned track."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.analysis.dead_reckoning.integration import DeadReckonedTrack, integrated
from factorgraph_dvl.analysis.dead_reckoning.track_error import Path, difference, path_of, score
from factorgraph_dvl.trial import Reference

START = np.array([0.6, 2.0, 0.0])
TIME = np.arange(0.0, 1501.0)
NORTH_EAST = np.tile([3.0, 4.0, 0.0], (TIME.size, 1))


def track(velocity, start=START):
    rph = np.zeros_like(velocity)
    return DeadReckonedTrack(TIME, integrated(TIME, velocity, start), velocity, rph, 0.0)


def truth(velocity):
    exact = track(velocity)
    return Reference(exact.time, exact.geodetic, exact.velocity, exact.rph)


def test_distance_and_course_of_a_straight_track():
    path = path_of(track(NORTH_EAST), TIME[10:])
    assert path.total == pytest.approx(5.0 * 1490.0)
    np.testing.assert_allclose(path.course, np.arctan2(3.0, 4.0))


def test_at_rest_there_is_no_course():
    path = path_of(track(0.0 * NORTH_EAST), TIME)
    assert path.total == 0.0
    np.testing.assert_array_equal(path.course, 0.0)


def test_a_scale_error_grows_along_the_course():
    exact = track(NORTH_EAST)
    found = score(track(1.002 * NORTH_EAST), truth(NORTH_EAST), exact)
    first, second, third = found.stretches
    assert (first.count, second.count, third.count) == (7, 1, 0)
    for each in (first, second):
        assert each.along == pytest.approx(0.2, rel=1e-3)
        assert each.across == pytest.approx(0.0, abs=1e-3)
        assert each.median == pytest.approx(each.largest, rel=1e-3)
    assert np.isnan(third.median)
    assert found.along[-1] == pytest.approx(0.002 * 7500.0, rel=1e-3)
    assert found.percent(found.horizontal[-1]) == pytest.approx(0.2, rel=1e-3)


def test_a_heading_error_grows_to_the_right():
    # 1 mrad clockwise.
    turned = NORTH_EAST + 1e-3 * NORTH_EAST[:, [1, 0, 2]] * [1.0, -1.0, 0.0]
    found = score(track(turned), truth(NORTH_EAST), track(NORTH_EAST))
    assert found.stretches[0].across == pytest.approx(0.1, rel=1e-2)
    assert found.across[-1] == pytest.approx(7.5, rel=1e-2)
    assert found.along[-1] == pytest.approx(0.0, abs=0.02)


def test_a_turn_divides_stretches():
    velocity = np.where((TIME < 700.0)[:, None], [0.0, 5.0, 0.0], [5.0, 0.0, 0.0])
    found = score(track(velocity), truth(velocity), track(velocity))
    assert found.stretches[0].count == 6
    assert found.stretches[1].count == 0


def test_positions_beyond_the_antimeridian_are_as_near():
    east = np.array([0.6, np.pi - 1e-9, 0.0])
    west = np.array([[0.6, -np.pi + 1e-9, 0.0]])
    at_rest = np.zeros((TIME.size, 3))
    apart = difference(track(at_rest, east), TIME[:1], west)
    assert 0.0 < -apart[0, 0] < 0.02


def test_without_common_epochs_there_is_no_score():
    later = truth(NORTH_EAST)
    later = Reference(later.time + 1e4, later.geodetic, later.velocity, later.rph)
    assert score(track(NORTH_EAST), later, track(NORTH_EAST)) is None


def test_of_no_distance_there_is_no_percentage():
    path = Path(TIME, 0.0 * TIME, 0.0 * TIME)
    assert path.total == 0.0
    found = score(track(0.0 * NORTH_EAST), truth(0.0 * NORTH_EAST), track(0.0 * NORTH_EAST))
    assert np.isnan(found.percent(1.0))
