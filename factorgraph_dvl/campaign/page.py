"""The report of a campaign: one page with the history of each parameter, trial by trial."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np

from factorgraph_dvl.campaign.files import REPORT_FILE
from factorgraph_dvl.campaign.joint_calibration import JointCalibration
from factorgraph_dvl.campaign.monte_carlo import MonteCarlo, Statistic
from factorgraph_dvl.campaign.record import write_whole
from factorgraph_dvl.campaign.trial_run import TRIALS_FOLDER
from factorgraph_dvl.campaign.trials import Campaign, CampaignTrial
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.io.calibration_file import CALIBRATION_FILE
from factorgraph_dvl.report.figures.drawing import VERDICT_COLOURS
from factorgraph_dvl.report.text import at_precision, split_unit, with_std

# Of a panel, in pixels.
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 900, 190, 90, 20, 12, 24
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 960px; margin: 2em auto; color: #222; }
table { border-collapse: collapse; margin: 1em 0; }
td, th { padding: .2em .8em .2em 0; text-align: left; border-bottom: 1px solid #ddd; }
svg { width: 100%; height: auto; } svg text { font: 11px system-ui, sans-serif; fill: #222; }
.band { fill: #bcd9f0; } .joint { stroke: #0a6ebd; fill: none; } .bar { stroke: #8a8a8a; }
.change { stroke: #c62828; stroke-dasharray: 4 3; } .grid { stroke: #e9e9e9; }
"""


def write_page(campaign: Campaign, out: Path) -> None:
    """Write the report of a campaign.

    Parameters
    ----------
    campaign : Campaign
        The trials and their joint calibration.
    out : path-like
        Folder of the campaign.
    """
    parts = [f"<h1>Campaign of {len(campaign.trials)} trials</h1>"]
    if campaign.failed:
        rows = [[_name(t), escape(t.record.error)] for t in campaign.failed]
        parts += ["<h2>Not solved</h2>", _table(["trial", "reason"], rows)]
    joint = campaign.joint
    if joint is not None:
        parts += _joint_parts(campaign, joint)
        parts += ["<h2>History of each parameter</h2>"]
        parts += ["<p>Each point is a trial with its σ, and leads to its result.</p>"]
        for k, name in enumerate(joint.information.names):
            parts += [f"<h3>{escape(name)}</h3>", _panel(campaign, joint, k, out)]
    parts += ["<h2>Trials</h2>", _trial_table(campaign, out)]
    write_whole(out / REPORT_FILE, _page("Campaign", parts))


def write_seed_page(found: MonteCarlo | None, scenario: Path, runs: int, out: Path) -> None:
    """Write the report of a Monte-Carlo campaign.

    Parameters
    ----------
    found : MonteCarlo or None
        Statistics of the seeds that were solved.
    scenario : path-like
        That was simulated.
    runs : int
        Number of seeds.
    out : path-like
        Folder of the campaign.
    """
    parts = [f"<h1>{escape(scenario.name)}, {runs} seeds</h1>"]
    if found is None:
        parts += ["<p>No seed was solved.</p>"]
    else:
        parts += [f"<p>{found.runs} of {runs} seeds were solved.</p>"]
        parts += _statistic_table([found.nees, *found.coverage], "statistic")
        parts += ["<h2>Root mean square of error over σ</h2>"]
        parts += _statistic_table(found.ratio, "component")
    write_whole(out / REPORT_FILE, _page(scenario.name, parts))


def _statistic_table(statistics: Sequence[Statistic], of: str) -> list[str]:
    rows = [
        [
            escape(s.name),
            f"{s.value:.4g}",
            f"{s.expected:.4g}",
            f"{s.low:.4g} to {s.high:.4g}",
            "yes" if s.inside else "<b>no</b>",
        ]
        for s in statistics
    ]
    return [_table([of, "measured", "expected", "by chance (99 %)", "inside"], rows)]


def _joint_parts(campaign: Campaign, joint: JointCalibration) -> list[str]:
    names, used = joint.information.names, campaign.used
    std = np.sqrt(np.diag(joint.covariance))
    rows = [
        [
            escape(name),
            escape(with_std(float(joint.value[k]), float(std[k]))),
            at_precision(float(joint.between_std[k]), float(joint.between_std[k])),
            f"{joint.variance_probability[k]:.2g}",
        ]
        for k, name in enumerate(names)
    ]
    parts = [
        f"<h2>Joint calibration of {len(used)} trials</h2>",
        _table(["component", "in the last trial", "σ between trials", "p of none"], rows),
        f"<p>χ² {joint.fit.statistic:.0f} with {joint.fit.freedom:.0f} degrees of freedom, "
        f"p = {joint.probability:.2g}.</p>",
    ]
    changes = [
        [
            _name(used[c.after]),
            escape(used[c.after + 1].record.epoch),
            escape(names[c.component]),
            escape(with_std(*joint.step(i))),
            f"{c.probability:.1g}",
        ]
        for i, c in enumerate(joint.changes)
    ]
    parts += ["<h2>Changes</h2>"]
    if changes:
        parts += [_table(["after", "seen on", "component", "step", "p"], changes)]
    else:
        parts += ["<p>No step between trials is clearer than chance.</p>"]
    unit = "√day" if campaign.dated else "√trial"
    parts += [
        f"<p>{escape(names[d.component])} drifts by {np.sqrt(d.variance):.2g} per {unit} "
        f"(p = {d.probability:.1g}).</p>"
        for d in joint.drifts
    ]
    parts += [
        f"<p>{escape(names[s.component])} follows {escape(s.covariate)}: "
        f"{escape(with_std(*joint.slope(i)))} per unit (p = {s.probability:.1g}).</p>"
        for i, s in enumerate(joint.slopes)
    ]
    return parts


