# SPDX-License-Identifier: Apache-2.0
"""Replies: their two-way times and stamps made whole, with depth, lever arm and beacon of each."""

import numpy as np

from abyssnav.align.beacons import BeaconField, longest_unseen
from abyssnav.config import Config, Vehicle
from abyssnav.geometry import body_to_enu, interpolate
from abyssnav.tables import Check, Columns, Depth, Float, Heading, Int, Log, Replies

#: Derived ping times that are nearer are of one ping.
_ONE_PING_NS = 100_000_000
#: A stamp and the travel time may disagree by this much.
_DISAGREE_S = 0.1
_PING_DERIVED = 1  #: as the stage read marks it; 2: the reply's stamp is derived


def complete_replies(columns: Columns, log: Log, config: Config) -> Columns:
    """Replies with two-way times, and with both stamps.

    A time from which the turn-around was taken off gets it back, the reply's own or its beacon's;
    a ping time that nobody logged is the reply's less T, and a reply's stamp that nobody logged
    the ping's plus T.
    """
    columns = dict(columns)
    without, derived = columns.pop("without_turn_around", None), columns.pop("derived", None)
    counted = columns.pop("counted", None)
    if without is not None:
        added_s = _turn_around_s(columns, log, config)
        columns["travel_time_s"] = columns["travel_time_s"] + np.nan_to_num(added_s)
    if derived is None:
        return columns
    flight_s = np.nan_to_num(columns["travel_time_s"], posinf=0.0, neginf=0.0)
    flight_ns = np.rint(np.clip(flight_s, -1e5, 1e5) * 1e9).astype(np.int64)
    backwards = derived == _PING_DERIVED
    stamp_ns = columns["time_ns"]
    columns["ping_time_ns"] = np.where(backwards, stamp_ns - flight_ns, columns["ping_time_ns"])
    columns["time_ns"] = np.where(backwards, stamp_ns, columns["ping_time_ns"] + flight_ns)
    if not backwards.any():  # in no message's order, which is nothing odd
        order = np.argsort(columns["time_ns"], kind="stable")
        columns = {name: column[order] for name, column in columns.items()}
    if backwards.all() and counted is not None and not counted.any():
        columns["ping_id"] = _numbered(columns["ping_time_ns"])
    return columns


def _turn_around_s(columns: Columns, log: Log, config: Config) -> Float:
    """Turn-around time of each reply (n,): its own, or its beacon's; NaN of unknown beacons."""
    by_id: dict[int, float] = {}
    if config.beacon:
        by_id = {beacon.id: beacon.turn_around_s for beacon in config.beacon}
    elif "beacons" in log.roles:
        rows = log.roles["beacons"]
        by_id = dict(zip(rows["id"].tolist(), rows["turn_around_s"].tolist(), strict=True))
    ids, row = np.unique(columns["beacon_id"], return_inverse=True)
    of_beacon = np.array([by_id.get(number, np.nan) for number in ids.tolist()])[row]
    own = columns.get("turn_around_s", np.full(len(row), np.nan))
    return np.where(np.isfinite(own), own, of_beacon)


def _numbered(ping_time_ns: Int) -> Int:
    """Pings counted by their times, those of nearly one instant together."""
    order = np.argsort(ping_time_ns, kind="stable")
    new = np.diff(ping_time_ns[order], prepend=ping_time_ns[order][:1]) > _ONE_PING_NS
    number = np.empty(len(order), np.int64)
    number[order] = np.cumsum(new)
    return number


