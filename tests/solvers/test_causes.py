"""Causes of the standard deviations of a calibration."""

from __future__ import annotations

import numpy as np
import pytest
import solved

from factorgraph_dvl.solvers.calibration import calibration
from factorgraph_dvl.solvers.causes import causes


@pytest.mark.parametrize("kind", ["turning", "straight"])
def test_the_squares_of_all_causes_are_the_variances(kind):
    _, found = getattr(solved, kind)()
    parts = causes(found)
    std = np.concatenate([e.std for e in calibration(found)[0]])
    total = np.sqrt(np.sum([c.adds**2 for c in parts], axis=0))
    np.testing.assert_allclose(total, std, rtol=0.01)
    # The largest first, each with what is assumed of it.
    share = [float(np.max(c.adds**2 / np.maximum(std**2, 1e-300))) for c in parts]
    assert share == sorted(share, reverse=True)
    assumed = {c.cause: c.assumed for c in parts}
    assert assumed["noise of DVL velocity"].endswith("m/s")
    assert ("directions that the data do not determine" in assumed) == (kind == "straight")
