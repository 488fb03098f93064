"""Units in which speeds may have been written."""

from factorgraph_dvl.geometry.units import KNOT

# Below this speed, m/s, a vehicle is not called moving. Chosen: drift by wind and sea.
MOVING_M_S = 0.3
# SI value of what a speed may have been written in.
SPEED_UNITS = {
    "knots": KNOT,
    "km/h": 1.0 / 3.6,
    "ft/s": 0.3048,
    "cm/s": 0.01,
    "mm/s": 0.001,
}
