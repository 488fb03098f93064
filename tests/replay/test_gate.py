"""The innovation gate."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.replay.gate import InnovationGate


def test_a_kind_of_outliers_is_excluded_until_it_agrees():
    gate = InnovationGate()
    rng = np.random.default_rng(0)
    used, finding = gate.accept("DVL", rng.normal(size=(50, 3)))
    assert used.all()
    assert finding is None
    used, _ = gate.accept("DVL", np.array([[7.0, 0, 0]]))
    assert not used.any()
    used, finding = gate.accept("DVL", np.full((30, 3), 8.0))
    assert not used.any()
    assert (finding.code, finding.sensor) == (Code.CONTRADICTS, "DVL")
    assert gate.excluded == {"DVL"}
    for _ in range(60):
        used, finding = gate.accept("DVL", rng.normal(size=(1, 3)))
        if finding is not None:
            break
    assert (finding.code, finding.sensor) == (Code.HEARD_AGAIN, "DVL")
    assert not gate.inconsistent


def test_an_outlier_is_rejected_and_nothing_else():
    gate = InnovationGate()
    rng = np.random.default_rng(0)
    gate.accept("GNSS", rng.normal(size=(50, 3)))
    used, finding = gate.accept("GNSS", np.array([[200.0, 0, 0]]))
    assert not used.any()
    assert finding is None
    used, _ = gate.accept("GNSS", rng.normal(size=(5, 3)))
    assert used.all()
    assert not gate.inconsistent


def test_a_kind_of_large_innovations_is_excluded_though_none_is_an_outlier():
    gate = InnovationGate()
    _, finding = gate.accept("GNSS", np.full((50, 3), 4.0))
    assert gate.excluded == {"GNSS"}
    assert "the last 50 innovations are 4.0 times as large as predicted" in finding.text


def test_innovations_that_are_too_large_are_inconsistent():
    gate = InnovationGate()
    rng = np.random.default_rng(0)
    used, finding = gate.accept("DVL", rng.normal(0.0, 2.0, (50, 3)))
    assert used.all()
    assert "too small" in finding.text
    assert gate.inconsistent == {"DVL"}


def test_echoes_are_rejected_one_by_one():
    gate = InnovationGate()
    rng = np.random.default_rng(0)
    normalised = np.where(rng.random(2000) < 0.2, 40.0, rng.normal(size=2000))
    for value in normalised:
        used, finding = gate.accept("range", np.array([[value]]), 3.5)
        assert used.all() == (abs(value) < 3.5)
        assert finding is None
    assert not gate.inconsistent
    # A clock that has jumped is another matter.
    found = [gate.accept("range", np.array([[40.0]]), 3.5)[1] for _ in range(50)]
    assert {f.code for f in found if f is not None} == {Code.CONTRADICTS}
    assert any("none are used until" in str(f) for f in found)
