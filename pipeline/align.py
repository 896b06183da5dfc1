# SPDX-License-Identifier: Apache-2.0
"""`Log` -> `Dive`: one clock, sorted, gaps and disorder told as checks, nothing repaired unseen."""

from collections.abc import Sequence

import numpy as np

from pipeline.config import BeaconSetting, Config
from pipeline.errors import ClockError, ConfigError, SolveError
from pipeline.nav.geometry import body_to_enu, geodetic_to_enu, interpolate
from pipeline.tables import (
    Beacons,
    Check,
    Columns,
    Depth,
    Dive,
    Float,
    Heading,
    Int,
    Log,
    Origin,
    Reference,
    Replies,
    SoundSpeed,
    Velocity,
)

_DAY_NS = 86_400_000_000_000
#: A stamp further than this from the dive's median is not of this dive (unset, or 1970).
_LONGEST_DIVE_NS = 30 * _DAY_NS
#: Messages may be this many periods apart before it counts as a gap.
_GAP_PERIODS = 5.0
_SENSORS = ("heading", "velocity", "depth")


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
    start_ns, roles, checks = _on_one_clock(log)
    heading, found = _heading(roles["heading"], start_ns, log)
    checks += found
    depth, found = _depth(roles["depth"], start_ns, log)
    checks += found
    velocity, found = _velocity(roles["velocity"], start_ns, heading, log)
    checks += found
    first_reply_ns = int(roles["travel_time"]["time_ns"].min())
    origin = _origin(log, config, first_reply_ns)
    beacons = _beacons(log, config, origin, first_reply_ns)
    offset_m = np.array(config.vehicle.transducer_offset_m)
    replies, found = _replies(roles["travel_time"], start_ns, beacons, heading, depth, offset_m)
    checks += found
    if not np.any(replies.beacon >= 0):
        heard = ", ".join(str(i) for i in np.unique(replies.beacon_id)[:8])
        known = ", ".join(str(i) for i in beacons.id)
        raise SolveError(
            f"{log.name}: no reply on {log.topics['travel_time']} is from a known beacon: "
            f"heard {heard}; known {known}"
        )
    checks += [_finding_check(f.what, f"{f.where}: {f.detail}") for f in log.findings]
    return Dive(
        name=log.name,
        start_ns=start_ns,
        origin=origin,
        heading=heading,
        velocity=velocity,
        depth=depth,
        replies=replies,
        beacons=beacons,
        sound_speed=_sound_speed(log, config, first_reply_ns),
        checks=tuple(checks),
    )


def reference(log: Log) -> Reference | None:
    """The log's independent positions, sorted; None when it holds none."""
    columns = log.roles.get("reference")
    if columns is None or not len(columns["time_ns"]):
        return None
    time_ns, first = np.unique(columns["time_ns"], return_index=True)
    return Reference(time_ns, columns["position_enu_m"][first])


def _on_one_clock(log: Log) -> tuple[int, dict[str, dict[str, np.ndarray]], list[Check]]:
    """Start of the dive, and the required roles in order, without doubles and foreign stamps."""
    required = (*_SENSORS, "travel_time")
    for role in required:
        if not len(log.roles[role]["time_ns"]):
            raise SolveError(f"{log.name}: no messages on {log.topics[role]} ({role})")
    middle_ns = int(np.median([np.median(log.roles[role]["time_ns"]) for role in required]))
    ordered, checks = {}, list[Check]()
    for role in required:
        ordered[role], found = _in_order(role, log.roles[role], middle_ns, log)
        checks += found
    return min(int(c["time_ns"][0]) for c in ordered.values()), ordered, checks


