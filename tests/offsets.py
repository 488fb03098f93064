"""Where the sensors of tests are."""

from __future__ import annotations

# So far from the origin, level axes and those of n differ by half a degree.
OFFSET_RAD = 60e3 / 6.37e6