def replies_of(
    columns: Columns,
    start_ns: int,
    field: BeaconField,
    attitude: tuple[Heading, Depth],
    offset_m: Float,
) -> tuple[Replies, list[Check]]:
    """Every reply with depth, lever arm and beacon at its ping and at itself, in the order heard.

    Parameters
    ----------
    columns : of the role travel_time, as `complete_replies` leaves them
    attitude : of the vehicle, and its depth
    offset_m : (3,) transducer from the navigated point: forward, starboard, down
    """
    heading, depth = attitude
    t_reply_s = np.asarray((columns["time_ns"] - start_ns) / 1e9)
    t_ping_s = np.asarray((columns["ping_time_ns"] - start_ns) / 1e9)
    travel_time_s = np.asarray(columns["travel_time_s"], dtype=float)
    beacon_id = columns["beacon_id"].astype(np.int64)
    beacon = _rows_of(field.beacons.id, beacon_id)
    answered_ns = columns["ping_time_ns"] + (columns["time_ns"] - columns["ping_time_ns"]) // 2
    beacon = np.where(field.stands(beacon, answered_ns), beacon, -1)
    beacon_enu_m, turn_around_s, beacon_sigma_m = field.at_replies(beacon, answered_ns)
    if "turn_around_s" in columns:
        own_s = columns["turn_around_s"]
        turn_around_s = np.where(np.isfinite(own_s) & (beacon >= 0), own_s, turn_around_s)
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
        lever_ping_enu_m=lever_enu_m(t_ping_s, heading, offset_m),
        lever_reply_enu_m=lever_enu_m(t_reply_s, heading, offset_m),
        beacon_enu_m=beacon_enu_m,
        turn_around_s=turn_around_s,
        beacon_sigma_m=beacon_sigma_m,
    )
    return replies, [*_checks(replies), *longest_unseen(field, beacon, answered_ns)]


def _checks(replies: Replies) -> list[Check]:
    with np.errstate(invalid="ignore"):
        disagree_s = np.abs(replies.t_reply_s - replies.t_ping_s - replies.travel_time_s)
        n_disagree = int(np.sum(disagree_s > _DISAGREE_S))
    return [
        count("replies_of_unknown_beacons", int(np.sum(replies.beacon < 0)), "not used"),
        count(
            "replies_heard_before_their_ping",
            int(np.sum(replies.t_reply_s < replies.t_ping_s)),
            "as stamped",
        ),
        count("replies_whose_stamp_is_not_ping_plus_travel_time", n_disagree, "more than 0.1 s"),
    ]


def no_replies() -> Replies:
    """What a dive without acoustics has."""
    whole, real, vector = np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3))
    return Replies(
        ping_id=whole, beacon_id=whole, beacon=whole, t_ping_s=real, t_reply_s=real,
        travel_time_s=real, snr_db=real, depth_ping_m=real, depth_reply_m=real,
        lever_ping_enu_m=vector, lever_reply_enu_m=vector, beacon_enu_m=vector,
        turn_around_s=real, beacon_sigma_m=real,
    )  # fmt: skip


def _rows_of(ids: Int, asked: Int) -> Int:
    """Row of each number among `ids`, -1 where there is none."""
    order = np.argsort(ids)
    row = order[np.clip(np.searchsorted(ids[order], asked), 0, len(order) - 1)]
    return np.asarray(np.where(ids[row] == asked, row, -1))


def count(name: str, value: int, detail: str) -> Check:
    """A number that should be zero."""
    return Check("align", name, value, 0, "messages", value == 0, detail if value else "")


def lever_arm_checks(vehicle: Vehicle) -> list[Check]:
    """What is assumed of the transducer's place where nobody stated it."""
    if vehicle.transducer_offset_m is not None:
        return []
    sigma_m = vehicle.lever_sigma_m
    detail = (
        "no transducer_offset_m under [vehicle] of the settings: the transducer is taken for the "
        f"navigated point, which the 95 % radius believes to {sigma_m:g} m an axis. Turns both "
        "ways show a longer arm; on one circle or a straight line nothing does"
    )
    return [Check("align", "lever_arm_assumed", sigma_m, sigma_m, "m", True, detail)]


def lever_enu_m(t_s: Float, heading: Heading, offset_m: Float) -> Float:
    """Lever arm (n, 3) m, ENU, from the navigated point, with the attitude of each instant."""
    attitude = np.stack([heading.roll_rad, heading.pitch_rad, heading.heading_rad], axis=-1)
    roll_rad, pitch_rad, heading_rad = interpolate(t_s, heading.t_s, attitude).T
    return body_to_enu(np.broadcast_to(offset_m, (len(t_s), 3)), roll_rad, pitch_rad, heading_rad)
