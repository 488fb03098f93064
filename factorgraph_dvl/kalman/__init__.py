"""The Kalman point-set approach: SINS/GNSS first, then the DVL against it."""

from factorgraph_dvl.kalman.run import METHODS, History, Method, calibrate, kalman
from factorgraph_dvl.kalman.sins import sins

__all__ = ["METHODS", "History", "Method", "calibrate", "kalman", "sins"]
