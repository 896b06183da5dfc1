# SPDX-License-Identifier: Apache-2.0
"""`Log` -> `Dive`: one clock, sorted, what was odd as checks, nothing repaired unseen."""

from dataclasses import replace

import numpy as np

from abyssnav.align.beacons import BeaconField, answering, beacons_of, has_rows, no_beacons
from abyssnav.align.calibration import apply_calibration
from abyssnav.align.environment import origin_of, sound_speed_of
from abyssnav.align.positions import positions_of
from abyssnav.align.replies import complete_replies, count, lever_arm_checks, no_replies, replies_of
from abyssnav.align.sensors import (
    Synchronized,
    depth_of,
    floor_of,
    heading_of,
    losses,
    synchronize,
    velocity_of,
)
from abyssnav.config import Config
from abyssnav.errors import ClockError, SolveError
from abyssnav.profile import SENSORS
from abyssnav.tables import (
    REPLIES_AHEAD,
    Beacons,
    Bool,
    Check,
    Dive,
    Float,
    Heading,
    Log,
    Origin,
    Positions,
    Reference,
    Replies,
)

#: Sensors whose stamps the recorder follows alike, to so much, are on one clock, s.
_ONE_CLOCK_S = 1.0
#: No track is so far from its origin: such a position of the reference is none.
_FARTHEST_M = 1e7
_NO_IDS = np.zeros(0, np.int64)
#: A longer dive needs a reading of its sensors, whichever, at least this often on average.
_ANY_LENGTH_S, _SPARSEST_S = 86_400.0, 10.0


def align(log: Log, config: Config) -> Dive:
    """Bring every sensor onto one clock and every reply to its ping's and its own instant.

    Time becomes float64 seconds since the dive's first stamp.  Heading is unwrapped and brought to
    the velocity's times, attitude (for the lever arm) and depth to each ping and reply, a moving
    beacon to the instant at which it answered.

    Raises
    ------
    ClockError
        A required role whose stamps all lie outside the dive; days of hardly any readings.
    SolveError
        A required role without messages or values, fewer than two beacons, or replies of none
        of them; with position fixes a dive needs no beacon.
    ConfigError
        Beacons in the settings that cannot be placed.
    """
    log, of_calibration = apply_calibration(_with_whole_replies(log, config), config.calibration)
    clock = synchronize(log)
    start_ns, roles = clock.start_ns, clock.roles
    acoustic = "travel_time" in roles
    first_ns = clock.first_heard_ns
    origin, of_origin = origin_of(log, config, first_ns)
    heading, of_heading = heading_of(roles["heading"], start_ns, log)
    depth, of_depth = depth_of(roles["depth"], start_ns, origin, log)
    velocity, of_velocity = velocity_of(roles["velocity"], start_ns, heading, log)
    _refuse_sparse((heading.t_s, velocity.t_s, depth.t_s), log)
    field, of_beacons = _beacons(log, config, origin, clock)
    replies, of_replies = no_replies(), list[Check]()
    if acoustic:
        offset_m = np.array(config.vehicle.lever_arm_m)
        columns, attitude = roles["travel_time"], (heading, depth)
        replies, of_replies = replies_of(columns, start_ns, field, attitude, offset_m)
        of_replies += lever_arm_checks(config.vehicle)
        _require_known_beacon(replies, field.beacons, log)
    water = (start_ns, first_ns, depth)
    sound_speed, water_errors, of_sound = sound_speed_of(log, config, field.beacons, water)
    positions, of_positions = _positions(log, clock, origin, heading)
    locked_s = velocity.t_s[velocity.valid]
    sensors = {"heading": heading.t_s, "velocity": locked_s, "depth": depth.t_s}
    checks = [
        *clock.checks, *of_calibration, *of_origin, *of_heading, *of_depth, *of_velocity,
        *of_beacons, *of_replies, *of_sound, *of_positions,
        *losses(_span_s(replies, positions), sensors, log), *_of_recorder(log, config),
        *_of_reading(log),
    ]  # fmt: skip
    return Dive(
        name=log.name,
        start_ns=start_ns,
        origin=origin,
        heading=heading,
        velocity=velocity,
        depth=depth,
        replies=replies,
        beacons=field.beacons,
        sound_speed=sound_speed,
        checks=tuple(checks),
        floor=floor_of(roles, start_ns, depth),
        positions=positions,
        water=water_errors,
    )


def _with_whole_replies(log: Log, config: Config) -> Log:
    if not has_rows(log, "travel_time"):
        return log
    replies = complete_replies(log.roles["travel_time"], log, config)
    return replace(log, roles={**log.roles, "travel_time": replies})


