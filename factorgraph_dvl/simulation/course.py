"""Where a simulated vessel starts, and how the sea moves it."""

from __future__ import annotations

from typing import Annotated

import msgspec

from factorgraph_dvl.settings.sections import NonNegative, Positive, Section

Latitude = Annotated[float, msgspec.Meta(ge=-89, le=89)]
Longitude = Annotated[float, msgspec.Meta(ge=-360, le=360)]


class StartSettings(Section, frozen=True, kw_only=True):
    """Position, heading and speed of the vehicle at time zero."""

    lat_deg: Latitude
    lon_deg: Longitude
    height_m: float = 0.0
    heading_deg: float = 0.0
    speed_m_s: NonNegative = 0.0


class AngularSway(Section, frozen=True, kw_only=True):
    """A sinusoid of an angle."""

    amplitude_deg: float
    frequency_hz: Positive
    phase_deg: float = 0.0


class Heave(Section, frozen=True, kw_only=True):
    """A sinusoid of the height."""

    amplitude_m: float
    frequency_hz: Positive
    phase_deg: float = 0.0


class SwaySettings(Section, frozen=True, kw_only=True):
    """Sway of the vehicle by the sea."""

    roll: tuple[AngularSway, ...] = ()
    pitch: tuple[AngularSway, ...] = ()
    yaw: tuple[AngularSway, ...] = ()
    heave: tuple[Heave, ...] = ()
