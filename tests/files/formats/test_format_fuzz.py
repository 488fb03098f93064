"""Damaged input ends in records or in an error of this package, quickly and in little memory.

`python tests/format_fuzz.py 960 41` does the same at length, with all readers here, and
`python tests/format_fuzz.py 960 41 bag` with that of a library.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from format_fuzz import LIBRARIES, OWN, run

from factorgraph_dvl.files.formats.catalogue import FORMATS

EXTRAS = {form.name: form for form in FORMATS if form.module}
TESTS = Path(__file__).resolve().parents[2]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("count", [50, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", OWN)
def test_damaged_input(name, count):
    found = run(name, count, 11)
    # 64 kB take milliseconds on an idle machine; a hang takes longer than this on any.
    assert found["slowest"] < 5.0
    assert found["most"] < 20e6
    assert found["useful"] > 10


@pytest.mark.slow
@pytest.mark.parametrize("name", LIBRARIES)
def test_damaged_input_of_a_library(name):
    form = EXTRAS[name]
    pytest.importorskip(form.module, reason=f"extra {form.extra} not installed")
    if name == "bag":
        pytest.importorskip("mcap")
    path = os.pathsep.join([str(TESTS.parent), str(TESTS)])
    done = subprocess.run(
        [sys.executable, str(TESTS / "format_fuzz.py"), "25", "11", name],
        env=os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert "25 inputs" in done.stdout
