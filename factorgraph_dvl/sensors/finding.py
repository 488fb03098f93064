"""Findings: what the user should know about records and results, each with a stable code."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, Self

Severity = Literal["ok", "warning", "error"]


class Code(StrEnum):
    """Stable names of findings, each with what it means and what to do about it."""

    meaning: str
    action: str

    def __new__(cls, value: str, meaning: str, action: str) -> Self:
        """Return a code with its meaning and action."""
        code = str.__new__(cls, value)
        code._value_ = value
        code.meaning = meaning
        code.action = action
        return code

    # Clocks and gaps.
    TIME_UNIT = (
        "time_unit",
        "The samples are too far apart, or too close together, for an IMU.",
        "Write time_s in seconds.",
    )
    NO_OVERLAP = (
        "no_overlap",
        "A sensor measured nothing while the others did.",
        "Write all time_s by one clock, in seconds.",
    )
    PARTIAL_OVERLAP = (
        "partial_overlap",
        "Record and IMU cover each other only in part; the rest is not used.",
        "Check the clocks, or record all sensors at once.",
    )
    GAPS = (
        "gaps",
        "A record has gaps.",
        "Check the logger; of a planar trial keep straight on during a gap.",
    )
    CLOCK_RESTARTED = (
        "clock_restarted",
        "The IMU recorded a stretch by another clock than all other sensors; it is not used.",
        "Write all of time_s by one clock.",
    )
    CLOCK_JUMP = (
        "clock_jump",
        "The clock of the IMU jumps.",
        "Write all of time_s by one clock.",
    )
    IMU_GAP = (
        "imu_gap",
        "The IMU's record has a gap, which the inertial chain does not bridge.",
        "Nothing, if the rest is long enough; else record anew.",
    )
    LOST_SAMPLES = (
        "lost_samples",
        "Few lost samples of the IMU were interpolated.",
        "Nothing, if they are few.",
    )
    UNUSED = (
        "unused",
        "Measurements were not used.",
        "Check the clocks; the text says how many there are, and why.",
    )
    # What a record holds.
    NO_MEASUREMENT = (
        "no_measurement",
        "A record holds no measurement.",
        "Remove its section from trial.yaml, or correct the record.",
    )
    MISSING = (
        "missing",
        "More than half of the rows hold no measurement.",
        "Check bottom lock, fixes and the conversion of the record.",
    )
    COUNTED_TWICE = (
        "counted_twice",
        "dvl and dvl_beams seem to be records of one instrument, whose noise counts twice.",
        "Remove one of the two sections.",
    )
    # Units, signs and axes.
    FORCE_UNIT = (
        "force_unit",
        "The specific force is not about 9.8 m/s².",
        "Convert it to m/s², with gravity.",
    )
    BODY_AXES = (
        "body_axes",
        "Gravity does not point where body_axes says.",
        "Correct body_axes, or the sign of the force.",
    )
    GYRO_UNIT = (
        "gyro_unit",
        "The angular rate does not turn the specific force as it should.",
        "Convert it to rad/s, in the axes of the force.",
    )
    GYRO_FROZEN = ("gyro_frozen", "The angular rate is zero throughout.", "Correct the record.")
    ZERO_FIXES = (
        "zero_fixes",
        "Some fixes are at latitude and longitude 0.",
        "Leave the cells of lost fixes empty.",
    )
    RADIANS = (
        "radians",
        "Latitude and longitude look like radians.",
        "Convert them to degrees.",
    )
    GNSS_VELOCITY = (
        "gnss_velocity",
        "GNSS velocities disagree with the differences of positions.",
        "Correct unit, order or sign of the velocity.",
    )
    DVL_UNIT = (
        "dvl_unit",
        "The DVL's speed is far from that of the GNSS.",
        "Convert it to m/s.",
    )
    DVL_FROZEN = ("dvl_frozen", "The DVL's velocity never changes.", "Correct the record.")
    DVL_STD = (
        "dvl_std",
        "The DVL's standard deviation is large for its speed.",
        "Correct velocity_std_m_s, or the columns std.",
    )
    DVL_SIGN = (
        "dvl_sign",
        "By its prior misalignment the vehicle moves astern.",
        "Invert the velocity of a PD0 record, or correct misalignment_deg.",
    )
    BEAMS_LOST = (
        "beams_lost",
        "A beam is lost at most pings.",
        "Check the transducer; its values are known less well.",
    )
    BEAMS_DISAGREE = (
        "beams_disagree",
        "Beams contradict each other by more than noise and priors explain.",
        "Check their order, signs and directions.",
    )
    NO_EPOCH = (
        "no_epoch",
        "Stars tell the attitude only at a known time, and the trial has none.",
        "Give epoch, the UTC of time_s = 0.",
    )
    STAR_CATALOGUE = (
        "star_catalogue",
        "The angles between stars differ from those of the catalogue.",
        "Check identification and columns, or raise std_arcsec.",
    )
    STAR_VERTICAL = (
        "star_vertical",
        "The vertical by the stars is not that of the specific force.",
        "Check epoch and mounting_deg.",
    )
    STAR_CONVENTION = (
        "star_convention",
        "The star tracker turns otherwise than the gyros.",
        "Write C_b^i as a quaternion with the scalar first; check mounting_deg.",
    )
    HEADING_UNIT = (
        "heading_unit",
        "The heading stays close to north, steadier than it should.",
        "Convert it to degrees.",
    )
    LOG_SIGN = ("log_sign", "The log's speed is astern.", "Write speed_m_s positive ahead.")
    DEPTH_SIGN = ("depth_sign", "The depth is above the sea.", "Write depth_m positive down.")
    BEACON_HEIGHT = (
        "beacon_height",
        "A beacon is above the sea.",
        "Write height_m positive up; check depth.sea_surface_height_m.",
    )
    AT_REST = (
        "at_rest",
        "The vehicle rests, so that one beacon tells only a circle.",
        "Move, or add a beacon.",
    )
    # Where a solver starts.
    HEADING_UNKNOWN = (
        "heading_unknown",
        "The velocity changes too little to find the heading before solving.",
        "Change speed or course, or give `initial`.",
    )
    FEW_RANGES = (
        "few_ranges",
        "There are too few ranges to find a position from them.",
        "Give initial.position, or stay in reach of the beacons for longer.",
    )
    NOT_STARTED = (
        "not_started",
        "The replay cannot start yet.",
        "Wait, manoeuvre, or give `initial`.",
    )
    # What a solver found.
    NOT_CONVERGED = (
        "not_converged",
        "The solver did not converge, so that its numbers are not to be used.",
        "Look at the other findings, units and priors first.",
    )
    NOT_OBSERVABLE = (
        "not_observable",
        "The data do not determine a parameter better than its prior.",
        "Do the manoeuvres that the text names, or fix the parameter.",
    )
    PRIOR_KEPT = (
        "prior_kept",
        "The trial adds little to the calibration that it starts from.",
        "Nothing.",
    )
    AMBIGUOUS = (
        "ambiguous",
        "More than one answer fits the data; the standard deviations contain all of them.",
        "Turn by 30 degrees or more, change speed, or give initial.position.",
    )
    FAR_FROM_PRIOR = (
        "far_from_prior",
        "A value is far outside its prior.",
        "Check prior, units and axes before you use any value.",
    )
    DOES_NOT_FIT = (
        "does_not_fit",
        "Residuals are so large that the model does not fit the data.",
        "Check lever arm, clock, units and axes; do not use the values.",
    )
    LARGE_RESIDUALS = (
        "large_residuals",
        "Residuals are larger than their standard deviation says.",
        "Raise the standard deviation of the sensor.",
    )
    MANY_REJECTED = (
        "many_rejected",
        "Over a third of the measurements were rejected.",
        "Check place, clock, unit and standard deviation.",
    )
    AT_THE_GATE = (
        "at_the_gate",
        "Some measurements are as likely echoes as not; they are used.",
        "Nothing, if they are few.",
    )
    FILTER_CONTRADICTED = (
        "filter_contradicted",
        "Residuals are larger than the filter's covariance allows: it has not converged.",
        "Use `solve`.",
    )
    METHOD_LIMITS = (
        "method_limits",
        "The method neglects, fixes or assumes something that `solve` does not.",
        "Use `solve` if it matters.",
    )
    GNSS_OUTAGE = (
        "gnss_outage",
        "GNSS is missing for so long that the filter drifts.",
        "Use `solve`, which bridges it.",
    )
    FILTER_RESTARTED = (
        "filter_restarted",
        "The filter starts again after a gap.",
        "Use `solve`, which joins the parts.",
    )
    MEAN_OR_LAST = (
        "mean_or_last",
        "A bias walks: a replay reports its last value, `solve` the mean.",
        "Nothing.",
    )
    # What a replay noticed.
    SILENT = ("silent", "A sensor has fallen silent.", "Check its cable, power and clock.")
    HEARD_AGAIN = ("heard_again", "A sensor is back, or agrees again.", "Nothing.")
    CONTRADICTS = (
        "contradicts",
        "Measurements contradict the prediction.",
        "Check clock, time offset and sensor.",
    )
    # Results from files.
    UNCLASSIFIED = (
        "unclassified",
        "A warning in a file of another version, without a code that this one knows.",
        "Read its text.",
    )


# Errors with which there is nothing to solve; with the others a fit contradicts the data.
_UNUSABLE = frozenset(
    {
        Code.TIME_UNIT,
        Code.NO_OVERLAP,
        Code.NO_MEASUREMENT,
        Code.ZERO_FIXES,
        Code.RADIANS,
        Code.NO_EPOCH,
    }
)


@dataclass(frozen=True)
class Finding:
    """Something that the user should know about a record or a result.

    Parameters
    ----------
    code : Code
        What it is.
    text : str
        What happened, in this case.
    sensor : str, optional
        Label of the sensor, or of the kind of its measurements; empty if it is about none.
    parameter : str, optional
        Name as in calibration.json; empty if it is about none.
    severity : Severity, optional
        `ok` for a check that was passed, `error` where a solution is not to be used.
    """

    code: Code
    text: str
    sensor: str = ""
    parameter: str = ""
    severity: Severity = "warning"

    @property
    def unusable(self) -> bool:
        """Whether there is nothing to solve with; else a fit contradicts the data."""
        return self.severity == "error" and self.code in _UNUSABLE

    def __str__(self) -> str:
        return f"{self.sensor}: {self.text}" if self.sensor else self.text


def errors_of(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings for which a solution is not to be used."""
    return tuple(f for f in findings if f.severity == "error")
