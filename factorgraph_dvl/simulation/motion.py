"""Analytic motion over the ellipsoid, in the local-level frame.

Speed and heading are piecewise polynomials, the sway is a sum of sinusoids; velocity,
acceleration, attitude and rates follow in closed form. Only latitude and longitude are
integrated, by collocation to the last digits of a double.
"""

from __future__ import annotations

import os
import resource
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PPoly
from scipy.spatial.transform import Rotation

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.earth import RATE, normal_gravity, radii
from factorgraph_dvl.geometry.rotations import (
    BodyAxes,
    frd_from_body,
    rotation_from_rph,
    rph_from_rotation,
    wrapped,
)
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.simulation.instruments import ScenarioView
from factorgraph_dvl.simulation.manoeuvres import Accelerate, Climb, Manoeuvre, Stop, Straight


def table_angle(scenario: ScenarioView, duration: float) -> PPoly | None:
    """Return the angle of the turntable over time, rad; None without one.

    Raises
    ------
    ConfigError
        If a turn ends after the manoeuvres.
    """
    if scenario.turntable is None:
        return None
    breaks, rates, slopes = [0.0], [], []

    def add(until: float, rate: float, slope: float) -> None:
        if until > breaks[-1]:
            breaks.append(until)
            rates.append(rate)
            slopes.append(slope)

    for i, turn in enumerate(scenario.turntable.turns):
        end = turn.at_s + turn.duration_s
        if end > duration:
            raise ConfigError(
                f"the turn ends at {end:g} s, after the manoeuvres, which take {duration:g} s",
                where=f"{scenario.source} key turntable.turns[{i}]",
                expected="an earlier turn, or longer manoeuvres",
            )
        rate = turn.turn_deg * DEG / (turn.duration_s - turn.ramp_s)
        slope = rate / turn.ramp_s if turn.ramp_s > 0.0 else 0.0
        add(turn.at_s, 0.0, 0.0)
        add(turn.at_s + turn.ramp_s, 0.0, slope)
        add(end - turn.ramp_s, rate, 0.0)
        add(end, rate, -slope)
    add(duration, 0.0, 0.0)
    angle = PPoly(np.array([slopes, rates]), np.array(breaks)).antiderivative()
    angle.c[-1] += scenario.turntable.start_deg * DEG
    return angle


# Measured: growth of the peak by simulating a million rows of the IMU, of GNSS, DVL or the
# reference, and by integrating a million steps of the motion.
_BYTES_PER_SAMPLE = 200
_BYTES_PER_ROW = 600
_BYTES_PER_STEP = 820


def check_size(scenario: ScenarioView, duration: float, steps: float) -> None:
    """Raise ConfigError if motion and records of a scenario cannot be in memory.

    Parameters
    ----------
    scenario : Scenario
        Scenario with the rates of its sensors.
    duration : float
        Duration of its motion, s.
    steps : float
        Steps of the integration of its motion.
    """
    rows = {f"{name}.rate_hz": s.rate_hz * duration for name, s in scenario.aids.items()}
    rows["reference_rate_hz"] = scenario.reference_rate_hz * duration
    needs = {key: count * _BYTES_PER_ROW for key, count in rows.items()}
    if scenario.imu is not None:
        rows["imu.rate_hz"] = scenario.imu.rate_hz * duration
        needs["imu.rate_hz"] = rows["imu.rate_hz"] * _BYTES_PER_SAMPLE
    motion = "sway" if steps > 2.0 * duration else "manoeuvres"
    rows[motion], needs[motion] = steps, steps * _BYTES_PER_STEP
    have = _memory()
    if sum(needs.values()) > have:
        key = max(needs, key=lambda k: needs[k])
        raise ConfigError(
            f"{duration:.6g} s of it are {rows[key]:.3g} steps; the trial needs about "
            f"{sum(needs.values()) / 1e9:.3g} GB of memory, and there are {have / 1e9:.3g} GB",
            where=f"{scenario.source} key {key}",
            expected="a lower rate or frequency, or shorter manoeuvres",
        )


def _memory() -> float:
    """Return the memory that a process can have, bytes."""
    installed = float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return installed if limit == resource.RLIM_INFINITY else min(installed, float(limit))


# Chosen: reaches the precision of a double with steps of half a second.
_COLLOCATION_NODES = 6
# Chosen: east and north are undefined at the poles.
_MAX_LATITUDE = 89.5 * DEG


