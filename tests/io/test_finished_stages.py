"""Finished stages: kept for the same inputs alone, and computed anew where they are damaged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.io.finished_stages import FinishedStages
from factorgraph_dvl.solvers.stages import finished


@dataclass(frozen=True)
class Part:
    name: str
    weights: dict[str, Array]


@dataclass(frozen=True)
class Result:
    values: Array
    used: np.ndarray
    parts: tuple[Part, ...]
    time: float | None = None


RESULT = Result(
    np.array([[0.1, np.nan], [-np.inf, 1e-300]]),
    np.array([True, False]),
    (Part("GNSS", {"position": np.arange(3.0)}), Part("DVL", {})),
)


def never():
    raise AssertionError("computed again")


def same(found):
    np.testing.assert_array_equal(found.values, RESULT.values)
    np.testing.assert_array_equal(found.used, RESULT.used)
    np.testing.assert_array_equal(found.parts[0].weights["position"], [0.0, 1.0, 2.0])
    found.values[0, 0] = 1.0
    return found.parts[1] == RESULT.parts[1]


def test_a_result_is_taken_to_the_last_bit(tmp_path):
    first = FinishedStages(tmp_path / "stages", "inputs", resume=False)
    assert not first.found
    assert first.names == []
    assert first.result("alignment", Result, lambda: RESULT) is RESULT
    again = FinishedStages(tmp_path / "stages", "inputs", resume=True)
    assert again.found
    assert again.names == ["alignment"]
    assert same(again.result("alignment", Result, never))
    again.remove()
    assert not (tmp_path / "stages").exists()


@pytest.mark.parametrize(("fingerprint", "resume"), [("others", True), ("inputs", False)])
def test_of_other_inputs_or_without_resume_nothing_is_taken(tmp_path, fingerprint, resume):
    first = FinishedStages(tmp_path / "stages", "inputs", resume=False)
    first.result("alignment", Result, lambda: RESULT)
    other = FinishedStages(tmp_path / "stages", fingerprint, resume=resume)
    assert not other.found
    with pytest.raises(AssertionError, match="computed again"):
        other.result("alignment", Result, never)


@pytest.mark.parametrize("content", [b"", b"\xc1", b"\x93\x01\x02\x03"])
def test_a_damaged_file_is_computed_anew(tmp_path, content):
    stages = FinishedStages(tmp_path / "stages", "inputs", resume=False)
    stages.result("alignment", Result, lambda: RESULT)
    (tmp_path / "stages" / "alignment.msgpack").write_bytes(content)
    assert stages.result("alignment", Result, lambda: RESULT) is RESULT
    assert same(stages.result("alignment", Result, never))


def test_without_room_a_run_goes_on(tmp_path):
    stages = FinishedStages(tmp_path / "stages", "inputs", resume=False)
    # Under this name nothing can be written.
    (tmp_path / "stages" / "alignment.partial").mkdir()
    assert stages.result("alignment", Result, lambda: RESULT) is RESULT
    other = Result(RESULT.values, RESULT.used, (object(),))
    assert stages.result("mounting", Result, lambda: other) is other
    assert finished(None, "alignment", Result, lambda: RESULT) is RESULT
