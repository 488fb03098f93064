"""Simulated paddle wheel."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from factorgraph_dvl.sensors.wheel import Wheel, WheelSettings

from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.protocol import SensorSection
from factorgraph_dvl.simulation.instruments import ScenarioView, SimulatedInstrument
from factorgraph_dvl.simulation.measurements import sample_times
from factorgraph_dvl.simulation.motion import TrueMotion


class WheelTruth(SimulatedInstrument, frozen=True, kw_only=True):
    """The simulated wheel."""

    section_type: ClassVar[type[SensorSection]] = WheelSettings

    scale_error: float = 0.0
    speed_std_m_s: float = 0.05

    def claimed(self) -> dict[str, Any]:
        """Return the noise as simulated."""
        return {"speed_std_m_s": self.speed_std_m_s}


def simulate_wheel(
    scenario: ScenarioView, motion: TrueMotion, rng: np.random.Generator
) -> tuple[Wheel, dict[str, Array]]:
    """Return the wheel's record and its scale error."""
    truth: WheelTruth = scenario.wheel
    time = sample_times(truth, motion.duration, rng)
    state = motion.at(time)
    settings: Any = scenario.settings("wheel")
    nRb = rotation_from_rph(state.rph, scenario.body_axes)
    speed = (1.0 + truth.scale_error) * np.sum(nRb @ np.array(settings.ahead) * state.v_n, axis=1)
    speed += truth.speed_std_m_s * rng.standard_normal(time.size)
    return Wheel(settings, time, speed), {"wheel_scale_error": np.array([truth.scale_error])}
