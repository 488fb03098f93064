"""Inputs of KF-GINS, the Kalman filter of GNSS and IMU of i2Nav, for a simulated trial.

Its records: of the IMU, time, increments of the angle and of the velocity, forward, starboard,
down; of GNSS, time, latitude and longitude in degrees, height, standard deviations north, east,
down.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from factorgraph_dvl.geometry.rotations import frd_from_body
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.trial import Trial

CONFIGURATION = "kf-gins.yaml"
# Errors of the start, and their standard deviations: roll, pitch, heading, deg; m and m/s.
START_DEG, START_M, START_M_S = np.array([0.5, -0.5, 2.0]), 0.02, 0.03
# Correlation time of the biases, h: they are constant.
_LASTING_H = 1000.0
_MGAL_OF_UG = 0.980665
_M_S_SQRT_H_OF_UG_SQRT_HZ = 9.80665e-6 * 60.0


def write_inputs(trial: Trial, folder: Path) -> None:
    """Write the records and the configuration of KF-GINS into a folder, which is made."""
    assert trial.imu is not None
    assert trial.gnss is not None
    assert trial.reference is not None
    (folder / "out").mkdir(parents=True)
    imu, gnss, reference = trial.imu, trial.gnss, trial.reference
    turn = frd_from_body(trial.body_axes).T
    interval = float(np.median(np.diff(imu.time)))
    samples = np.column_stack([imu.time, imu.gyro @ turn * interval, imu.accel @ turn * interval])
    np.savetxt(folder / "imu.txt", samples, fmt=["%.4f"] + ["%.14e"] * 6)
    degrees = gnss.geodetic / [DEG, DEG, 1.0]
    std = np.broadcast_to(gnss.settings.position_std_m, degrees.shape)[:, [1, 0, 2]]
    fixes = np.column_stack([gnss.time, degrees, std])
    np.savetxt(folder / "gnss.txt", fixes, fmt=["%.3f", "%.12f", "%.12f", "%.6f"] + ["%.4f"] * 3)
    # Its first second is left to the filter's own start.
    begin = int(np.searchsorted(reference.time, reference.time[0] + 1.0))
    east, north, up = reference.velocity[begin]
    s = imu.settings
    gyro_bias, accel_bias = (
        np.broadcast_to(each, 3).tolist() for each in (s.gyro_bias_std_deg_h, s.accel_bias_std_ug)
    )
    nothing = [0.0] * 3
    place = reference.geodetic[begin] / [DEG, DEG, 1.0]
    place[2] += START_M
    configuration: dict[str, Any] = {
        "imupath": "imu.txt",
        "gnsspath": "gnss.txt",
        "outputpath": "out",
        "imudatalen": 7,
        "imudatarate": round(1.0 / interval),
        "starttime": float(reference.time[begin]),
        "endtime": float(np.floor(imu.time[-1]) - 1.0),
        "initpos": place.tolist(),
        "initvel": [float(v) + START_M_S for v in (north, east, -up)],
        "initatt": (reference.rph[begin] / DEG + START_DEG).tolist(),
        **dict.fromkeys(("initgyrbias", "initaccbias", "initgyrscale", "initaccscale"), nothing),
        "initposstd": [START_M] * 3,
        "initvelstd": [START_M_S] * 3,
        "initattstd": np.abs(START_DEG).tolist(),
        "initbgstd": gyro_bias,
        "initbastd": [_MGAL_OF_UG * each for each in accel_bias],
        **dict.fromkeys(("initsgstd", "initsastd"), nothing),
        "imunoise": {
            "arw": [float(s.gyro_noise_deg_sqrt_h)] * 3,
            "vrw": [float(s.accel_noise_ug_sqrt_hz) * _M_S_SQRT_H_OF_UG_SQRT_HZ] * 3,
            "gbstd": gyro_bias,
            "abstd": [_MGAL_OF_UG * each for each in accel_bias],
            **dict.fromkeys(("gsstd", "asstd"), nothing),
            "corrtime": _LASTING_H,
        },
        "antlever": (np.array(gnss.settings.lever_arm_m) @ turn).tolist(),
    }
    text = yaml.safe_dump(configuration, sort_keys=False)
    (folder / CONFIGURATION).write_text(text, encoding="utf-8")
