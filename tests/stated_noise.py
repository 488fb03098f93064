"""Trials that state noise other than they have."""

from __future__ import annotations

from dataclasses import replace

import msgspec

from factorgraph_dvl.trial import Trial


def stated(
    trial: Trial, factor_dvl: float = 1.0, factor_gnss: float = 1.0, **settings: object
) -> Trial:
    """State noise that is wrong by factors."""
    dvl, gnss = trial.dvl.settings, trial.gnss
    dvl = msgspec.structs.replace(
        dvl,
        velocity_std_m_s=factor_dvl * dvl.velocity_std_m_s,
        velocity_std_fraction=factor_dvl * dvl.velocity_std_fraction,
        **settings,
    )
    gnss = replace(
        gnss,
        position_std=factor_gnss * gnss.position_std,
        velocity_std=factor_gnss * gnss.velocity_std,
    )
    return replace(trial, dvl=replace(trial.dvl, settings=dvl), gnss=gnss)