def _in_order(
    role: str, columns: Columns, middle_ns: int, log: Log
) -> tuple[dict[str, np.ndarray], list[Check]]:
    """Rows of one role sorted by stamp; what was wrong with them as checks."""
    time_ns = columns["time_ns"]
    near = np.abs(time_ns - middle_ns) < _LONGEST_DIVE_NS
    if not near.any():
        raise ClockError(
            f"{log.name}: every stamp on {log.topics[role]} lies more than 30 days from the dive's"
        )
    late = int(np.sum(np.diff(time_ns[near]) < 0))
    order = np.flatnonzero(near)[np.argsort(time_ns[near], kind="stable")]
    doubled = np.zeros(len(order), dtype=bool)
    if role in _SENSORS:  # replies of one instant are different replies
        doubled[1:] = np.diff(time_ns[order]) == 0
    kept = {name: column[order[~doubled]] for name, column in columns.items()}
    where = log.topics[role]
    checks = [
        _count(f"{role}_foreign_stamps", int(np.sum(~near)), f"{where}: left out"),
        _count(f"{role}_out_of_order", late, f"{where}: sorted by stamp"),
        _count(f"{role}_repeated_stamps", int(doubled.sum()), f"{where}: the first is kept"),
    ]
    if role in _SENSORS:
        checks.append(_largest_gap(role, kept["time_ns"], where))
    return kept, checks


def _largest_gap(role: str, time_ns: Int, where: str) -> Check:
    """Longest silence of a sensor against a few of its periods."""
    step_s = np.diff(time_ns) / 1e9
    if not len(step_s):
        return Check("align", f"{role}_largest_gap", 0.0, 0.0, "s", False, f"{where}: one message")
    longest = int(np.argmax(step_s))
    limit_s = _GAP_PERIODS * float(np.median(step_s))
    after_s = (time_ns[longest] - time_ns[0]) / 1e9
    return Check(
        "align", f"{role}_largest_gap", float(step_s[longest]), limit_s, "s",
        bool(step_s[longest] <= limit_s), f"{where}: {after_s:.1f} s after its first message",
    )  # fmt: skip


def _count(name: str, value: int, detail: str) -> Check:
    """A number that should be zero."""
    return Check("align", name, value, 0, "messages", value == 0, detail if value else "")


def _finding_check(what: str, detail: str) -> Check:
    return Check("read", what, 1, 0, "", False, detail)


def _seconds(columns: Columns, start_ns: int) -> Float:
    return np.asarray((columns["time_ns"] - start_ns) / 1e9)


def _finite(columns: Columns, names: Sequence[str], role: str, log: Log) -> tuple[Columns, Check]:
    """Rows whose named columns are all finite, and how many were not."""
    finite = np.all([np.isfinite(columns[name]) for name in names], axis=0)
    where = log.topics[role]
    if not finite.any():
        raise SolveError(f"{log.name}: no finite {names[0]} on {where} ({role})")
    lost = int(np.sum(~finite))
    kept = {name: column[finite] for name, column in columns.items()}
    return kept, _count(f"{role}_not_finite", lost, f"{where}: left out")


def _heading(columns: Columns, start_ns: int, log: Log) -> tuple[Heading, list[Check]]:
    kept, check = _finite(columns, ["heading_rad"], "heading", log)
    heading = Heading(
        t_s=_seconds(kept, start_ns),
        roll_rad=np.nan_to_num(kept["roll_rad"]),  # a bare compass: level, as the paper takes it
        pitch_rad=np.nan_to_num(kept["pitch_rad"]),
        heading_rad=np.unwrap(kept["heading_rad"]),
    )
    return heading, [check]


def _depth(columns: Columns, start_ns: int, log: Log) -> tuple[Depth, list[Check]]:
    kept, check = _finite(columns, ["depth_m"], "depth", log)
    return Depth(_seconds(kept, start_ns), np.asarray(kept["depth_m"], dtype=float)), [check]


def _velocity(
    columns: Columns, start_ns: int, heading: Heading, log: Log
) -> tuple[Velocity, list[Check]]:
    t_s = _seconds(columns, start_ns)
    body_mps = np.asarray(columns["velocity_body_mps"], dtype=float)
    valid = np.asarray(columns["valid"], dtype=bool) & np.all(np.isfinite(body_mps), axis=1)
    where = log.topics["velocity"]
    if not valid.any():
        raise SolveError(f"{log.name}: no valid velocity on {where} (velocity)")
    attitude = interpolate(
        t_s,
        heading.t_s,
        np.stack([heading.roll_rad, heading.pitch_rad, heading.heading_rad], axis=-1),
    )
    velocity = Velocity(
        t_s=t_s,
        velocity_body_mps=np.where(valid[:, None], body_mps, 0.0),
        valid=valid,
        roll_rad=attitude[:, 0],
        pitch_rad=attitude[:, 1],
        heading_rad=attitude[:, 2],
    )
    outside = float(np.mean((t_s < heading.t_s[0]) | (t_s > heading.t_s[-1])))
    lost = float(np.mean(~valid))
    longest_s = _longest_loss(t_s, valid)
    return velocity, [
        Check("align", "velocity_without_bottom_lock", lost, 0.05, "", lost <= 0.05,
              f"{where}: bridged with the last good velocity" if lost else ""),
        Check("align", "velocity_longest_loss", longest_s, 60.0, "s", longest_s <= 60.0, where),
        Check("align", "velocity_outside_heading", outside, 0.01, "", outside <= 0.01,
              f"{where}: the nearest heading is held" if outside else ""),
    ]  # fmt: skip


