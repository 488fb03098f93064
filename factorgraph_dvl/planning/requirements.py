"""Required standard deviations, and whether a prediction meets them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.estimates import Estimate


@dataclass(frozen=True)
class Requirement:
    """A required standard deviation and the predicted one, in reported units."""

    component: str
    required: float
    predicted: float

    @property
    def met(self) -> bool:
        """Whether the predicted standard deviation is at most the required one."""
        return self.predicted <= self.required


def requirements(
    required: Mapping[str, float | Sequence[float]], estimates: Sequence[Estimate], source: str
) -> tuple[Requirement, ...]:
    """Return the requirements of a plan with their predictions.

    Parameters
    ----------
    required : mapping of str to float or sequence of float
        Required standard deviations, as in a scenario.
    estimates : sequence of Estimate
        Estimates of the prediction.
    source : str
        Name of the plan, for messages.

    Raises
    ------
    ConfigError
        If a name is not an estimated parameter, or the number of values is wrong.
    """
    components = {
        n: float(e.std[i])
        for e in estimates
        for i, n in enumerate(e.component_names)
        if e.prior_std[i] > 0.0
    }
    by_name = {e.name: [n for n in e.component_names if n in components] for e in estimates}
    sigma: dict[str, float] = {}
    for name, given in required.items():
        values = [given] if isinstance(given, float | int) else list(given)
        names = by_name.get(name) or ([name] if name in components else [])
        if not names:
            known = [n for n, parts in by_name.items() if parts]
            raise ConfigError(
                f"{name} is not estimated in this trial",
                where=f"{source} key required.{name}",
                expected=f"one of {', '.join([*known, *components])}",
            )
        if len(values) not in (1, len(names)):
            raise ConfigError(
                f"{len(values)} numbers are given",
                where=f"{source} key required.{name}",
                expected=f"1, or {len(names)}: {', '.join(names)}",
            )
        spread = values * len(names) if len(values) == 1 else values
        for component, value in zip(names, spread, strict=True):
            # The requirement of a component overrides that of the whole parameter.
            if component not in required or name == component:
                sigma[component] = value
    return tuple(Requirement(n, s, components[n]) for n, s in sigma.items())
