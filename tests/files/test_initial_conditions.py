"""Where a trial starts, in its settings and in the trial."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from builders import build_trial
from msgspec import UNSET

from factorgraph_dvl.files.initial_conditions import (
    attitude_of,
    initial_settings,
    position_of,
    velocity_of,
)


def test_what_a_trial_states_comes_back():
    trial = build_trial()
    settings = initial_settings(trial)
    np.testing.assert_allclose(attitude_of(settings).rph, trial.initial_attitude.rph)
    np.testing.assert_allclose(attitude_of(settings).std, trial.initial_attitude.std)
    np.testing.assert_allclose(position_of(settings).geodetic, trial.initial_position.geodetic)
    np.testing.assert_array_equal(position_of(settings).std, trial.initial_position.std)
    np.testing.assert_array_equal(velocity_of(settings).velocity, trial.initial_velocity.velocity)
    # In degrees, as files have it.
    np.testing.assert_allclose(settings.std_deg, np.degrees(trial.initial_attitude.std))


def test_what_is_not_stated_is_none():
    trial = build_trial()
    nothing = replace(trial, initial_attitude=None, initial_position=None, initial_velocity=None)
    assert initial_settings(nothing) is UNSET
    only = initial_settings(replace(nothing, initial_position=trial.initial_position))
    assert attitude_of(only) is None
    assert velocity_of(only) is None
    assert position_of(only) is not None
