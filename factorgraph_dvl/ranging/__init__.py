"""Navigation in the plane, from dead reckoning and ranges to beacons.

The light form, for a vehicle without a usable IMU: heading, speed and depth carry it from
range to range. `track` reckons, `smoother` finds the most probable track near a start and its
covariance, `search` the starts, `evidence` weighs, `hypotheses` follows all tracks that the
ranges allow, `ridge` says how far each may turn, and `solve` makes a solution. It needs
no GTSAM: its graph is a chain with a few constants, and elimination along the chain is a
banded Cholesky factorisation.
"""
