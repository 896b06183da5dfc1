# SPDX-License-Identifier: Apache-2.0
"""What every method starts from, and what each makes of it."""

from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import Legs, is_physical, legs
from abyssnav.config import Config
from abyssnav.estimation.dead_reckoning import Motion, dead_reckon
from abyssnav.geometry import interpolate
from abyssnav.tables import (
    Bool,
    Dive,
    Event,
    Float,
    Innovations,
    Replies,
    SensorEstimates,
    Start,
    Track,
)


class Run(NamedTuple):
    """What one method made of the dive; its gate's threshold; what it learned and met."""

    track: Track | None
    innovations: Innovations | None = None
    gamma: float = np.inf
    start: Start | None = None
    estimates: SensorEstimates | None = None
    events: tuple[Event, ...] = ()
    noise_s: Float | float = np.nan  #: of the times as the method took it: all, or each reply's


class Evidence(NamedTuple):
    """What every method starts from: dead reckoning, the replies and the output's instants."""

    dive: Dive
    motion: Motion
    usable: Bool  #: (n,) of a known beacon and physical
    heard: Replies  #: the usable ones
    legs: Legs  #: of the usable ones
    grid: Motion  #: dead reckoning at the output's instants
    live: Motion  #: those from the first velocity on; before it dead reckoning is hindsight


def gather(dive: Dive, config: Config) -> Evidence:
    """Dead reckoning over all that sensors and replies span; the replies that are of use."""
    times = (dive.velocity.t_s, dive.depth.t_s, dive.replies.t_ping_s, dive.replies.t_reply_s)
    span_s = (min(float(t.min()) for t in times), max(float(t.max()) for t in times))
    process = config.process
    motion = dead_reckon(
        dive.velocity, dive.heading, span_s, process.gap_sigma_mps, process.max_gap_s
    )
    usable = dive.replies.beacon >= 0
    known = dive.replies[usable]
    sigma_s = config.acoustics.travel_time_sigma_s
    paths = legs(known, dive.sound_speed, sigma_s=sigma_s)
    physical = is_physical(paths, known.travel_time_s, sigma_s)
    usable[usable] = physical
    grid = motion.at(_output_times(dive, motion, config.output.rate_hz))
    live = since(grid, float(dive.velocity.t_s[np.argmax(dive.velocity.valid)]))
    return Evidence(dive, motion, usable, known[physical], paths[physical], grid, live)


def since(rows: Motion, t_s: float) -> Motion:
    """Those from an instant on."""
    return rows[int(np.searchsorted(rows.t_s, t_s)) :]


def _output_times(dive: Dive, motion: Motion, rate_hz: float) -> Float:
    """Every multiple of the period in UTC that dead reckoning covers, in seconds of the dive.

    Counted in UTC so that tracks of several dives, rates and methods share their instants.
    """
    period_ns = round(1e9 / rate_hz)
    first_ns = dive.start_ns + int(np.ceil(motion.t_s[0] * 1e9))
    last_ns = dive.start_ns + int(np.floor(motion.t_s[-1] * 1e9))
    ticks = np.arange(-(-first_ns // period_ns), last_ns // period_ns + 1, dtype=np.int64)
    return np.asarray((ticks * period_ns - dive.start_ns) / 1e9)


def place_track(
    evidence: Evidence, t_s: Float, position_m: Float, cov_m2: Float, heading_rad: Float
) -> Track:
    """A method's positions with the depth measured at the same instants."""
    depth = evidence.dive.depth
    up_m = -interpolate(t_s, depth.t_s, depth.depth_m)
    position_enu_m = np.column_stack([position_m, up_m])
    return Track(t_s, position_enu_m, cov_m2, heading_rad % (2 * np.pi))
