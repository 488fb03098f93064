"""Plans: scenarios with the standard deviations that they shall reach.

```yaml
...                                # all that a scenario has
required:                          # σ in the names and units of calibration.json
  misalignment_deg: 0.05           # of every component
  scale_error: 0.0005
  lever_arm_m: [0.05, 0.05, 0.1]   # of each
  lever_arm_z_m: 0.05              # of one; before the others
```
"""

from __future__ import annotations

from os import PathLike
from typing import Any

import msgspec

from factorgraph_dvl.simulation.scenario import Scenario, read_scenario


class Plan(Scenario, frozen=True, kw_only=True):
    """A scenario that is not drawn from but predicted, with the σ that it shall reach."""

    # A mapping of Any: a number, or a list of them, is checked below in one sentence.
    required: dict[str, Any] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, given in self.required.items():
            numbers = given if isinstance(given, list) else [given]
            if not numbers or not all(_is_sigma(number) for number in numbers):
                raise ValueError(
                    f"`required` must hold a number above 0 for each name, or a list of them; "
                    f"{name} is {given}"
                )


def _is_sigma(value: Any) -> bool:
    is_number = isinstance(value, float | int) and not isinstance(value, bool)
    return is_number and 0.0 < value < float("inf")


def load_plan(path: str | PathLike[str]) -> Plan:
    """Read a plan from its YAML file.

    Raises
    ------
    ConfigError
        As `load_scenario`, also for `required`.
    """
    return read_scenario(path, Plan)
