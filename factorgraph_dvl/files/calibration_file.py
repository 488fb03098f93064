"""Calibration files: calibration.json, format 1."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from factorgraph_dvl.errors import DataError, printable
from factorgraph_dvl.estimates import Cause, Estimate, Noise, NoiseBySpeed
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.unit_vectors import turns_to
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import encoded, message
from factorgraph_dvl.quality.finding import Code, Finding, Severity
from factorgraph_dvl.quality.texts import decoded
from factorgraph_dvl.quality.verdict import DEFAULT_LIMITS, Grade, VerdictGrade
from factorgraph_dvl.sensors.catalogue import specs_of
from factorgraph_dvl.sensors.dvl import CALIBRATED, MISALIGNMENT
from factorgraph_dvl.sensors.fingerprint import PATTERN
from factorgraph_dvl.settings.convert import from_json
from factorgraph_dvl.settings.files import MEGABYTE, read_bytes
from factorgraph_dvl.settings.ranges import out_of_range
from factorgraph_dvl.settings.sections import check_epoch
from factorgraph_dvl.solution import Calibration, Solution

CALIBRATION_FILE = "calibration.json"

_CODES = {str(code): code for code in Code}
# The covariance of some hundred parameters.
_MAX_BYTES = 64 * MEGABYTE
# Of a variance, for files with few digits.
_ROUNDING = 0.02
# What readers of the file would else take for roll, pitch and yaw.
_CONVENTIONS = {
    MISALIGNMENT: "rotation vector from body to DVL, in the body axes; it is not roll, pitch and "
    "yaw: instrument.yaml has those to enter"
}
# JSON knows no nan: null stands for it.
_Numbers = list[float | None]
_Entries = list[float | _Numbers | None]


class _Parameter(msgspec.Struct):
    """One entry for each component; of directions, `value` has vectors and the others pairs."""

    value: _Entries
    std: _Entries
    observable: list[bool | list[bool]]
    prior_value: _Entries = []
    prior_std: _Entries = []
    grade: list[Grade | list[Grade]] = []


class _Covariance(msgspec.Struct):
    order: list[str]
    matrix: list[_Numbers]


class _Finding(msgspec.Struct):
    code: str
    severity: Literal["note", "warning", "error"]
    sensor: str
    parameter: str
    text: str
    message: Any = UNSET


class _Reason(msgspec.Struct):
    code: str
    text: str
    sensor: str = ""
    parameter: str = ""
    action: str = ""
    message: Any = UNSET


class _Verdict(msgspec.Struct):
    grade: VerdictGrade
    reasons: list[_Reason] = []


class _Noise(msgspec.Struct, omit_defaults=True):
    factor: _Numbers
    correlation_time_s: _Numbers | None = None
    correlated_std: _Numbers | None = None
    by_speed: NoiseBySpeed | None = None


class _Cause(msgspec.Struct):
    cause: str
    assumed: str
    adds: dict[str, float | None]


class _File(msgspec.Struct):
    format: Literal[1]
    trial: str
    solver: str
    converged: bool
    iterations: int
    parameters: dict[str, _Parameter]
    covariance: _Covariance
    verdict: _Verdict | UnsetType = UNSET
    limits: dict[str, float] | UnsetType = UNSET
    cost: float | None = None
    body_axes: BodyAxes | UnsetType = UNSET
    warnings: list[str] = []
    findings: list[_Finding] = []
    inputs: list[Annotated[str, msgspec.Meta(pattern=PATTERN)]] = []
    noise: dict[str, _Noise] = {}
    error_budget: list[_Cause] = []
    epoch: str = ""
    span_s: tuple[float, float] | None = None
    conventions: dict[str, str] = {}

    def __post_init__(self) -> None:
        check_epoch(self.epoch)


def load_calibration(path: Path | str, *, body_axes: BodyAxes = "RFU") -> Calibration:
    """Read a calibration file.

    Parameters
    ----------
    path : path-like
        Path of the file, or of the solution folder that contains it.
    body_axes : BodyAxes, default 'RFU'
        Body axes that it is in where it does not say so.

    Raises
    ------
    DataError
        If the file is missing or does not contain what it should.

    Examples
    --------
    >>> import tempfile
    >>> import factorgraph_dvl as fd
    >>> solution = fd.solve(fd.simulate("examples/short.yaml", seed=1))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     fd.save_solution(solution, f"{folder}/out")
    ...     fd.load_calibration(f"{folder}/out/calibration.json").values["scale_error"].round(4)
    array([0.0052])
    """
    path = Path(path)
    path = path / CALIBRATION_FILE if path.is_dir() else path
    file = _decode(path)
    rows = _rows(file, str(path))
    names = iter([printable(file.covariance.order[i]) for i in rows])
    covariance = _covariance(file)[np.ix_(rows, rows)]
    _check_std(file, covariance, str(path))
    found = Calibration(
        trial=printable(file.trial),
        solver=printable(file.solver),
        body_axes=body_axes if file.body_axes is UNSET else file.body_axes,
        converged=file.converged,
        iterations=file.iterations,
        cost=np.nan if file.cost is None else file.cost,
        estimates=tuple(
            _estimate(name, parameter, names) for name, parameter in file.parameters.items()
        ),
        covariance=covariance,
        findings=tuple(_findings(file)),
        inputs=tuple(file.inputs),
        limits=_limits(file, str(path)),
        noise=tuple(
            Noise(
                printable(name),
                np.array(n.factor, dtype=float),
                _optional(n.correlation_time_s),
                _optional(n.correlated_std),
                n.by_speed,
            )
            for name, n in file.noise.items()
        ),
        error_budget=tuple(
            Cause(printable(c.cause), printable(c.assumed), _adds(c, file.covariance.order, rows))
            for c in file.error_budget
        ),
        epoch=file.epoch,
        span=file.span_s,
    )
    return found if isinstance(file.verdict, UnsetType) else _with_verdict(found, file.verdict)


def _optional(numbers: _Numbers | None) -> Array | None:
    return None if numbers is None else np.array(numbers, dtype=float)


def _adds(cause: _Cause, order: Sequence[str], rows: Sequence[int]) -> Array:
    """Return what a cause adds to each component, in the order of the parameters."""
    return np.array([cause.adds.get(order[i], 0.0) for i in rows], dtype=float)


def _limits(file: _File, source: str) -> Mapping[str, float]:
    if isinstance(file.limits, UnsetType):
        return dict(DEFAULT_LIMITS)
    for name, limit in file.limits.items():
        if not limit > 0.0:
            raise DataError(
                f"limits: {printable(name)} is {limit:g}", where=source, expected="above 0"
            )
    return file.limits


def _findings(file: _File) -> Iterator[Finding]:
    """Yield the findings of a file, and the warnings of one that has no findings."""
    for f in file.findings:
        # Before there were verdicts, whatever was no error was called a warning.
        old = file.verdict is UNSET and f.severity != "error"
        yield _finding(f, None if old else f.severity)
    if not file.findings and file.verdict is UNSET:
        yield from (Finding(Code.UNCLASSIFIED, printable(text)) for text in file.warnings)


def _with_verdict(calibration: Calibration, stated: _Verdict) -> Calibration:
    """Return a calibration with what its file's verdict says beyond the findings."""
    severity: Severity = "error" if stated.grade == "do not use" else "warning"
    own = calibration.verdict
    said = {(f.code, f.text) for f in own.reasons}
    found = [_finding(reason, severity) for reason in stated.reasons]
    more = [f for f in found if (f.code, f.text) not in said]
    if severity == "error" and own.grade != stated.grade and not more:
        more = [Finding(Code.UNCLASSIFIED, message("unclassified.none"), severity="error")]
    return replace(calibration, findings=(*calibration.findings, *more))