def _panel(campaign: Campaign, joint: JointCalibration, k: int, out: Path) -> str:
    """Return the history of a component as SVG."""
    name, used = joint.information.names[k], campaign.used
    expected = [joint.fit.value_in(i) for i in range(len(used))]
    centre = np.array([value[k] for value, _ in expected])
    half = np.sqrt([cov[k, k] for _, cov in expected])
    found = np.array([_estimate(t, name) for t in used])
    std = np.hypot(half, joint.between_std[k])
    shown = np.isfinite(found[:, 0])
    low = np.concatenate([centre - 2 * std, (found[:, 0] - found[:, 1])[shown]]).min()
    high = np.concatenate([centre + 2 * std, (found[:, 0] + found[:, 1])[shown]]).max()
    room = 0.05 * (high - low) or 1.0
    low, high = low - room, high + room
    days = joint.days - joint.days[0]
    span = float(days[-1]) or 1.0

    def across(t: float) -> float:
        return _LEFT + (_WIDTH - _LEFT - _RIGHT) * (0.02 + 0.96 * t / span)

    def down(value: float) -> float:
        return _TOP + (_HEIGHT - _TOP - _BOTTOM) * (high - value) / (high - low)

    def line(values: Array) -> Iterable[str]:
        return (f"{across(t):.1f},{down(v):.1f}" for t, v in zip(days, values, strict=True))

    outline = " ".join([*line(centre + std), *reversed(list(line(centre - std)))])
    parts = [f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}">']
    for value in np.linspace(low + room, high - room, 4):
        y = down(float(value))
        parts += [f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH}" y1="{y:.1f}" y2="{y:.1f}"/>']
        label = at_precision(float(value), 0.1 * (high - low))
        parts += [f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{label}</text>']
    parts += [f'<polygon class="band" points="{outline}"/>']
    parts += [f'<polyline class="joint" points="{" ".join(line(centre))}"/>']
    for c in joint.changes:
        if c.component == k:
            x = 0.5 * (across(days[c.after]) + across(days[c.after + 1]))
            parts += [
                f'<line class="change" x1="{x:.1f}" x2="{x:.1f}" y1="{_TOP}" '
                f'y2="{_HEIGHT - _BOTTOM}"/>'
            ]
    for t, trial, (value, own) in zip(days, used, found, strict=True):
        if np.isfinite(value):
            ends = down(value + own), down(value - own)
            parts += [_point(trial, _link(trial, out), across(t), down(value), ends)]
    unit = split_unit(name)[1]
    axis = "days since the first trial" if campaign.dated else "trial"
    parts += [f'<text x="{_LEFT}" y="{_HEIGHT - 6}">{escape(unit)}</text>']
    parts += [f'<text x="{_WIDTH - 4}" y="{_HEIGHT - 6}" text-anchor="end">{axis}</text></svg>']
    return "".join(parts)


def _point(trial: CampaignTrial, link: str, x: float, y: float, ends: tuple[float, float]) -> str:
    assert trial.calibration is not None
    colour = VERDICT_COLOURS[trial.calibration.verdict.grade]
    return (
        f'<a href="{link}"><title>{escape(trial.name)}</title>'
        f'<line class="bar" x1="{x:.1f}" x2="{x:.1f}" y1="{ends[0]:.1f}" y2="{ends[1]:.1f}"/>'
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{colour}"/></a>'
    )


def _trial_table(campaign: Campaign, out: Path) -> str:
    rows = []
    for t in campaign.trials:
        grade = t.calibration.verdict.grade if t.calibration else "not solved"
        name = f'<a href="{_link(t, out)}">{_name(t)}</a>' if t.calibration else _name(t)
        took = f"{t.record.wall_s:.1f} s"
        rows.append([name, escape(t.record.epoch), grade, escape(t.unused), took])
    return _table(["trial", "date", "verdict", "why it is not used", "time"], rows)


def _link(trial: CampaignTrial, out: Path) -> str:
    """Return the address of a trial's own report, or of its calibration if it has none."""
    folder = f"{TRIALS_FOLDER}/{trial.label}"
    own = f"{folder}/{REPORT_FILE}"
    found = own if (out / own).exists() else f"{folder}/{CALIBRATION_FILE}"
    return escape(found, quote=True)


def _name(trial: CampaignTrial) -> str:
    return escape(trial.name)


def _estimate(trial: CampaignTrial, component: str) -> tuple[float, float]:
    for e in trial.calibration.estimates if trial.calibration else ():
        for name, value, std in zip(e.component_names, e.value, e.std, strict=True):
            if name == component:
                return float(value), float(std)
    return np.nan, np.nan


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of HTML; cells are HTML already."""
    head = "".join(f"<th>{escape(h)}</th>" for h in heads)
    body = "".join("<tr>" + "".join(f"<td>{c}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def _page(title: str, parts: Iterable[str]) -> bytes:
    text = "\n".join(parts)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>{escape(title)}</title>"
        f"<style>{_STYLE}</style></head><body>{text}</body></html>\n"
    ).encode()
