from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from comparisons import dense, moved, one, result, scale

from factorgraph_dvl.analysis.comparison.crosscheck import crosscheck
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.trial import Reference


def test_errors_against_truth() -> None:
    trajectory = dense(10.0, 50.0)
    reference = Reference(
        trajectory.time, trajectory.geodetic, trajectory.velocity, trajectory.rph
    )
    a = scale(1.3, 0.1, trajectory=trajectory)
    b = scale(0.9, 0.1, trajectory=moved(trajectory, 2.0))
    check = crosscheck(a, b, truth={"scale_error": 1.0}, reference=reference)
    assert check.has_truth
    truth_a, truth_b = check.truth_a.calibration, check.truth_b.calibration
    assert truth_a is not None
    assert truth_b is not None
    assert truth_a.nees == pytest.approx(9.0)
    assert truth_b.nees == pytest.approx(1.0)
    assert check.truth_b.trajectory is not None
    np.testing.assert_allclose(check.truth_b.trajectory.position.error[:, 2], 2.0, atol=1e-6)


def test_other_trials_are_not_the_same_data() -> None:
    check = crosscheck(scale(1.0, 1.0), scale(1.0, 2.0, trial="another"), efficient="A")
    assert check.efficient is None
    assert one(check).kind == "upper bound"
    assert "A is from trial by hand, B from another" in check.notes[0]


def test_nothing_in_common_is_an_error() -> None:
    bare = replace(dense(1.0, 1.0), time=np.array([1e6]))
    with pytest.raises(DataError, match="nothing in common"):
        crosscheck(result(trajectory=bare), scale(1.0, 1.0))