@dataclass(frozen=True)
class Sway:
    """A sum of sinusoids.

    Parameters
    ----------
    amplitude, frequency, phase : ndarray, shape (K,)
        Terms amplitude · sin(frequency t + phase); the frequency in rad/s.
    """

    amplitude: Array
    frequency: Array
    phase: Array

    def derivatives(self, t: Array) -> tuple[Array, Array, Array]:
        """Return value, first and second derivative at times (M,)."""
        value, rate, acceleration = np.zeros_like(t), np.zeros_like(t), np.zeros_like(t)
        for a, w, phase in zip(self.amplitude, self.frequency, self.phase, strict=True):
            angle = w * t + phase
            sine = a * np.sin(angle)
            value += sine
            rate += a * w * np.cos(angle)
            acceleration -= w * w * sine
        return value, rate, acceleration

    @property
    def highest_frequency(self) -> float:
        """Highest frequency, rad/s; 0 without any sway."""
        return float(np.max(self.frequency, initial=0.0))


@dataclass(frozen=True)
class TrueState:
    """Motion at M times.

    Parameters
    ----------
    geodetic : ndarray, shape (M, 3)
        Latitude, longitude (rad), ellipsoidal height (m).
    v_n, a_n : ndarray, shape (M, 3)
        Velocity over ground and its derivative, local-level ENU.
    rph : ndarray, shape (M, 3)
        Roll, pitch, heading, rad; the heading is not wrapped.
    omega_eb_b : ndarray, shape (M, 3), rad/s
        Angular rate relative to the Earth.
    omega_ib_b : ndarray, shape (M, 3), rad/s
        Angular rate relative to inertial space.
    f_b : ndarray, shape (M, 3), m/s²
        Specific force.
    """

    geodetic: Array
    v_n: Array
    a_n: Array
    rph: Array
    omega_eb_b: Array
    omega_ib_b: Array
    f_b: Array


