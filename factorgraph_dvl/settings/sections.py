"""Sections of YAML files: typed settings whose names state their units and ranges."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from typing import Annotated, Any

import msgspec

from factorgraph_dvl.settings.ranges import out_of_range

Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Vector3 = tuple[float, float, float]
Sigma3 = tuple[NonNegative, NonNegative, NonNegative]


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A section of a YAML file, in the units that its names state."""

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            if wrong := out_of_range(name, _numbers(getattr(self, name))):
                raise ValueError(wrong)


def check_epoch(epoch: str) -> None:
    """Raise ValueError unless an epoch is empty or a date and time of ISO 8601."""
    try:
        if epoch:
            datetime.fromisoformat(epoch)
    except ValueError:
        raise ValueError("`epoch` must be a date and time such as 2022-10-12T02:00:00Z") from None


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, float):
        yield value
    elif isinstance(value, (tuple, list)):
        for item in value:
            yield from _numbers(item)
