"""What of a trial without IMU is not estimated, for the user."""

from __future__ import annotations

from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.results import windows_left_out
from factorgraph_dvl.sensors.attitude import Attitude
from factorgraph_dvl.sensors.ins import Ins
from factorgraph_dvl.trial import Trial


def notes_without_imu(trial: Trial) -> tuple[Finding, ...]:
    """Return findings of records that are not used, and of errors that are not estimated."""
    return (*_unused(trial), *_left_out(trial))


def _left_out(trial: Trial) -> list[Finding]:
    """Name errors that the trial states and that are not estimated without an IMU."""
    changes = [
        Finding(
            Code.ERROR_LEFT_OUT,
            message("error_left_out.change", section=aid.section, name=key),
            sensor=aid.label,
        )
        for aid in trial.aids
        for key in aid.settings.left_out
        if key != "averaging_s"
    ]
    return changes + windows_left_out(trial.aids)


def _unused(trial: Trial) -> tuple[Finding, ...]:
    """Name attitudes that another sensor of attitude takes the place of."""
    if trial.find(Ins) is None or trial.find(Attitude) is None:
        return ()
    text = message("unused.ins_attitude")
    return (Finding(Code.UNUSED, text, sensor="INS"),)
