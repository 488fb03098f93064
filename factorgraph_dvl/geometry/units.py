"""Units of files and people in SI."""

from __future__ import annotations

import numpy as np

# By definition: SI values of the units of files.
DEG = np.pi / 180.0
ARCSEC = DEG / 3600.0
HOUR = 3600.0
DAY = 86400.0
KNOT = 1852.0 / HOUR
MICROSECOND = 1e-6
PPM = 1e-6
DEG_PER_HOUR = DEG / HOUR
DEG_PER_SQRT_HOUR = DEG / np.sqrt(HOUR)
# By definition, m/s² (3rd CGPM, 1901).
STANDARD_GRAVITY = 9.80665
MICRO_G = 1e-6 * STANDARD_GRAVITY
# SI values of the units of latitude, longitude and height in files.
GEODETIC_SI = np.array([DEG, DEG, 1.0])
