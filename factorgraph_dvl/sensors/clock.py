"""The clock of a sensor: its offset and rate against the clock of the IMU."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.parameters import SCALAR, Parameter, ParameterSpec, Relative
from factorgraph_dvl.sensors.protocol import Aid, SensorSection
from factorgraph_dvl.settings.sections import NonNegative

# Plausible offset, s, and rate, ppm, of a clock. Chosen: four times the first are the leap seconds
# of GPS time, and the second is quartz that is broken.
_OFFSET_S = 5.0
_RATE_PPM = 1000.0
# Plausible delay, s, that a buffer makes. Chosen: some pings.
_SAWTOOTH_S = 0.2
# How names of offset and rate end, without the unit.
CLOCK_STEMS = ("time_offset", "clock_rate")


class ClockSection(SensorSection, frozen=True, kw_only=True):
    """Section of trial.yaml of a sensor that has a clock.

    Where `clock` names the section of another sensor, its stamps are by the clock of that one, and
    the time offset is how late they are beside it.
    """

    clock: str = ""
    time_offset_s: float = 0.0
    time_offset_std_s: NonNegative = 0.0
    clock_rate_std_ppm: NonNegative = 0.0

    @property
    def velocity_lag_s(self) -> tuple[float, float]:
        """What stamps of velocities are late by, and its standard deviation, s."""
        return self.time_offset_s, self.time_offset_std_s


@dataclass(frozen=True)
class Clock:
    """What the stamps of a sensor depend on: stamp = t + offset + rate (t - zero) + delay.

    `zero` is the middle of the trial, so that offset and rate do not depend on each other. The
    delay is that of a buffer that fills and is emptied: a sawtooth of the stamp, zero on average.

    Parameters
    ----------
    offset, rate : ParameterSpec
        Offset, s, and rate, ppm, of the sensor's clock.
    sawtooth : ParameterSpec
        How much longer the delay is at the end of a period than at its start, s.
    period : ParameterSpec
        The period, and the stamp at which one begins, s. A search finds them: they are known.
    """

    offset: ParameterSpec
    rate: ParameterSpec
    sawtooth: ParameterSpec
    period: ParameterSpec

    @classmethod
    def of(cls, sensor: str, *, prefix: str = "", section: str = "") -> Clock:
        """Return the clock of a sensor.

        `prefix` is that of the offset's name, and `section` that of trial.yaml if it is not the
        sensor's name.
        """
        offset = ParameterSpec(
            f"{prefix}time_offset",
            "s",
            labels=SCALAR,
            nuisance=True,
            plausible=_OFFSET_S,
            key=f"{section or sensor}: time_offset_std_s",
        )
        rate = ParameterSpec(
            f"{sensor}_clock_rate",
            "ppm",
            labels=SCALAR,
            nuisance=True,
            plausible=_RATE_PPM,
            key=f"{section or sensor}: clock_rate_std_ppm",
        )
        sawtooth = ParameterSpec(
            f"{sensor}_sawtooth_delay",
            "s",
            labels=SCALAR,
            nuisance=True,
            plausible=_SAWTOOTH_S,
            of_record=True,
            searched=True,
        )
        period = ParameterSpec(
            f"{sensor}_sawtooth", "s", labels=("period", "start"), nuisance=True
        )
        return cls(offset, rate, sawtooth, period)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of offset, rate and sawtooth."""
        return self.offset.name, self.rate.name, self.sawtooth.name

    @property
    def specs(self) -> tuple[ParameterSpec, ...]:
        """What offset, rate, sawtooth and its period are."""
        return self.offset, self.rate, self.sawtooth, self.period

    def parameters(self, settings: ClockSection) -> tuple[Parameter, ...]:
        """Return offset and rate with the priors of the settings, and no sawtooth."""
        rate_sigma = settings.clock_rate_std_ppm * self.rate.si
        return (
            Parameter(
                self.offset,
                np.array([settings.time_offset_s]),
                np.array([settings.time_offset_std_s]),
            ),
            Parameter(self.rate, np.zeros(1), np.array([rate_sigma])),
            Parameter(self.sawtooth, np.zeros(1), np.zeros(1)),
            Parameter(self.period, np.zeros(2), np.zeros(2)),
        )

    def lag(self, time: Array, values: Mapping[str, Array], zero: float) -> Array:
        """Return stamps minus true times, (M,), s.

        Parameters
        ----------
        time : ndarray, shape (M,), s
            Stamps.
        values : mapping of str to ndarray
            Offset and rate by name, SI, and the sawtooth where there is one.
        zero : float, s
            When the offset is valid.
        """
        offset, rate = float(values[self.offset.name][0]), float(values[self.rate.name][0])
        out = offset + rate * (time - zero)
        delay = values.get(self.sawtooth.name)
        return out if delay is None or not delay[0] else out + delay[0] * self._rise(time, values)

    def by_parameters(
        self, time: Array, values: Mapping[str, Array], zero: float
    ) -> dict[str, Array]:
        """Return the derivatives of the lag, (M,) by name; arguments are those of `lag`."""
        return {
            self.offset.name: np.ones(time.size),
            self.rate.name: time - zero,
            self.sawtooth.name: self._rise(time, values),
        }

    def _rise(self, time: Array, values: Mapping[str, Array]) -> Array:
        """Return the share of the sawtooth at each stamp, from -1/2 to 1/2, (M,)."""
        period, start = values.get(self.period.name, np.zeros(2))
        return np.mod((time - start) / period, 1.0) - 0.5 if period > 0.0 else np.zeros(time.size)


