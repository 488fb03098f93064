"""Kalman methods: SINS/GNSS, then the DVL against it; SINS against a star tracker."""

from factorgraph_dvl.baselines.calibration import (
    DVL_METHODS,
    METHODS,
    History,
    Method,
    calibrate,
    kalman,
)
from factorgraph_dvl.baselines.ins_attitude import sins

__all__ = ["DVL_METHODS", "METHODS", "History", "Method", "calibrate", "kalman", "sins"]