@dataclass(frozen=True)
class TrueMotion:
    """The motion of a scenario, exact at any time from 0 to `duration`.

    The vehicle moves through the water along its course; yaw sway turns the bow about the
    course, so the vehicle slips sideways, as in waves.

    Parameters
    ----------
    speed : PPoly
        Speed through the water, m/s.
    course : PPoly
        Course through the water, clockwise from north, rad.
    lat, lon : PPoly
        Latitude and longitude, rad.
    height : PPoly
        Ellipsoidal height without heave and current, m.
    current_n : ndarray, shape (3,), m/s
        Current, ENU.
    roll, pitch, yaw, heave : Sway
        Sway, rad and m.
    kinks : ndarray, shape (K,), s
        Times at which acceleration or turn rate change abruptly.
    duration : float
        Duration, s.
    body_axes : BodyAxes
        Axes of the body frame.
    table : PPoly, optional
        Angle of the turntable that carries the body on the vehicle, counter-clockwise seen from
        above, rad; None without one. Its axis passes through the IMU.
    """

    speed: PPoly
    course: PPoly
    lat: PPoly
    lon: PPoly
    height: PPoly
    current_n: Array
    roll: Sway
    pitch: Sway
    yaw: Sway
    heave: Sway
    kinks: Array
    duration: float
    body_axes: BodyAxes
    table: PPoly | None = None

    def highest_rate(self) -> float:
        """Return the highest angular frequency in the body-frame signals, rad/s.

        Roll and pitch multiply each other and the gravity: twice the highest of the sway.
        """
        sway = max(s.highest_frequency for s in (self.roll, self.pitch, self.yaw, self.heave))
        turn = float(np.max(np.abs(_evaluate(self.course, self.kinks[:-1], 1)), initial=0.0))
        if self.table is not None:
            turn += float(np.max(np.abs(_evaluate(self.table, self.kinks, 1))))
        return 2.0 * sway + turn

    def velocity(self, t: Array) -> tuple[Array, ...]:
        """Return east, north, up velocity over ground and their derivatives, each (M,)."""
        speed, course = _evaluate(self.speed, t), _evaluate(self.course, t)
        acceleration, rate = _evaluate(self.speed, t, 1), _evaluate(self.course, t, 1)
        sine, cosine = np.sin(course), np.cos(course)
        _, heave_rate, heave_acceleration = self.heave.derivatives(t)
        east, north, up = self.current_n
        return (
            speed * sine + east,
            speed * cosine + north,
            heave_rate + up + _evaluate(self.height, t, 1),
            acceleration * sine + speed * rate * cosine,
            acceleration * cosine - speed * rate * sine,
            heave_acceleration + _evaluate(self.height, t, 2),
        )

    def height_at(self, t: Array) -> Array:
        """Return the ellipsoidal height, (M,), m."""
        drift = float(self.current_n[2]) * t
        return _evaluate(self.height, t) + drift + self.heave.derivatives(t)[0]

    def at(self, t: Array) -> TrueState:
        """Return the motion of the body at times (M,).

        On a turntable, components in the vehicle s are Rz(angle) times those in b, about the
        upward axis u of both, so that nRb = nRs Rz, omega_b = Rzᵀ omega_s + rate u and
        f_b = Rzᵀ f_s.
        """
        state = self.ship_at(t)
        if self.table is None:
            return state
        angle, rate = _evaluate(self.table, t), _evaluate(self.table, t, 1)
        up = frd_from_body(self.body_axes).T @ np.array([0.0, 0.0, -1.0])
        turn = Rotation.from_rotvec(angle[:, None] * up)
        nRs = rotation_from_rph(state.rph, self.body_axes)
        turning = rate[:, None] * up
        return TrueState(
            geodetic=state.geodetic,
            v_n=state.v_n,
            a_n=state.a_n,
            rph=rph_from_rotation(nRs @ turn.as_matrix(), self.body_axes),
            omega_eb_b=turn.apply(state.omega_eb_b, inverse=True) + turning,
            omega_ib_b=turn.apply(state.omega_ib_b, inverse=True) + turning,
            f_b=turn.apply(state.f_b, inverse=True),
        )

    def ship_at(self, t: Array) -> TrueState:
        """Return the motion of the vehicle at times (M,), in axes of its own like the body's.

        With M and N the radii of curvature, L the latitude and h the height,

            omega_ie = [0, O cos L, O sin L],
            omega_en = [-v_n / (M + h), v_e / (N + h), v_e tan L / (N + h)],
            omega_ib_b = omega_nb_b + nRbᵀ (omega_ie + omega_en),
            f_b = nRbᵀ (dv_n/dt + (2 omega_ie + omega_en) x v_n - g_n).

        Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation
        Systems, 2nd ed., eqs. 5.39 to 5.54, in ENU.
        """
        t = np.asarray(t, dtype=float)
        v_e, v_n, v_u, a_e, a_n, a_u = self.velocity(t)
        lat, lon, height = _evaluate(self.lat, t), _evaluate(self.lon, t), self.height_at(t)
        roll, roll_rate, _ = self.roll.derivatives(t)
        pitch, pitch_rate, _ = self.pitch.derivatives(t)
        yaw, yaw_rate, _ = self.yaw.derivatives(t)
        heading = _evaluate(self.course, t) + yaw
        heading_rate = _evaluate(self.course, t, 1) + yaw_rate

        sl, cl = np.sin(lat), np.cos(lat)
        meridian, prime = radii(lat)
        earth_n, earth_u = RATE * cl, RATE * sl
        level_e = -v_n / (meridian + height)
        level_n = v_e / (prime + height)
        level_u = level_n * sl / cl
        turn_n, turn_u = 2.0 * earth_n + level_n, 2.0 * earth_u + level_u
        f_e = a_e + turn_n * v_u - turn_u * v_n
        f_n = a_n + turn_u * v_e - level_e * v_u
        f_u = a_u + level_e * v_n - turn_n * v_e + normal_gravity(lat, height)

        to_body = _LevelToBody(roll, pitch, heading, self.body_axes)
        sr, cr, sp, cp = to_body.sr, to_body.cr, to_body.sp, to_body.cp
        omega_nb_b = to_body.from_frd(
            roll_rate - heading_rate * sp,
            pitch_rate * cr + heading_rate * sr * cp,
            -pitch_rate * sr + heading_rate * cr * cp,
        )
        omega_eb_b = omega_nb_b + to_body(level_e, level_n, level_u)
        return TrueState(
            geodetic=np.stack([lat, wrapped(lon), height], axis=1),
            v_n=np.stack([v_e, v_n, v_u], axis=1),
            a_n=np.stack([a_e, a_n, a_u], axis=1),
            rph=np.stack([roll, pitch, heading], axis=1),
            omega_eb_b=omega_eb_b,
            omega_ib_b=omega_eb_b + to_body(np.zeros_like(t), earth_n, earth_u),
            f_b=to_body(f_e, f_n, f_u),
        )


