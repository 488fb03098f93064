"""The joint calibration of a campaign, and its trials by verdict, as tables."""

from __future__ import annotations

from factorgraph_dvl.campaign.files import for_the_next
from factorgraph_dvl.campaign.joint_calibration import JointCalibration
from factorgraph_dvl.campaign.trials import Campaign
from factorgraph_dvl.quality.notation import with_std
from factorgraph_dvl.report.table import Component, Mark, Table, unit_of
from factorgraph_dvl.report.tables import GRADES, VERDICT_COLOURS

_GRADES = ("good", "doubtful", "do not use")


def joint_table(campaign: Campaign, joint: JointCalibration) -> Table:
    """Return the joint calibration, a row for each component.

    Parameters
    ----------
    campaign : Campaign
        Trials.
    joint : JointCalibration
        Their joint calibration.
    """
    table = Table(
        title="Joint calibration",
        caption=(
            "Grades are those of a next trial: its σ includes the variation between trials. "
            "The misalignment is a rotation vector, in the body axes of the trials: do not enter "
            "it."
        ),
    )
    table.column("parameter")
    table.column("value ± σ", numeric=True)
    table.column("unit")
    table.column("between trials", numeric=True)
    table.column("grade")
    expected = for_the_next(campaign, joint)
    graded = {
        name: grade
        for e in expected.estimates
        for name, grade in zip(e.component_names, expected.grades[e.name], strict=True)
    }
    std = joint.covariance.diagonal() ** 0.5
    for k, name in enumerate(joint.information.names):
        grade = graded.get(name)
        table.row(
            Component(name),
            with_std(float(joint.value[k]), float(std[k])),
            unit_of(name),
            f"{joint.between_std[k]:.2g}",
            "–" if grade is None else Mark(grade, GRADES[grade]),
        )
    return table


def trials_table(campaign: Campaign) -> Table:
    """Return how many trials have each verdict, and which."""
    table = Table(title="Trials")
    table.column("verdict")
    table.column("number", numeric=True)
    table.column("trials")
    by_grade: dict[str, list[str]] = {grade: [] for grade in (*_GRADES, "not solved")}
    for trial in campaign.trials:
        found = trial.calibration
        by_grade["not solved" if found is None else found.verdict.grade].append(trial.label)
    for grade, labels in by_grade.items():
        if labels:
            colour = VERDICT_COLOURS.get(grade, "red")
            table.row(Mark(grade, colour), f"{len(labels)}", ", ".join(labels))
    return table
