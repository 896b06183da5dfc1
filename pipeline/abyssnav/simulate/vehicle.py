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
    """Drive the pattern around its centre, at constant altitude over the relief.

    The pattern is a list of stretches of constant turn rate and speed; a raised cosine of
    `settle_s` makes both change smoothly.  Course and speed are over ground, the bow points into
    the current as far as the course needs, and the vehicle banks and pitches with its path.  A
    vehicle that hovers strays about its spot under thrusters, whatever its bow points to.
    """
    t_s = STEP_S * np.arange(round(duration_s / STEP_S) + 1, dtype=np.float64)
    if vehicle.pattern == "hover":
        horizontal, over_ground, heading_rad = _hover(vehicle, t_s, rng)
        water_speed_mps = np.ones(len(t_s))  # hovering neither banks nor pitches much
    else:
        course_rad, speed_mps = _course_and_speed(vehicle, t_s, duration_s, rng)
        direction = np.stack([np.sin(course_rad), np.cos(course_rad)], axis=-1)
        over_ground = speed_mps[:, None] * direction
        horizontal = _sum_up(over_ground)
        through_water = over_ground - np.array(vehicle.current_mps)
        heading_rad = np.unwrap(np.arctan2(through_water[:, 0], through_water[:, 1]))
        water_speed_mps = np.linalg.norm(through_water, axis=-1)
    horizontal -= 0.5 * (horizontal.min(axis=0) + horizontal.max(axis=0))
    horizontal += vehicle.centre_m
    depth_m = relief.depth_m(floor.depth_m, horizontal) - vehicle.altitude_m
    depth_m = vehicle.surface_m + _share_of_depth(vehicle, t_s) * (depth_m - vehicle.surface_m)
    climb_mps = -np.gradient(depth_m, STEP_S)
    turn_rate = np.gradient(heading_rad, STEP_S)
    return TrueMotion(
        t_s=t_s,
        position_enu_m=np.column_stack([horizontal, -depth_m]),
        velocity_enu_mps=np.column_stack([over_ground, climb_mps]),
        roll_rad=np.arctan(water_speed_mps * turn_rate / _GRAVITY_MPS2),
        pitch_rad=np.arctan2(climb_mps, water_speed_mps),
        heading_rad=heading_rad,
    )


def _share_of_depth(vehicle: settings.Vehicle, t_s: Float) -> Float:
    """How far (n,) from the surface to the working depth the vehicle is: 1 but on its ways."""
    share = np.ones(len(t_s))
    for way_s, since_s in ((vehicle.descent_s, t_s), (vehicle.ascent_s, t_s[-1] - t_s)):
        if way_s > 0:
            # a settled start and end of the way: no step in the vertical speed
            under_way = (since_s - vehicle.surface_s) / (way_s - vehicle.surface_s)
            share = np.minimum(share, _smooth(np.clip(under_way, 0.0, 1.0), 60.0))
    return share


def _hover(vehicle: settings.Vehicle, t_s: Float, rng: Generator) -> tuple[Float, Float, Float]:
    """Position, velocity (n, 2) and heading (n,) of a vehicle that strays about its spot."""
    wander = np.stack([gauss_markov(len(t_s), STEP_S, 60.0, rng) for _ in range(3)], axis=-1)
    smooth = np.stack([_smooth(axis, 60.0) for axis in wander.T], axis=-1)
    smooth /= smooth.std(axis=0)
    horizontal = vehicle.hover_m * smooth[:, :2]
    heading_rad = rng.uniform(0, 2 * np.pi) + np.radians(20.0) * smooth[:, 2]
    return horizontal, np.gradient(horizontal, STEP_S, axis=0), heading_rad


def _course_and_speed(
    vehicle: settings.Vehicle, t_s: Float, duration_s: float, rng: Generator
) -> tuple[Float, Float]:
    length_s, turn_rate, speed = _stretches(vehicle, duration_s, rng)
    stretch = np.searchsorted(np.cumsum(length_s), t_s, side="right")
    rate = turn_rate[stretch]
    if vehicle.pattern == "meander":
        wander = gauss_markov(len(t_s), STEP_S, vehicle.meander_time_s, rng)
        rate = np.radians(vehicle.meander_deg_per_s) * wander
    on_the_way = (t_s < vehicle.descent_s) | (t_s > t_s[-1] - vehicle.ascent_s)
    rate = _smooth(np.where(on_the_way, speed[stretch] / vehicle.spiral_m, rate), vehicle.settle_s)
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
    if vehicle.pattern in ("transit", "meander"):
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


def gauss_markov(n: int, step_s: float, correlation_s: float, rng: Generator) -> Float:
    """Stationary process of unit variance: x_k = a x_{k-1} + √(1 - a²) w_k, a = exp(-Δt/τ)."""
    from scipy.signal import lfilter

    a = np.exp(-step_s / correlation_s)
    noise = np.sqrt(1 - a**2) * rng.normal(size=n)
    noise[0] = rng.normal()
    return np.asarray(lfilter([1.0], [1.0, -a], noise))


def _smooth(values: Float, settle_s: float) -> Float:
    """Values averaged under a raised cosine of width `settle_s`; the ends are held."""
    half = max(round(0.5 * settle_s / STEP_S), 1)
    window = np.hanning(2 * half + 1 + 2)[1:-1]
    return np.convolve(np.pad(values, half, mode="edge"), window / window.sum(), mode="valid")


def _sum_up(rate: Float) -> Float:
    """Trapezoids of `rate` over the time steps, from zero."""
    area = 0.5 * STEP_S * (rate[1:] + rate[:-1])
    return np.concatenate([np.zeros_like(rate[:1]), np.cumsum(area, axis=0)])
