"""Findings: what the user should know about records and results, each with a stable code."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, Self, cast

from factorgraph_dvl.message import Message
from factorgraph_dvl.quality.texts import Language, catalogue, chinese, text_of

# A check that was passed; something to know; a reason for caution; one not to use it.
Severity = Literal["ok", "note", "warning", "error"]


class Code(StrEnum):
    """Stable names of findings; the catalogue has what each means, why it matters, what to do.

    They stand in the order in which a verdict lists its reasons: causes before symptoms. Each
    has a severity, which a finding may override.

    `python tests/findings_page.py` writes them to docs/findings.md, in the groups of the
    comments.
    """

    severity: Severity

    def __new__(cls, value: str, severity: Severity = "warning") -> Self:
        """Return a code with its usual severity."""
        code = str.__new__(cls, value)
        code._value_ = value
        code.severity = severity
        return code

    @property
    def rank(self) -> int:
        """Place among the reasons of a verdict."""
        return list(Code).index(self)

    @property
    def meaning(self) -> str:
        """What it says, in English."""
        return self.text("meaning")

    @property
    def why(self) -> str:
        """Why it matters, in English."""
        return self.text("why")

    @property
    def action(self) -> str:
        """What to do about it, in English."""
        return self.text("action")

    def text(self, part: Literal["meaning", "why", "action"], language: Language = "en") -> str:
        """Return its meaning, why it matters, or what to do, in a language."""
        en, zh = catalogue("findings")[self.value][part]
        return str({"en": en, "zh": zh}[language])

    # Clocks and gaps.
    TIME_UNIT = "time_unit", "error"
    NO_OVERLAP = "no_overlap", "error"
    PARTIAL_OVERLAP = "partial_overlap", "note"
    GAPS = "gaps", "note"
    CLOCK_RESTARTED = "clock_restarted"
    CLOCK_JUMP = "clock_jump"
    IMU_GAP = "imu_gap", "note"
    LOST_SAMPLES = "lost_samples", "note"
    CLOCK_JITTER = "clock_jitter", "error"
    IMU_NOISE = "imu_noise"
    CLOCK_OFFSET = "clock_offset"
    CLOCK_DRIFT = "clock_drift"
    CLOCK_STEP = "clock_step"
    LEAP_SECONDS = "leap_seconds", "error"
    LOCAL_TIME = "local_time", "error"
    UNUSED = "unused", "note"
    # What a record holds.
    INVALID_VALUES = "invalid_values", "note"
    FROZEN_VALUES = "frozen_values", "error"
    IMU_CHANNEL = "imu_channel", "error"
    IMU_SPIKES = "imu_spikes", "error"
    SATURATED = "saturated", "error"
    NO_MEASUREMENT = "no_measurement", "error"
    MISSING = "missing", "note"
    COUNTED_TWICE = "counted_twice"
    # Units, signs and axes.
    FORCE_UNIT = "force_unit", "error"
    BODY_AXES = "body_axes", "error"
    GYRO_UNIT = "gyro_unit", "error"
    GYRO_FROZEN = "gyro_frozen", "error"
    IMU_AXES = "imu_axes", "error"
    GYRO_AXES = "gyro_axes", "error"
    ACCEL_AXES = "accel_axes", "error"
    COURSE = "course"
    ANTENNA = "antenna"
    GNSS_AXES = "gnss_axes", "error"
    DVL_AXES = "dvl_axes", "error"
    ZERO_FIXES = "zero_fixes", "error"
    RADIANS = "radians", "error"
    GNSS_VELOCITY = "gnss_velocity", "error"
    DVL_UNIT = "dvl_unit", "error"
    DVL_FROZEN = "dvl_frozen", "error"
    DVL_STD = "dvl_std"
    DVL_SIGN = "dvl_sign"
    BEAMS_LOST = "beams_lost", "note"
    BEAMS_DISAGREE = "beams_disagree"
    NO_EPOCH = "no_epoch", "error"
    STAR_CATALOGUE = "star_catalogue"
    STAR_VERTICAL = "star_vertical", "error"
    STAR_CONVENTION = "star_convention", "error"
    HEADING_UNIT = "heading_unit"
    LOG_SIGN = "log_sign"
    DEPTH_SIGN = "depth_sign"
    BEACON_HEIGHT = "beacon_height"
    BEACON_RANGES = "beacon_ranges", "error"
    USBL_AXES = "usbl_axes", "error"
    USBL_TRACK = "usbl_track", "error"
    USBL_RUN = "usbl_run"
    USBL_GRID_NORTH = "usbl_grid_north"
    AT_REST = "at_rest", "note"
    # Where a solver starts.
    UNUSABLE_PRIOR = "unusable_prior"
    HEADING_UNKNOWN = "heading_unknown"
    FEW_RANGES = "few_ranges"
    NOT_STARTED = "not_started", "note"
    # What a solver found.
    PRIOR_CONTRADICTED = "prior_contradicted"
    HALVES_DIFFER = "halves_differ"
    DOES_NOT_FIT = "does_not_fit", "error"
    HEADING_ERROR = "heading_error", "note"
    IMPOSSIBLE_SCALE = "impossible_scale", "error"
    CHANGED_ALONG_TRIAL = "changed_along_trial", "error"
    FAR_FROM_PRIOR = "far_from_prior"
    LARGE_RESIDUALS = "large_residuals"
    SMALL_RESIDUALS = "small_residuals"
    OUTLIERS = "outliers"
    ESTIMATED_INSTEAD = "estimated_instead"
    AVERAGING = "averaging", "note"
    UNEXPLAINED_MISFIT = "unexplained_misfit", "error"
    MANY_REJECTED = "many_rejected"
    AMBIGUOUS = "ambiguous"
    NOT_CONVERGED = "not_converged", "error"
    NOT_OBSERVABLE = "not_observable", "note"
    PRIOR_KEPT = "prior_kept", "note"
    UNCERTAIN = "uncertain"
    FILTER_CONTRADICTED = "filter_contradicted", "error"
    METHOD_LIMITS = "method_limits", "note"
    GNSS_OUTAGE = "gnss_outage"
    FILTER_RESTARTED = "filter_restarted", "note"
    MEAN_OR_LAST = "mean_or_last", "note"
    # What a replay noticed.
    ERROR_LEFT_OUT = "error_left_out"
    SILENT = "silent", "note"
    HEARD_AGAIN = "heard_again", "note"
    CONTRADICTS = "contradicts"
    # Results from files.
    UNCLASSIFIED = "unclassified", "note"


# Errors with which there is nothing to solve; with the others a fit contradicts the data.
UNUSABLE = frozenset(
    {
        Code.TIME_UNIT,
        Code.NO_OVERLAP,
        Code.LOCAL_TIME,
        Code.NO_MEASUREMENT,
        Code.ZERO_FIXES,
        Code.RADIANS,
        Code.NO_EPOCH,
        Code.BEACON_RANGES,
        Code.USBL_AXES,
    }
)


# In place of a severity: that of the code.
_OF_THE_CODE = cast("Severity", "")


@dataclass(frozen=True)
class Finding:
    """Something that the user should know about a record or a result.

    Parameters
    ----------
    code : Code
        What it is.
    message : Message or str
        What happened, in this case; a plain text is one from a file of another version.
    sensor : str, optional
        Label of the sensor, or of the kind of its measurements; empty if it is about none.
    parameter : str, optional
        Name as in calibration.json; empty if it is about none.
    severity : Severity, optional
        `ok` for a check that was passed, `note` for what is no reason for caution, `warning`
        for a reason, `error` where a result is not to be used. That of the code if not given.
    """

    code: Code
    message: Message | str
    sensor: str = ""
    parameter: str = ""
    severity: Severity = _OF_THE_CODE

    def __post_init__(self) -> None:
        object.__setattr__(self, "severity", self.severity or self.code.severity)

    @property
    def text(self) -> str:
        """What happened, in English."""
        return text_of(self.message)

    @property
    def unusable(self) -> bool:
        """Whether there is nothing to solve with; else a fit contradicts the data."""
        return self.severity == "error" and self.code in UNUSABLE

    @property
    def chinese(self) -> str:
        """What happened, in Chinese; a text of another version behind what its code means."""
        if isinstance(self.message, str):
            return f"{self.code.text('meaning', 'zh')}（{self}）"
        text = text_of(self.message, "zh")
        return f"{chinese(self.sensor)}：{text}" if self.sensor else text

    def __str__(self) -> str:
        return f"{self.sensor}: {self.text}" if self.sensor else self.text


def errors_of(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings for which a solution is not to be used."""
    return tuple(f for f in findings if f.severity == "error")