def _finding(stored: _Finding | _Reason, severity: Severity | None) -> Finding:
    code = _CODES.get(stored.code, Code.UNCLASSIFIED)
    text, sensor, parameter = map(printable, (stored.text, stored.sensor, stored.parameter))
    said = decoded(stored.message, text)
    return Finding(code, said, sensor, parameter, severity or code.severity)


def _message(finding: Finding) -> Any:
    said = finding.message
    return UNSET if isinstance(said, str) else encoded(said)


def check_usable(
    calibration: Calibration, body_axes: BodyAxes, source: str, *, anyway: bool = False
) -> None:
    """Raise DataError unless a calibration is one, and is in these body axes.

    And unless it is fit to be used, or to be used `anyway`.
    """
    for e in calibration.estimates:
        if e.name in CALIBRATED:
            check_values(e.name, e.value, source)
    check_verdict(calibration, source, anyway=anyway)
    if calibration.body_axes != body_axes:
        raise DataError(
            f"the calibration is in {calibration.body_axes} axes", where=source,
            expected=f"{body_axes}, as the trial has them",
        )  # fmt: skip


def check_verdict(result: Solution | Calibration, source: str, *, anyway: bool = False) -> None:
    """Raise DataError if a result is graded `do not use`, unless it is used `anyway`."""
    verdict = result.verdict
    if verdict.grade == "do not use" and not anyway:
        reason = verdict.reasons[0]
        overrule = "To use it all the same, add --anyway (in Python anyway=True)"
        raise DataError(
            f"graded `do not use`: {reason}",
            where=source,
            expected="a result graded good or doubtful",
            hint=f"{reason.code.action} {overrule}",
        )


