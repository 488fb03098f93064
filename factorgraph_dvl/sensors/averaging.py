"""The window over which a sensor averages: its length as a parameter, and what its stamp means."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import msgspec
import numpy as np
from msgspec import UnsetType

from factorgraph_dvl.sensors.parameters import SCALAR, Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import SensorSection

# What the stamp of a mean is the time of.
Stamp = Literal["start", "middle", "end"]
# Plausible length, s, of windows of instruments where nothing else is set. Chosen.
_USUAL_S = 0.3
# How the keys of windows end.
_WINDOW_KEY = "averaging_s"
_MIDDLE = {"start": 0.5, "middle": 0.0, "end": -0.5}


def averaging_spec(prefix: str = "", plausible: float = _USUAL_S) -> ParameterSpec:
    """Return what the length of a window is; `prefix` is that of its name."""
    return usual_spec(f"{prefix}averaging", plausible)


def usual_spec(stem: str, plausible: float) -> ParameterSpec:
    """Return what a time is that sensors have although trials do not state it, above zero."""
    return ParameterSpec(stem, "s", labels=SCALAR, nuisance=True, plausible=plausible, usual=True)


def usual_parameter(spec: ParameterSpec, length: float, std: float | UnsetType) -> Parameter:
    """Return the length of a window, or another time that sensors usually have.

    Where its standard deviation is stated, tests leave it as it is.
    """
    if isinstance(std, UnsetType):
        return Parameter(spec, np.array([length]), np.zeros(1))
    final = replace(spec, usual=False, plausible=None)
    return Parameter(final, np.array([length]), np.array([std]))


def is_window(key: str) -> bool:
    """Whether a key, or the name of a parameter, is that of the length of a window."""
    return key.endswith(_WINDOW_KEY)


def stated_window(settings: SensorSection) -> float:
    """Return the window, s, over which a section states that velocities are averaged."""
    lengths = (getattr(settings, key) for key in settings.left_out if is_window(key))
    return max(lengths, default=0.0)


def hidden_delay(length: float) -> float:
    """Return the delay, s, up to which what a window hides of sway may look like one."""
    return 0.5 * length


def stamp_in_the_middle(record: Any) -> None:
    """Move the stamps of a record, which is new, to the middles of its windows."""
    settings = record.settings
    shift = _MIDDLE[settings.stamp] * settings.averaging_s
    if shift != 0.0:
        # A new array: the one that was given is the caller's.
        object.__setattr__(record, "time", record.time + shift)
        settings = msgspec.structs.replace(settings, stamp="middle")
        object.__setattr__(record, "settings", settings)
