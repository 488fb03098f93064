"""Where a trial starts, between the settings of trial.yaml and the trial."""

from __future__ import annotations

import msgspec
import numpy as np
from msgspec import UNSET

from factorgraph_dvl.files.trial_yaml import InitialSettings, PositionSettings, VelocitySettings
from factorgraph_dvl.geometry.units import DEG, GEODETIC_SI
from factorgraph_dvl.trial import InitialAttitude, InitialPosition, InitialVelocity, Trial


def attitude_of(initial: InitialSettings) -> InitialAttitude | None:
    """Return the prior of the attitude that `initial` states, None if there is none."""
    if initial.roll_pitch_heading_deg is UNSET or initial.std_deg is UNSET:
        return None
    return InitialAttitude(
        np.array(initial.roll_pitch_heading_deg) * DEG, np.array(initial.std_deg) * DEG
    )


def velocity_of(initial: InitialSettings) -> InitialVelocity | None:
    """Return the prior of the velocity that `initial` states, None if there is none."""
    velocity = initial.velocity
    if velocity is UNSET:
        return None
    return InitialVelocity(np.array(velocity.east_north_up_m_s), np.array(velocity.std_m_s))


def position_of(initial: InitialSettings) -> InitialPosition | None:
    """Return the prior of the position that `initial` states, None if there is none."""
    position = initial.position
    if position is UNSET:
        return None
    geodetic = np.array([position.lat_deg, position.lon_deg, position.height_m])
    return InitialPosition(geodetic * GEODETIC_SI, np.array(position.std_m))


def initial_settings(trial: Trial) -> InitialSettings | msgspec.UnsetType:
    """Return what a trial states of its start, as `initial` has it."""
    attitude, position = trial.initial_attitude, trial.initial_position
    velocity = trial.initial_velocity
    if attitude is None and position is None and velocity is None:
        return UNSET
    fields: dict[str, object] = {}
    if attitude is not None:
        fields["roll_pitch_heading_deg"] = tuple((attitude.rph / DEG).tolist())
        fields["std_deg"] = tuple((attitude.std / DEG).tolist())
    if position is not None:
        lat, lon, height = (position.geodetic / GEODETIC_SI).tolist()
        fields["position"] = PositionSettings(
            lat_deg=lat, lon_deg=lon, height_m=height, std_m=tuple(position.std.tolist())
        )
    if velocity is not None:
        fields["velocity"] = VelocitySettings(
            east_north_up_m_s=tuple(velocity.velocity.tolist()),
            std_m_s=tuple(velocity.std.tolist()),
        )
    return InitialSettings(**fields)  # type: ignore[arg-type]
