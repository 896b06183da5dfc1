# SPDX-License-Identifier: Apache-2.0
"""Sensors on one clock: sorted, judged, brought to each other's instants."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from abyssnav.align.beacons import DEEPEST_M
from abyssnav.align.replies import count
from abyssnav.errors import ClockError, SolveError
from abyssnav.geometry import depth_of_pressure, enu_to_body, interpolate
from abyssnav.profile import SENSORS
from abyssnav.tables import (
    Bool,
    Check,
    Columns,
    Depth,
    Float,
    Heading,
    Int,
    Log,
    Origin,
    Velocity,
)

#: Stamps beyond a day in which nothing at all was recorded are not of this dive: unset, or 1970.
_LONGEST_SILENCE_NS = 86_400_000_000_000
#: So many messages in a row at most that lie by this outside the time of those recorded around
#: them are stamped wrongly, as long as no more, or no larger share of all, do: they would draw the
#: dive out.
_ALONE, _ALONE_SHARE, _OUTSIDE_NS = 4, 0.01, 60_000_000_000
#: Messages may be this many periods apart before it counts as a gap.
_GAP_PERIODS = 5.0
#: No underwater vehicle is faster: a reading that says so is none.
_FASTEST_MPS = 30.0
#: No vehicle that navigates by beacons is higher above the sea, and no depth is beyond this.
_ABOVE_M, _NO_DEPTH_M = 20.0, 1e9
#: A sensor may be silent for so long between first and last reply before it counts as lost.
_LOST_S = 60.0
#: Attitude is differenced over this time, to turn a lever arm: its noise is that of angles.
_RATE_OVER_S = 1.0
#: Where nothing tells: the depth of 6,000 m is 15 m wrong at the equator, and at a pole.
_LATITUDE_DEG = 45.0
#: A smaller share of values than this is left out where it is of no sea.
_FEW = 0.1


@dataclass(frozen=True)
class Synchronized:
    """The roles on one clock."""

    start_ns: int
    roles: dict[str, Columns]
    checks: list[Check]

    @property
    def first_heard_ns(self) -> int:
        """When anything of the outside was heard first: a reply, else a position."""
        role = "travel_time" if "travel_time" in self.roles else "position"
        return int(self.roles[role]["time_ns"].min())


def synchronize(log: Log) -> Synchronized:
    """Start of the dive, and its roles in order, without doubles and foreign stamps.

    Required are heading, velocity, depth, and travel times or positions.

    Raises
    ------
    SolveError
        A required role without messages.
    ClockError
        A required role without a stamp of this dive.
    """
    alone = "travel_time" not in log.roles and "position" in log.roles
    required = (*SENSORS, "position" if alone else "travel_time")
    for role in required:
        if role not in log.roles or not len(log.roles[role]["time_ns"]):
            where = log.topics.get(role, "any topic")
            raise SolveError(
                f"{log.name}: no messages on {where} ({role}) by profile {log.profile}; "
                "abyssnav inspect shows what is there and proposes a profile"
            )
    first_ns, last_ns = _span([log.roles[role]["time_ns"] for role in required])
    ordered, checks = dict[str, Columns](), list[Check]()
    for role in (*required, *(r for r in ("position", "altitude") if r in log.roles)):
        if role in ordered:
            continue
        slack_ns = 0 if role in required else _LONGEST_SILENCE_NS
        columns = log.roles[role]
        span_ns = (first_ns - slack_ns, last_ns + slack_ns)
        if role not in required and not _inside(columns["time_ns"], span_ns).any():
            detail = f"{log.topics[role]}: no stamp is of this dive: left out"
            checks.append(count(f"{role}_foreign_stamps", len(columns["time_ns"]), detail))
            continue
        ordered[role], more = _in_order(role, columns, span_ns, log)
        checks += more
    start_ns = min(int(ordered[role]["time_ns"][0]) for role in required)
    return Synchronized(start_ns, ordered, checks)


def _inside(time_ns: Int, span_ns: tuple[int, int]) -> Bool:
    return (time_ns >= span_ns[0]) & (time_ns <= span_ns[1])


def _span(stamps_ns: Sequence[Int]) -> tuple[int, int]:
    """First and last stamp of the stretch without a long silence that holds most messages."""
    every_ns = np.sort(np.concatenate(stamps_ns), kind="stable")  # quick where parts are sorted
    silent = np.flatnonzero(np.diff(every_ns) > _LONGEST_SILENCE_NS)
    begin, end = np.concatenate([[0], silent + 1]), np.concatenate([silent, [len(every_ns) - 1]])
    longest = np.argmax(end - begin)
    return int(every_ns[begin[longest]]), int(every_ns[end[longest]])


def _in_order(
    role: str, columns: Columns, span_ns: tuple[int, int], log: Log
) -> tuple[Columns, list[Check]]:
    """Rows of one role sorted by stamp; what was wrong with them as checks."""
    time_ns = columns["time_ns"]
    near = _inside(time_ns, span_ns)
    if "ping_time_ns" in columns:
        near &= np.abs(columns["ping_time_ns"] - time_ns) < _LONGEST_SILENCE_NS
    if not near.any():
        first = np.datetime64(int(time_ns[0]), "ns").astype("datetime64[s]")
        pings = ' (with ping_time = "", or the pings stay)' if "ping_time_ns" in columns else ""
        raise ClockError(
            f"{log.name}: every stamp on {log.topics[role]} lies more than a day from the others' "
            f"or from its ping's; the first says {first}: are field and unit of its time right? "
            f'time = "log_time"{pings} in the profile takes the recorder\'s'
        )
    near[near] = ~_alone(time_ns[near])
    late = int(np.sum(np.diff(time_ns[near]) < 0))
    order = np.flatnonzero(near)
    order = order[np.argsort(time_ns[order], kind="stable")] if late else order
    doubled = np.zeros(len(order), dtype=bool)
    if role in SENSORS:  # replies of one instant are different replies
        doubled[1:] = np.diff(time_ns[order]) == 0
    odd = late or doubled.any() or not near.all()
    kept = {name: c[order[~doubled]] if odd else c for name, c in columns.items()}
    where = log.topics[role]
    checks = [
        count(f"{role}_foreign_stamps", int(np.sum(~near)), f"{where}: left out"),
        count(f"{role}_out_of_order", late, f"{where}: sorted by stamp"),
        count(f"{role}_repeated_stamps", int(doubled.sum()), f"{where}: the first is kept"),
    ]
    if role in SENSORS:
        checks.append(_largest_gap(role, kept["time_ns"], where))
    return kept, checks


def _alone(time_ns: Int) -> Bool:
    """Few stamps (n,), in the order recorded, far outside what the running median of all spans."""
    if not np.any(np.diff(time_ns) < 0):
        return np.zeros(len(time_ns), bool)
    around_ns = sliding_window_view(np.pad(time_ns, _ALONE, "edge"), 2 * _ALONE + 1)
    usual_ns = np.partition(around_ns, _ALONE, axis=1)[:, _ALONE]
    alone = ~_inside(time_ns, (usual_ns.min() - _OUTSIDE_NS, usual_ns.max() + _OUTSIDE_NS))
    return np.asarray(alone & (alone.sum() <= max(_ALONE, _ALONE_SHARE * len(time_ns))))


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
    return kept, count(f"{role}_not_finite", lost, f"{where}: left out")


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
        with np.errstate(invalid="ignore", over="ignore"):  # wild pressures are no depth, below
            depth_m = depth_of_pressure(columns["pressure_dbar"], latitude_deg)
        columns = {"time_ns": columns["time_ns"], "depth_m": depth_m}
        known = origin is not None
        detail = f"{where}: the origin's" if known else f"{where}: taken, as none is known"
        checks.append(
            Check("align", "depth_latitude", latitude_deg, 90.0, "degrees", known, detail)
        )
    depth_m = np.asarray(columns["depth_m"], dtype=float)
    columns = {**columns, "depth_m": np.where(np.abs(depth_m) < _NO_DEPTH_M, depth_m, np.nan)}
    kept, check = _finite(columns, ["depth_m"], "depth", log)
    depth_m = np.asarray(kept["depth_m"], dtype=float)
    odd = (depth_m < -_ABOVE_M) | (depth_m > DEEPEST_M)
    share = float(np.mean(odd))
    spread = f"{depth_m.min():,.0f} to {depth_m.max():,.0f} m"
    detail = f"{where}: {spread}; are unit and sign right?"
    if 0 < share < _FEW:  # single wild values are no depth; many are of another unit
        kept = {name: column[~odd] for name, column in kept.items()}
        depth_m, detail = depth_m[~odd], f"{where}: {spread}; {int(odd.sum())} left out"
    checks += [
        check,
        Check("align", "depth_of_no_sea", share, 0.0, "", share == 0, detail if share else ""),
    ]
    return Depth(_seconds(kept, start_ns), depth_m), checks


def velocity_of(
    columns: Columns, start_ns: int, heading: Heading, log: Log
) -> tuple[Velocity, list[Check]]:
    """Velocity of the navigated point at its own times with the attitude of those.

    Vectors of the earth's frame are turned into the vehicle's; with a lever arm the instrument's
    own motion about the point is taken off.  What is beyond any vehicle is not valid.
    """
    t_s = _seconds(columns, start_ns)
    attitude = interpolate(t_s, heading.t_s, _angles(heading))
    roll_rad, pitch_rad, heading_rad = attitude.T
    if "velocity_enu_mps" in columns:
        enu_mps = np.asarray(columns["velocity_enu_mps"], dtype=float)
        body_mps = enu_to_body(enu_mps, roll_rad, pitch_rad, heading_rad)
    else:
        body_mps = np.asarray(columns["velocity_body_mps"], dtype=float)
    slow_mps = np.abs(np.nan_to_num(body_mps, nan=np.inf)) < _FASTEST_MPS
    valid = np.asarray(columns["valid"], dtype=bool) & np.all(slow_mps, axis=1)
    where = log.topics["velocity"]
    if not valid.any():
        fast = int(np.sum(np.any(np.abs(np.nan_to_num(body_mps)) >= _FASTEST_MPS, axis=1)))
        hint = (
            f"; {fast} are faster than {_FASTEST_MPS:.0f} m/s: is the unit right?" if fast else ""
        )
        raise SolveError(f"{log.name}: no valid velocity on {where} (velocity){hint}")
    if "offset_m" in columns:
        rate_rad_s = angular_rate(t_s, heading)
        body_mps = body_mps - np.cross(rate_rad_s, columns["offset_m"][0])
    velocity = Velocity(
        t_s=t_s,
        velocity_body_mps=np.where(valid[:, None], body_mps, 0.0),
        valid=valid,
        roll_rad=roll_rad,
        pitch_rad=pitch_rad,
        heading_rad=heading_rad,
    )
    return velocity, _velocity_checks(velocity, heading, columns, where)


def _velocity_checks(
    velocity: Velocity, heading: Heading, columns: Columns, where: str
) -> list[Check]:
    t_s, valid = velocity.t_s, velocity.valid
    outside = float(np.mean((t_s < heading.t_s[0]) | (t_s > heading.t_s[-1])))
    lost = float(np.mean(~valid))
    longest_s = _longest_loss(t_s, valid)
    checks = [
        Check("align", "velocity_without_bottom_lock", lost, 0.05, "", lost <= 0.05,
              f"{where}: bridged with the last good velocity" if lost else ""),
        Check("align", "velocity_longest_loss", longest_s, 60.0, "s", longest_s <= 60.0, where),
        Check("align", "velocity_outside_heading", outside, 0.01, "", outside <= 0.01,
              f"{where}: the nearest heading is held" if outside else ""),
    ]  # fmt: skip
    if "water_track" in columns:
        water = float(np.mean(columns["water_track"]))
        detail = f"{where}: through the water, not over ground: left out" if water else ""
        checks.append(
            Check("align", "velocity_of_water_track", water, 0.05, "", water <= 0.05, detail)
        )
    return checks


def _angles(heading: Heading) -> Float:
    return np.stack([heading.roll_rad, heading.pitch_rad, heading.heading_rad], axis=-1)


def angular_rate(t_s: Float, heading: Heading) -> Float:
    """Rate of turn (n, 3) rad/s about forward, starboard, down, from differences of the attitude.

        p = φ' - ψ' sin θ,  q = θ' cos φ + ψ' sin φ cos θ,  r = ψ' cos φ cos θ - θ' sin φ

    Over a second, so that noise of the angles does not become speed.
    """
    half_s = 0.5 * _RATE_OVER_S
    begin_s = np.clip(t_s - half_s, heading.t_s[0], heading.t_s[-1])
    end_s = np.clip(t_s + half_s, heading.t_s[0], heading.t_s[-1])
    angles = _angles(heading)
    turned = interpolate(end_s, heading.t_s, angles) - interpolate(begin_s, heading.t_s, angles)
    rates = turned / np.maximum(end_s - begin_s, 1e-3)[:, None]
    roll_rate, pitch_rate, heading_rate = rates.T
    roll_rad, pitch_rad, _ = interpolate(t_s, heading.t_s, angles).T
    return np.stack(
        [
            roll_rate - heading_rate * np.sin(pitch_rad),
            pitch_rate * np.cos(roll_rad) + heading_rate * np.sin(roll_rad) * np.cos(pitch_rad),
            heading_rate * np.cos(roll_rad) * np.cos(pitch_rad) - pitch_rate * np.sin(roll_rad),
        ],
        axis=-1,
    )


def losses(dive_s: tuple[float, float], sensors: dict[str, Float], log: Log) -> list[Check]:
    """Longest time that each sensor is silent between the first and the last reply, its ends too.

    A sensor that ends before the last reply is lost as one with a gap in the middle is.

    Parameters
    ----------
    dive_s : first and last reply, or position fix
    sensors : times of each role's good messages, sorted
    """
    checks = []
    for role, t_s in sensors.items():
        inside_s = t_s[(t_s > dive_s[0]) & (t_s < dive_s[1])]
        ends_s = np.concatenate([dive_s[:1], inside_s, dive_s[1:]])
        silence_s = np.diff(ends_s)
        which = int(np.argmax(silence_s))
        longest_s, began_s = float(silence_s[which]), float(ends_s[which])
        ok = longest_s <= _LOST_S
        detail = f"{log.topics[role]}: nothing for {longest_s:.0f} s from {began_s:.0f} s on"
        checks.append(
            Check("align", f"{role}_lost", longest_s, _LOST_S, "s", ok, "" if ok else detail)
        )
    return checks


def floor_of(roles: Mapping[str, Columns], start_ns: int, depth: Depth) -> Depth | None:
    """Depth of the floor below the vehicle: its own and the altitude; None without any.

    The altitude is the DVL's, or of its own role where the DVL's message has none.
    """
    for role in ("velocity", "altitude"):
        columns = roles.get(role, {})
        altitude_m = np.asarray(columns.get("altitude_m", np.zeros(0)), dtype=float)
        known = np.isfinite(altitude_m)
        if known.any():
            t_s = _seconds(columns, start_ns)[known]
            return Depth(t_s, interpolate(t_s, depth.t_s, depth.depth_m) + altitude_m[known])
    return None


def _longest_loss(t_s: Float, valid: np.ndarray) -> float:
    """Longest time between two good velocities."""
    good_s = np.concatenate([t_s[:1], t_s[valid], t_s[-1:]])
    return float(np.max(np.diff(good_s)))