class _LevelToBody:
    """Resolve east, north, up components in body."""

    def __init__(self, roll: Array, pitch: Array, heading: Array, body_axes: BodyAxes) -> None:
        self.sr, self.cr = np.sin(roll), np.cos(roll)
        self.sp, self.cp = np.sin(pitch), np.cos(pitch)
        self.sh, self.ch = np.sin(heading), np.cos(heading)
        self.frd_from_body = frd_from_body(body_axes)

    def from_frd(self, x: Array, y: Array, z: Array) -> Array:
        """Return (M, 3) body components of forward, right, down ones."""
        return np.stack([x, y, z], axis=1) @ self.frd_from_body

    def __call__(self, east: Array, north: Array, up: Array) -> Array:
        """Return (M, 3) body components."""
        ahead = self.ch * north + self.sh * east
        right = self.ch * east - self.sh * north
        below = self.sp * ahead - self.cp * up
        return self.from_frd(
            self.cp * ahead + self.sp * up,
            self.cr * right + self.sr * below,
            self.cr * below - self.sr * right,
        )


def plan_motion(scenario: ScenarioView) -> TrueMotion:
    """Return the motion of a scenario.

    Raises
    ------
    ConfigError
        If the manoeuvres cannot be carried out.
    """
    start = scenario.start
    speed, rate, climb = _profiles(
        scenario.plan(), start.speed_m_s, start.height_m, scenario.source
    )
    course, height = rate.antiderivative(), climb.antiderivative()
    course.c[-1] += start.heading_deg * DEG
    height.c[-1] += start.height_m
    sway = scenario.sway
    heave = _sway((s.amplitude_m, s.frequency_hz, s.phase_deg) for s in sway.heave)
    roll, pitch, yaw = (
        _sway((s.amplitude_deg * DEG, s.frequency_hz, s.phase_deg) for s in part)
        for part in (sway.roll, sway.pitch, sway.yaw)
    )
    still = PPoly(np.zeros((1, 1)), np.array([0.0, 1.0]))
    duration = float(speed.x[-1])
    table = table_angle(scenario, duration)
    kinks = np.asarray(speed.x, dtype=float)
    if table is not None:
        kinks = np.union1d(kinks, table.x)
    motion = TrueMotion(
        speed=speed,
        course=course,
        lat=still,
        lon=still,
        height=height,
        current_n=np.array(scenario.current_m_s),
        roll=roll,
        pitch=pitch,
        yaw=yaw,
        heave=heave,
        kinks=kinks,
        duration=duration,
        body_axes=scenario.body_axes,
        table=table,
    )
    check_size(scenario, duration, duration / _step(motion))
    lat, lon = _integrate_position(
        motion, scenario.start.lat_deg * DEG, scenario.start.lon_deg * DEG, scenario.source
    )
    return TrueMotion(**{**vars(motion), "lat": lat, "lon": lon})


