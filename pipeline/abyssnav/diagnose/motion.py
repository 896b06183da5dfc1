# SPDX-License-Identifier: Apache-2.0
"""The detective for compass and DVL: which reading of them brings dead reckoning to the fixes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from abyssnav.diagnose.course import Course, lost_variance, recorded, with_heading, with_velocity
from abyssnav.diagnose.evidence import believable
from abyssnav.diagnose.regression import (
    Prepared,
    Regression,
    prepare,
    prior_sigmas,
    robust_inflation,
)
from abyssnav.geometry import Plane
from abyssnav.tables import Dive, Fixes, Float

#: Fixes spread over the dive that are enough.
_MOST_FIXES = 220
_LEAST_FIXES = 8
#: Windows in which a current, or a turn of the compass, may be another.
_ROUNDS = 2
_WINDOW_S = 300.0
_MOST_WINDOWS = 60
#: Noise of a fix beyond its formal one, and random walk of dead reckoning.
_FIX_FLOOR_M, _WALK_M2_PER_S = 1.0, 0.005
#: Sigma of each kind of error of sound sensors.
SOUND: Mapping[str, float] = {
    "origin": 20000.0,
    "turn": 0.035,
    "scale": 0.007,
    "deviation_1": 0.0175,
    "deviation_2": 0.007,
    "sway": 0.01,
    "current": 0.001,
    "slow_current": 0.004,
    "slow_turn": 0.009,
    "slow_bow": 0.005,
    "lever": 0.3,
    "clock": 0.3,
    "compass_clock": 0.15,
    "dvl_clock": 0.15,
}


@dataclass(frozen=True)
class Reading:
    """A way in which compass and DVL may have to be read, and which errors are wide under it."""

    name: str
    change: Callable[[Course], Course]
    wide: Mapping[str, float]
    penalty: float = 0.0  #: how much less likely it is before any data, nats
    value: str = ""  #: unit or frame that it stands for


@dataclass(frozen=True, eq=False)
class Scored:
    """A reading with its evidence and its parameters by name."""

    reading: Reading
    log_likelihood: float
    value: Mapping[str, Float]
    span_s: tuple[float, float]  #: of the fixes


def _as_it_is(course: Course) -> Course:
    return course


def _reversed(course: Course) -> Course:
    return with_heading(course, -course.heading_rad)


def _from_east(course: Course) -> Course:
    return with_heading(course, np.pi / 2 - course.heading_rad)


def _degrees_as_radians(course: Course) -> Course:
    return with_heading(course, np.radians(course.heading_rad))


def _radians_as_degrees(course: Course) -> Course:
    return with_heading(course, np.degrees(course.heading_rad))


def _port_for_starboard(course: Course) -> Course:
    return with_velocity(course, course.bow_mps, -course.starboard_mps)


def _earth_frame(east: complex, north: complex) -> Callable[[Course], Course]:
    """The velocities are of the earth's frame: bow · east + starboard · north."""

    def change(course: Course) -> Course:
        velocity = course.bow_mps * east + course.starboard_mps * north
        body = velocity * np.conj(course.forward)
        return with_velocity(course, np.real(body), -np.imag(body))

    return change


_ANY = {"turn": 3.0, "scale": 1.0}
_SCALE = {"scale": 3.0}
READINGS = (
    Reading("", _as_it_is, {}),
    Reading("turn", _as_it_is, {"turn": 1.5, "scale": 1.0}),
    Reading("dvl_scale", _as_it_is, {"scale": 0.5}),
    Reading("dvl_unit", _as_it_is, {"scale": 1000.0}),
    Reading("heading_sense", _reversed, {}),
    Reading("heading_reference", _from_east, {}),
    Reading("heading_sense_turn", _reversed, _ANY),
    Reading("heading_unit", _degrees_as_radians, _ANY, value="deg"),
    Reading("heading_unit", _radians_as_degrees, _ANY, value="rad"),
    Reading("dvl_frame", _port_for_starboard, {}),
    Reading("dvl_frame", _earth_frame(1, 1j), {}, value="enu"),
    Reading("dvl_frame", _earth_frame(1, -1j), {}, value="enu"),
    Reading("dvl_frame", _earth_frame(1j, 1), {}, value="ned"),
    Reading("dvl_frame", _earth_frame(1j, -1), {}, value="ned"),
    Reading("water_track", _as_it_is, {"current": 0.2, "slow_current": 0.05}),
    Reading("water_track", _as_it_is, {"current": 0.1, "slow_current": 0.15}),
    Reading("lever_arm", _as_it_is, {"lever": 5.0}),
    Reading("clock_offset", _as_it_is, {"clock": 10.0}, 5.0),
    Reading("compass_clock", _as_it_is, {"compass_clock": 1.5}, 6.0),
    Reading("slow_heading", _as_it_is, {"slow_turn": 0.1}, 8.0),
    Reading("slow_heading", _as_it_is, {"turn": 0.3, "slow_turn": 0.3}, 8.0),
    Reading("slow_velocity", _as_it_is, {"slow_bow": 0.04}, 15.0),
    Reading("deviation", _as_it_is, {"deviation_1": 0.1, "deviation_2": 0.04}),
)


