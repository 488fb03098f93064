"""Water that a DVL sees in place of the bottom: its current, all the time or for a while."""

from __future__ import annotations

from dataclasses import replace

from factorgraph_dvl.sensors.parameters import ParameterSpec

# Plausible size, m/s. Chosen: tides and ocean currents.
CURRENT_SPEC = ParameterSpec(
    "current", "m_s", labels=("e", "n"), frame="n", plausible=0.5, of_record=True
)
# Of water that is seen in place of the bottom for a while: its current, and the first and the last
# stamp, which a search finds.
WATER_SPEC = replace(CURRENT_SPEC, stem="water_current", nuisance=True, searched=True)
WATER_SPAN_SPEC = ParameterSpec("water_span", "s", labels=("first", "last"), nuisance=True)

CURRENT = CURRENT_SPEC.name
WATER, WATER_SPAN = WATER_SPEC.name, WATER_SPAN_SPEC.name
