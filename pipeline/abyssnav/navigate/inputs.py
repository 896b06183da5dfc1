# SPDX-License-Identifier: Apache-2.0
"""What every method starts from, and what each makes of it."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import RayGeometry, is_physical, ray_geometry
from abyssnav.config import Config
from abyssnav.estimation.dead_reckoning import DeadReckoning, dead_reckon, still_before_lock
from abyssnav.estimation.dive_problem import ErrorPriors
from abyssnav.estimation.filter_problem import KnownStart
from abyssnav.estimation.fixes import repeated
from abyssnav.estimation.two_state import TravelTimes, innovation_rows, undecided
from abyssnav.geometry import blend, bracket, interpolate, leveled
from abyssnav.tables import (
    BeaconEstimates,
    Bool,
    CauseWeight,
    Dive,
    Event,
    Float,
    Innovations,
    Int,
    Learned,
    PositionInnovations,
    Replies,
    SensorEstimates,
    Start,
    Table,
    Track,
)

#: An echo of the floor counts for instants this near in time.
FLOOR_KNOWN_S = 10.0
#: Sigma of each axis of a lever arm that nobody gave, beside the hypothesis of a large one.
_NO_LEVER_M = 0.15


class MethodResult(NamedTuple):
    """What one method made of the dive; its gate's threshold; what it learned and met."""

    track: Track | None
    innovations: Innovations | None = None
    gamma: float = np.inf
    start: Start | None = None
    estimates: SensorEstimates | None = None
    events: tuple[Event, ...] = ()
    noise_s: Float | float = np.nan  #: of the times as the method took it: all, or each reply's
    learned: tuple[Learned, ...] = ()  #: parameters estimated with the track
    beacons: BeaconEstimates | None = None
    positions: PositionInnovations | None = None  #: position fixes as the method met them
    causes: tuple[CauseWeight, ...] = ()


@dataclass(frozen=True, eq=False)
class VehicleState(Table):
    """What the sensors measured of the vehicle at the output's instants."""

    t_s: Float
    roll_rad: Float  #: starboard down
    pitch_rad: Float  #: bow up
    forward_mps: Float  #: over ground, level, as the DVL reads it; held where it reads nothing
    starboard_mps: Float  #: the same across the heading
    altitude_m: Float  #: above the floor; NaN: unknown

    def at_instants(self, t_s: Float) -> "VehicleState":
        """The same at other instants (m,) s; without a copy where those are rows of its own."""
        first = int(np.searchsorted(self.t_s, t_s[0])) if len(t_s) else 0
        own = self[first : first + len(t_s)]
        if np.array_equal(own.t_s, t_s):
            return own
        before, after, share = place = bracket(t_s, self.t_s)
        columns = self.roll_rad, self.pitch_rad, self.forward_mps, self.starboard_mps
        roll_rad, pitch_rad, forward_mps, starboard_mps = (blend(c, *place) for c in columns)
        altitude_m = self.altitude_m[np.where(share < 0.5, before, after)]
        return VehicleState(t_s, roll_rad, pitch_rad, forward_mps, starboard_mps, altitude_m)


@dataclass(frozen=True, eq=False)
class NavigationInputs:
    """What every method starts from: dead reckoning, the replies and the output's instants."""

    dive: Dive
    motion: DeadReckoning
    still: (
        DeadReckoning  #: the same, but at rest before the first bottom lock: `ekf` knows no better
    )
    usable: Bool  #: (n,) of a known beacon and physical
    usable_replies: Replies  #: the usable ones
    geometry: RayGeometry  #: of the usable ones
    rate_hz: float  #: of the output's instants
    max_gap_s: float  #: over which velocities are joined by a straight line

    @cached_property
    def grid(self) -> DeadReckoning:
        """Dead reckoning at the output's instants."""
        return self.motion.interpolate(_output_times(self.dive, self.motion, self.rate_hz))

    @cached_property
    def live(self) -> DeadReckoning:
        """Those from the first velocity on; before it dead reckoning is hindsight."""
        return since(self.grid, first_velocity_s(self.dive))

    @cached_property
    def vehicle(self) -> VehicleState:
        """At the output's instants."""
        return vehicle_state(self.dive, self.grid.t_s, self.max_gap_s)

    @property
    def times(self) -> TravelTimes:
        """All travel times."""
        return TravelTimes(self.dive.replies, self.usable, self.geometry)


