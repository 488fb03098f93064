"""Incremental smoothing of data as they arrive: collect, align, navigate."""

from __future__ import annotations

from factorgraph_dvl.replay.playback import replay
from factorgraph_dvl.replay.record import ReplayRecord
from factorgraph_dvl.replay.session import KINDS, LAG, RATE, Kind, Replay
from factorgraph_dvl.replay.update import Update

__all__ = ["KINDS", "LAG", "RATE", "Kind", "Replay", "ReplayRecord", "Update", "replay"]
