"""What the transceiver of a USBL measured, and the ship that carries it, as two tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.files.importing.acoustic import between, of_vessel
from factorgraph_dvl.files.importing.decisions import Decisions
from factorgraph_dvl.files.importing.merging import Beside, Merged, merge
from factorgraph_dvl.files.importing.time_base import Timed
from factorgraph_dvl.geometry.units import DEG, GEODETIC_SI
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.attitude import COLUMNS as ATTITUDE_COLUMNS
from factorgraph_dvl.sensors.gnss import POSITION_COLUMNS
from factorgraph_dvl.sensors.records import named_columns
from factorgraph_dvl.sensors.usbl import CARTESIAN_COLUMNS, POLAR_COLUMNS

_POLAR_SI = np.array([1.0, DEG, DEG])


@dataclass(frozen=True)
class Transceiver:
    """Measurements of a transceiver, and position and attitude of its ship.

    Parameters
    ----------
    measured, position, attitude : Merged
        Records in order.
    height : {'height', 'altitude', ''}
        Which vertical position of the ship is used; empty if there is none.
    """

    measured: Merged
    position: Merged
    attitude: Merged
    height: str

    def tables(self, epoch: float) -> Iterator[dict[str, Array]]:
        """Yield parts of the table `usbl`."""
        for time, part in self.measured.chunks():
            table = {"time_s": time - epoch}
            for names, values in (
                (POLAR_COLUMNS, part["polar"] / _POLAR_SI),
                (CARTESIAN_COLUMNS, part["place"]),
            ):
                values = np.where(np.isnan(values).any(axis=1)[:, None], np.nan, values)
                table |= named_columns(names, values)
            yield table

    def ship_tables(self, epoch: float) -> Iterator[dict[str, Array]]:
        """Yield parts of the table `ship`: positions at the times of attitudes."""
        position = Beside(self.position)
        for time, part in self.attitude.chunks():
            known, fixes = position.around(time)
            names = ("lat", "lon", *([self.height] if self.height else []))
            place = np.zeros((len(time), 3))
            for i, name in enumerate(names):
                place[:, i] = between(time, known, fixes[name])
            rph = np.stack([part[name] for name in ("roll", "pitch", "heading")], axis=1) / DEG
            whole = np.isfinite(place).all(axis=1) & np.isfinite(rph).all(axis=1)
            yield {
                "time_s": (time - epoch)[whole],
                **named_columns(POSITION_COLUMNS, (place / GEODETIC_SI)[whole]),
                **named_columns(ATTITUDE_COLUMNS, rph[whole]),
            }


def choose(streams: Sequence[Timed], decisions: Decisions) -> Transceiver | None:
    """Return what a transceiver measured, with its ship; None without, or if that is not known.

    Parameters
    ----------
    streams : sequence of Timed
        Streams of all kinds.
    decisions : Decisions
        Takes what was chosen, and why.
    """
    measured = merge([t for t in streams if t.stream.kind == "transceiver"], decisions)
    if measured is None:
        return None
    position = of_vessel(streams, ("lat",), decisions)
    attitude = of_vessel(streams, ("roll", "heading"), decisions)
    if position is None or attitude is None:
        lack = "position" if position is None else "roll, pitch and heading"
        decisions.warn(
            f"{measured.label}: no file has the {lack} of the ship → measurements of its "
            "transceiver are not used"
        )
        return None
    for timed in streams:
        if timed.stream.kind == "topside" and timed not in (*position.streams, *attitude.streams):
            decisions.add(timed.stream.label, "of the vessel, not used: another one has more")
    decisions.add(
        measured.label,
        f"measurements of a transceiver on the ship, whose position is that of {position.label} "
        f"and whose attitude that of {attitude.label}",
        "usbl.file",
    )
    known = (name for name in ("height", "altitude") if np.isfinite(position.sample[name]).any())
    height = next(known, "")
    if not height:
        decisions.add(position.label, "the ship has no height → 0, and so no heave")
    return Transceiver(measured, position, attitude, height)
