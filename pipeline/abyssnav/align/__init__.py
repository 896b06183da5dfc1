# SPDX-License-Identifier: Apache-2.0
"""`Log` -> `Dive`: one clock, sorted, gaps and disorder told as checks, nothing repaired unseen."""

import numpy as np

from abyssnav.align.environment import beacons_of, origin_of, sound_speed_of
from abyssnav.align.sensors import (
    depth_of,
    floor_of,
    heading_of,
    on_one_clock,
    replies_of,
    velocity_of,
)
from abyssnav.config import Config
from abyssnav.errors import SolveError
from abyssnav.tables import Beacons, Check, Dive, Log, Reference, Replies


def align(log: Log, config: Config) -> Dive:
    """Bring every sensor onto one clock and every reply to its ping's and its own instant.

    Time becomes float64 seconds since the dive's first stamp.  Heading is unwrapped and brought to
    the velocity's times, attitude (for the lever arm) and depth to each ping and reply.

    Raises
    ------
    ClockError
        A required role whose stamps all lie outside the dive.
    SolveError
        A required role without messages or values, fewer than three beacons, or replies of none
        of them.
    ConfigError
        Beacons in the settings that cannot be placed.
    """
    start_ns, roles, checks = on_one_clock(log)
    heading, found = heading_of(roles["heading"], start_ns, log)
    checks += found
    first_reply_ns = int(roles["travel_time"]["time_ns"].min())
    origin = origin_of(log, config, first_reply_ns)
    depth, found = depth_of(roles["depth"], start_ns, origin, log)
    checks += found
    velocity, found = velocity_of(roles["velocity"], start_ns, heading, log)
    checks += found
    beacons, found = beacons_of(log, config, origin, first_reply_ns)
    checks += found
    offset_m = np.array(config.vehicle.transducer_offset_m)
    replies, found = replies_of(roles["travel_time"], start_ns, beacons, heading, depth, offset_m)
    checks += found
    _require_known_beacon(replies, beacons, log)
    sound_speed, found = sound_speed_of(log, config, beacons, first_reply_ns)
    checks += found
    checks += [
        Check("read", f.what, 1, 0, "", False, f"{f.where}: {f.detail}") for f in log.findings
    ]
    return Dive(
        name=log.name,
        start_ns=start_ns,
        origin=origin,
        heading=heading,
        velocity=velocity,
        depth=depth,
        replies=replies,
        beacons=beacons,
        sound_speed=sound_speed,
        checks=tuple(checks),
        floor=floor_of(roles["velocity"], start_ns, depth),
    )


def _require_known_beacon(replies: Replies, beacons: Beacons, log: Log) -> None:
    if np.any(replies.beacon >= 0):
        return
    heard = ", ".join(str(i) for i in np.unique(replies.beacon_id)[:8])
    known = ", ".join(str(i) for i in beacons.id)
    where = log.topics["travel_time"]
    raise SolveError(
        f"{log.name}: no reply on {where} is from a known beacon: heard {heard}; known {known}"
    )


def reference(log: Log) -> Reference | None:
    """The log's independent positions, sorted, whole ones only; None when it holds none."""
    if "reference" not in log.roles:
        return None
    columns = log.roles["reference"]
    whole = np.all(np.isfinite(columns["position_enu_m"]), axis=-1)
    if not whole.any():
        return None
    time_ns, first = np.unique(columns["time_ns"][whole], return_index=True)
    return Reference(time_ns, columns["position_enu_m"][whole][first])
