"""GTSAM's stock preintegration against ours, in a sway that makes cones: drift and cost.

    python benchmarks/preintegration.py [--out DIR]

writes `preintegration.md` into out/benchmarks, or with `--out docs` that of the documentation. It
takes half a minute.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import process_time
from typing import Any

import common
import gtsam
import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3, rotation_from_rph
from factorgraph_dvl.geometry.units import DEG, HOUR
from factorgraph_dvl.imu.gtsam_measurements import gtsam_measurements
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import segments
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.simulation import parse_scenario, plan_motion, simulate
from factorgraph_dvl.simulation.scenario import Scenario

PAGE = "preintegration.md"
DURATION_S = 60.0
RATES_HZ = (50, 100, 200, 400)
PAPER_HZ = 100
# Sways of roll and pitch: amplitude, deg, frequency, Hz, phase of the pitch, deg.
SWAYS = {
    "2 Hz, 4°, in quadrature": (4.0, 2.0, 90.0),
    "2 Hz, 4°, in phase": (4.0, 2.0, 0.0),
    "swell: 0.2 Hz, 5°, in quadrature": (5.0, 0.2, 90.0),
}
CONING = next(iter(SWAYS))
# What takes raw samples one by one.
Stock = Callable[[Any], Any]
STOCK: dict[str, tuple[Stock, Stock]] = {
    "default": (gtsam.PreintegratedImuMeasurements, gtsam.PreintegrationParams),
    "manifold": (gtsam.PreintegratedImuMeasurementsManifold, gtsam.PreintegrationParams),
    "tangent": (gtsam.PreintegratedImuMeasurementsTangent, gtsam.PreintegrationParams),
    "Lie group": (gtsam.PreintegratedImuMeasurementsLieGroup, gtsam.PreintegrationParams),
    "combined": (gtsam.PreintegratedCombinedMeasurements, gtsam.PreintegrationCombinedParams),
    "Galilean (…G), raw samples": (
        gtsam.PreintegratedImuMeasurementsG,
        gtsam.PreintegrationParams,
    ),
}
OURS = "ours: increments free of coning, then …G"


@dataclass(frozen=True)
class Record:
    """Samples without noise, and the true rotation over seconds."""

    imu: Imu
    true: np.ndarray
    frame: LocalFrame


def made(sway: tuple[float, float, float], rate_hz: int) -> Scenario:
    """Return a vessel that lies still in a sway."""
    amplitude, frequency, phase = sway
    wave = {"amplitude_deg": amplitude, "frequency_hz": frequency}
    data = common.config("luo-2024-phase-90", noise=False)
    data["manoeuvres"] = [{"straight_s": DURATION_S}]
    data["current_m_s"] = [0, 0, 0]
    data["sway"] = {"roll": [wave], "pitch": [{**wave, "phase_deg": phase}]}
    data["imu"] = {**data["imu"], "rate_hz": rate_hz, "gyro_bias_deg_h": [0, 0, 0]}
    data["imu"]["accel_bias_ug"] = [0, 0, 0]
    return parse_scenario(data)


def recorded(sway: tuple[float, float, float], rate_hz: int) -> Record:
    """Return the samples of such a vessel, and how it turns in inertial space."""
    scenario = made(sway, rate_hz)
    trial = simulate(scenario, 0)
    assert trial.imu is not None
    start = scenario.start
    frame = LocalFrame(start.lat_deg * DEG, start.lon_deg * DEG, 0.0)
    nodes = np.arange(DURATION_S)
    nRb = rotation_from_rph(plan_motion(scenario).at(nodes).rph, scenario.body_axes)
    true = nRb[:-1].transpose(0, 2, 1) @ exp_so3(frame.earth_rate[None])[0] @ nRb[1:]
    return Record(trial.imu, true, frame)


def drift(turned: np.ndarray, true: np.ndarray) -> float:
    """Return the mean rate at which rotations over seconds are wrong, °/h."""
    wrong = log_so3(true.transpose(0, 2, 1) @ turned)
    return float(np.linalg.norm(wrong.mean(axis=0)) / DEG * HOUR)


def stock(kind: Stock, params: Stock, record: Record) -> tuple[np.ndarray, float]:
    """Return the rotations that GTSAM integrates from raw samples, and processor time, s."""
    imu, out = record.imu, []
    begin = process_time()
    settings = params(np.array([0.0, 0.0, -9.8]))
    dt = np.diff(imu.time, prepend=imu.time[0] - (imu.time[1] - imu.time[0]))
    for second in range(len(record.true)):
        # A sample is the mean over the interval that ends with it.
        inside = np.flatnonzero((imu.time > second + 1e-6) & (imu.time < second + 1 + 1e-6))
        pim = kind(settings)
        for i in inside.tolist():
            pim.integrateMeasurement(imu.accel[i], imu.gyro[i], dt[i])
        out.append(pim.deltaRij().matrix())
    return np.array(out), process_time() - begin


def ours(record: Record) -> tuple[np.ndarray, float]:
    """Return the rotations of this package's measurements for GTSAM, and processor time, s."""
    begin = process_time()
    inc, _ = increments(record.imu)
    seg = segments(inc, 1.0)
    gravity = np.tile(record.frame.gravity_without_rotation(np.zeros((1, 3))), (seg.first.size, 1))
    # Without Earth rate: as GTSAM integrates the samples alone.
    measured = gtsam_measurements(seg, record.imu.settings, gravity, np.zeros(3))
    seconds = process_time() - begin
    # Seconds of the nodes: the first node stands at the first sample's start.
    return np.array([m.deltaRij().matrix() for m in measured])[: len(record.true)], seconds


