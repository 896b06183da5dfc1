# SPDX-License-Identifier: Apache-2.0
"""The true dive: sea floor, pattern, and the vehicle's motion over them."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from abyssnav.simulate import scenario as settings
from abyssnav.tables import Float, Table

#: Between the rows of the true motion; a chord of this length leaves the track by < 0.1 mm.
STEP_S = 0.1
_GRAVITY_MPS2 = 9.81


@dataclass(frozen=True, eq=False)
class TrueMotion(Table):
    """The vehicle as it really moved, every 0.1 s."""

    t_s: Float
    position_enu_m: Float  #: (n, 3) of the navigated point
    velocity_enu_mps: Float  #: (n, 3) over ground
    roll_rad: Float  #: starboard down positive
    pitch_rad: Float  #: bow up positive
    heading_rad: Float  #: unwrapped, clockwise from true north


@dataclass(frozen=True, eq=False)
class Relief(Table):
    """Waves whose sum, about a mean depth, is the sea floor."""

    wave_number_per_m: Float  #: (w, 2) east, north
    phase_rad: Float
    height_m: Float

    def depth_m(self, mean_depth_m: float, horizontal_m: Float) -> Float:
        """Depth of the floor below the places (n, 2) m east, north."""
        phase = horizontal_m @ self.wave_number_per_m.T + self.phase_rad
        return np.asarray(mean_depth_m - np.sin(phase) @ self.height_m)


def make_relief(floor: settings.Floor, rng: Generator) -> Relief:
    """Five waves of random direction, phase and length; their heights sum up to the relief."""
    number = 2 * np.pi / (floor.wavelength_m * np.array([1.0, 1.3, 1.7, 2.2, 2.9]))
    direction = rng.uniform(0, 2 * np.pi, len(number))
    weight = 1 / number**0.5
    return Relief(
        wave_number_per_m=number[:, None]
        * np.stack([np.sin(direction), np.cos(direction)], axis=-1),
        phase_rad=rng.uniform(0, 2 * np.pi, len(number)),
        height_m=floor.relief_m * weight / weight.sum(),
    )


def move(
    vehicle: settings.Vehicle,
    floor: settings.Floor,
    relief: Relief,
    duration_s: float,
    rng: Generator,
) -> TrueMotion:
    """Drive the pattern around the origin, at constant altitude over the relief.

    The pattern is a list of stretches of constant turn rate and speed; a raised cosine of
    `settle_s` makes both change smoothly.  Course and speed are over ground, the bow points into
    the current as far as the course needs, and the vehicle banks and pitches with its path.
    """
    t_s = STEP_S * np.arange(round(duration_s / STEP_S) + 1, dtype=np.float64)
    course_rad, speed_mps = _course_and_speed(vehicle, t_s, duration_s, rng)
    over_ground = speed_mps[:, None] * np.stack([np.sin(course_rad), np.cos(course_rad)], axis=-1)
    horizontal = _sum_up(over_ground)
    horizontal -= 0.5 * (horizontal.min(axis=0) + horizontal.max(axis=0))
    depth_m = relief.depth_m(floor.depth_m, horizontal) - vehicle.altitude_m
    climb_mps = -np.gradient(depth_m, STEP_S)

    through_water = over_ground - np.array(vehicle.current_mps)
    heading_rad = np.unwrap(np.arctan2(through_water[:, 0], through_water[:, 1]))
    water_speed_mps = np.linalg.norm(through_water, axis=-1)
    turn_rate = np.gradient(heading_rad, STEP_S)
    return TrueMotion(
        t_s=t_s,
        position_enu_m=np.column_stack([horizontal, -depth_m]),
        velocity_enu_mps=np.column_stack([over_ground, climb_mps]),
        roll_rad=np.arctan(water_speed_mps * turn_rate / _GRAVITY_MPS2),
        pitch_rad=np.arctan2(climb_mps, water_speed_mps),
        heading_rad=heading_rad,
    )


def _course_and_speed(
    vehicle: settings.Vehicle, t_s: Float, duration_s: float, rng: Generator
) -> tuple[Float, Float]:
    length_s, turn_rate, speed = _stretches(vehicle, duration_s, rng)
    stretch = np.searchsorted(np.cumsum(length_s), t_s, side="right")
    rate = _smooth(turn_rate[stretch], vehicle.settle_s)
    course = rng.uniform(0, 2 * np.pi) + _sum_up(rate)
    return course, _smooth(speed[stretch], vehicle.settle_s)


def _stretches(
    vehicle: settings.Vehicle, duration_s: float, rng: Generator
) -> tuple[Float, Float, Float]:
    """Length [s], turn rate [rad/s] and speed [m/s] of stretches that outlast the dive."""
    slow, fast = vehicle.speed_mps
    turn = np.radians(vehicle.turn_rate_deg_per_s)
    leg_m = rng.uniform(*vehicle.leg_m)
    if vehicle.pattern == "circle":
        # The mean speed's circle: each stretch keeps the radius and not the turn rate.
        legs = int(np.ceil(duration_s / 600)) + 1
        speed = rng.uniform(slow, fast, legs)
        return np.full(legs, 600.0), speed / vehicle.radius_m, speed
    legs = int(np.ceil(duration_s * fast / leg_m)) + 1
    speed = rng.uniform(slow, fast, legs)
    if vehicle.pattern == "transit":
        angle = np.radians(rng.uniform(-1, 1, legs) * vehicle.transit_turn_deg)
        length = np.column_stack([leg_m / speed, np.abs(angle) / turn])
        rate = np.column_stack([np.zeros(legs), np.sign(angle) * turn])
        return length.ravel(), rate.ravel(), np.repeat(speed, 2)
    # Leg, quarter turn, short cross leg, quarter turn; to starboard and to port in alternation.
    # The turns themselves take the vehicle sideways by twice their radius.
    quarter_s = np.full(legs, 0.5 * np.pi / turn)
    cross_m = np.maximum(vehicle.spacing_m - 2 * speed / turn, 1.0)
    side = turn * (-1.0) ** np.arange(legs)
    length = np.column_stack([leg_m / speed, quarter_s, cross_m / speed, quarter_s])
    rate = np.column_stack([np.zeros(legs), side, np.zeros(legs), side])
    return length.ravel(), rate.ravel(), np.repeat(speed, 4)


def _smooth(values: Float, settle_s: float) -> Float:
    """Values averaged under a raised cosine of width `settle_s`; the ends are held."""
    half = max(round(0.5 * settle_s / STEP_S), 1)
    window = np.hanning(2 * half + 1 + 2)[1:-1]
    return np.convolve(np.pad(values, half, mode="edge"), window / window.sum(), mode="valid")


def _sum_up(rate: Float) -> Float:
    """Trapezoids of `rate` over the time steps, from zero."""
    area = 0.5 * STEP_S * (rate[1:] + rate[:-1])
    return np.concatenate([np.zeros_like(rate[:1]), np.cumsum(area, axis=0)])
