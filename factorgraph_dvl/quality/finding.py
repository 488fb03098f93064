"""A finding about a sensor's record."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

_UNUSABLE = ("time_unit", "no_overlap", "no_measurement", "zero_fixes", "radians", "no_epoch")
Severity = Literal["ok", "warning", "error"]


@dataclass(frozen=True)
class Finding:
    """Something that the user should know about a sensor.

    Parameters
    ----------
    severity : Severity
        `ok`, `warning`, or `error` where solving would give a wrong answer.
    sensor : str
        Label of the sensor.
    text : str
        In plain language.
    code : str, optional
        Stable name of what is wrong, for programs; empty where nothing is.
    """

    severity: Severity
    sensor: str
    text: str
    code: str = ""

    @property
    def unusable(self) -> bool:
        """Whether there is nothing to solve with; else a fit contradicts the data."""
        return self.severity == "error" and self.code in _UNUSABLE

    def __str__(self) -> str:
        return f"{self.sensor}: {self.text}"
