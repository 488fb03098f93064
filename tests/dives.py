"""Recorded dives without their IMU: an INS and a DVL."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from factorgraph_dvl.sensors.dvl import Dvl, DvlSettings
from factorgraph_dvl.sensors.ins import Ins, InsSettings
from factorgraph_dvl.trial import Trial

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
# Stamps were made by a linspace over one sample too few; samples come every second.
STRETCHED = 1.0025


def dive(number):
    folder = DATA / "snapir_auv"
    if not folder.is_dir():
        pytest.skip(f"no recorded dives in {folder}")
    pings = np.loadtxt(folder / f"DVL_trajectory{number}.csv", delimiter=",", skiprows=1)
    motion = np.loadtxt(folder / f"GT_trajectory{number}.csv", delimiter=",", skiprows=1)
    dvl = Dvl(
        DvlSettings(time_offset_std_s=5.0, velocity_std_m_s=0.01),
        pings[:, 0] / STRETCHED,
        pings[:, 1:4],
        np.full((len(pings), 3), np.nan),
    )
    ins = Ins(
        InsSettings(position_std_m=(1.0, 1.0, 1.0), velocity_std_m_s=(0.02, 0.02, 0.02)),
        motion[:, 0] / STRETCHED,
        motion[:, [2, 1, 3]],
        motion[:, [5, 4, 6]] * [1.0, 1.0, -1.0],
        motion[:, 7:10],
        np.full((len(motion), 9), np.nan),
    )
    return Trial(f"dive {number}", None, dvl=dvl, others=(ins,), body_axes="FRD")
