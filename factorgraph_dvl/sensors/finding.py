"""Findings: what the user should know about records and results, each with a stable code."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, Self, cast

# A check that was passed; something to know; a reason for caution; one not to use it.
Severity = Literal["ok", "note", "warning", "error"]
VerdictGrade = Literal["good", "doubtful", "do not use"]


class Code(StrEnum):
    """Stable names of findings: what each means, why it matters, and what to do about it.

    They stand in the order in which a verdict lists its reasons: causes before symptoms. Each
    has a severity, which a finding may override.

    `python tests/findings_page.py` writes them to docs/findings.md, in the groups of the
    comments.
    """

    meaning: str
    why: str
    action: str
    severity: Severity

    def __new__(
        cls, value: str, meaning: str, why: str, action: str, severity: Severity = "warning"
    ) -> Self:
        """Return a code with its meaning, why it matters, the action and the usual severity."""
        code = str.__new__(cls, value)
        code._value_ = value
        code.meaning = meaning
        code.why = why
        code.action = action
        code.severity = severity
        return code

    @property
    def rank(self) -> int:
        """Place among the reasons of a verdict."""
        return list(Code).index(self)

    # Clocks and gaps.
    TIME_UNIT = (
        "time_unit",
        "The samples are too far apart, or too close together, for an IMU.",
        "Every rate, noise density and lag in the trial is per second: nothing can be solved.",
        "Write time_s in seconds.",
        "error",
    )
    NO_OVERLAP = (
        "no_overlap",
        "A sensor measured nothing while the others did.",
        "Nothing ties the sensor to the motion: it cannot be used.",
        "Write all time_s by one clock, in seconds.",
        "error",
    )
    PARTIAL_OVERLAP = (
        "partial_overlap",
        "Record and IMU cover each other only in part; the rest is not used.",
        "The calibration rests on less data than the files hold.",
        "Check the clocks, or record all sensors at once.",
        "note",
    )
    GAPS = (
        "gaps",
        "A record has gaps.",
        "Nothing is measured there: standard deviations grow, and turns in a gap are lost.",
        "Check the logger; of a planar trial keep straight on during a gap.",
        "note",
    )
    CLOCK_RESTARTED = (
        "clock_restarted",
        "The IMU recorded a stretch by another clock than all other sensors; it is not used.",
        "The true time of that stretch is unknown, and so is the motion in it.",
        "Write all of time_s by one clock.",
    )
    CLOCK_JUMP = (
        "clock_jump",
        "The clock of a record jumps.",
        "The time that really passed is unknown: dead reckoning breaks there.",
        "Write all of time_s by one clock.",
    )
    IMU_GAP = (
        "imu_gap",
        "The IMU's record has a gap, which the inertial chain does not bridge.",
        "Each part has biases in common but a motion of its own, known less well at its ends.",
        "Nothing, if the rest is long enough; else record anew.",
        "note",
    )
    LOST_SAMPLES = (
        "lost_samples",
        "Few lost samples of the IMU were interpolated.",
        "The motion in between is a guess, good while the gaps are few samples long.",
        "Nothing, if they are few.",
        "note",
    )
    IMU_NOISE = (
        "imu_noise",
        "The record of the IMU is noisier at high frequencies than trial.yaml states.",
        "The stated noise would make standard deviations too small; that of the record is used.",
        "State the noise of a static record, or `noise: stated` where the IMU only vibrates.",
    )
    CLOCK_OFFSET = (
        "clock_offset",
        "The clock of a sensor differs from that of the IMU.",
        "In turns and sway it moves misalignment and lever arm by many standard deviations.",
        "State it as time_offset_s of the sensor, or write all time_s by one clock.",
    )
    CLOCK_DRIFT = (
        "clock_drift",
        "The clock of a sensor runs faster or slower than that of the IMU.",
        "No single time offset is right for the whole trial.",
        "Write time_s from the instruments' own stamps, all by one clock.",
    )
    CLOCK_STEP = (
        "clock_step",
        "The clock of a sensor jumps against that of the IMU.",
        "No single time offset is right for the whole trial.",
        "Write time_s by one clock, or solve the parts before and after the jump apart.",
    )
    LEAP_SECONDS = (
        "leap_seconds",
        "Stamps differ by the leap seconds between GPS time and UTC.",
        "The sensor would be compared with motion of another time.",
        "Write all time_s in UTC, or all in GPS time.",
        "error",
    )
    LOCAL_TIME = (
        "local_time",
        "Stamps differ by whole hours, as local time and UTC do.",
        "Nothing ties the sensor to the motion: it cannot be used.",
        "Write all time_s in UTC.",
        "error",
    )
    UNUSED = (
        "unused",
        "Measurements were not used.",
        "The calibration rests on less data than the files hold.",
        "Check the clocks; the text says how many there are, and why.",
        "note",
    )
    # What a record holds.
    INVALID_VALUES = (
        "invalid_values",
        "Values with which an instrument marks what it has not measured were taken as missing.",
        "As measurements they would be gross errors.",
        "Nothing, if they are few; else leave such cells empty.",
        "note",
    )
    FROZEN_VALUES = (
        "frozen_values",
        "A record repeats its values for a while.",
        "What it repeats is not the motion of that time.",
        "Check the logger, and leave such rows out.",
        "error",
    )
    IMU_CHANNEL = (
        "imu_channel",
        "A channel of the IMU does not measure.",
        "Without it there is no attitude, and nothing can be solved.",
        "Check cable and conversion of the record.",
        "error",
    )
    NO_MEASUREMENT = (
        "no_measurement",
        "A record holds no measurement.",
        "A sensor that measured nothing adds nothing: most often a conversion failed.",
        "Remove its section from trial.yaml, or correct the record.",
        "error",
    )
    MISSING = (
        "missing",
        "More than half of the rows hold no measurement.",
        "Parameters are known less well, and what is left may be the doubtful part.",
        "Check bottom lock, fixes and the conversion of the record.",
        "note",
    )
    COUNTED_TWICE = (
        "counted_twice",
        "dvl and dvl_beams seem to be records of one instrument, whose noise counts twice.",
        "Standard deviations come out too small, by up to the square root of two.",
        "Remove one of the two sections.",
    )
    # Units, signs and axes.
    FORCE_UNIT = (
        "force_unit",
        "The specific force is not about 9.8 m/s².",
        "Velocity and attitude follow from the force: the solution would be wrong throughout.",
        "Convert it to m/s², with gravity.",
        "error",
    )
    BODY_AXES = (
        "body_axes",
        "Gravity does not point where body_axes says.",
        "Roll, pitch and all lever arms would be those of other axes.",
        "Correct body_axes, or the sign of the force.",
        "error",
    )
    GYRO_UNIT = (
        "gyro_unit",
        "The angular rate does not turn the specific force as it should.",
        "Attitude follows from the rate: the solution would be wrong throughout.",
        "Convert it to rad/s, in the axes of the force.",
        "error",
    )
    GYRO_FROZEN = (
        "gyro_frozen",
        "The angular rate is zero throughout.",
        "Without rates there is neither attitude nor lever arm.",
        "Correct the record.",
        "error",
    )
    IMU_AXES = (
        "imu_axes",
        "Axes of the IMU are mirrored or swapped.",
        "Turns are integrated to the wrong side: the solution would be wrong throughout.",
        "Invert or swap the columns of imu that the text names.",
        "error",
    )
    GYRO_AXES = (
        "gyro_axes",
        "The gyros measure in other axes, or with another sign, than the accelerometers.",
        "Attitude follows from the rate: the solution would be wrong throughout.",
        "Invert or swap the columns of the gyros that the text names.",
        "error",
    )
    ACCEL_AXES = (
        "accel_axes",
        "The accelerometers measure in other axes, or with another sign, than the gyros.",
        "Velocity follows from the force: the solution would be wrong throughout.",
        "Invert or swap the columns of the accelerometers that the text names.",
        "error",
    )
    COURSE = (
        "course",
        "The bow by body_axes does not point where the vehicle goes.",
        "Roll, pitch, heading and the misalignment would be given in other axes than they seem.",
        "Correct body_axes; if the vehicle did move like that, nothing.",
    )
    ANTENNA = (
        "antenna",
        "The antenna is elsewhere than gnss.lever_arm_m says.",
        "In turns the error goes into the lever arm and the misalignment of the DVL.",
        "Measure and correct gnss.lever_arm_m, or give lever_arm_std_m.",
    )
    GNSS_AXES = (
        "gnss_axes",
        "GNSS moves otherwise than the IMU.",
        "Heading, and all that follows from it, would be wrong.",
        "Correct order and sign of the columns of gnss that the text names.",
        "error",
    )
    DVL_AXES = (
        "dvl_axes",
        "Axes of the DVL are mirrored, which no mounting does.",
        "The misalignment would be a rotation that fits as badly as all others.",
        "Invert the components that the text names; all three of a PD0 record.",
        "error",
    )
    ZERO_FIXES = (
        "zero_fixes",
        "Some fixes are at latitude and longitude 0.",
        "A fix that was lost would draw the track into the Gulf of Guinea.",
        "Leave the cells of lost fixes empty.",
        "error",
    )
    RADIANS = (
        "radians",
        "Latitude and longitude look like radians.",
        "The track would be 57 times too short, and near latitude and longitude 0.",
        "Convert them to degrees.",
        "error",
    )
    GNSS_VELOCITY = (
        "gnss_velocity",
        "GNSS velocities disagree with the differences of positions.",
        "Heading, misalignment and scale error follow from this velocity.",
        "Correct unit, order or sign of the velocity.",
        "error",
    )
    DVL_UNIT = (
        "dvl_unit",
        "The DVL's speed is far from that of the GNSS.",
        "The unit would be taken for a scale error.",
        "Convert it to m/s.",
        "error",
    )
    DVL_FROZEN = (
        "dvl_frozen",
        "The DVL's velocity never changes.",
        "A frozen value is taken for a measurement, and looks most precise.",
        "Correct the record.",
        "error",
    )
    DVL_STD = (
        "dvl_std",
        "The DVL's standard deviation is large for its speed.",
        "The DVL hardly counts: its parameters stay near their priors.",
        "Correct velocity_std_m_s, or the columns std.",
    )
    DVL_SIGN = (
        "dvl_sign",
        "By its prior misalignment the vehicle moves astern.",
        "The misalignment is searched for around the wrong direction.",
        "Invert the velocity of a PD0 record, or correct misalignment_deg.",
    )
    BEAMS_LOST = (
        "beams_lost",
        "A beam is lost at most pings.",
        "The direction and scale of that beam rest on few pings.",
        "Check the transducer; its values are known less well.",
        "note",
    )
    BEAMS_DISAGREE = (
        "beams_disagree",
        "Beams contradict each other by more than noise and priors explain.",
        "A beam under another's number moves every parameter.",
        "Check their order, signs and directions.",
    )
    NO_EPOCH = (
        "no_epoch",
        "Stars give the attitude only at a known time, and the trial has none.",
        "The Earth turns by 15 degrees an hour under the stars.",
        "Give epoch, the UTC of time_s = 0.",
        "error",
    )
    STAR_CATALOGUE = (
        "star_catalogue",
        "The angles between stars differ from those of the catalogue.",
        "A wrong star makes an attitude that looks as good as a right one.",
        "Check identification and columns, or raise std_arcsec.",
    )
    STAR_VERTICAL = (
        "star_vertical",
        "The vertical by the stars is not that of the specific force.",
        "A wrong time or mounting is taken for an attitude, and for gyro bias.",
        "Check epoch and mounting_deg.",
        "error",
    )
    STAR_CONVENTION = (
        "star_convention",
        "The star tracker turns otherwise than the gyros.",
        "An inverse or reordered quaternion contradicts the gyros at every turn.",
        "Write C_b^i as a quaternion with the scalar first; check mounting_deg.",
        "error",
    )
    HEADING_UNIT = (
        "heading_unit",
        "The heading stays close to north, steadier than it should.",
        "The dead-reckoned track would run north whatever the vehicle did.",
        "Convert it to degrees.",
    )
    LOG_SIGN = (
        "log_sign",
        "The log's speed is astern.",
        "The dead-reckoned track would run backwards.",
        "Write speed_m_s positive ahead.",
    )
    DEPTH_SIGN = (
        "depth_sign",
        "The depth is above the sea.",
        "Heights, and with them slant ranges, would be mirrored at the surface.",
        "Write depth_m positive down.",
    )
    BEACON_HEIGHT = (
        "beacon_height",
        "A beacon is above the sea.",
        "Horizontal distances follow from ranges and heights.",
        "Write height_m positive up; check depth.sea_surface_height_m.",
    )
    AT_REST = (
        "at_rest",
        "The vehicle rests, so that one beacon gives only a circle.",
        "The trajectory is one of many that the ranges allow.",
        "Move, or add a beacon.",
        "note",
    )
    # Where a solver starts.
    UNUSABLE_PRIOR = (
        "unusable_prior",
        "The calibration that the trial starts from is graded `do not use`.",
        "What was wrong there is carried into this trial.",
        "Calibrate anew, and name that result in dvl.calibration or imu.calibration.",
    )
    HEADING_UNKNOWN = (
        "heading_unknown",
        "The velocity changes too little to find the heading before solving.",
        "The solver starts from a heading that may be far off.",
        "Change speed or course, or give `initial`.",
    )
    FEW_RANGES = (
        "few_ranges",
        "There are too few ranges to find a position from them.",
        "The solver starts from a position that may be far off.",
        "Give initial.position, or stay in reach of the beacons for longer.",
    )
    NOT_STARTED = (
        "not_started",
        "The replay cannot start yet.",
        "There is no estimate yet; the records so far are kept.",
        "Wait, manoeuvre, or give `initial`.",
        "note",
    )
    # What a solver found.
    PRIOR_CONTRADICTED = (
        "prior_contradicted",
        "The calibration that the trial starts from contradicts its data.",
        "The result lies between the two, and fits neither.",
        "Leave dvl.calibration out if the DVL was mounted anew, imu.calibration if the IMU was "
        "switched off; else look for what differs.",
    )
    HALVES_DIFFER = (
        "halves_differ",
        "The two halves of the trial, solved apart, differ by more than chance.",
        "A mount or a scale that changes has no one value: the result is a mean.",
        "Check the mount; calibrate again after it was fixed, or solve shorter trials.",
    )
    DOES_NOT_FIT = (
        "does_not_fit",
        "Residuals are so large that the model does not fit the data.",
        "Values and standard deviations are those of a model that the data contradict.",
        "Check lever arm, clock, units and axes; do not use the values.",
        "error",
    )
    HEADING_ERROR = (
        "heading_error",
        "Without an IMU, misalignment and error of the heading show only together.",
        "A DVL that is turned and a compass that is off make the same velocities.",
        "Read the misalignment with the heading's own error, or relative to its mean.",
        "note",
    )
    FAR_FROM_PRIOR = (
        "far_from_prior",
        "A value is far outside its prior.",
        "Either the prior is wrong, which draws all values with it, or the data are.",
        "Check clocks, units, axes and lever arms, and then the prior itself.",
    )
    LARGE_RESIDUALS = (
        "large_residuals",
        "Residuals are larger than their standard deviation says.",
        "Standard deviations allow for it where the noise was estimated; else they are too small.",
        "Correct the standard deviation of the sensor; check clock and lever arm.",
    )
    SMALL_RESIDUALS = (
        "small_residuals",
        "The noise of a sensor is less than half of what is stated.",
        "Errors that wander, as those of GNSS do, hide in the trajectory and leave little noise.",
        "Correct the standard deviation of the sensor; state what wanders as correlated.",
    )
    OUTLIERS = (
        "outliers",
        "Some measurements are far from what all others say, and are not used.",
        "Values and standard deviations come from the rest; smaller errors may have passed.",
        "Look at rejected.csv; check bottom lock and fixes at these times.",
    )
    ESTIMATED_INSTEAD = (
        "estimated_instead",
        "The data contradict a parameter that was stated as known; it was estimated instead.",
        "Taken as stated it would draw all values with it.",
        "Check it, and state its standard deviation.",
    )
    UNEXPLAINED_MISFIT = (
        "unexplained_misfit",
        "Residuals do not fit, and a parameter that is taken as known would explain it.",
        "Values are drawn by more than their standard deviations.",
        "Check the parameter that is named, and give it a standard deviation.",
        "error",
    )
    CHANGED_ALONG_TRIAL = (
        "changed_along_trial",
        "A parameter is not the same all along the trial.",
        "A mount that slips, a false lock or a clock that steps make a mean that holds nowhere.",
        "Check mount, lock and clock at that time; solve what came before and after apart.",
        "error",
    )
    NOISE_NOT_SETTLED = (
        "noise_not_settled",
        "The noise of a sensor comes out the larger the more of it is allowed for.",
        "What the IMU measured contradicts the sensor: errors of the IMU are larger than stated.",
        "Raise the noise of the IMU, or give its grade; check clocks and lever arms.",
    )
    MANY_REJECTED = (
        "many_rejected",
        "Over a third of the measurements were rejected.",
        "Single echoes are few: a cause common to all of them is more likely.",
        "Check place, clock, unit and standard deviation.",
    )
    AT_THE_GATE = (
        "at_the_gate",
        "Some measurements are as likely echoes as not; they are used.",
        "Results would change a little if they were left out.",
        "Nothing, if they are few.",
        "note",
    )
    AMBIGUOUS = (
        "ambiguous",
        "More than one answer fits the data; the standard deviations contain all of them.",
        "The value that is given may be that of the wrong answer.",
        "Turn by 30 degrees or more, change speed, or give initial.position.",
    )
    NOT_CONVERGED = (
        "not_converged",
        "The solver did not converge, so that its numbers are not to be used.",
        "Values and standard deviations hold at a minimum of the cost only.",
        "Look at the other findings, units and priors first.",
        "error",
    )
    NOT_OBSERVABLE = (
        "not_observable",
        "The data do not determine a parameter better than its prior.",
        "Its value is the prior's, not one that was measured.",
        "Do the manoeuvres that the text names, or fix the parameter.",
        "note",
    )
    PRIOR_KEPT = (
        "prior_kept",
        "The trial adds little to the calibration that it starts from.",
        "The values are those of the earlier calibration: this trial does not confirm them.",
        "Nothing.",
        "note",
    )
    UNCERTAIN = (
        "uncertain",
        "A misalignment or scale error is known less well than the limits ask.",
        "Dead reckoning with it drifts by more than the limits allow.",
        "Turn to both sides and change speed; `plan` proposes the manoeuvre that is missing.",
    )
    FILTER_CONTRADICTED = (
        "filter_contradicted",
        "Residuals are larger than the filter's covariance allows: it has not converged.",
        "Values and standard deviations of a filter that diverged mean nothing.",
        "Use `solve`.",
        "error",
    )
    METHOD_LIMITS = (
        "method_limits",
        "The method neglects, fixes or assumes something that `solve` does not.",
        "Values may be biased, and standard deviations too small.",
        "Use `solve` if it matters.",
        "note",
    )
    GNSS_OUTAGE = (
        "gnss_outage",
        "GNSS is missing for so long that the filter drifts.",
        "What the filter learns of the DVL in the outage is worth little.",
        "Use `solve`, which bridges it.",
    )
    FILTER_RESTARTED = (
        "filter_restarted",
        "The filter starts again after a gap.",
        "Both sides of the gap are known less well than together.",
        "Use `solve`, which joins the parts.",
        "note",
    )
    MEAN_OR_LAST = (
        "mean_or_last",
        "A bias walks: a replay reports its last value, `solve` the mean.",
        "The two values differ, and neither is wrong.",
        "Nothing.",
        "note",
    )
    # What a replay noticed.
    ERROR_LEFT_OUT = (
        "error_left_out",
        "The trial states an error that no solver estimates.",
        "Standard deviations leave out what this error adds.",
        "Compare --halves; a change that is larger than chance is named.",
    )
    CORRELATION_LEFT_OUT = (
        "correlation_left_out",
        "The replay takes noise that persists for white noise.",
        "Its standard deviations are too small.",
        "Solve the trial as a whole for standard deviations that contain it.",
    )
    IMU_ERRORS_LEFT_OUT = (
        "imu_errors_left_out",
        "The replay does not estimate scale, axes and g-sensitivity of the IMU.",
        "Its standard deviations leave out what these errors add.",
        "Solve the trial as a whole for standard deviations that contain them.",
    )
    SILENT = (
        "silent",
        "A sensor has fallen silent.",
        "The estimate continues without it, and its standard deviations grow.",
        "Check its cable, power and clock.",
        "note",
    )
    HEARD_AGAIN = (
        "heard_again",
        "A sensor is back, or agrees again.",
        "From here on its measurements are used again.",
        "Nothing.",
        "note",
    )
    CONTRADICTS = (
        "contradicts",
        "Measurements contradict the prediction.",
        "Used, they would move the estimate by many standard deviations.",
        "Check clock, time offset and sensor.",
    )
    # Results from files.
    UNCLASSIFIED = (
        "unclassified",
        "A warning in a file of another version, without a code that this one knows.",
        "What it means for the result is known to the version that wrote it only.",
        "Read its text.",
        "note",
    )


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
    text : str
        What happened, in this case.
    sensor : str, optional
        Label of the sensor, or of the kind of its measurements; empty if it is about none.
    parameter : str, optional
        Name as in calibration.json; empty if it is about none.
    severity : Severity, optional
        `ok` for a check that was passed, `note` for what is no reason for caution, `warning`
        for a reason, `error` where a result is not to be used. That of the code if not given.
    """

    code: Code
    text: str
    sensor: str = ""
    parameter: str = ""
    severity: Severity = _OF_THE_CODE

    def __post_init__(self) -> None:
        object.__setattr__(self, "severity", self.severity or self.code.severity)

    @property
    def unusable(self) -> bool:
        """Whether there is nothing to solve with; else a fit contradicts the data."""
        return self.severity == "error" and self.code in UNUSABLE

    def __str__(self) -> str:
        return f"{self.sensor}: {self.text}" if self.sensor else self.text


@dataclass(frozen=True)
class Verdict:
    """Whether a result can be used, and why not.

    Parameters
    ----------
    grade : VerdictGrade
        `do not use`: the data contradict the model. `doubtful`: there is something to check.
    reasons : tuple of Finding
        The worst first, and of equal ones causes before symptoms. Empty if the grade is good.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> verdict = fd.solve(fd.simulate("examples/short.yaml", seed=1)).verdict
    >>> verdict.grade, verdict.reasons
    ('good', ())
    """

    grade: VerdictGrade
    reasons: tuple[Finding, ...]

    def __str__(self) -> str:
        return f"{self.grade}: {self.reasons[0]}" if self.reasons else self.grade


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict on a result with these findings."""
    found = dict.fromkeys(findings)
    errors = [f for f in found if f.severity == "error"]
    warnings = [f for f in found if f.severity == "warning"]
    reasons = [f for group in (errors, warnings) for f in sorted(group, key=lambda f: f.code.rank)]
    return Verdict("do not use" if errors else "doubtful" if warnings else "good", tuple(reasons))


def errors_of(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings for which a solution is not to be used."""
    return tuple(f for f in findings if f.severity == "error")