def prepare(dive: Dive, config: Config) -> NavigationInputs:
    """Dead reckoning over all that sensors and replies span; the replies that are of use."""
    process = config.process
    span_s = _span_s(dive, process.max_gap_s)
    usable = (dive.replies.beacon >= 0) & ~repeated(dive.replies)
    known = dive.replies[usable]
    sigma_s = config.acoustics.travel_time_sigma_s
    with ThreadPoolExecutor(1) as thread:
        tracing = thread.submit(ray_geometry, known, dive.sound_speed, sigma_s=sigma_s)
        motion = dead_reckon(
            dive.velocity, dive.heading, span_s, process.gap_sigma_mps, process.max_gap_s
        )
    paths = tracing.result()
    physical = is_physical(paths, known.travel_time_s, sigma_s)
    usable[usable] = physical
    first_s = first_velocity_s(dive)
    outside_s = np.concatenate(
        [known.t_ping_s, np.empty(0) if dive.positions is None else dive.positions.t_s]
    )
    early = first_s > np.min(outside_s, initial=np.inf)
    still = still_before_lock(motion, first_s) if early else motion
    return NavigationInputs(
        dive, motion, still, usable, known[physical], paths[physical], config.output.rate_hz,
        process.max_gap_s,
    )  # fmt: skip


def first_velocity_s(dive: Dive) -> float:
    """Instant of the first velocity with bottom lock."""
    return float(dive.velocity.t_s[np.argmax(dive.velocity.valid)])


def _span_s(dive: Dive, max_gap_s: float) -> tuple[float, float]:
    """First and last instant of velocities, replies and position fixes, and of depths near them.

    Depths say nothing of the way made: where they alone go on, no track does.
    """
    times = [dive.velocity.t_s, dive.replies.t_ping_s, dive.replies.t_reply_s]
    times += [] if dive.positions is None else [dive.positions.t_s]
    every_s, depth_s = np.concatenate(times), dive.depth.t_s
    near = (depth_s > every_s.min() - max_gap_s) & (depth_s < every_s.max() + max_gap_s)
    every_s = np.concatenate([every_s, depth_s[near]])
    return float(every_s.min()), float(every_s.max())


def settings_start(inputs: NavigationInputs, config: Config) -> KnownStart | None:
    """The start that the settings know; None where they know none.

    Without an instant it is for the first ping or position fix.
    """
    rule, dive = config.start, inputs.dive
    if rule.position_m is None:
        return None
    if rule.at is not None:
        t_s = (round(rule.at.timestamp() * 1e9) - dive.start_ns) / 1e9
    else:
        positions_s = np.empty(0) if dive.positions is None else dive.positions.t_s
        instants_s = np.concatenate([inputs.usable_replies.t_ping_s, positions_s])
        t_s = float(np.min(instants_s)) if len(instants_s) else float(inputs.motion.t_s[0])
    t_s = min(max(t_s, float(inputs.motion.t_s[0])), float(inputs.motion.t_s[-1]))
    east_m, north_m = rule.position_m
    return KnownStart(Start(t_s, east_m, north_m, 0, "settings"), rule.sigma_m)


def error_priors(dive: Dive, config: Config) -> ErrorPriors:
    """Sigmas of all that `ekf` and `smoother` estimate, from the settings.

    An arm that nobody gave is mostly none and seldom metres: the hypothesis of a large one stands
    beside a narrow prior, where one wide prior would cost every dive without an arm a tenth of its
    accuracy.
    """
    errors, vehicle = config.errors, config.vehicle
    unknown = vehicle.transducer_offset_m is None and vehicle.transducer_sigma_m is None
    first, second = np.radians(errors.deviation_sigma_deg).tolist()
    return ErrorPriors(
        travel_time_s=config.acoustics.travel_time_sigma_s,
        position_m2_per_s=errors.position_m2_per_s,
        heading_rad=float(np.radians(errors.heading_sigma_deg)),
        heading_time_s=errors.heading_time_s,
        velocity_mps=errors.dvl_sigma_mps,
        velocity_time_s=errors.dvl_time_s,
        current_mps=errors.current_sigma_mps,
        current_time_s=errors.current_time_s,
        sound_slow_mps=errors.sound_slow_sigma_mps,
        sound_slow_time_s=errors.sound_slow_time_s,
        offset_rad=float(np.radians(errors.heading_offset_sigma_deg)),
        deviation_rad=(first, second),
        dvl_scale=errors.dvl_scale_sigma,
        sound_mps=dive.water.sigma_mps,
        gradient_per_s=dive.water.gradient_sigma_per_s,
        gradient_depth_m=dive.water.depth_m,
        clock_s=errors.clock_sigma_s,
        lever_m=_NO_LEVER_M if unknown else vehicle.lever_sigma_m,
        unstated_lever_m=vehicle.lever_sigma_m if unknown else 0.0,
        beacon_m=errors.beacon_sigma_m,
        turn_around_s=errors.turn_around_sigma_s,
        gap_velocity_mps=config.process.gap_sigma_mps,
    )


def since(rows: DeadReckoning, t_s: float) -> DeadReckoning:
    """Those from an instant on."""
    return rows[int(np.searchsorted(rows.t_s, t_s)) :]


