"""What samples of an IMU look like that are means and are taken for instants, or the reverse.

The mean of an angular rate of frequency f over an interval T is sin(x)/x of the rate in its
middle, x = π f T: less by x²/6, so that the gyros seem to have an error of scale.
"""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.imu import Imu


def apparent_gyro_scale(imu: Imu) -> Array:
    """Return the scale errors of the gyros if their samples are the other of means and instants.

    Parameters
    ----------
    imu : Imu
        Samples, with what they are stated to be.

    Returns
    -------
    ndarray, shape (3,)
        Dimensionless: -T²/24 of the mean square of the angular acceleration over that of the
        angular rate, for instants that are means. Noise of the samples does not add to it.
    """
    interval = float(np.median(np.diff(imu.time)))
    # Changes over one interval and over three around it have no sample in common, nor its noise.
    over_one, over_three = imu.gyro[2:-1] - imu.gyro[1:-2], imu.gyro[3:] - imu.gyro[:-3]
    curvature = np.mean(over_one * over_three, axis=0) / (3.0 * interval**2)
    power = np.mean(imu.gyro**2, axis=0)
    sign = -1.0 if imu.settings.sampling == "instantaneous" else 1.0
    scale: Array = sign * interval**2 / 24.0 * curvature / np.maximum(power, np.finfo(float).tiny)
    return scale
