"""A finding about a sensor's record."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["ok", "warning", "error"]


@dataclass(frozen=True)
class Finding:
    """Something that the user should know about a sensor.

    Parameters
    ----------
    severity : `ok`, `warning`, or `error` where solving would give a wrong answer.
    sensor : label of the sensor.
    text : in plain language.
    """

    severity: Severity
    sensor: str
    text: str
