"""Navigation in the plane, from dead reckoning and ranges to beacons.

For a vehicle without a usable IMU: heading, speed and depth carry it from range to range.
`planar_track` integrates them, `search` finds positions to start from, `smoother` the most
probable track near a start and its covariance, `hypotheses` follows all tracks that the ranges
allow, `hypothesis_weights` compares them, `marginal_posterior` integrates along the direction
that is determined least, and `planar_solution` makes a solution. No GTSAM is needed: the graph
is a chain with a few constants, and elimination along the chain is a banded Cholesky
factorisation.
"""
