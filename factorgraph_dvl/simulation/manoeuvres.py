"""Manoeuvres of a scenario, one after the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import msgspec

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.settings.convert import convert
from factorgraph_dvl.settings.sections import NonNegative, Positive, Section

# Chosen: more than any trial has, far fewer than would exhaust memory.
_MAX_MANOEUVRES = 100_000
# Chosen: longest circle, s; four months, so a longer one is a typing error.
_LONGEST_S = 1e7


class Accelerate(Section, frozen=True, kw_only=True):
    """Change the speed through the water at a constant rate."""

    accelerate_m_s2: float
    to_m_s: NonNegative


class Straight(Section, frozen=True, kw_only=True):
    """Keep speed and heading."""

    straight_s: Positive


class Turn(Section, frozen=True, kw_only=True):
    """Turn by turn_deg_s · duration_s, to starboard where positive."""

    turn_deg_s: float
    duration_s: Positive
    ramp_s: NonNegative = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ramp_s > self.duration_s:
            raise ValueError("`ramp_s` must not exceed `duration_s`")


class FigureEight(Section, frozen=True, kw_only=True):
    """Turn a full circle to each side, first to starboard if positive."""

    figure_eight_deg_s: float
    ramp_s: NonNegative = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.figure_eight_deg_s == 0.0:
            raise ValueError("`figure_eight_deg_s` must not be 0")
        if self.circle_s > _LONGEST_S:
            raise ValueError(f"`figure_eight_deg_s`: a circle takes longer than {_LONGEST_S:g} s")
        if self.ramp_s > self.circle_s:
            raise ValueError("`ramp_s` must not exceed the time of a circle")

    @property
    def circle_s(self) -> float:
        """Time of one circle without its ramp, s."""
        return 360.0 / abs(self.figure_eight_deg_s)

    def turns(self) -> tuple[Turn, Turn]:
        """Return the two circles."""
        rate, time = self.figure_eight_deg_s, self.circle_s
        return (
            Turn(turn_deg_s=rate, duration_s=time, ramp_s=self.ramp_s),
            Turn(turn_deg_s=-rate, duration_s=time, ramp_s=self.ramp_s),
        )


class Stop(Section, frozen=True, kw_only=True):
    """Stop in the water for `stop_s`, and return to the speed before."""

    stop_s: NonNegative
    acceleration_m_s2: Positive = 0.2


class Climb(Section, frozen=True, kw_only=True):
    """Change the height at a vertical speed with ramps of `ramp_s` at both ends."""

    climb_m_s: float
    to_height_m: float
    ramp_s: Positive = 10.0


class Repeat(Section, frozen=True, kw_only=True):
    """Run a list of manoeuvres several times."""

    repeat: Annotated[int, msgspec.Meta(ge=1)]
    manoeuvres: list[dict[str, Any]]


Manoeuvre = Accelerate | Straight | Turn | Stop | Climb
_MANOEUVRES: dict[str, type[Manoeuvre | FigureEight | Repeat]] = {
    "accelerate_m_s2": Accelerate,
    "straight_s": Straight,
    "turn_deg_s": Turn,
    "figure_eight_deg_s": FigureEight,
    "stop_s": Stop,
    "climb_m_s": Climb,
    "repeat": Repeat,
}


def flatten(items: Sequence[Mapping[str, Any]], key: str, source: str) -> list[Manoeuvre]:
    """Return manoeuvres with repetitions and figures of eight written out.

    Raises
    ------
    ConfigError
        If one is not valid, or there is none; the message names its key in the source.
    """
    out: list[Manoeuvre] = []
    for i, item in enumerate(items):
        kinds = [kind for name, kind in _MANOEUVRES.items() if name in item]
        if len(kinds) != 1:
            raise ConfigError(
                f"{sorted(item)} is not a manoeuvre",
                where=f"{source} key {key}[{i}]",
                expected=f"exactly one of {', '.join(_MANOEUVRES)}",
            )
        manoeuvre = convert(dict(item), kinds[0], f"{key}[{i}]", source)
        if isinstance(manoeuvre, Repeat):
            inner = flatten(manoeuvre.manoeuvres, f"{key}[{i}].manoeuvres", source)
            if len(out) + len(inner) * manoeuvre.repeat > _MAX_MANOEUVRES:
                raise ConfigError(
                    "the repetitions add up to too many manoeuvres",
                    where=f"{source} key {key}[{i}].repeat",
                    expected=f"at most {_MAX_MANOEUVRES} in all",
                )
            out += inner * manoeuvre.repeat
        elif isinstance(manoeuvre, FigureEight):
            out += manoeuvre.turns()
        else:
            out.append(manoeuvre)
    if not out:
        raise ConfigError(
            "there is no manoeuvre", where=f"{source} key {key}", expected="at least one"
        )
    return out
