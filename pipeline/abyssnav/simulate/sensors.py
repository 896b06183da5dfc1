# SPDX-License-Identifier: Apache-2.0
"""What compass, DVL and depth sensor say of the true motion."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from abyssnav.geometry import interpolate
from abyssnav.simulate import scenario as settings
from abyssnav.simulate.vehicle import TrueMotion, gauss_markov
from abyssnav.tables import Bool, Depth, Float, Heading, Table

# The sensors do not fire together.
_DVL_PHASE_S = 0.07
_DEPTH_PHASE_S = 0.31
#: Of the constant errors, which dives of a voyage have in common, and of the noise.
Generators = tuple[Generator, Generator]


@dataclass(frozen=True, eq=False)
class CompassError:
    """How the compass was wrong: reading minus truth, white noise and steps aside."""

    bias_rad: float
    harmonics_rad: Float  #: (4,) of sin ψ, cos ψ, sin 2ψ, cos 2ψ
    error_rad: Float  #: bias, deviation, slow drift and jump at the compass's stamps


@dataclass(frozen=True, eq=False)
class DvlError:
    """How the DVL was wrong."""

    scale: float
    misalignment_rad: float  #: turn of the readings about the down axis


@dataclass(frozen=True, eq=False)
class DvlReadings(Table):
    """Velocity as recorded; NaN where bottom lock is lost."""

    t_s: Float
    velocity_body_mps: Float  #: (n, 3) forward, starboard, down
    valid: Bool


def read_compass(
    compass: settings.Compass, motion: TrueMotion, generators: Generators
) -> tuple[Heading, CompassError]:
    """Attitude with the compass's errors; heading unwrapped."""
    constants, rng = generators
    t_s = _stamps(motion, compass.rate_hz, 0.0)
    true = np.stack([motion.roll_rad, motion.pitch_rad, motion.heading_rad], axis=-1)
    roll, pitch, heading = interpolate(t_s, motion.t_s, true).T
    sigma_rad = np.radians(np.repeat(compass.deviation_sigma_deg, 2))
    harmonics = constants.normal(0, 1, 4) * sigma_rad
    bias = np.radians(compass.bias_deg + compass.bias_sigma_deg * constants.normal())
    slow = gauss_markov(len(t_s), 1 / compass.rate_hz, compass.slow_time_s, rng)
    shapes = np.stack([f(k * heading) for k in (1, 2) for f in (np.sin, np.cos)])
    error = bias + harmonics @ shapes + np.radians(compass.slow_sigma_deg) * slow
    error += np.radians(np.where(t_s >= compass.jump_at_s, compass.jump_deg, 0.0))
    white = np.radians(compass.white_sigma_deg) * rng.normal(size=len(t_s))
    tilt = np.radians(compass.tilt_sigma_deg) * rng.normal(size=(2, len(t_s)))
    step = np.radians(compass.step_deg)
    heading = _stuck(heading + error + white, t_s, compass.stuck_from_s)
    reading = Heading(
        t_s=t_s,
        roll_rad=_in_steps(roll + tilt[0], step),
        pitch_rad=_in_steps(pitch + tilt[1], step),
        heading_rad=_in_steps(heading, step),
    )
    return reading, CompassError(float(bias), harmonics, error)


def read_dvl(
    dvl: settings.Dvl,
    motion: TrueMotion,
    altitude_m: Float,
    current_enu_mps: Float,
    generators: Generators,
) -> tuple[DvlReadings, DvlError]:
    """Body velocity with the DVL's errors, water track and losses of bottom lock.

    Parameters
    ----------
    altitude_m : (n,) above the floor, at the motion's instants
    current_enu_mps : (n, 3) of the water that it tracks at the motion's instants; 0: bottom track
    """
    constants, rng = generators
    t_s = _stamps(motion, dvl.rate_hz, _DVL_PHASE_S)
    over = replace(motion, velocity_enu_mps=motion.velocity_enu_mps - current_enu_mps)
    true = interpolate(t_s, motion.t_s, velocity_body(over))
    scale = dvl.scale + dvl.scale_sigma * constants.normal()
    turn = np.radians(dvl.mount_deg + dvl.misalignment_sigma_deg * constants.normal())
    forward, starboard, down = true.T
    turned = np.stack(
        [
            forward * np.cos(turn) - starboard * np.sin(turn),
            forward * np.sin(turn) + starboard * np.cos(turn),
            down,
        ],
        axis=-1,
    )
    axes = [gauss_markov(len(t_s), 1 / dvl.rate_hz, dvl.slow_time_s, rng) for _ in range(3)]
    white = rng.normal(0, 1, turned.shape)
    reading = _in_steps(
        (1 + scale) * turned
        + dvl.slow_sigma_mps * np.stack(axes, axis=-1)
        + dvl.white_sigma_mps * white,
        dvl.step_mps,
    )
    near = np.interp(t_s, motion.t_s, altitude_m) <= dvl.lock_range_m
    valid = near & _has_lock(dvl, t_s, rng)
    velocity = np.where(valid[:, None], reading, np.nan)
    return DvlReadings(t_s, velocity, valid), DvlError(scale, float(turn))


