"""Kalman methods: SINS/GNSS, then the DVL against it; SINS against a star tracker."""

from factorgraph_dvl.baselines.calibration import DVL_METHODS, METHODS, Method, calibrate, kalman
from factorgraph_dvl.baselines.ins_attitude import sins
from factorgraph_dvl.baselines.outcome import History

__all__ = ["DVL_METHODS", "METHODS", "History", "Method", "calibrate", "kalman", "sins"]