def check_values(name: str, value: Array, source: str) -> None:
    """Raise DataError unless the values of a parameter are numbers that can be."""
    if not (value.size and np.isfinite(value).all()):
        raise DataError(f"{name} is not a number", where=source, expected="finite values")
    if wrong := out_of_range(name, np.ravel(value).tolist()):
        raise DataError(wrong, where=source)
    above = max((spec.above for spec in specs_of(name).values()), default=-np.inf)
    if np.min(value) <= above:
        raise DataError(
            f"{name} is {np.min(value):g}", where=source, expected=f"numbers above {above:g}"
        )


def encode_calibration(solution: Solution | Calibration) -> bytes:
    """Return the content of calibration.json."""
    calibration = _File(
        format=1,
        trial=solution.trial,
        solver=solution.solver,
        converged=bool(solution.converged),
        iterations=int(solution.iterations),
        parameters={e.name: _parameter(e, solution.grades[e.name]) for e in solution.estimates},
        covariance=_Covariance(
            list(solution.order), [_numbers(row) for row in np.asarray(solution.covariance)]
        ),
        cost=float(solution.cost),
        body_axes=solution.body_axes,
        verdict=_Verdict(
            solution.verdict.grade,
            [
                _Reason(f.code, f.text, f.sensor, f.parameter, f.code.action, _message(f))
                for f in solution.verdict.reasons
            ],
        ),
        limits=dict(solution.limits),
        warnings=list(solution.warnings),
        findings=[
            _Finding(f.code, f.severity, f.sensor, f.parameter, f.text, _message(f))
            for f in solution.findings
            if f.severity != "ok"
        ],
        inputs=list(solution.inputs),
        noise={
            n.name: _Noise(
                _numbers(n.factor),
                None if n.correlation_time is None else _numbers(n.correlation_time),
                None if n.correlated_std is None else _numbers(n.correlated_std),
                n.by_speed,
            )
            for n in solution.noise
        },
        error_budget=[
            _Cause(c.cause, c.assumed, dict(zip(solution.order, c.adds.tolist(), strict=True)))
            for c in solution.error_budget
        ],
        epoch=solution.epoch,
        span_s=solution.span,
        conventions={
            e.name: _CONVENTIONS[e.name] for e in solution.estimates if e.name in _CONVENTIONS
        },
    )
    # msgspec writes nan and infinity as null, and every float with the digits it takes.
    return msgspec.json.format(msgspec.json.encode(calibration), indent=2) + b"\n"


def _parameter(e: Estimate, grades: tuple[Grade, ...]) -> _Parameter:
    value, prior_value, shape = e.value, e.prior_value, np.shape(e.std)
    if e.nominal is not None:
        value, prior_value, shape = e.directions, e.nominal, (-1, 2)
    entries: list[Any] = [
        np.reshape(x, shape).tolist()
        for x in (e.std, np.asarray(e.observable, dtype=bool), e.prior_std, grades)
    ]
    return _Parameter(
        value=np.asarray(value).tolist(),
        std=entries[0],
        observable=entries[1],
        prior_value=np.asarray(prior_value).tolist(),
        prior_std=entries[2],
        grade=entries[3],
    )


def _decode(file: Path) -> _File:
    try:
        calibration = from_json(read_calibration_bytes(file), _File)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise DataError(f"cannot be read ({error})", where=str(file)) from None
    for name, parameter in calibration.parameters.items():
        _check_sizes(name, parameter, str(file))
    size = sum(_size(parameter) for parameter in calibration.parameters.values())
    shape = {len(calibration.covariance.order), len(calibration.covariance.matrix)}
    shape |= {len(row) for row in calibration.covariance.matrix}
    if shape != {size}:
        raise DataError(
            "the covariance does not fit the parameters",
            where=str(file),
            expected=f"{size} names in `order`, and a {size} x {size} matrix",
        )
    return calibration


