"""Memory of small blocks goes back to the system once they are freed."""

import os
import platform
from pathlib import Path

import gtsam
import numpy as np
import pytest

from factorgraph_dvl.graph.freed_memory import return_freed


def resident() -> int:
    """Return the memory in use, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 1_000_000


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other libraries keep less")
def test_memory_of_factors_goes_back():
    unit = gtsam.noiseModel.Unit.Create(9)
    factors = [
        gtsam.JacobianFactor(k, np.eye(9), k + 1, np.eye(9), np.zeros(9), unit)
        for k in range(40_000)
    ]
    full = resident()
    # One that stays behind the others keeps the heap from ending before it.
    kept = factors[-1]
    del factors
    return_freed()
    assert kept.rows() == 9
    assert full - resident() > 40
