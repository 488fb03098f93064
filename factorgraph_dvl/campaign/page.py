"""The report of a campaign: one page with the history of each parameter, trial by trial."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from html import escape
from pathlib import Path

import numpy as np

from factorgraph_dvl.analysis.instrument_terms import has_instrument_terms, instrument_of
from factorgraph_dvl.campaign.files import REPORT_FILE, for_the_next
from factorgraph_dvl.campaign.joint_calibration import JointCalibration
from factorgraph_dvl.campaign.monte_carlo import MonteCarlo, Statistic
from factorgraph_dvl.campaign.record import write_whole
from factorgraph_dvl.campaign.trial_run import TRIALS_FOLDER
from factorgraph_dvl.campaign.trials import Campaign, CampaignTrial
from factorgraph_dvl.files.calibration_file import CALIBRATION_FILE
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.notation import at_precision, split_unit, with_std
from factorgraph_dvl.quality.texts import chinese, component_names, text_of
from factorgraph_dvl.report.entries import TITLE
from factorgraph_dvl.report.figures.drawing import VERDICT_COLOURS
from factorgraph_dvl.report.html.entries import values_to_enter
from factorgraph_dvl.report.html.markup import (
    Cell,
    Html,
    Section,
    both,
    component_cell,
    element,
    paragraph,
    said,
    section,
    table,
)
from factorgraph_dvl.report.html.page import whole_page
from factorgraph_dvl.report.html.sections import verdict_box

# Of a panel, in pixels.
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 900, 190, 90, 20, 12, 24
_KIND = "Campaign report"


def write_page(campaign: Campaign, out: Path) -> None:
    """Write the report of a campaign.

    Parameters
    ----------
    campaign : Campaign
        The trials and their joint calibration.
    out : path-like
        Folder of the campaign.
    """
    sections: list[Section] = []
    if campaign.failed:
        rows = [[t.name, t.record.error] for t in campaign.failed]
        own = _table(["trial", "reason"], rows, "Not solved")
        sections.append(section("Not solved", own, key="failed"))
    joint = campaign.joint
    if joint is not None:
        expected = for_the_next(campaign, joint)
        sections.append(section("Verdict", verdict_box(expected.verdict), key="verdict"))
        if expected.verdict.grade != "do not use" and has_instrument_terms(expected):
            own = values_to_enter(instrument_of(expected))
            sections.append(section(TITLE, own, key="enter"))
        sections += _joint_sections(campaign, joint)
        text = "Each point is a trial with its σ, and leads to its result."
        panels: list[Cell] = [paragraph(both(text))]
        for k, name in enumerate(joint.information.names):
            panels += [element("h3", component_cell(name)), _panel(campaign, joint, k, out)]
        sections.append(section("History of each parameter", *panels, key="history"))
    sections.append(section("Trials", _trial_table(campaign, out), key="trials"))
    heading = message("campaign.title", count=len(campaign.trials))
    write_whole(out / REPORT_FILE, _page(said(heading), str(heading), sections))


def write_seed_page(found: MonteCarlo | None, scenario: Path, runs: int, out: Path) -> None:
    """Write the report of a Monte-Carlo campaign.

    Parameters
    ----------
    found : MonteCarlo or None
        Statistics of the seeds that were solved.
    scenario : path-like
        Scenario that was simulated.
    runs : int
        Number of seeds.
    out : path-like
        Folder of the campaign.
    """
    heading = message("campaign.seeds_title", scenario=scenario.name, count=runs)
    solved = message("campaign.solved", solved=0 if found is None else found.runs, count=runs)
    cells: list[Cell] = [paragraph(said(solved))]
    sections: list[Section] = []
    if found is not None:
        title = "Root mean square of error over σ"
        cells.append(_statistic_table([found.nees, *found.coverage], "statistic", "Seeds"))
        ratios = _statistic_table(found.ratio, "component", title)
        sections.append(section(title, ratios, key="ratio"))
    sections.insert(0, section("Seeds", *cells, key="seeds"))
    write_whole(out / REPORT_FILE, _page(said(heading), str(heading), sections))


def _page(heading: Html, title: str, sections: Sequence[Section]) -> bytes:
    return whole_page(_KIND, heading, sections, title=title).encode()


def _table(header: Sequence[str], rows: Sequence[Sequence[Cell]], label: str) -> Html:
    return table([both(h) for h in header], rows, label=label)


def _statistic_table(statistics: Sequence[Statistic], of: str, label: str) -> Html:
    rows = [
        [
            s.name,
            f"{s.value:.4g}",
            f"{s.expected:.4g}",
            f"{s.low:.4g} – {s.high:.4g}",
            both("yes") if s.inside else element("b", both("no")),
        ]
        for s in statistics
    ]
    return _table([of, "measured", "expected", "by chance (99 %)", "inside"], rows, label)


def _joint_sections(campaign: Campaign, joint: JointCalibration) -> Iterator[Section]:
    names, used = joint.information.names, campaign.used
    std = np.sqrt(np.diag(joint.covariance))
    rows = [
        [
            component_cell(name),
            component_names(name)[2],
            with_std(float(joint.value[k]), float(std[k])),
            at_precision(float(joint.between_std[k]), float(joint.between_std[k])),
            f"{joint.variance_probability[k]:.2g}",
        ]
        for k, name in enumerate(names)
    ]
    header = ["component", "unit", "in the last trial", "σ between trials", "p of none"]
    fit = message(
        "campaign.fit",
        statistic=joint.fit.statistic,
        freedom=joint.fit.freedom,
        probability=joint.probability,
    )
    yield section(
        "Joint calibration",
        paragraph(said(message("campaign.joint", count=len(used)))),
        _table(header, rows, "Joint calibration"),
        paragraph(said(fit)),
        key="joint",
    )
    yield section("Changes", *_changes(campaign, joint), key="changes")


def _changes(campaign: Campaign, joint: JointCalibration) -> Iterator[Html]:
    names, used = joint.information.names, campaign.used
    changes = [
        [
            used[c.after].name,
            used[c.after + 1].record.epoch,
            component_cell(names[c.component]),
            with_std(*joint.step(i)),
            f"{c.probability:.1g}",
        ]
        for i, c in enumerate(joint.changes)
    ]
    if changes:
        yield _table(["after", "seen on", "component", "step", "p"], changes, "Changes")
    else:
        yield paragraph(both("No step between trials is clearer than chance."))
    unit = "√day" if campaign.dated else "√trial"
    for d in joint.drifts:
        drift = message(
            "campaign.drift",
            name=names[d.component],
            size=np.sqrt(d.variance),
            unit=unit,
            probability=d.probability,
        )
        yield paragraph(said(drift))
    for i, s in enumerate(joint.slopes):
        slope = message(
            "campaign.slope",
            name=names[s.component],
            covariate=s.covariate,
            slope=with_std(*joint.slope(i)),
            probability=s.probability,
        )
        yield paragraph(said(slope))


def _panel(campaign: Campaign, joint: JointCalibration, k: int, out: Path) -> Html:
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
    heading = message("campaign.history", name=name)
    label, own = escape(text_of(heading)), escape(text_of(heading, "zh"))
    parts = [
        f'<svg class="history" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="group" '
        f'aria-label="{label}" data-en="{label}" data-zh="{own}">'
    ]
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
            parts += [_point(trial, escape(_link(trial, out)), across(t), down(value), ends)]
    unit = split_unit(name)[1]
    axis = "days since the first trial" if campaign.dated else "trial"
    parts += [f'<text x="{_LEFT}" y="{_HEIGHT - 6}">{escape(unit)}</text>']
    words = "".join(
        f'<tspan lang="{language}">{text}</tspan>'
        for language, text in (("en", axis), ("zh-Hans", chinese(axis)))
    )
    parts += [f'<text x="{_WIDTH - 4}" y="{_HEIGHT - 6}" text-anchor="end">{words}</text></svg>']
    return Html("".join(parts))


def _point(trial: CampaignTrial, link: str, x: float, y: float, ends: tuple[float, float]) -> str:
    assert trial.calibration is not None
    colour = VERDICT_COLOURS[trial.calibration.verdict.grade]
    return (
        f'<a href="{link}"><title>{escape(trial.name)}</title>'
        f'<line class="bar" x1="{x:.1f}" x2="{x:.1f}" y1="{ends[0]:.1f}" y2="{ends[1]:.1f}"/>'
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{colour}"/></a>'
    )


def _trial_table(campaign: Campaign, out: Path) -> Html:
    rows: list[list[Cell]] = []
    for t in campaign.trials:
        grade = t.calibration.verdict.grade if t.calibration else "not solved"
        name = element("a", t.name, href=_link(t, out)) if t.calibration else t.name
        took = f"{t.record.wall_s:.1f} s"
        rows.append([name, t.record.epoch, both(grade), said(t.unused), took])
    return _table(["trial", "date", "verdict", "why it is not used", "time"], rows, "Trials")


def _link(trial: CampaignTrial, out: Path) -> str:
    """Return the address of a trial's own report, or of its calibration if it has none."""
    folder = f"{TRIALS_FOLDER}/{trial.label}"
    own = f"{folder}/{REPORT_FILE}"
    found = own if (out / own).exists() else f"{folder}/{CALIBRATION_FILE}"
    return found


def _estimate(trial: CampaignTrial, component: str) -> tuple[float, float]:
    for e in trial.calibration.estimates if trial.calibration else ():
        for name, value, std in zip(e.component_names, e.value, e.std, strict=True):
            if name == component:
                return float(value), float(std)
    return np.nan, np.nan