def _output_times(dive: Dive, motion: DeadReckoning, rate_hz: float) -> Float:
    """Every multiple of the period in UTC that dead reckoning covers, in seconds of the dive.

    Counted in UTC so that tracks of several dives, rates and methods share their instants.
    """
    period_ns = round(1e9 / rate_hz)
    first_ns = dive.start_ns + int(np.ceil(motion.t_s[0] * 1e9))
    last_ns = dive.start_ns + int(np.floor(motion.t_s[-1] * 1e9))
    ticks = np.arange(-(-first_ns // period_ns), last_ns // period_ns + 1, dtype=np.int64)
    return np.asarray((ticks * period_ns - dive.start_ns) / 1e9)


def vehicle_state(dive: Dive, t_s: Float, max_gap_s: float) -> VehicleState:
    """Attitude, velocity over ground and altitude at given instants.

    The velocity is the one that dead reckoning integrates: level, linear between the DVL's stamps,
    and the last good one where bottom lock is lost or stamps lie more than `max_gap_s` apart.
    """
    roll_rad = interpolate(t_s, dive.heading.t_s, dive.heading.roll_rad)
    pitch_rad = interpolate(t_s, dive.heading.t_s, dive.heading.pitch_rad)
    before, after, share = bracket(t_s, dive.velocity.t_s)
    valid = dive.velocity.valid
    last = np.maximum.accumulate(np.where(valid, np.arange(len(valid)), -1))
    source = np.where(last >= 0, last, np.argmax(valid))
    gap = dive.velocity.t_s[after] - dive.velocity.t_s[before] > max_gap_s
    after = np.where(gap, before, after)
    used = np.zeros(len(valid), dtype=bool)
    used[before] = used[after] = True
    rows = dive.velocity[used]
    body_mps = dive.velocity.velocity_body_mps[source[used]]
    level_mps = np.column_stack(leveled(body_mps, rows.roll_rad, rows.pitch_rad)[:2])
    place = np.cumsum(used) - 1
    places = place[before], place[after]
    forward_mps, starboard_mps = blend(level_mps, *places, share).T
    altitude_m = _altitude(dive, t_s)
    return VehicleState(t_s, roll_rad, pitch_rad, forward_mps, starboard_mps, altitude_m)


def _altitude(dive: Dive, t_s: Float) -> Float:
    """Depth of the floor less that of the vehicle, where an echo is near in time."""
    floor = dive.floor
    if floor is None or not len(floor):
        return np.full(len(t_s), np.nan)
    before, after, share = bracket(t_s, floor.t_s)
    age_s = np.maximum(np.abs(t_s - floor.t_s[before]), np.abs(t_s - floor.t_s[after]))
    height_m = blend(floor.depth_m, before, after, share)
    height_m -= interpolate(t_s, dive.depth.t_s, dive.depth.depth_m)
    return np.where(age_s <= FLOOR_KNOWN_S, height_m, np.nan)


class LevelTrack(NamedTuple):
    """What a method estimates of m instants."""

    t_s: Float
    position_m: Float  #: (m, 2)
    position_cov_m2: Float  #: (m, 2, 2)
    heading_rad: Float
    speed_scale: Float | float = 1.0  #: (m,) or one number, true speed over the DVL's


def place_track(inputs: NavigationInputs, level: LevelTrack) -> Track:
    """The same with depth, attitude, speed and altitude as measured at those instants."""
    depth, t_s = inputs.dive.depth, level.t_s
    up_m = -interpolate(t_s, depth.t_s, depth.depth_m)
    vehicle = inputs.vehicle.at_instants(t_s)
    return Track(
        t_s,
        np.column_stack([level.position_m, up_m]),
        level.position_cov_m2,
        level.heading_rad % (2 * np.pi),
        roll_rad=vehicle.roll_rad,
        pitch_rad=vehicle.pitch_rad,
        forward_mps=level.speed_scale * vehicle.forward_mps,
        starboard_mps=level.speed_scale * vehicle.starboard_mps,
        altitude_m=vehicle.altitude_m,
    )


def innovations_of_usable(inputs: NavigationInputs, decision: Int, values: Float) -> Innovations:
    """Innovations, a row a reply of the dive, from those of the usable replies (m,)."""
    replies, usable = inputs.dive.replies, inputs.usable
    every = undecided(replies, usable)
    every[usable] = decision
    return innovation_rows(inputs.times, every, rows_of_all(inputs, values))


def rows_of_all(inputs: NavigationInputs, values: Float) -> Float:
    """Values (n, ...) of all replies from those (m, ...) of the usable ones; NaN for the others."""
    every = np.full((len(inputs.usable), *values.shape[1:]), np.nan)
    every[inputs.usable] = values
    return every
