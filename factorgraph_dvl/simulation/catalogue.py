"""The simulated instruments: a new one is known once it stands here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from factorgraph_dvl.sensors.catalogue import PLANAR
from factorgraph_dvl.simulation.beams import simulate_beams, simulate_turntable
from factorgraph_dvl.simulation.compass import (
    AttitudeTruth,
    InsTruth,
    simulate_attitude,
    simulate_ins,
)
from factorgraph_dvl.simulation.depth import simulate_depth
from factorgraph_dvl.simulation.instruments import (
    DepthTruth,
    DvlBeamsTruth,
    DvlTruth,
    GnssTruth,
    ImuTruth,
    SimulatedInstrument,
    StarTruth,
    TurntableTruth,
)
from factorgraph_dvl.simulation.measurements import simulate_dvl, simulate_gnss, simulate_imu
from factorgraph_dvl.simulation.ranging import (
    BeaconTruth,
    HeadingTruth,
    LogTruth,
    simulate_beacons,
    simulate_heading,
    simulate_log,
)
from factorgraph_dvl.simulation.star import simulate_star
from factorgraph_dvl.simulation.usbl import UsblTruth, simulate_usbl


class Instrument(NamedTuple):
    """Section of a scenario, and the model that makes a record and its truth from it."""

    truth: type[SimulatedInstrument]
    simulate: Callable[..., tuple[Any, dict[str, Any]]]


# By section; the order is that of the random streams, so a new instrument comes last.
INSTRUMENTS = {
    "imu": Instrument(ImuTruth, simulate_imu),
    "gnss": Instrument(GnssTruth, simulate_gnss),
    "dvl": Instrument(DvlTruth, simulate_dvl),
    "star": Instrument(StarTruth, simulate_star),
    "depth": Instrument(DepthTruth, simulate_depth),
    "beacons": Instrument(BeaconTruth, simulate_beacons),
    "dvl_beams": Instrument(DvlBeamsTruth, simulate_beams),
    "turntable": Instrument(TurntableTruth, simulate_turntable),
    "attitude": Instrument(AttitudeTruth, simulate_attitude),
    "ins": Instrument(InsTruth, simulate_ins),
    "heading": Instrument(HeadingTruth, simulate_heading),
    "log": Instrument(LogTruth, simulate_log),
    "usbl": Instrument(UsblTruth, simulate_usbl),
}
# Of a planar trial, likewise in the order of its streams.
PLANAR_INSTRUMENTS = {kind.section: INSTRUMENTS[kind.section] for kind in PLANAR}
