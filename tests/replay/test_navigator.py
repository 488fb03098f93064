"""Navigation from segment to segment."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.analysis.error_statistics import motion_errors
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.replay.gate import InnovationGate
from factorgraph_dvl.replay.navigator import LocalGravity, Navigator


def test_gravity_is_that_of_the_full_model_along_a_track():
    frame = LocalFrame(0.6, 0.3, 10.0)
    gravity = LocalGravity(frame)
    for step in np.linspace(0.0, 3000.0, 200):
        p = np.array([[step, 0.5 * step, -0.01 * step]])
        exact = frame.gravity_without_rotation(p)
        np.testing.assert_allclose(gravity.at(p), exact, rtol=0.0, atol=3e-9)


@pytest.fixture
def navigator(started):
    return Navigator(started.start, InnovationGate(), lag=20.0, memory=10.0)


def position_sigma(navigator, started):
    return navigator.newest(started.trial.body_axes)().position_std[0]


def test_a_segment_takes_the_motion_on_by_its_length(navigator, started):
    for i in range(5):
        seg = started.segment(i)
        navigator.extend(seg, started.aids(seg))
        assert navigator.time == pytest.approx(seg.node_time[1])
    last = navigator.last_segment(started.trial.body_axes, navigator.time - 1.0)()
    assert last.time.size == 10
    found = motion_errors(last, started.trial.reference)
    for v in (found.position, found.velocity, found.attitude):
        assert np.abs(v.normalised).max() < 5.0
    labels = {i.label for i in navigator.innovations}
    assert labels == {"GNSS position", "GNSS velocity", "DVL velocity"}
    assert not navigator.findings


def test_without_measurements_the_position_becomes_worse_and_with_them_not(started):
    alone, aided = (
        Navigator(started.start, InnovationGate(), lag=20.0, memory=10.0) for _ in range(2)
    )
    before = position_sigma(alone, started)
    for i in range(4):
        seg = started.segment(i)
        alone.extend(seg, [])
        aided.extend(seg, started.aids(seg))
    assert np.all(position_sigma(alone, started) > before)
    assert np.all(position_sigma(aided, started) < position_sigma(alone, started))


def test_late_measurements_correct_what_is_known(started):
    on_time, late = (
        Navigator(started.start, InnovationGate(), lag=20.0, memory=10.0) for _ in range(2)
    )
    kept = {}
    for i in range(3):
        seg = started.segment(i)
        on_time.extend(seg, started.aids(seg))
        kept[late.smoother.node] = started.aids(seg)
        late.extend(seg, [])
    late.correct(kept)
    found, expected = (np.sqrt(np.diag(each.calibration().covariance)) for each in (late, on_time))
    np.testing.assert_allclose(found, expected, rtol=1e-3)
    np.testing.assert_allclose(
        position_sigma(late, started), position_sigma(on_time, started), rtol=0.01
    )


def test_a_time_belongs_to_the_state_before_it(navigator, started):
    first = navigator.smoother.node
    for i in range(2):
        navigator.extend(started.segment(i), [])
    t = started.start.time
    assert navigator.node_before(t + 0.5) == first
    assert navigator.node_before(t + 1.5) == first + 1
    assert navigator.node_before(t - 5.0) is None
    assert navigator.node_before(t + 10.0) is None


def test_what_will_be_known_later_is_less_by_the_walk_of_the_biases(navigator, started):
    now, later = navigator.known(0.0), navigator.known(100.0)
    settings = started.trial.imu.settings
    walk = np.repeat([settings.accel_bias_walk_root_psd, settings.gyro_bias_walk_root_psd], 3)
    gained = np.diag(later.covariance - now.covariance)
    np.testing.assert_allclose(gained[:6], walk**2 * 100.0, rtol=1e-9)
    np.testing.assert_allclose(gained[6:], 0.0, atol=0.0)


def test_no_rotation_has_changed_at_the_start(navigator):
    assert navigator.rotation_change < 1e-6


def test_what_was_known_is_the_same_when_it_is_read_later(navigator, started):
    axes = started.trial.body_axes
    segments = [started.segment(i) for i in range(2)]
    navigator.extend(segments[0], started.aids(segments[0]))
    finders = (navigator.newest(axes), navigator.last_segment(axes, 0.0))
    now, calibration = [find() for find in finders], navigator.calibration()
    known = navigator.find_calibration()
    navigator.extend(segments[1], started.aids(segments[1]))
    for before, find in zip(now, finders, strict=True):
        for name, values in vars(before).items():
            np.testing.assert_array_equal(getattr(find(), name), values, err_msg=name)
    np.testing.assert_array_equal(known().covariance, calibration.covariance)
    assert not np.array_equal(navigator.calibration().covariance, calibration.covariance)