def _beacons(
    log: Log, config: Config, origin: Origin | None, clock: Synchronized
) -> tuple[BeaconField, list[Check]]:
    replies = clock.roles.get("travel_time")
    if replies is None and not config.beacon:
        return no_beacons(), []
    field, checks = beacons_of(log, config, origin, clock.first_heard_ns)
    field, left_out = answering(field, _NO_IDS if replies is None else replies["beacon_id"])
    return field, [*checks, *left_out]


def _positions(
    log: Log, clock: Synchronized, origin: Origin | None, heading: Heading
) -> tuple[Positions | None, list[Check]]:
    columns = clock.roles.get("position")
    if columns is None:
        return None, []
    return positions_of(columns, clock.start_ns, origin, heading, log.topics["position"])


def _span_s(replies: Replies, positions: Positions | None) -> tuple[float, float]:
    """First and last instant at which something was heard of the outside."""
    if len(replies):
        return float(replies.t_reply_s.min()), float(replies.t_reply_s.max())
    if positions is None:
        return 0.0, 0.0
    return float(positions.t_s.min()), float(positions.t_s.max())


def _refuse_sparse(sensors_s: tuple[Float, ...], log: Log) -> None:
    """Refuse a dive whose tracks would be weeks of positions made of a handful of readings."""
    span_s = max(t_s[-1] for t_s in sensors_s) - min(t_s[0] for t_s in sensors_s)
    readings = sum(map(len, sensors_s))
    if span_s > max(_ANY_LENGTH_S, _SPARSEST_S * readings):
        raise ClockError(
            f"{log.name}: {span_s / 86_400:,.1f} days from {readings:,} readings of heading, "
            f"velocity and depth, one in {span_s / readings:,.0f} s: are field and unit of their "
            "time right?"
        )


def _of_recorder(log: Log, config: Config) -> list[Check]:
    """Pings stamped later than the recorder had their replies, by a clock that the sensors share.

    A recorder that holds messages back says nothing; one that has replies before their pings were
    sent, by its own time and by what it has sensors after their stamps, tells that the receiver's
    clock is ahead.  The value is by how much the replies' stamps are.
    """
    latency_s, after_s = config.calibration.latency_s, log.recorded_after_s
    if not after_s.keys() >= {*SENSORS, "ping"}:
        return []
    sensors_s = [after_s[role] + getattr(latency_s, role, 0.0) for role in SENSORS]
    usual_s = float(np.median(sensors_s))
    ping_s, reply_s = (after_s[name] + latency_s.travel_time for name in ("ping", "travel_time"))
    if np.ptp(sensors_s) > _ONE_CLOCK_S or ping_s >= min(usual_s, 0.0) - _ONE_CLOCK_S:
        return []
    detail = f"{log.topics['travel_time']}: stamped ahead of the recorder, pings too"
    return [Check("align", REPLIES_AHEAD, usual_s - reply_s, _ONE_CLOCK_S, "s", False, detail)]


def _of_reading(log: Log) -> list[Check]:
    """What the reader found, and what of the reference is left out."""
    checks = [
        Check("read", f.what, 1, 0, "", False, f"{f.where}: {f.detail}") for f in log.findings
    ]
    if "reference" in log.roles:
        odd = int(np.sum(~_is_near(log.roles["reference"]["position_enu_m"])))
        detail = f"{log.topics['reference']}: not finite, or of another planet: left out"
        checks += [count("reference_positions_left_out", odd, detail)] if odd else []
    return checks


def _is_near(position_enu_m: Float) -> Bool:
    with np.errstate(invalid="ignore"):
        return np.asarray(np.all(np.abs(position_enu_m) < _FARTHEST_M, axis=-1))


def _require_known_beacon(replies: Replies, beacons: Beacons, log: Log) -> None:
    if np.any(replies.beacon >= 0) or has_rows(log, "position"):
        return
    ids = ", ".join(str(i) for i in np.unique(replies.beacon_id)[:8])
    known = ", ".join(str(i) for i in beacons.id[:8])
    where = log.topics["travel_time"]
    raise SolveError(
        f"{log.name}: no reply on {where} is from a known beacon: heard {ids}; known {known}"
    )


def reference(log: Log) -> Reference | None:
    """The log's independent positions, sorted, whole ones only; None when it holds none."""
    if "reference" not in log.roles:
        return None
    columns = log.roles["reference"]
    whole = _is_near(columns["position_enu_m"])
    if not whole.any():
        return None
    time_ns, first = np.unique(columns["time_ns"][whole], return_index=True)
    return Reference(time_ns, columns["position_enu_m"][whole][first])
