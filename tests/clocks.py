"""Trials whose sensors measure at odd rates and phases, by clocks that run fast and round."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from truth import scenario

from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.trial import Trial

COUNT = 15
# Rates at which stamps fall on, between and half-way between the times of states.
_IMU = (50.0, 64.0, 100.0, 100.0, 125.0, 128.0, 200.0)
_AIDS = (1.0, 2.0, 4.0, 5.0, 7.3, 8.0, 10.0)
_ROUNDED = (None, 1e-6, 1e-3)


def odd_trial(seed: int) -> Trial:
    """Return a trial of 60 to 100 s: rates, phases, clock and manoeuvres drawn by its seed."""
    rng = np.random.default_rng(seed)
    imu_rate = float(rng.choice(_IMU)) if rng.random() < 0.6 else rng.uniform(50.0, 200.0)

    def sampled(rate: float) -> dict[str, float]:
        # Half a sample of the IMU, or anything.
        phase = 0.5 / imu_rate if rng.random() < 0.4 else rng.uniform(0.0, 0.9 / rate)
        return {"rate_hz": rate, "phase_s": phase}

    first, last = rng.uniform(15.0, 25.0), rng.uniform(7.0, 30.0)
    scene = scenario(
        noise=True,
        reference_rate_hz=10,
        manoeuvres=[
            {"straight_s": first},
            {"turn_deg_s": -6, "duration_s": 15, "ramp_s": 4},
            {"straight_s": 8},
            {"turn_deg_s": 8, "duration_s": 15, "ramp_s": 4},
            {"straight_s": last},
        ],
        imu=sampled(imu_rate) | {"sampling": str(rng.choice(["mean", "instantaneous"]))},
        dvl=sampled(float(rng.choice(_AIDS[2:]))),
        gnss=sampled(float(rng.choice(_AIDS))),
    )
    fast = 1.0 + (25e-6 * rng.choice([-1.0, 1.0]) if rng.random() < 0.5 else 0.0)
    rounded = _ROUNDED[rng.integers(3)]
    trial = simulate(scene, seed)

    def stamps(time: np.ndarray) -> np.ndarray:
        time = time * fast
        return time if rounded is None else np.round(time / rounded) * rounded

    imu, gnss, dvl = (replace(r, time=stamps(r.time)) for r in (trial.imu, trial.gnss, trial.dvl))
    return replace(trial, imu=imu, gnss=gnss, dvl=dvl)
