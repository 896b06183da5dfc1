# SPDX-License-Identifier: Apache-2.0
"""Sensors and replies on one clock: sorted, judged, brought to each other's instants."""

from collections.abc import Sequence

import numpy as np

from abyssnav.errors import ClockError, SolveError
from abyssnav.geometry import body_to_enu, depth_of_pressure, interpolate
from abyssnav.tables import (
    Beacons,
    Check,
    Columns,
    Depth,
    Float,
    Heading,
    Int,
    Log,
    Origin,
    Replies,
    Velocity,
)

#: Stamps beyond a day in which nothing at all was recorded are not of this dive: unset, or 1970.
_LONGEST_SILENCE_NS = 86_400_000_000_000
#: Messages may be this many periods apart before it counts as a gap.
_GAP_PERIODS = 5.0
#: No underwater vehicle is faster: a reading that says so is none.
_FASTEST_MPS = 30.0
#: No sea is deeper, and no vehicle that navigates by beacons higher.
DEEPEST_M, _ABOVE_M = 12_000.0, 20.0
#: Where nothing tells: the depth of 6,000 m is 15 m wrong at the equator, and at a pole.
_LATITUDE_DEG = 45.0
_SENSORS = ("heading", "velocity", "depth")


def on_one_clock(log: Log) -> tuple[int, dict[str, dict[str, np.ndarray]], list[Check]]:
    """Start of the dive, and the required roles in order, without doubles and foreign stamps.

    Raises
    ------
    SolveError
        A required role without messages.
    ClockError
        A required role without a stamp of this dive.
    """
    required = (*_SENSORS, "travel_time")
    for role in required:
        if role not in log.roles or not len(log.roles[role]["time_ns"]):
            where = log.topics.get(role, "any topic")
            raise SolveError(
                f"{log.name}: no messages on {where} ({role}) by profile {log.profile}; "
                "abyssnav inspect shows what is there and proposes a profile"
            )
    first_ns, last_ns = _span([log.roles[role]["time_ns"] for role in required])
    ordered, checks = {}, list[Check]()
    for role in required:
        ordered[role], found = _in_order(role, log.roles[role], first_ns, last_ns, log)
        checks += found
    return min(int(c["time_ns"][0]) for c in ordered.values()), ordered, checks


def _span(stamps_ns: Sequence[Int]) -> tuple[int, int]:
    """First and last stamp of the stretch without a long silence that holds most messages."""
    every_ns = np.sort(np.concatenate(stamps_ns), kind="stable")  # quick where parts are sorted
    silent = np.flatnonzero(np.diff(every_ns) > _LONGEST_SILENCE_NS)
    begin, end = np.concatenate([[0], silent + 1]), np.concatenate([silent, [len(every_ns) - 1]])
    longest = np.argmax(end - begin)
    return int(every_ns[begin[longest]]), int(every_ns[end[longest]])


def _in_order(
    role: str, columns: Columns, first_ns: int, last_ns: int, log: Log
) -> tuple[dict[str, np.ndarray], list[Check]]:
    """Rows of one role sorted by stamp; what was wrong with them as checks."""
    time_ns = columns["time_ns"]
    near = (time_ns >= first_ns) & (time_ns <= last_ns)
    if "ping_time_ns" in columns:
        near &= np.abs(columns["ping_time_ns"] - time_ns) < _LONGEST_SILENCE_NS
    if not near.any():
        first = np.datetime64(int(time_ns[0]), "ns").astype("datetime64[s]")
        raise ClockError(
            f"{log.name}: every stamp on {log.topics[role]} lies more than a day from the others' "
            f"or from its ping's; the first says {first}: are field and unit of its time right?"
        )
    late = int(np.sum(np.diff(time_ns[near]) < 0))
    order = np.flatnonzero(near)
    order = order[np.argsort(time_ns[order], kind="stable")] if late else order
    doubled = np.zeros(len(order), dtype=bool)
    if role in _SENSORS:  # replies of one instant are different replies
        doubled[1:] = np.diff(time_ns[order]) == 0
    odd = late or doubled.any() or not near.all()
    kept = {name: c[order[~doubled]] if odd else c for name, c in columns.items()}
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


def _seconds(columns: Columns, start_ns: int) -> Float:
    return np.asarray((columns["time_ns"] - start_ns) / 1e9)


