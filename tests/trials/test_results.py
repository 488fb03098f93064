"""Results of trials of all kinds are those of the program before it was laid out anew."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from store_results import TRIALS, results

STORED = Path(__file__).resolve().parents[1] / "data" / "results.json"
# Standard deviations, as shares of themselves, and values, as shares of theirs.
SHARE = 1e-3
EARTH = np.array([6.4e6, 6.4e6, 1.0])


# They take long: what is left has GNSS, a DVL and a star tracker in one minute.
LONG = ("cruise", "cruise-mems", "cruise-beams", "dive", "dive-one-beacon")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in LONG else ()) for n in TRIALS]
)
def test_results_are_as_stored(name):
    before = json.loads(STORED.read_text(encoding="utf-8"))[name]
    now = results(name)
    assert now["converged"] == before["converged"]
    assert now["estimates"].keys() == before["estimates"].keys()
    for parameter, old in before["estimates"].items():
        new = {key: np.array(value) for key, value in now["estimates"][parameter].items()}
        assert new["observable"].tolist() == old["observable"], parameter
        np.testing.assert_allclose(new["std"], old["std"], rtol=SHARE, err_msg=parameter)
        # Beam directions are unit vectors of three components with two standard deviations.
        scale = np.max(old["std"]) if new["value"].size != new["std"].size else old["std"]
        miss = np.abs(new["value"] - old["value"])
        assert np.all(miss <= SHARE * np.asarray(scale)), parameter
    old, new = before["trajectory"], now["trajectory"]
    np.testing.assert_allclose(new["time"], old["time"], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(new["position_std"], old["position_std"], rtol=SHARE)
    moved = np.abs(np.subtract(new["geodetic"], old["geodetic"])) * EARTH
    assert np.all(moved <= SHARE * np.max(old["position_std"]))