def rows(record: Record) -> dict[str, tuple[float, float]]:
    """Return drift, °/h, and processor time, s, of each way."""
    found = {name: stock(*how, record) for name, how in STOCK.items()}
    found[OURS] = ours(record)
    return {name: (drift(R, record.true), seconds) for name, (R, seconds) in found.items()}


def sample() -> list[str]:
    """Return the lines of the page that are made anew to hold against it."""
    found = rows(recorded(SWAYS[CONING], PAPER_HZ))
    return [f"| {name} | {value:.2g} |" for name, (value, _) in found.items()]


INTRODUCTION = """\
# GTSAM's preintegration of raw samples, and of increments without coning

{origin}

GTSAM's factors take samples of an IMU one by one, each as a constant rate and force in the body.
If roll and pitch sway a quarter period apart (in quadrature), the axis of rotation turns within a
sample. GTSAM neglects that, and the error adds up to a drift of the attitude (coning). A solver
would take the drift for a bias of the gyros. This package first makes increments from a polynomial
through neighbouring samples ([model](model.md#from-imu-samples-to-increments)). It then gives them
to GTSAM's Galilean preintegration, the classes whose names end in G. This page compares the turn
over each second with the exact one, and gives the mean error as a drift. The samples are means
over their interval, without noise. For comparison: a navigation-grade gyro has a bias of 0.02 °/h.
"""


def main() -> None:
    """Measure all ways and write the page."""
    args = common.parse(common.parser(__doc__))
    tables = {name: rows(recorded(sway, PAPER_HZ)) for name, sway in SWAYS.items()}
    by_rate = {hz: rows(recorded(SWAYS[CONING], hz)) for hz in RATES_HZ}
    names = (*STOCK, OURS)
    samples = PAPER_HZ * DURATION_S
    lines = INTRODUCTION.format(origin=args.origin).splitlines()
    lines += [
        "",
        f"## Drift by sway, °/h, {PAPER_HZ} Hz",
        "",
        "| | " + " | ".join(SWAYS) + " |",
        "|---" * (len(SWAYS) + 1) + "|",
        *(f"| {n} | {' | '.join(f'{t[n][0]:.2g}' for t in tables.values())} |" for n in names),
        "",
        f"## Drift by rate of the samples, °/h, {CONING}",
        "",
        "| | " + " | ".join(f"{hz} Hz" for hz in RATES_HZ) + " |",
        "|---" * (len(RATES_HZ) + 1) + "|",
        *(f"| {n} | {' | '.join(f'{t[n][0]:.2g}' for t in by_rate.values())} |" for n in names),
        "",
        "## Cost",
        "",
        f"Processor time per sample, µs, over {samples:.0f} samples, called from Python: stock "
        "preintegration one sample at a time, ours for the whole record.",
        "",
        "| | µs |",
        "|---|---|",
        *(f"| {n} | {1e6 * tables[CONING][n][1] / samples:.1f} |" for n in names),
        "",
        "Ours needs the samples after an interval too, so it belongs to a record, or lags by some "
        "samples. It needs to know whether samples are means or instants.",
        *common.sample_section(["| | drift, °/h |", "|---|---|", *sample()]),
    ]
    common.write_page(args.out / PAGE, lines)


if __name__ == "__main__":
    main()