def _longest_loss(t_s: Float, valid: np.ndarray) -> float:
    """Longest time between two good velocities."""
    good_s = np.concatenate([t_s[:1], t_s[valid], t_s[-1:]])
    return float(np.max(np.diff(good_s)))


def _latest(columns: Columns, first_reply_ns: int) -> Columns:
    """Rows of the last message before the first reply, or of the first message."""
    before = columns["time_ns"] <= first_reply_ns
    chosen = columns["message"][before][-1] if before.any() else columns["message"][0]
    return {name: column[columns["message"] == chosen] for name, column in columns.items()}


def _has(log: Log, role: str) -> bool:
    return role in log.roles and len(log.roles[role]["time_ns"]) > 0


def _origin(log: Log, config: Config, first_reply_ns: int) -> Origin | None:
    """Origin of the local frame: the settings', else the log's, else the first geodetic beacon."""
    if config.origin is not None:
        return Origin(config.origin.latitude_deg, config.origin.longitude_deg)
    if _has(log, "beacons"):
        first = _latest(log.roles["beacons"], first_reply_ns)
        place = (first["origin_latitude_deg"][0], first["origin_longitude_deg"][0])
        if np.all(np.isfinite(place)):
            return Origin(float(place[0]), float(place[1]))
    for beacon in config.beacon:
        if beacon.latitude_deg is not None and beacon.longitude_deg is not None:
            return Origin(beacon.latitude_deg, beacon.longitude_deg)
    return None


def _beacons(log: Log, config: Config, origin: Origin | None, first_reply_ns: int) -> Beacons:
    """The settings' beacons, else the log's."""
    if config.beacon:
        beacons = Beacons(
            id=np.array([b.id for b in config.beacon]),
            name=np.array([b.name or str(b.id) for b in config.beacon]),
            position_enu_m=np.array([_placed(b, origin) for b in config.beacon]),
            turn_around_s=np.array([b.turn_around_s for b in config.beacon]),
            sigma_m=np.array([b.sigma_m for b in config.beacon]),
        )
    elif _has(log, "beacons"):
        rows = _latest(log.roles["beacons"], first_reply_ns)
        names = np.where(rows["name"] == "", rows["id"].astype(str), rows["name"])
        beacons = Beacons(
            rows["id"].astype(np.int64), names, rows["position_enu_m"], rows["turn_around_s"],
            np.nan_to_num(rows["sigma_m"]),
        )  # fmt: skip
    else:
        raise SolveError(f"{log.name}: no beacons, neither in the log nor in the settings")
    return _judged(beacons, log)


def _judged(beacons: Beacons, log: Log) -> Beacons:
    """Refuse beacons that no position follows from."""
    ids, count = np.unique(beacons.id, return_counts=True)
    if np.any(count > 1):
        raise SolveError(f"{log.name}: beacon {ids[np.argmax(count)]} is there {count.max()} times")
    numbers = np.column_stack([beacons.position_enu_m, beacons.turn_around_s])
    if not np.all(np.isfinite(numbers)):
        bad = beacons.id[~np.all(np.isfinite(numbers), axis=1)][0]
        raise SolveError(f"{log.name}: beacon {bad} has no finite position and turn-around time")
    if len(beacons) < 3:
        raise SolveError(
            f"{log.name}: {len(beacons)} beacons; a position needs 3 (two leave its mirror)"
        )
    return beacons


