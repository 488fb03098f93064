"""The true calibration of a simulated trial."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.truth_file import read_truth, truth_json


def test_what_is_written_is_read(tmp_path):
    truth = {"misalignment_deg": np.array([1.0, 2.0, 30.0]), "scale_error": np.array(0.005)}
    path = tmp_path / "truth.json"
    path.write_bytes(truth_json(truth))
    found = read_truth(path)
    np.testing.assert_array_equal(found["misalignment_deg"], [1.0, 2.0, 30.0])
    np.testing.assert_array_equal(found["scale_error"], [0.005])
    assert read_truth(tmp_path / "none.json") == {}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "cannot be read"),
        ('{"parameters": {"a": {"value": "text"}}}', "cannot be read"),
        ('{"parameters": {"a": {"value": [[1, 2], [3]]}}}', "the vectors differ in size"),
        ('{"parameters": {"scale_error": {"value": [-2]}}}', "scale_error"),
    ],
)
def test_what_is_none_is_refused_with_the_file(tmp_path, text, said):
    path = tmp_path / "truth.json"
    path.write_text(text)
    with pytest.raises(DataError, match=said) as caught:
        read_truth(path)
    assert "truth.json" in str(caught.value)