def read_depth(
    sensor: settings.DepthSensor, motion: TrueMotion, generators: Generators
) -> tuple[Depth, float]:
    """Depth with bias and noise, and the bias [m]."""
    constants, rng = generators
    t_s = _stamps(motion, sensor.rate_hz, _DEPTH_PHASE_S)
    true = -interpolate(t_s, motion.t_s, motion.position_enu_m[:, 2])
    bias = sensor.bias_m + sensor.bias_sigma_m * constants.normal()
    noise = sensor.white_sigma_m * rng.normal(size=len(t_s))
    return Depth(t_s, _in_steps(true + bias + noise, sensor.step_m)), float(bias)


def velocity_body(motion: TrueMotion) -> Float:
    """True velocity as the vehicle feels it: v_body = (E Rz(ψ) Ry(θ) Rx(φ))ᵀ v_enu.

    Returns
    -------
    velocity_body_mps : (n, 3) forward, starboard, down
    """
    east, north, up = motion.velocity_enu_mps.T
    sin, cos = np.sin, np.cos
    heading, pitch, roll = motion.heading_rad, motion.pitch_rad, motion.roll_rad
    ahead = north * cos(heading) + east * sin(heading)
    starboard = east * cos(heading) - north * sin(heading)
    forward = ahead * cos(pitch) + up * sin(pitch)
    below = ahead * sin(pitch) - up * cos(pitch)
    return np.stack(
        [
            forward,
            starboard * cos(roll) + below * sin(roll),
            below * cos(roll) - starboard * sin(roll),
        ],
        axis=-1,
    )


def water_tracked(
    dvl: settings.Dvl, current_mps: tuple[float, float], t_s: Float, rng: Generator
) -> Float:
    """Velocity (n, 3) ENU of the water that the DVL takes for the ground; 0 on bottom track."""
    water = np.zeros((len(t_s), 3))
    for stretch in dvl.water_track:
        anywhere = rng.uniform(0, 2 * np.pi)
        direction = anywhere if stretch.direction_deg is None else np.radians(stretch.direction_deg)
        flow = np.array([np.sin(direction), np.cos(direction)]) * (stretch.current_mps or 0.0)
        if stretch.current_mps is None:
            flow = np.array(current_mps)
        inside = (t_s >= stretch.from_s) & (t_s < stretch.from_s + stretch.for_s)
        water[inside, :2] = flow
    return water


def _stuck(heading_rad: Float, t_s: Float, from_s: float | None) -> Float:
    """Heading that stays what it was from an instant on."""
    if from_s is None:
        return heading_rad
    last = min(int(np.searchsorted(t_s, from_s)), len(t_s) - 1)
    return np.where(t_s >= from_s, heading_rad[last], heading_rad)


def _stamps(motion: TrueMotion, rate_hz: float, phase_s: float) -> Float:
    last = motion.t_s[-1] - phase_s
    return phase_s + np.arange(int(np.floor(last * rate_hz + 1e-9)) + 1) / rate_hz


def _has_lock(dvl: settings.Dvl, t_s: Float, rng: Generator) -> Bool:
    gaps = round(dvl.gaps_per_hour * (t_s[-1] - t_s[0]) / 3600)
    begin = np.append(rng.uniform(t_s[0], t_s[-1], gaps), dvl.lost_from_s)
    length = np.append(np.full(gaps, dvl.gap_s), dvl.lost_for_s)
    lost = (t_s >= begin[:, None]) & (t_s < (begin + length)[:, None])
    return np.asarray(~lost.any(axis=0))


def _in_steps(values: Float, step: float) -> Float:
    """Values in whole steps of the output; as they are for a step of 0."""
    return np.round(values / step) * step if step > 0 else values