def score_readings(
    dive: Dive, fixes: Fixes, readings: tuple[Reading, ...] = READINGS
) -> list[Scored]:
    """Every reading of compass and DVL by its evidence, the likeliest first; none: too few fixes.

    Positions of consistent fixes are compared with dead reckoning under each reading, whose
    errors are Gaussian with the sigmas of sound sensors; a reading makes one kind wide:

        fix(t) = p₀ + ∫ (1 + s + iθ + i φ(ψ) + ...) v dt + current t + lever · bow + τ v + noise
    """
    chosen = _chosen(dive, fixes)
    if chosen is None:
        return []
    fixes, noise, span_s = chosen
    course = recorded(dive)
    problems = {
        change: _regression(change(course), fixes, noise)
        for change in dict.fromkeys(reading.change for reading in readings)
    }
    inflation = np.zeros(2 * len(fixes))
    for _ in range(_ROUNDS):
        scored = _score_all(readings, problems, inflation, span_s)
        best = scored[0].reading
        problem = problems[best.change]
        sigma = prior_sigmas(problem.names, {**SOUND, **best.wide})
        inflation = robust_inflation(problem, sigma)
    return _score_all(readings, problems, inflation, span_s)


def _chosen(dive: Dive, fixes: Fixes) -> tuple[Fixes, Float, tuple[float, float]] | None:
    """Believable fixes spread over the dive, their noise, and first and last instant."""
    fixes = believable(fixes)
    known_s = dive.velocity.t_s[dive.velocity.valid]
    first_s, last_s = max(known_s[0], dive.heading.t_s[0]), min(known_s[-1], dive.heading.t_s[-1])
    fixes = fixes[(fixes.t_mid_s >= first_s) & (fixes.t_mid_s <= last_s)]
    if len(fixes) < _LEAST_FIXES:
        return None
    if len(fixes) > _MOST_FIXES:
        fixes = fixes[np.linspace(0, len(fixes) - 1, _MOST_FIXES).astype(int)]
    noise = _noise(fixes, lost_variance(dive, fixes.t_mid_s))
    return fixes, noise, (float(fixes.t_mid_s[0]), float(fixes.t_mid_s[-1]))


def motion_regression(dive: Dive, fixes: Fixes) -> Regression | None:
    """Fixes less dead reckoning as recorded, with every error's column; None: too few fixes."""
    chosen = _chosen(dive, fixes)
    return None if chosen is None else _regression(recorded(dive), *chosen[:2])


def _score_all(
    readings: tuple[Reading, ...],
    problems: Mapping[Callable[[Course], Course], Regression],
    inflation: Float,
    span_s: tuple[float, float],
) -> list[Scored]:
    base = {
        change: prepare(problem, prior_sigmas(problem.names, SOUND), inflation)
        for change, problem in problems.items()
    }
    names = next(iter(problems.values())).names
    scored = [_score(reading, base[reading.change], names, span_s) for reading in readings]
    return sorted(scored, key=lambda s: -s.log_likelihood)


def _score(
    reading: Reading, base: Prepared, names: tuple[str, ...], span_s: tuple[float, float]
) -> Scored:
    result = base.fit(prior_sigmas(names, {**SOUND, **reading.wide}))
    groups = np.array(names)
    value = {name: result.value[groups == name] for name in SOUND}
    return Scored(reading, result.log_likelihood - reading.penalty, value, span_s)


def _noise(fixes: Fixes, lost_m2: Float) -> Float:
    """Covariance (2n, 2n) of fixes less dead reckoning, east of all before north of all."""
    n, t_s = len(fixes), fixes.t_mid_s
    grown = _WALK_M2_PER_S * (t_s - t_s[0]) + lost_m2 - lost_m2[0]
    walk = np.minimum.outer(grown, grown)
    K = np.zeros((2 * n, 2 * n))
    for a in range(2):
        for b in range(2):
            block = np.diag(fixes.position_cov_m2[:, a, b] + (a == b) * _FIX_FLOOR_M**2)
            K[a * n : (a + 1) * n, b * n : (b + 1) * n] = block + (a == b) * walk
    return K


