"""Segments of a trial, given by the user.

```yaml
segments:
  - {start_s: 0, end_s: 120, label: alongside}
  - {start_s: 120, end_s: 300, label: turning}
```
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated

import msgspec

from factorgraph_dvl.errors import ConfigError, printable
from factorgraph_dvl.settings.sections import Section
from factorgraph_dvl.settings.yaml_file import read_yaml


class SegmentSettings(Section, frozen=True, kw_only=True):
    """One segment."""

    start_s: float
    end_s: float
    label: Annotated[str, msgspec.Meta(min_length=1, max_length=60)]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.end_s <= self.start_s:
            raise ValueError("`end_s` must be above `start_s`")


class _Segments(Section, frozen=True, kw_only=True):
    segments: Annotated[list[SegmentSettings], msgspec.Meta(min_length=1)]


def read_segments(path: Path) -> tuple[tuple[float, float, str], ...]:
    """Read start and end, s, and label of segments, in the order of time.

    Raises
    ------
    ConfigError
        If the file is missing or not valid, or segments overlap.
    """
    found = sorted(read_yaml(path, _Segments).segments, key=lambda s: s.start_s)
    for before, after in pairwise(found):
        if after.start_s < before.end_s:
            raise ConfigError(
                f"segments `{before.label}` and `{after.label}` overlap",
                where=f"{path.name} key segments",
                expected="each to start where the one before has ended, or later",
            )
    return tuple((s.start_s, s.end_s, printable(s.label)) for s in found)
