"""Check of a sensor that somebody else wrote: attributes, shapes, derivatives."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes, exp_so3, wrapped
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.priors import prior_mean
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Aid, Motion, Observation, parts_of

# Steps of the differences: rad, m, m/s, rad/s, and SI units of a parameter. Chosen: rounding of
# positions on the ellipsoid and curvature are both below the tolerance.
_STEPS = {"d_theta": 1e-5, "d_p": 1e-1, "d_v": 1e-4, "d_omega": 1e-5}
_PARAMETER_STEP = 1e-6
# Largest difference between a derivative and its difference quotient, relative to the largest
# element or 1. Chosen: a wrong sign, unit or transpose is far above.
_TOLERANCE = 1e-4


def check_sensor(sensor: Aid, frame: LocalFrame, body_axes: BodyAxes) -> None:
    """Check a sensor of one's own: what it lacks, which shape is wrong, which derivative.

    Derivatives are compared with differences at motions at random. Call it from a test of the
    sensor, with each of the body axes.

    Parameters
    ----------
    sensor : Aid
        A record of the sensor, with a measurement or more.
    frame : LocalFrame
        Tangent frame n.
    body_axes : {'RFU', 'FRD', 'FLU'}
        Axes of the body.

    Raises
    ------
    DataError
        Naming the first thing that is wrong, and what is expected.

    Examples
    --------
    >>> import numpy as np
    >>> from factorgraph_dvl import Dvl, DvlSettings, LocalFrame, check_sensor
    >>> dvl = Dvl(DvlSettings(), np.arange(3.0), np.ones((3, 3)), np.full((3, 3), 0.01))
    >>> check_sensor(dvl, LocalFrame(0.6, 2.1, 0.0), "FRD")
    """
    name = type(sensor).__name__
    _require(sensor, Aid, name)
    table = sensor.columns()
    _check_names(sensor.required, table, f"{name}.columns()", "every required column")
    kind: Any = type(sensor)
    columns = _with_absent(sensor, table)
    again = kind.from_columns(sensor.settings, columns, "columns()", **parts_of(sensor))
    if not np.array_equal(again.time, sensor.time):
        raise DataError(
            "the times differ after columns() and from_columns()", where=name, expected="the same"
        )
    parameters = {p.name: p for p in sensor.parameters()}
    _check_names(
        parameters, [s.name for s in sensor.specs], f"{name}.specs", "a spec for each parameter"
    )
    observations = sensor.observations(frame, body_axes)
    if not observations:
        raise DataError("it has no measurement to check", where=f"{name}.observations()")
    for observation in observations:
        _check_observation(observation, parameters)


def _check_observation(o: Observation, parameters: dict[str, Parameter]) -> None:
    where = type(o).__name__
    _require(o, Observation, where)
    _check_names(o.parameters, parameters, f"{where}.parameters", "names of parameters()")
    m, d = o.time.size, len(o.components)
    motion = _random_motion(m)
    values = {name: prior_mean(p) for name, p in parameters.items()}
    _check_shape(o.residual(motion, values), (m, d), f"{where}.residual()")
    _check_shape(o.sigma(motion, values), (m, d), f"{where}.sigma()")
    lin = o.linearize(motion, values, o.parameters)
    _check_shape(lin.residual, (m, d), f"{where}.linearize().residual")
    stated = {name: getattr(lin, name) for name in _STEPS}
    stated |= {f"d_parameters[{name!r}]": lin.d_parameters.get(name) for name in o.parameters}
    for name, quotient in _quotients(o, motion, values, parameters):
        found = stated[name]
        place = f"{where}.linearize().{name}"
        if found is None:
            found = np.zeros_like(quotient)
        _check_shape(found, quotient.shape, place)
        scale = max(float(np.abs(quotient).max()), 1.0)
        if not np.abs(found - quotient).max() < _TOLERANCE * scale:
            row = int(np.argmax(np.abs(found - quotient).reshape(m, -1).max(axis=1)))
            raise DataError(
                f"the derivative is {np.round(found[row], 6).tolist()}",
                where=place,
                expected=f"{np.round(quotient[row], 6).tolist()}, by differences of the residual",
            )


def _quotients(
    o: Observation, motion: Motion, values: dict[str, Array], parameters: dict[str, Parameter]
) -> Iterator[tuple[str, Array]]:
    """Yield the derivatives of the residual by differences, (M, d, n), with their names."""
    moves: dict[str, Callable[[Array], Motion]] = {
        "d_theta": lambda h: replace(motion, nRb=motion.nRb @ exp_so3(h)),
        "d_p": lambda h: replace(motion, p_n=motion.p_n + h),
        "d_v": lambda h: replace(motion, v_n=motion.v_n + h),
        "d_omega": lambda h: replace(motion, omega_eb_b=motion.omega_eb_b + h),
    }
    for name, move in moves.items():
        yield (
            name,
            _quotient(
                partial(_at_motion, o, values, move), 3, _STEPS[name], angles=o.unit == "rad"
            ),
        )
    for name in o.parameters:
        p = parameters[name]
        changed = partial(_at_value, o, motion, values, p)
        quotient = _quotient(changed, p.mean.size, _PARAMETER_STEP, angles=o.unit == "rad")
        yield f"d_parameters[{name!r}]", quotient


def _at_motion(
    o: Observation, values: dict[str, Array], move: Callable[[Array], Motion], h: Array
) -> Array:
    return o.residual(move(h), values)


def _at_value(
    o: Observation, motion: Motion, values: dict[str, Array], p: Parameter, h: Array
) -> Array:
    return o.residual(motion, {**values, p.name: _moved(p, values[p.name], h)})


def _quotient(
    function: Callable[[Array], Array], size: int, step: float, *, angles: bool
) -> Array:
    change = [function(h) - function(-h) for h in step * np.eye(size)]
    # Of angles one of the two may lie beyond half a turn.
    change = [wrapped(c) for c in change] if angles else change
    return np.stack([c / (2.0 * step) for c in change], axis=-1)


def _moved(p: Parameter, value: Array, h: Array) -> Array:
    return value @ exp_so3(h) if p.rotation else value + h


def _random_motion(m: int) -> Motion:
    """Return motions of M vehicles that head anywhere and roll and pitch by some degrees."""
    rng = np.random.default_rng(0)
    headings = np.stack([np.zeros(m), np.zeros(m), rng.uniform(-np.pi, np.pi, m)], axis=1)
    return Motion(
        nRb=exp_so3(headings) @ exp_so3(rng.normal(0.0, 0.1, (m, 3))),
        p_n=rng.normal(0.0, 50.0, (m, 3)),
        v_n=rng.normal(0.0, 2.0, (m, 3)),
        omega_eb_b=rng.normal(0.0, 0.1, (m, 3)),
        a_n=rng.normal(0.0, 0.1, (m, 3)),
        alpha_b=rng.normal(0.0, 0.01, (m, 3)),
        omega_sigma=np.full((m, 3), 1e-5),
    )


def _with_absent(sensor: Aid, table: dict[str, Array]) -> dict[str, Array]:
    """Return a table with its absent optional columns as nan, as readers hand it over."""
    absent = np.full(sensor.time.size, np.nan)
    return {**{name: absent for group in sensor.optional for name in group}, **table}


def _require(thing: object, protocol: type, where: str) -> None:
    """Raise DataError unless a thing has every attribute of a protocol."""
    names = {
        name
        for base in protocol.__mro__[:-1]
        for name in (*vars(base), *getattr(base, "__annotations__", {}))
        if not name.startswith("_")
    }
    missing = sorted(name for name in names if not hasattr(thing, name))
    if missing:
        raise DataError(
            f"it lacks {', '.join(missing)}", where=where, expected=f"all of {protocol.__name__}"
        )


def _check_names(wanted: Iterable[str], known: Collection[str], where: str, expected: str) -> None:
    missing = [name for name in wanted if name not in known]
    if missing:
        raise DataError(f"{', '.join(missing)} is missing", where=where, expected=expected)


def _check_shape(array: Array, shape: tuple[int, ...], where: str) -> None:
    if np.shape(array) != shape:
        raise DataError(
            f"the shape is {np.shape(array)}",
            where=where,
            expected=f"{shape}: measurements, components"
            + (", then the variable's dimension" if len(shape) == 3 else ""),
        )