def _finite(columns: Columns, names: Sequence[str], role: str, log: Log) -> tuple[Columns, Check]:
    """Rows whose named columns are all finite, and how many were not."""
    finite = np.all([np.isfinite(columns[name]) for name in names], axis=0)
    where = log.topics[role]
    if not finite.any():
        raise SolveError(f"{log.name}: no finite {names[0]} on {where} ({role})")
    lost = int(np.sum(~finite))
    kept = {name: column[finite] for name, column in columns.items()} if lost else columns
    return kept, _count(f"{role}_not_finite", lost, f"{where}: left out")


def heading_of(columns: Columns, start_ns: int, log: Log) -> tuple[Heading, list[Check]]:
    """Attitude at its own times, heading unwrapped; what was not finite is left out."""
    kept, check = _finite(columns, ["heading_rad"], "heading", log)
    heading = Heading(
        t_s=_seconds(kept, start_ns),
        roll_rad=np.nan_to_num(kept["roll_rad"]),  # a bare compass: level, as the paper takes it
        pitch_rad=np.nan_to_num(kept["pitch_rad"]),
        heading_rad=np.unwrap(kept["heading_rad"]),
    )
    return heading, [check]


def depth_of(
    columns: Columns, start_ns: int, origin: Origin | None, log: Log
) -> tuple[Depth, list[Check]]:
    """Depth at its own times; what was not finite is left out."""
    where, checks = log.topics["depth"], list[Check]()
    if "pressure_dbar" in columns:
        latitude_deg = _LATITUDE_DEG if origin is None else origin.latitude_deg
        depth_m = depth_of_pressure(columns["pressure_dbar"], latitude_deg)
        columns = {"time_ns": columns["time_ns"], "depth_m": depth_m}
        known = origin is not None
        told = f"{where}: the origin's" if known else f"{where}: taken, as none is known"
        checks.append(Check("align", "depth_latitude", latitude_deg, 90.0, "degrees", known, told))
    kept, check = _finite(columns, ["depth_m"], "depth", log)
    depth_m = np.asarray(kept["depth_m"], dtype=float)
    odd = float(np.mean((depth_m < -_ABOVE_M) | (depth_m > DEEPEST_M)))
    told = f"{where}: {depth_m.min():,.0f} to {depth_m.max():,.0f} m; are unit and sign right?"
    checks += [
        check,
        Check("align", "depth_of_no_sea", odd, 0.0, "", odd == 0, told if odd else ""),
    ]
    return Depth(_seconds(kept, start_ns), depth_m), checks


def velocity_of(
    columns: Columns, start_ns: int, heading: Heading, log: Log
) -> tuple[Velocity, list[Check]]:
    """Velocity at its own times with the attitude of those; beyond any vehicle's is not valid."""
    t_s = _seconds(columns, start_ns)
    body_mps = np.asarray(columns["velocity_body_mps"], dtype=float)
    slow_mps = np.abs(np.nan_to_num(body_mps, nan=np.inf)) < _FASTEST_MPS
    valid = np.asarray(columns["valid"], dtype=bool) & np.all(slow_mps, axis=1)
    where = log.topics["velocity"]
    if not valid.any():
        fast = int(np.sum(np.any(np.abs(np.nan_to_num(body_mps)) >= _FASTEST_MPS, axis=1)))
        told = (
            f"; {fast} are faster than {_FASTEST_MPS:.0f} m/s: is the unit right?" if fast else ""
        )
        raise SolveError(f"{log.name}: no valid velocity on {where} (velocity){told}")
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


def floor_of(columns: Columns, start_ns: int, depth: Depth) -> Depth | None:
    """Depth of the floor below the vehicle, its own and the DVL's altitude; None without any."""
    altitude_m = np.asarray(columns.get("altitude_m", np.zeros(0)), dtype=float)
    known = np.isfinite(altitude_m)
    if not known.any():
        return None
    t_s = _seconds(columns, start_ns)[known]
    return Depth(t_s, interpolate(t_s, depth.t_s, depth.depth_m) + altitude_m[known])


def _longest_loss(t_s: Float, valid: np.ndarray) -> float:
    """Longest time between two good velocities."""
    good_s = np.concatenate([t_s[:1], t_s[valid], t_s[-1:]])
    return float(np.max(np.diff(good_s)))


def replies_of(
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
    known = beacon >= 0
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
        beacon_enu_m=np.where(known[:, None], beacons.position_enu_m[beacon], np.nan),
        turn_around_s=np.where(known, beacons.turn_around_s[beacon], np.nan),
        beacon_sigma_m=np.zeros(len(beacon)),
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
