"""Navigation in the plane, from dead reckoning and ranges to beacons.

For a vehicle without a usable IMU: heading, speed and depth carry it from range to range.
`dead_reckoning` integrates them, `search` finds positions to start from, and `hypothesis_weights`
compares tracks. What follows and minimises them is a `graph.Problem` of a `graph.planar_chain`.
"""
