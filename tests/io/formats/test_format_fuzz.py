"""Damaged input ends in records or in an error of this package, quickly and in little memory.

`python tests/format_fuzz.py 2000` does the same at length.
"""

from __future__ import annotations

import pytest
from format_fuzz import run, seeds

READERS = seeds()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", READERS)
def test_damaged_input(name):
    _, slowest, most = run(name, *READERS[name], 60, 11)
    # 64 kB take milliseconds on an idle machine; a hang takes longer than this on any.
    assert slowest < 5.0
    assert most < 20e6