def _profiles(
    plan: list[Manoeuvre], speed: float, height: float, source: str
) -> tuple[PPoly, PPoly, PPoly]:
    """Return speed through the water, turn rate (rad/s) and vertical speed over time."""
    times, speeds, rates, climbs = [0.0], [], [], []

    def add(
        duration: float,
        *,
        acceleration: float = 0.0,
        turn: tuple[float, float] = (0.0, 0.0),
        climb: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Add a piece; slope and value at its start of the rates."""
        times.append(times[-1] + duration)
        speeds.append((acceleration, speed))
        rates.append(turn)
        climbs.append(climb)

    def add_ramped(name: str, rate: float, duration: float, ramp: float) -> None:
        if ramp > 0.0:
            add(ramp, **{name: (rate / ramp, 0.0)})  # type: ignore[arg-type]
        if duration > ramp:
            add(duration - ramp, **{name: (0.0, rate)})  # type: ignore[arg-type]
        if ramp > 0.0:
            add(ramp, **{name: (-rate / ramp, rate)})  # type: ignore[arg-type]

    for number, m in enumerate(plan, start=1):
        where = f"{source} key manoeuvres, manoeuvre {number} with repetitions written out"
        if isinstance(m, Accelerate):
            change = m.to_m_s - speed
            if change * m.accelerate_m_s2 <= 0.0:
                raise ConfigError(
                    f"accelerate_m_s2 = {m.accelerate_m_s2:g} does not lead from "
                    f"{speed:g} to {m.to_m_s:g} m/s",
                    where=where,
                    expected="another speed than the present one, and the sign of the change",
                )
            add(change / m.accelerate_m_s2, acceleration=m.accelerate_m_s2)
            speed = m.to_m_s
        elif isinstance(m, Straight):
            add(m.straight_s)
        elif isinstance(m, Stop):
            before = speed
            if before > 0.0:
                add(before / m.acceleration_m_s2, acceleration=-m.acceleration_m_s2)
            speed = 0.0
            if m.stop_s > 0.0:
                add(m.stop_s)
            if before > 0.0:
                add(before / m.acceleration_m_s2, acceleration=m.acceleration_m_s2)
            speed = before
        elif isinstance(m, Climb):
            change = m.to_height_m - height
            if change * m.climb_m_s <= 0.0 or change / m.climb_m_s < m.ramp_s:
                raise ConfigError(
                    f"climb_m_s = {m.climb_m_s:g} does not lead from {height:g} to "
                    f"{m.to_height_m:g} m with ramps of {m.ramp_s:g} s",
                    where=where,
                    expected="the sign of the change, and a change of at least ramp_s · climb_m_s",
                )
            add_ramped("climb", m.climb_m_s, change / m.climb_m_s, m.ramp_s)
            height = m.to_height_m
        else:
            add_ramped("turn", m.turn_deg_s * DEG, m.duration_s, m.ramp_s)
    breaks = np.array(times)
    speed_over_time, rate_over_time, climb_over_time = (
        PPoly(np.array(pieces).T, breaks) for pieces in (speeds, rates, climbs)
    )
    return speed_over_time, rate_over_time, climb_over_time


def _sway(parts: Iterable[tuple[float, float, float]]) -> Sway:
    table = np.array(list(parts), dtype=float).reshape(-1, 3)
    return Sway(table[:, 0], 2.0 * np.pi * table[:, 1], table[:, 2] * DEG)


def _step(motion: TrueMotion) -> float:
    """Return the longest step of the integration, s."""
    return min(0.5, 0.5 / max(motion.highest_rate(), 1e-9))


def _integrate_position(
    motion: TrueMotion, lat0: float, lon0: float, source: str
) -> tuple[PPoly, PPoly]:
    """Integrate dL/dt = v_n / (M + h) and dlon/dt = v_e / ((N + h) cos L).

    Gauss-Legendre collocation: the rates at the nodes of every step determine a
    polynomial; as they depend on the latitude, the whole is iterated to its fixed point,
    which contracts by the fraction of the Earth's radius that was travelled.
    """
    counts = np.maximum(np.ceil(np.diff(motion.kinks) / _step(motion)), 1).astype(int)
    pieces = [
        np.linspace(a, b, n, endpoint=False)
        for a, b, n in zip(motion.kinks[:-1], motion.kinks[1:], counts, strict=True)
    ]
    edges = np.append(np.concatenate(pieces), motion.duration)
    width = np.diff(edges)
    nodes = 0.5 * (np.polynomial.legendre.leggauss(_COLLOCATION_NODES)[0] + 1.0)
    powers = np.arange(_COLLOCATION_NODES)
    # Row i: coefficients of tau^i of the polynomial through the values at the nodes.
    interpolate = np.linalg.inv(nodes[:, None] ** powers)
    integral_at = nodes[:, None] ** (powers + 1) / (powers + 1)

    t = edges[:-1, None] + width[:, None] * nodes
    v_e, v_n = (v.reshape(t.shape) for v in motion.velocity(t.ravel())[:2])
    height = motion.height_at(t.ravel()).reshape(t.shape)

    def integrate(rate: Array) -> tuple[Array, Array]:
        coefficients = rate @ interpolate.T * width[:, None]
        whole = np.concatenate([[0.0], np.cumsum(coefficients @ (1.0 / (powers + 1.0)))])
        return coefficients, whole[:-1]

    lat = np.full(t.shape, lat0)
    for _ in range(50):
        coefficients, begin = integrate(v_n / (radii(lat)[0] + height))
        update = lat0 + begin[:, None] + coefficients @ integral_at.T
        if not np.all(np.abs(update) < _MAX_LATITUDE):
            raise ConfigError(
                "the vehicle reaches a pole, where east and north are undefined",
                where=f"{source} key start.lat_deg",
                expected="a track between 89.5 degrees south and north",
            )
        change = float(np.max(np.abs(update - lat)))
        lat = update
        if change < 4e-16:
            break
    lat_poly = _polynomial(edges, lat0 + begin, coefficients)
    coefficients, begin = integrate(v_e / ((radii(lat)[1] + height) * np.cos(lat)))
    return lat_poly, _polynomial(edges, lon0 + begin, coefficients)


def _polynomial(edges: Array, begin: Array, rate_coefficients: Array) -> PPoly:
    """Return begin + the integral of a polynomial in tau = (t - edge) / width."""
    degree = np.arange(1, rate_coefficients.shape[1] + 1)
    rising = rate_coefficients / degree / np.diff(edges)[:, None] ** degree
    return PPoly(np.column_stack([rising[:, ::-1], begin]).T, edges)


def _evaluate(polynomial: PPoly, t: Array, derivative: int = 0) -> Array:
    return np.asarray(polynomial(t, derivative), dtype=float)
