"""Findings: what the user should know about records and results, each with a stable code."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, Self, cast

from factorgraph_dvl.sensors.message import Message, in_language

# A check that was passed; something to know; a reason for caution; one not to use it.
Severity = Literal["ok", "note", "warning", "error"]


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
        "Rates, noise densities and time offsets are per second, so the trial cannot be solved.",
        "Write time_s in seconds.",
        "error",
    )
    NO_OVERLAP = (
        "no_overlap",
        "The record of a sensor does not overlap the records of the others in time.",
        "The sensor cannot be compared with the motion, so it cannot be used.",
        "Write all time_s by one clock, in seconds.",
        "error",
    )
    PARTIAL_OVERLAP = (
        "partial_overlap",
        "The records of a sensor and of the IMU overlap only in part. The rest is not used.",
        "The calibration uses less data than the files contain.",
        "Check the clocks, or record all sensors at the same time.",
        "note",
    )
    GAPS = (
        "gaps",
        "A record has gaps.",
        "The motion in a gap is not measured: standard deviations grow, and turns may be missed.",
        "Check the logger. In a planar trial, do not turn during a gap.",
        "note",
    )
    CLOCK_RESTARTED = (
        "clock_restarted",
        "The IMU used a different clock than all other sensors for a part of the trial. That "
        "part is not used.",
        "The true time of that part is unknown, and so is its motion.",
        "Write all of time_s by one clock.",
    )
    CLOCK_JUMP = (
        "clock_jump",
        "The clock of a record jumps.",
        "The time that passed is unknown, so dead reckoning breaks there.",
        "Write all of time_s by one clock.",
    )
    IMU_GAP = (
        "imu_gap",
        "The record of the IMU has a gap that is too long to bridge.",
        "The parts before and after it share the biases, but each is less accurate at its ends.",
        "Nothing, if the rest is long enough. Otherwise, record the trial again.",
        "note",
    )
    LOST_SAMPLES = (
        "lost_samples",
        "A few lost samples of the IMU were interpolated.",
        "The motion in between is approximate. This is harmless while the gaps are a few "
        "samples long.",
        "Nothing, if they are few.",
        "note",
    )
    CLOCK_JITTER = (
        "clock_jitter",
        "The stamps of the IMU scatter about even intervals.",
        "The motion between two samples is given to the wrong time, which adds an error to "
        "attitude and velocity at each sample.",
        "Write the stamps of the instrument, or even ones, in place of those of the computer.",
        "error",
    )
    IMU_NOISE = (
        "imu_noise",
        "The record of the IMU is noisier at high frequencies than trial.yaml states.",
        "The stated noise would make standard deviations too small, so the noise of the "
        "record is used.",
        "State the noise of a static record. If the IMU only vibrates, state `noise: stated`.",
    )
    CLOCK_OFFSET = (
        "clock_offset",
        "The clock of a sensor differs from that of the IMU.",
        "In turns and sway, this changes misalignment and lever arm by many standard deviations.",
        "State the offset as time_offset_s of the sensor, or write all time_s by one clock.",
    )
    CLOCK_DRIFT = (
        "clock_drift",
        "The clock of a sensor runs faster or slower than that of the IMU.",
        "No single time offset is right for the whole trial.",
        "Write time_s from the instruments' own stamps, all by one clock.",
    )
    CLOCK_STEP = (
        "clock_step",
        "The clock of a sensor jumps relative to that of the IMU.",
        "No single time offset is right for the whole trial.",
        "Write time_s by one clock, or solve the parts before and after the jump separately.",
    )
    LEAP_SECONDS = (
        "leap_seconds",
        "Stamps differ by the leap seconds between GPS time and UTC.",
        "The sensor would be compared with the motion at another time.",
        "Write all time_s in UTC, or all in GPS time.",
        "error",
    )
    LOCAL_TIME = (
        "local_time",
        "Stamps differ by whole hours, as local time and UTC do.",
        "The sensor cannot be compared with the motion, so it cannot be used.",
        "Write all time_s in UTC.",
        "error",
    )
    UNUSED = (
        "unused",
        "Some measurements were not used.",
        "The calibration uses less data than the files contain.",
        "Check the clocks. The text gives the number of measurements and the reason.",
        "note",
    )
    # What a record holds.
    INVALID_VALUES = (
        "invalid_values",
        'Some values are codes of the instrument for "not measured". They were taken as missing.',
        "As measurements, they would be gross errors.",
        "Nothing, if they are few. Otherwise, leave such cells empty.",
        "note",
    )
    FROZEN_VALUES = (
        "frozen_values",
        "A record repeats its values for a while.",
        "The repeated values do not show the motion at that time.",
        "Check the logger, and leave such rows out.",
        "error",
    )
    IMU_CHANNEL = (
        "imu_channel",
        "A channel of the IMU does not measure.",
        "The attitude cannot be computed without it, so the trial cannot be solved.",
        "Check the cable and the conversion of the record.",
        "error",
    )
    IMU_SPIKES = (
        "imu_spikes",
        "Single samples of the IMU differ by far from those before and after.",
        "The solver takes each for a real turn or push of the vehicle.",
        "Leave such samples out. A few missing samples are interpolated.",
        "error",
    )
    SATURATED = (
        "saturated",
        "A channel of the IMU reaches the end of its range.",
        "The motion beyond it is lost, which changes attitude, velocity and biases.",
        "Set a larger range, or leave out the time of such motion.",
        "error",
    )
    NO_MEASUREMENT = (
        "no_measurement",
        "A record contains no measurement.",
        "The sensor adds no information. Usually, a conversion failed.",
        "Remove its section from trial.yaml, or correct the record.",
        "error",
    )
    MISSING = (
        "missing",
        "More than half of the rows contain no measurement.",
        "Parameters are less accurate, and the remaining measurements may be poor ones.",
        "Check bottom lock, fixes and the conversion of the record.",
        "note",
    )
    COUNTED_TWICE = (
        "counted_twice",
        "dvl and dvl_beams seem to be records of the same instrument, so its pings count twice.",
        "Standard deviations are too small, by up to the square root of two.",
        "Remove one of the two sections.",
    )
    # Units, signs and axes.
    FORCE_UNIT = (
        "force_unit",
        "The specific force is not about 9.8 m/s².",
        "Velocity and attitude depend on the force, so the whole solution would be wrong.",
        "Convert it to m/s², with gravity.",
        "error",
    )
    BODY_AXES = (
        "body_axes",
        "Gravity does not point in the direction that body_axes states.",
        "Roll, pitch and all lever arms would be in wrong axes.",
        "Correct body_axes, or the sign of the force.",
        "error",
    )
    GYRO_UNIT = (
        "gyro_unit",
        "The angular rate does not agree with the rotation of the specific force.",
        "Attitude depends on the rate, so the whole solution would be wrong.",
        "Convert it to rad/s, in the axes of the force.",
        "error",
    )
    GYRO_FROZEN = (
        "gyro_frozen",
        "The angular rate is zero throughout.",
        "Attitude and lever arm cannot be computed without rates.",
        "Correct the record.",
        "error",
    )
    IMU_AXES = (
        "imu_axes",
        "Axes of the IMU are mirrored or swapped.",
        "Turns are integrated in the wrong direction, so the whole solution would be wrong.",
        "Invert or swap the columns of imu that the text names.",
        "error",
    )
    GYRO_AXES = (
        "gyro_axes",
        "The gyros use other axes, or another sign, than the accelerometers.",
        "Attitude depends on the rate, so the whole solution would be wrong.",
        "Invert or swap the columns of the gyros that the text names.",
        "error",
    )
    ACCEL_AXES = (
        "accel_axes",
        "The accelerometers use other axes, or another sign, than the gyros.",
        "Velocity depends on the force, so the whole solution would be wrong.",
        "Invert or swap the columns of the accelerometers that the text names.",
        "error",
    )
    COURSE = (
        "course",
        "The bow according to body_axes does not point in the direction of motion.",
        "Roll, pitch, heading and the misalignment would be in other axes than stated.",
        "Correct body_axes. If the vehicle did move like that, do nothing.",
    )
    ANTENNA = (
        "antenna",
        "The antenna is not at the position that gnss.lever_arm_m states.",
        "In turns, the error changes the lever arm and the misalignment of the DVL.",
        "Measure and correct gnss.lever_arm_m, or state lever_arm_std_m.",
    )
    GNSS_AXES = (
        "gnss_axes",
        "The motion of GNSS does not agree with that of the IMU.",
        "The heading would be wrong, and everything that depends on it.",
        "Correct the order and sign of the columns of gnss that the text names.",
        "error",
    )
    DVL_AXES = (
        "dvl_axes",
        "Axes of the DVL are mirrored, which no mounting can do.",
        "No rotation fits the data, so the misalignment would be meaningless.",
        "Invert the components that the text names. A PD0 record needs all three inverted.",
        "error",
    )
    ZERO_FIXES = (
        "zero_fixes",
        "Some fixes are at latitude and longitude 0.",
        "Such a lost fix would pull the track into the Gulf of Guinea.",
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
        "Heading, misalignment and scale error depend on this velocity.",
        "Correct the unit, order or sign of the velocity.",
        "error",
    )
    DVL_UNIT = (
        "dvl_unit",
        "The DVL's speed is far from that of the GNSS.",
        "The solver would mistake the unit for a scale error.",
        "Convert the velocity to m/s.",
        "error",
    )
    DVL_FROZEN = (
        "dvl_frozen",
        "The DVL's velocity, or a component, never changes.",
        "The repeated value would count as a very precise measurement.",
        "Correct the record.",
        "error",
    )
    DVL_STD = (
        "dvl_std",
        "The DVL's standard deviation is large for its speed.",
        "The DVL has little weight, so its parameters stay near their priors.",
        "Correct velocity_std_m_s, or the columns std.",
    )
    DVL_SIGN = (
        "dvl_sign",
        "With its prior misalignment, the DVL shows motion astern.",
        "The solver searches for the misalignment around the wrong direction.",
        "Invert the velocity of a PD0 record, or correct misalignment_deg.",
    )
    BEAMS_LOST = (
        "beams_lost",
        "A beam is lost at most pings.",
        "Few pings determine the direction and scale of that beam.",
        "Check the transducer. Its values are less accurate.",
        "note",
    )
    BEAMS_DISAGREE = (
        "beams_disagree",
        "Beams contradict each other by more than noise and priors explain.",
        "A beam with a wrong number changes every parameter.",
        "Check the order, signs and directions of the beams.",
    )
    NO_EPOCH = (
        "no_epoch",
        "The trial has a star tracker, but no epoch.",
        "Stars give the attitude only at a known time, because the Earth turns by 15 degrees "
        "an hour.",
        "State epoch, the UTC of time_s = 0.",
        "error",
    )
    STAR_CATALOGUE = (
        "star_catalogue",
        "The angles between stars differ from those of the catalogue.",
        "A wrong star gives an attitude that looks as good as the right one.",
        "Check identification and columns, or raise std_arcsec.",
    )
    STAR_VERTICAL = (
        "star_vertical",
        "The vertical from the stars differs from that of the specific force.",
        "A wrong time or mounting changes the attitude and the gyro bias.",
        "Check epoch and mounting_deg.",
        "error",
    )
    STAR_CONVENTION = (
        "star_convention",
        "The attitude of the star tracker does not turn as the gyros do.",
        "An inverse or reordered quaternion contradicts the gyros at every turn.",
        "Write C_b^i as a quaternion with the scalar first. Check mounting_deg.",
        "error",
    )
    HEADING_UNIT = (
        "heading_unit",
        "The heading stays close to north, and changes less than expected.",
        "The dead-reckoned track would run north for any motion.",
        "Convert the heading to degrees.",
    )
    LOG_SIGN = (
        "log_sign",
        "The log's speed is astern.",
        "The dead-reckoned track would run backwards.",
        "Write speed_m_s positive ahead.",
    )
    DEPTH_SIGN = (
        "depth_sign",
        "The depth is above the sea surface.",
        "Heights and slant ranges would be mirrored at the surface.",
        "Write depth_m positive down.",
    )
    BEACON_HEIGHT = (
        "beacon_height",
        "A beacon is above the sea surface.",
        "Horizontal distances depend on ranges and heights.",
        "Write height_m positive up. Check depth.sea_surface_height_m.",
    )
    AT_REST = (
        "at_rest",
        "The vehicle is at rest, so one beacon gives only a circle.",
        "The ranges allow many trajectories, and the result is one of them.",
        "Move, or add a beacon.",
        "note",
    )
    # Where a solver starts.
    UNUSABLE_PRIOR = (
        "unusable_prior",
        "The calibration that the trial starts from is graded `do not use`.",
        "Its errors enter this trial.",
        "Calibrate anew, and name that result in dvl.calibration or imu.calibration.",
    )
    HEADING_UNKNOWN = (
        "heading_unknown",
        "The velocity changes too little to find the heading before solving.",
        "The solver starts from a heading that may be wrong.",
        "Change speed or course, or state `initial`.",
    )
    FEW_RANGES = (
        "few_ranges",
        "There are too few ranges to find a position from them.",
        "The solver starts from a position that may be wrong.",
        "State initial.position, or stay in reach of the beacons for longer.",
    )
    NOT_STARTED = (
        "not_started",
        "The replay cannot start yet.",
        "There is no estimate yet. The records so far are kept.",
        "Wait, manoeuvre, or state `initial`.",
        "note",
    )
    # What a solver found.
    PRIOR_CONTRADICTED = (
        "prior_contradicted",
        "The data contradict the calibration that the trial starts from.",
        "The result is between the two, and fits neither.",
        "Leave dvl.calibration out if the DVL was mounted anew, and imu.calibration if the "
        "IMU was switched off. Otherwise, find out what differs.",
    )
    HALVES_DIFFER = (
        "halves_differ",
        "The two halves of the trial, solved separately, differ by more than chance.",
        "A mount or a scale that changes has no single value: the result is a mean.",
        "Check the mount. Calibrate again after the repair, or solve shorter trials.",
    )
    DOES_NOT_FIT = (
        "does_not_fit",
        "The residuals are so large that the model does not fit the data.",
        "Values and standard deviations are meaningless, because the data contradict the model.",
        "Check lever arm, clock, units and axes. Do not use the values.",
        "error",
    )
    HEADING_ERROR = (
        "heading_error",
        "Without an IMU, the data determine only the sum of misalignment and heading error.",
        "A rotated DVL and a compass with an offset give the same velocities.",
        "Read the misalignment together with the heading error, or relative to the mean heading.",
        "note",
    )
    IMPOSSIBLE_SCALE = (
        "impossible_scale",
        "A scale error is larger than a velocity log that works can have.",
        "Something else, such as a current, is taken for it, and biases the other values.",
        "Check units and sound speed. Through water, sail faster, on both sides of each course.",
        "error",
    )
    CHANGED_ALONG_TRIAL = (
        "changed_along_trial",
        "A parameter changes along the trial.",
        "After a slipping mount, a false lock or a clock step, the mean is right at no time.",
        "Check mount, lock and clock at that time. Solve the parts before and after separately. "
        "For a bias of the IMU state its walk, such as imu: gyro_bias_walk_deg_h_sqrt_h.",
        "error",
    )
    FAR_FROM_PRIOR = (
        "far_from_prior",
        "A value is far outside its prior.",
        "Either the prior or the data are wrong. A wrong prior biases all values.",
        "Check clocks, units, axes and lever arms, and then the prior itself.",
    )
    LARGE_RESIDUALS = (
        "large_residuals",
        "Residuals are larger than their standard deviation states.",
        "If the noise is not estimated, standard deviations are too small.",
        "Correct the standard deviation of the sensor. Check clock and lever arm.",
    )
    SMALL_RESIDUALS = (
        "small_residuals",
        "The noise of a sensor is less than half of the stated noise.",
        "Slow errors, such as those of GNSS, move the trajectory instead of the residuals.",
        "Correct the standard deviation of the sensor. State slow errors as correlated.",
    )
    OUTLIERS = (
        "outliers",
        "Some measurements are far from all others, and are not used.",
        "Values and standard deviations come from the rest. Smaller errors may be among them.",
        "Look at rejected.csv. Check bottom lock and fixes at these times.",
    )
    ESTIMATED_INSTEAD = (
        "estimated_instead",
        "The data contradict a parameter that was stated as known. It was estimated instead.",
        "The stated value would bias all other values.",
        "Check the parameter, and state its standard deviation.",
    )
    UNEXPLAINED_MISFIT = (
        "unexplained_misfit",
        "The residuals do not fit. A wrong value of a parameter that is taken as known would "
        "explain this.",
        "The values have errors larger than their standard deviations.",
        "Check the parameter that the text names, and state its standard deviation.",
        "error",
    )
    NOISE_NOT_SETTLED = (
        "noise_not_settled",
        "The estimated noise of a sensor keeps growing.",
        "The IMU contradicts the sensor, because errors of the IMU are larger than stated.",
        "Raise the noise of the IMU, or state its grade. Check clocks and lever arms.",
    )
    MANY_REJECTED = (
        "many_rejected",
        "More than a third of the measurements were rejected.",
        "Echoes are rare, so a common cause is more likely.",
        "Check position, clock, unit and standard deviation.",
    )
    AT_THE_GATE = (
        "at_the_gate",
        "Some measurements are as likely to be echoes as not. They are used.",
        "The result would change a little without them.",
        "Nothing, if they are few.",
        "note",
    )
    AMBIGUOUS = (
        "ambiguous",
        "More than one answer fits the data. The standard deviations contain all of them.",
        "The reported value may be that of the wrong answer.",
        "Turn by 30 degrees or more, change speed, or state initial.position.",
    )
    NOT_CONVERGED = (
        "not_converged",
        "The solver did not converge.",
        "Values and standard deviations are valid only at a minimum of the cost.",
        "Do not use the numbers. Check the other findings, units and priors first.",
        "error",
    )
    NOT_OBSERVABLE = (
        "not_observable",
        "The data do not determine a parameter better than its prior.",
        "Its value is that of the prior, and was not measured.",
        "Do the manoeuvres that the text names, or fix the parameter.",
        "note",
    )
    PRIOR_KEPT = (
        "prior_kept",
        "The trial adds little to the calibration that it starts from.",
        "The values are those of the earlier calibration. This trial does not confirm them.",
        "Nothing.",
        "note",
    )
    UNCERTAIN = (
        "uncertain",
        "The standard deviation of a misalignment or scale error is above its limit.",
        "Dead reckoning with it drifts by more than the limits allow.",
        "Turn to both sides and change speed; `plan` proposes the manoeuvre that is missing.",
    )
    FILTER_CONTRADICTED = (
        "filter_contradicted",
        "The filter has not converged: its residuals are larger than its covariance allows.",
        "Values and standard deviations of a filter that diverged are meaningless.",
        "Use `solve`.",
        "error",
    )
    METHOD_LIMITS = (
        "method_limits",
        "The method neglects, fixes or assumes something that `solve` estimates.",
        "Values may be biased, and standard deviations too small.",
        "Use `solve` if this matters.",
        "note",
    )
    GNSS_OUTAGE = (
        "gnss_outage",
        "GNSS is missing for so long that the filter drifts.",
        "The filter learns little about the DVL in the outage.",
        "Use `solve`, which bridges the outage.",
    )
    FILTER_RESTARTED = (
        "filter_restarted",
        "The filter starts again after a gap.",
        "The results before and after the gap are less accurate than a joint solution.",
        "Use `solve`, which joins the parts.",
        "note",
    )
    MEAN_OR_LAST = (
        "mean_or_last",
        "A bias or a scale walks. A replay reports its last value, and `solve` its mean.",
        "The two values differ, and neither is wrong.",
        "Nothing.",
        "note",
    )
    # What a replay noticed.
    ERROR_LEFT_OUT = (
        "error_left_out",
        "The trial states an error that is estimated only with an IMU.",
        "Standard deviations do not contain the effect of this error.",
        "Use --halves, which reports changes that are larger than chance.",
    )
    SILENT = (
        "silent",
        "A sensor no longer sends measurements.",
        "The estimate continues without it, and standard deviations grow.",
        "Check its cable, power and clock.",
        "note",
    )
    HEARD_AGAIN = (
        "heard_again",
        "A sensor sends measurements again, or agrees again.",
        "Its measurements are used again from this time on.",
        "Nothing.",
        "note",
    )
    CONTRADICTS = (
        "contradicts",
        "Measurements contradict the prediction.",
        "They would move the estimate by many standard deviations.",
        "Check clock, time offset and sensor.",
    )
    # Results from files.
    UNCLASSIFIED = (
        "unclassified",
        "A file of another version contains a warning that this version does not know.",
        "Only the version that wrote it knows its effect on the result.",
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
        return in_language(self.message, "en")

    @property
    def unusable(self) -> bool:
        """Whether there is nothing to solve with; else a fit contradicts the data."""
        return self.severity == "error" and self.code in UNUSABLE

    def __str__(self) -> str:
        return f"{self.sensor}: {self.text}" if self.sensor else self.text


def errors_of(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings for which a solution is not to be used."""
    return tuple(f for f in findings if f.severity == "error")
