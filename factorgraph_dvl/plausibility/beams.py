"""Whether the beams of a DVL are plausible: which are lost, and do they contradict each other."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.beam_geometry import as_dvl, error_velocity
from factorgraph_dvl.sensors.dvl_beams import DvlBeams

# Times what noise and priors make of the error velocity from which on it is too large, and share
# of lost pings that is worth a word. Chosen: no honest instrument comes near; half are left.
_TOO_LARGE = 3.0
_MOSTLY = 0.5


def beam_findings(beams: DvlBeams) -> Iterator[Finding]:
    """Check how often each beam is lost, and how well nominal beams agree."""
    lost = np.isnan(beams.velocity).mean(axis=0)
    if lost.any():
        yield Finding(
            Code.BEAMS_LOST,
            message("beams_lost.shares", shares=100.0 * lost),
            beams.label,
            severity="note" if lost.max() > _MOSTLY else "ok",
        )
    yield from _agreement(beams)


def _agreement(beams: DvlBeams) -> Iterator[Finding]:
    """Compare the error velocity with what noise, and errors as the priors allow, make of it."""
    s = beams.settings
    scale = np.broadcast_to(np.array(s.scale_error, dtype=float), (len(s.nominal_d),))
    error = error_velocity((1.0 + scale)[:, None] * s.nominal_d, beams.velocity)
    log = as_dvl(beams)
    known = np.isfinite(error) & log.locked
    if known.sum() < 3:
        return
    rms = float(np.sqrt(np.mean(error[known] ** 2)))
    speed = float(np.sqrt(np.mean(np.sum(log.velocity[known] ** 2, axis=1))))
    noise = float(np.sqrt(np.nanmean(beams.sigma()[known] ** 2)))
    prior = speed * float(np.hypot(s.direction_std_deg * DEG, s.scale_error_std))
    if rms > _TOO_LARGE * np.hypot(noise, prior):
        text = message("beams_disagree.more", rms=rms, speed=speed)
        yield Finding(Code.BEAMS_DISAGREE, text, beams.label)
    else:
        text = message("beams_disagree.explained", rms=rms)
        yield Finding(Code.BEAMS_DISAGREE, text, beams.label, severity="ok")