@dataclass(frozen=True)
class LateClock(Clock):
    """The clock of measurements that may be late beside the others of their sensor.

    Parameters
    ----------
    offset, rate, sawtooth, period : ParameterSpec
        Those of the sensor's clock.
    delay : ParameterSpec
        What their stamps are late by, s, beside the offset.
    """

    delay: ParameterSpec

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of offset, rate, sawtooth and delay."""
        return (*super().names, self.delay.name)

    def lag(self, time: Array, values: Mapping[str, Array], zero: float) -> Array:
        """Return stamps minus true times, (M,), s; arguments are those of `Clock.lag`."""
        return super().lag(time, values, zero) + float(values[self.delay.name][0])

    def by_parameters(
        self, time: Array, values: Mapping[str, Array], zero: float
    ) -> dict[str, Array]:
        """Return the derivatives of the lag, (M,) by name; arguments are those of `lag`."""
        by_clock = super().by_parameters(time, values, zero)
        return by_clock | {self.delay.name: np.ones(time.size)}


def on_shared_clocks(parameters: Iterable[Parameter], aids: Sequence[Aid]) -> list[Parameter]:
    """Return parameters with clocks relative to those that sensors say they are by.

    Parameters
    ----------
    parameters : iterable of Parameter
        Parameters of all sensors.
    aids : sequence of Aid
        The sensors; the settings of each may name the section of another one as `clock`.

    Raises
    ------
    ConfigError
        If that sensor has no clock of its own.
    """
    named = {aid.section: getattr(aid.settings, "clock", "") for aid in aids}
    if not any(named.values()):
        return list(parameters)
    out = {p.name: p for p in parameters}
    clocks = {
        aid.section: [p.name for p in aid.parameters() if p.stem.endswith(CLOCK_STEMS)]
        for aid in aids
    }
    for section, other in named.items():
        if not other:
            continue
        if not clocks.get(other) or named[other]:
            usable = [name for name in clocks if clocks[name] and not named[name]]
            raise ConfigError(
                f"no sensor {other!r} has a clock of its own",
                where=f"{section}.clock",
                expected=f"one of {', '.join(usable)}",
            )
        for own, reference in zip(clocks[section], clocks[other], strict=True):
            p, to = out[own], out[reference]
            if to.estimated:
                relative = Relative(reference, float(p.sigma[0]))
                sigma = np.hypot(p.sigma, to.sigma)
                p = replace(p, sigma=sigma, relative=relative)
            out[own] = replace(p, mean=p.mean + to.mean)
    return list(out.values())