def _placed(beacon: BeaconSetting, origin: Origin | None) -> Float:
    """ENU position of a beacon of the settings."""
    if beacon.position_m is not None:
        return np.array(beacon.position_m)
    place = (beacon.latitude_deg, beacon.longitude_deg, beacon.depth_m)
    if None in place or origin is None:
        raise ConfigError(
            f"[[beacon]] {beacon.id}: give position_m, or latitude_deg, longitude_deg and depth_m"
        )
    latitude_deg, longitude_deg, depth_m = (np.float64(value or 0.0) for value in place)
    east_m, north_m, _ = geodetic_to_enu(
        origin.latitude_deg,
        origin.longitude_deg,
        np.array(latitude_deg),
        np.array(longitude_deg),
        np.array(-depth_m),
    )
    return np.array([east_m, north_m, -depth_m])


def _sound_speed(log: Log, config: Config, first_reply_ns: int) -> SoundSpeed:
    """The settings' profile, else the log's, else the constant as two equal levels."""
    if config.sound_speed_profile is not None:
        depth_m = np.array(config.sound_speed_profile.depth_m)
        speed_mps = np.array(config.sound_speed_profile.sound_speed_mps)
    elif _has(log, "sound_speed"):
        rows = _latest(log.roles["sound_speed"], first_reply_ns)
        depth_m, first = np.unique(rows["depth_m"], return_index=True)
        speed_mps = rows["sound_speed_mps"][first]
        if not np.all(np.isfinite(speed_mps) & (speed_mps > 0) & np.isfinite(depth_m)):
            raise SolveError(f"{log.name}: {log.topics['sound_speed']} holds a speed that is none")
    else:
        depth_m, speed_mps = np.array([0.0]), np.array([config.acoustics.sound_speed_mps])
    if len(depth_m) == 1:
        depth_m, speed_mps = np.array([0.0, 12_000.0]), np.repeat(speed_mps, 2)
    return SoundSpeed(depth_m, speed_mps)


def _replies(
    columns: Columns,
    start_ns: int,
    beacons: Beacons,
    heading: Heading,
    depth: Depth,
    offset_m: Float,
) -> tuple[Replies, list[Check]]:
    """Every reply with depth and lever arm at its ping and at itself, in the order heard."""
    t_reply_s = _seconds(columns, start_ns)
    t_ping_s = np.asarray((columns["ping_time_ns"] - start_ns) / 1e9)
    travel_time_s = np.asarray(columns["travel_time_s"], dtype=float)
    beacon_id = columns["beacon_id"].astype(np.int64)
    place = np.argsort(beacons.id)
    found = place[np.clip(np.searchsorted(beacons.id[place], beacon_id), 0, len(place) - 1)]
    beacon = np.where(beacons.id[found] == beacon_id, found, -1)
    disagree_s = np.abs(t_reply_s - t_ping_s - travel_time_s)
    replies = Replies(
        ping_id=columns["ping_id"].astype(np.int64),
        beacon_id=beacon_id,
        beacon=beacon,
        t_ping_s=t_ping_s,
        t_reply_s=t_reply_s,
        travel_time_s=travel_time_s,
        snr_db=columns["snr_db"],
        depth_ping_m=interpolate(t_ping_s, depth.t_s, depth.depth_m),
        depth_reply_m=interpolate(t_reply_s, depth.t_s, depth.depth_m),
        lever_ping_enu_m=_lever(t_ping_s, heading, offset_m),
        lever_reply_enu_m=_lever(t_reply_s, heading, offset_m),
    )
    with np.errstate(invalid="ignore"):
        n_disagree = int(np.sum(disagree_s > 0.1))
    return replies, [
        _count("replies_of_unknown_beacons", int(np.sum(beacon < 0)), "not used"),
        _count("replies_heard_before_their_ping", int(np.sum(t_reply_s < t_ping_s)), "as stamped"),
        _count("replies_whose_stamp_is_not_ping_plus_travel_time", n_disagree, "more than 0.1 s"),
    ]


def _lever(t_s: Float, heading: Heading, offset_m: Float) -> Float:
    """Transducer minus navigated point (n, 3) m, ENU, with the attitude of each instant."""
    attitude = np.stack([heading.roll_rad, heading.pitch_rad, heading.heading_rad], axis=-1)
    roll_rad, pitch_rad, heading_rad = interpolate(t_s, heading.t_s, attitude).T
    return body_to_enu(np.broadcast_to(offset_m, (len(t_s), 3)), roll_rad, pitch_rad, heading_rad)