def _regression(course: Course, fixes: Fixes, noise: Float) -> Regression:
    """Fixes less dead reckoning, and every column by which its errors show."""
    t_s = fixes.t_mid_s
    position = fixes.position_enu_m[:, 0] + 1j * fixes.position_enu_m[:, 1]
    stacked, names = error_columns(course, t_s, (float(t_s[0]), float(t_s[-1])))
    y = position - course.run(course.velocity_mps, t_s)
    return Regression(_real(y), noise, _real(stacked), names)


def _real(values: Plane) -> Float:
    return np.concatenate([np.real(values), np.imag(values)])


def error_columns(
    course: Course, t_s: Float, span_s: tuple[float, float]
) -> tuple[Plane, tuple[str, ...]]:
    """Displacement (n, k) of the acoustic position at instants by one unit of each error.

    Returns
    -------
    columns, names : and the group (k,) that each belongs to

    Parameters
    ----------
    span_s : what the windows of slow errors divide
    """
    groups = _constant_columns(course, t_s, span_s[0]) | _slow_columns(course, t_s, span_s)
    names = tuple(name for name, group in groups.items() for _ in group)
    return np.column_stack([column for group in groups.values() for column in group]), names


def _constant_columns(course: Course, t_s: Float, first_s: float) -> dict[str, list[Plane]]:
    velocity, psi, bow = course.velocity_mps, course.heading_rad, course.forward
    turned = 1j * velocity
    turning = np.gradient(psi, course.t_s) if len(psi) > 1 else np.zeros(len(psi))
    deviation = [course.run(f * turned, t_s) for f in _harmonics(psi)]
    forward_then, velocity_then = (_at(course, v, t_s) for v in (bow, velocity))
    by_turning = course.run(turning * turned, t_s)
    one = np.ones(len(t_s), dtype=complex)
    return {
        "origin": [one, 1j * one],
        "turn": [course.run(turned, t_s)],
        "scale": [course.run(velocity, t_s)],
        "deviation_1": deviation[:2],
        "deviation_2": deviation[2:],
        "sway": [course.run(-1j * course.starboard_mps * bow, t_s)],
        "current": [(t_s - first_s) * one, 1j * (t_s - first_s) * one],
        "lever": [forward_then, -1j * forward_then],
        "clock": [velocity_then],
        "compass_clock": [by_turning],
        "dvl_clock": [velocity_then - course.velocity_mps[0] + by_turning],
    }


def _harmonics(psi: Float) -> tuple[Float, ...]:
    return np.sin(psi), np.cos(psi), np.sin(2 * psi), np.cos(2 * psi)


def _slow_columns(
    course: Course, t_s: Float, span_s: tuple[float, float]
) -> dict[str, list[Plane]]:
    """Errors that are others in each of a number of windows."""
    n = int(np.clip((span_s[1] - span_s[0]) / _WINDOW_S, 1, _MOST_WINDOWS))
    edges_s = np.linspace(*span_s, n + 1)
    edges_s[[0, -1]] += -1e6, 1e6
    begin_s = np.maximum(edges_s[:-1], span_s[0])
    within_s = np.clip(t_s[:, None], begin_s, edges_s[1:])

    def run(rate: Plane) -> list[Plane]:
        """One column a window: ∫ rate dt over what of it has passed."""
        passed = course.run(rate, within_s.ravel()).reshape(within_s.shape)
        return list((passed - course.run(rate, begin_s)).T)

    bow = course.forward
    current = list((within_s - begin_s).astype(complex).T)
    return {
        "slow_current": [*current, *(1j * column for column in current)],
        "slow_turn": run(1j * course.velocity_mps),
        "slow_bow": [*run(bow), *run(-1j * bow)],
    }


def predicted(scored: Scored, course: Course, t_s: Float, span_s: tuple[float, float]) -> Plane:
    """Position (n,) of the acoustic point by dead reckoning with the errors of a reading."""
    columns, names = error_columns(course, t_s, span_s)
    value = np.concatenate([scored.value[name] for name in dict.fromkeys(names)])
    return np.asarray(course.run(course.velocity_mps, t_s) + columns @ value)


def _at(course: Course, values: Plane, t_s: Float) -> Plane:
    east, north = (np.interp(t_s, course.t_s, part) for part in (values.real, values.imag))
    return np.asarray(east + 1j * north)
