"""Output of an INS in the place of GNSS: what its filter does to position and velocity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from factorgraph_dvl.simulation import displaced
from factorgraph_dvl.simulation.faults import gauss_markov

# As of a recorded INS of fibre-optic gyros, aided by a DVL: its velocity errs by a centimetre a
# second for minutes and hardly from one second to the next. Its position is not the integral of
# its velocity: it walks, and answers to a change of velocity late, and over a filter's time.
VELOCITY_STD = 0.008
VELOCITY_TIME = 150.0
WHITE_VELOCITY_STD = 0.0005
UP_STD = 0.002
UP_TIME = 3.0
POSITION_WALK = 0.015
ANSWER = 0.35
LATE = 2.5
FILTER_TIME = 15.0


def as_ins_output(trial, seed):
    """Return a trial whose GNSS is an INS's output, from a record of GNSS without noise."""
    rng = np.random.default_rng(seed)
    gnss = trial.gnss
    interval = float(np.median(np.diff(gnss.time)))
    share = np.exp(-interval / FILTER_TIME)
    start = gnss.velocity[0]
    slow = start + lfilter([1.0 - share], [1.0, -share], gnss.velocity - start, axis=0)
    fast = gnss.velocity - slow
    before = gnss.time - LATE
    answer = np.column_stack([np.interp(before, gnss.time, each) for each in fast.T])
    walk = np.cumsum(rng.standard_normal(fast.shape), axis=0) * POSITION_WALK * np.sqrt(interval)
    position = (walk - ANSWER * answer) * [1.0, 1.0, 0.1]
    slow_error = gauss_markov(gnss.time, [VELOCITY_TIME, VELOCITY_TIME, UP_TIME], 3, rng)
    error = slow_error * [VELOCITY_STD, VELOCITY_STD, UP_STD]
    error += WHITE_VELOCITY_STD * rng.standard_normal(fast.shape)
    return replace(
        trial,
        gnss=replace(
            gnss,
            geodetic=displaced(gnss.geodetic, position),
            velocity=gnss.velocity + error,
        ),
    )
