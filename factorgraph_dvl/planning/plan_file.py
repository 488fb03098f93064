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

import msgspec

from factorgraph_dvl.simulation.scenario import Scenario, read_scenario


class Plan(Scenario, frozen=True, kw_only=True):
    """A scenario that is not drawn from but predicted, with the σ that it shall reach."""

    required: dict[str, float | list[float]] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, values in self.required.items():
            numbers = values if isinstance(values, list) else [values]
            if not numbers or not all(0.0 < s < float("inf") for s in numbers):
                raise ValueError(f"`required` must hold σ above 0, unlike `{name}`: {values}")


def load_plan(path: str | PathLike[str]) -> Plan:
    """Read a plan from its YAML file.

    Raises
    ------
    ConfigError
        As `load_scenario`, also for `required`.
    """
    return read_scenario(path, Plan)