def read_calibration_bytes(file: Path) -> bytes:
    """Read calibration.json as it is; raise DataError if there is no such file."""
    return read_bytes(file, limit=_MAX_BYTES, expected=f"the {CALIBRATION_FILE} of a solution")


def _size(parameter: _Parameter) -> int:
    """Return the number of components: of each direction two."""
    return (2 if _holds_directions(parameter) else 1) * len(parameter.value)


def _holds_directions(parameter: _Parameter) -> bool:
    return bool(parameter.value) and isinstance(parameter.value[0], list)


def _check_sizes(name: str, parameter: _Parameter, source: str) -> None:
    """Raise DataError unless the entries of a parameter have the sizes that belong together."""
    n = len(parameter.value)
    directions = _holds_directions(parameter)
    own = (n, 2) if directions else (n,)
    values = (n, 3) if directions else (n,)
    empty = [] if directions else [(0,)]
    for field, shapes in (
        ("value", [values]),
        ("std", [own]),
        ("observable", [own]),
        ("prior_value", [values, *empty]),
        ("prior_std", [own, *empty]),
    ):
        try:
            fits = np.array(getattr(parameter, field), dtype=float).shape in shapes
        except (TypeError, ValueError):
            fits = False
        if not fits:
            raise DataError(
                f"{name}: `{field}` does not fit", where=source,
                expected=" x ".join(map(str, shapes[0])) + " numbers",
            )  # fmt: skip


def _rows(calibration: _File, source: str) -> list[int]:
    """Return the rows of the covariance in the order of the parameters, by their names.

    Of a parameter that no sensor has, the components stand together, and where it does.
    """
    row = {name: i for i, name in enumerate(calibration.covariance.order)}
    out: list[int] = []
    known = {n: specs_of(n).get(_size(p)) for n, p in calibration.parameters.items()}
    claimed = {name for spec in known.values() if spec for name in spec.component_names}
    others = iter([i for name, i in row.items() if name not in claimed])
    for name, parameter in calibration.parameters.items():
        spec = known[name]
        size = _size(parameter)
        own = map(row.get, spec.component_names) if spec else islice(others, size)
        found = [i for i in own if i is not None]
        if len(found) != size:
            raise DataError(
                f"`covariance.order` does not name the components of {name}",
                where=source,
                expected="each once, such as lever_arm_x_m, lever_arm_y_m, lever_arm_z_m",
            )
        out += found
    return out


def _check_std(calibration: _File, covariance: Array, source: str) -> None:
    """Raise DataError where standard deviations and covariance contradict each other."""
    std = np.concatenate(
        [np.empty(0), *(_array(p.std).ravel() for p in calibration.parameters.values())]
    )
    # Roots, as the square of a damaged number overflows.
    root = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    known = np.isfinite(std) & np.isfinite(root)
    if std.size != root.size or np.any(
        np.abs(std[known] - root[known]) > 0.5 * _ROUNDING * np.maximum(root[known], 1e-15)
    ):
        raise DataError(
            "`std` and the diagonal of the covariance do not agree",
            where=source,
            expected="std² on the diagonal, to one per cent",
        )


def _estimate(name: str, parameter: _Parameter, names: Iterator[str]) -> Estimate:
    size = _size(parameter)
    unknown: _Entries = [None] * size
    value = _array(parameter.value)
    prior_value = _array(parameter.prior_value or unknown)
    nominal = None
    if _holds_directions(parameter):
        nominal = prior_value
        value = (turns_to(nominal, value) / DEG).ravel()
        prior_value = np.zeros(size)
    return Estimate(
        name,
        tuple(islice(names, size)),
        value,
        _array(parameter.std).ravel(),
        prior_value,
        _array(parameter.prior_std or unknown).ravel(),
        np.array(parameter.observable, dtype=bool).ravel(),
        nominal,
    )


def _covariance(calibration: _File) -> Array:
    size = len(calibration.covariance.order)
    return np.array(calibration.covariance.matrix, dtype=float).reshape(size, size)


def _numbers(values: Array) -> _Numbers:
    return list(np.asarray(values, dtype=float).tolist())


def _array(values: _Entries) -> Array:
    return np.array(values, dtype=float)
