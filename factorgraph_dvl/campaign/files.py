"""Files of a campaign: campaign.json, trials.parquet, and the calibration for the next trial."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from factorgraph_dvl.campaign.joint_calibration import JointCalibration
from factorgraph_dvl.campaign.monte_carlo import SEEDS_FOLDER, MonteCarlo, SeedRecord, Statistic
from factorgraph_dvl.campaign.record import write_whole
from factorgraph_dvl.campaign.trial_run import TRIALS_FOLDER
from factorgraph_dvl.campaign.trials import Campaign
from factorgraph_dvl.errors import as_text
from factorgraph_dvl.estimates import OBSERVABLE, Estimate
from factorgraph_dvl.files.calibration_file import CALIBRATION_FILE, encode_calibration
from factorgraph_dvl.files.tables import write_table
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.texts import text_of
from factorgraph_dvl.solution import Calibration

CAMPAIGN_FILE = "campaign.json"
TRIALS_FILE = "trials.parquet"
SEEDS_FILE = "seeds.parquet"
REPORT_FILE = "report.html"
OWNED = (
    *(CAMPAIGN_FILE, TRIALS_FILE, SEEDS_FILE, REPORT_FILE, CALIBRATION_FILE),
    *(f"{TRIALS_FOLDER}/*", f"{SEEDS_FOLDER}/*.json"),
)


def write_begun(out: Path) -> None:
    """Write a campaign.json that says that a campaign has begun, unless there is one.

    A run that is killed leaves at least it, by which the next knows that it goes on.

    Parameters
    ----------
    out : path-like
        Folder of the campaign.
    """
    if not (out / CAMPAIGN_FILE).exists():
        write_whole(out / CAMPAIGN_FILE, _json({"format": 1, "ended": False}))


def write_campaign(campaign: Campaign, out: Path) -> None:
    """Write the tables of a campaign, campaign.json last.

    Parameters
    ----------
    campaign : Campaign
        The trials and their joint calibration.
    out : path-like
        Folder of the campaign.
    """
    _write_table(out / TRIALS_FILE, _trial_columns(campaign))
    if campaign.joint is not None:
        next_trial = for_the_next(campaign, campaign.joint)
        write_whole(out / CALIBRATION_FILE, encode_calibration(next_trial))
    write_whole(out / CAMPAIGN_FILE, _json(campaign_content(campaign)))


def write_seeds(
    found: MonteCarlo | None, records: Sequence[SeedRecord], scenario: Path, out: Path
) -> None:
    """Write the tables of a Monte-Carlo campaign, campaign.json last.

    Parameters
    ----------
    found : MonteCarlo or None
        Statistics of the seeds.
    records : sequence of SeedRecord
        Records of the seeds.
    scenario : path-like
        Scenario that was simulated.
    out : path-like
        Folder of the campaign.
    """
    names = dict.fromkeys(n for r in records for n in r.names)
    columns: dict[str, np.ndarray] = {
        "seed": np.array([float(r.name) for r in records]),
        "grade": np.array([r.grade for r in records]),
        "wall_s": np.array([r.wall_s for r in records]),
        "error": np.array([r.error for r in records]),
    }
    for name in names:
        values = np.full((len(records), 2), np.nan)
        for i, r in enumerate(records):
            if name in r.names:
                k = r.names.index(name)
                values[i] = r.deviation[k], np.sqrt(r.covariance[k][k])
        columns |= {f"{name}_error": values[:, 0], f"{name}_std": values[:, 1]}
    _write_table(out / SEEDS_FILE, columns)
    content: dict[str, Any] = {"format": 1, "ended": True, "scenario": as_text(scenario)}
    content["seeds"] = len(records)
    content["failed"] = [{"seed": int(r.name), "error": r.error} for r in records if not r.done]
    if found is not None:
        content |= {
            "solved": found.runs,
            "nees": _statistic(found.nees),
            "rms_over_std": [_statistic(s) for s in found.ratio],
            "coverage": [_statistic(s) for s in found.coverage],
            "rms": dict(zip(found.names, found.rms, strict=True)),
        }
    write_whole(out / CAMPAIGN_FILE, _json(content))


def campaign_content(campaign: Campaign) -> dict[str, Any]:
    """Return what campaign.json contains.

    Parameters
    ----------
    campaign : Campaign
        The trials and their joint calibration.
    """
    content: dict[str, Any] = {
        "format": 1,
        "ended": True,
        "trials": [
            {
                "name": t.name,
                "folder": f"{TRIALS_FOLDER}/{t.label}",
                "epoch": t.record.epoch,
                "solved": t.record.done,
                "grade": None if t.calibration is None else t.calibration.verdict.grade,
                "used": not t.unused,
                "reason": text_of(t.unused),
                "wall_s": t.record.wall_s,
                "cpu_s": t.record.cpu_s,
                "peak_bytes": t.record.peak_bytes,
            }
            for t in campaign.trials
        ],
    }
    joint = campaign.joint
    if joint is None:
        return content | {"joint": None, "between_trials_std": {}, "changes": []}
    names = joint.information.names
    used = campaign.used
    shared = joint.shared
    return content | {
        "joint": _calibration(joint, joint.value, joint.covariance),
        "shared": _calibration(joint, *shared.value_in(-1))
        | {"statistic": shared.statistic, "freedom": shared.freedom},
        "between_trials_std": dict(zip(names, joint.between_std.tolist(), strict=True)),
        "between_trials_p": dict(zip(names, joint.variance_probability.tolist(), strict=True)),
        "chi_square": {
            "statistic": joint.fit.statistic,
            "freedom": joint.fit.freedom,
            "p": joint.probability,
        },
        "changes": [
            {
                "after": used[c.after].name,
                "before": used[c.after + 1].name,
                "epoch": used[c.after + 1].record.epoch,
                "parameter": names[c.component],
                "step": joint.step(i)[0],
                "std": joint.step(i)[1],
                "p": c.probability,
            }
            for i, c in enumerate(joint.changes)
        ],
        "covariates": [
            {
                "covariate": s.covariate,
                "parameter": names[s.component],
                "slope": joint.slope(i)[0],
                "std": joint.slope(i)[1],
                "p": s.probability,
            }
            for i, s in enumerate(joint.slopes)
        ],
        "drifts": [
            {
                "parameter": names[d.component],
                "std": float(np.sqrt(d.variance)),
                "per": "square root of a day" if campaign.dated else "square root of a trial",
                "p": d.probability,
            }
            for d in joint.drifts
        ],
    }


def _calibration(joint: JointCalibration, value: Array, covariance: Array) -> dict[str, Any]:
    """Return values and covariance in the form of calibration.json."""
    names = joint.information.names
    std = np.sqrt(np.diag(covariance))
    place = {name: i for i, name in enumerate(names)}
    parameters = {}
    for spec in joint.information.specs:
        at = [place[n] for n in spec.component_names if n in place]
        parameters[spec.name] = {"value": value[at].tolist(), "std": std[at].tolist()}
    matrix = {"order": list(names), "matrix": covariance.tolist()}
    return {"parameters": parameters, "covariance": matrix}


def for_the_next(campaign: Campaign, joint: JointCalibration) -> Calibration:
    """Return what is known of the calibration in a trial to come: its own variation added.

    Parameters
    ----------
    campaign : Campaign
        Trials; at least one is used.
    joint : JointCalibration
        Their joint calibration.
    """
    covariance = joint.covariance + np.diag(joint.between_std**2)
    std = np.sqrt(np.diag(covariance))
    place = {name: i for i, name in enumerate(joint.information.names)}
    first = campaign.used[0].calibration
    assert first is not None
    estimates, rows = [], []
    for spec in joint.information.specs:
        if spec.kind == "directions" or not set(spec.component_names) <= place.keys():
            continue
        at = [place[name] for name in spec.component_names]
        rows += at
        prior = joint.information.prior_std[at]
        estimates.append(
            Estimate(
                spec.name,
                spec.component_names,
                joint.value[at],
                std[at],
                joint.information.prior_mean[at],
                prior,
                std[at] <= OBSERVABLE * prior,
            )
        )
    inputs = (text for t in campaign.used if t.calibration for text in t.calibration.inputs)
    return Calibration(
        trial=f"{len(campaign.used)} trials, {campaign.used[0].name} to {campaign.used[-1].name}",
        solver="campaign",
        body_axes=first.body_axes,
        converged=True,
        iterations=0,
        cost=0.5 * joint.fit.statistic,
        estimates=tuple(estimates),
        covariance=covariance[np.ix_(rows, rows)],
        inputs=tuple(dict.fromkeys(inputs)),
        limits=first.limits,
    )


def _trial_columns(campaign: Campaign) -> dict[str, np.ndarray]:
    trials = campaign.trials
    columns: dict[str, np.ndarray] = {
        "trial": np.array([t.name for t in trials]),
        "folder": np.array([f"{TRIALS_FOLDER}/{t.label}" for t in trials]),
        "epoch": np.array([t.record.epoch for t in trials]),
        "grade": np.array([t.calibration.verdict.grade if t.calibration else "" for t in trials]),
        "reason": np.array([text_of(t.unused) for t in trials]),
        "wall_s": np.array([t.record.wall_s for t in trials]),
        "cpu_s": np.array([t.record.cpu_s for t in trials]),
        "peak_bytes": np.array([float(t.record.peak_bytes) for t in trials]),
    }
    values: dict[str, np.ndarray] = {}
    for i, t in enumerate(trials):
        for e in t.calibration.estimates if t.calibration else ():
            for name, value, std in zip(e.component_names, e.value, e.std, strict=True):
                values.setdefault(name, np.full((len(trials), 2), np.nan))[i] = value, std
    for name, pair in values.items():
        columns |= {name: pair[:, 0], f"{name}_std": pair[:, 1]}
    return columns


def _statistic(s: Statistic) -> dict[str, Any]:
    return asdict(s) | {"inside": s.inside}


def _write_table(path: Path, columns: dict[str, np.ndarray]) -> None:
    partial = path.with_name(f".partial-{path.name}")
    try:
        write_table(partial, columns)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _json(content: dict[str, Any]) -> bytes:
    return msgspec.json.format(msgspec.json.encode(content), indent=2) + b"\n"
