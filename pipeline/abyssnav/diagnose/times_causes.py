# SPDX-License-Identifier: Apache-2.0
"""From the readings of travel times and single ranges to a cause, its size, and what mends it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from abyssnav.diagnose.acoustics import ScoredAssumption
from abyssnav.diagnose.beacon_place import BeaconPlace
from abyssnav.diagnose.cause import Cause, Evidence, Mend
from abyssnav.diagnose.motion_causes import (
    Case,
    clock_offset_cause,
    evidence_among,
    lever_arm_cause,
)
from abyssnav.diagnose.ranges import Suspected
from abyssnav.tables import Beacons, Dive, Float, SoundSpeed

#: Smaller errors than these are what a survey leaves.
_LEAST_BEACON_M, _LEAST_WAIT_MS, _LEAST_SOUND = 2.0, 2.0, 0.004
#: Beacons whose evidence is this near to the likeliest one's cannot be told from it, nats.
_CLOSE_ASSUMPTION, _CLOSE_SUSPECT = 20.0, 5.0
#: Levels of a sound-speed profile that are written out.
_LEVELS = 6
_SOUND_OR_WAIT = "A wrong speed of sound and wrong turn-around times look much the same."
_IN_SETTINGS, _IN_TIMES = "in the settings", "under [travel_time] of the profile"


def acoustic_cause(case: Case, scored: list[ScoredAssumption]) -> Cause | None:
    """Cause that the best reading of the travel times stands for; None when it is as given."""
    if not scored or not scored[0].assumption.name:
        return None
    best = scored[0]
    name, value = best.assumption.name, best.assumption.value
    given = next(s for s in scored if not s.assumption.name)
    evidence = evidence_among(
        [(s.assumption.name, s.log_likelihood) for s in scored], given.log_likelihood
    )
    observed = (
        f"As given, the replies of {100 * given.share:.0f} % of the pings agree on a place; "
        f"{_if(name, value)} {100 * best.share:.0f} %."
    )
    role = {"depth": "depth", "sound_speed": "sound_speed", "beacon_moved": "beacons"}.get(
        name, "travel_time"
    )
    doubt = _SOUND_OR_WAIT if name in ("sound_speed", "turn_around") else ""
    if name == "beacon_moved":
        near = best.log_likelihood - _CLOSE_ASSUMPTION
        close = [s.assumption for s in scored[1:] if s.log_likelihood > near]
        doubt = _one_among([value, *(a.value for a in close if a.name == name)])
    return Cause(role, name, value, evidence, _mend(case.dive, best), observed, doubt)


_IF = {
    "time_one_way": "taken as {0},",
    "turn_around_removed": "with the turn-around put back,",
    "time_unit": "taken in {0},",
    "sound_speed": "with all ranges changed by {0},",
    "turn_around": "with {0} more for every turn-around,",
    "depth": "with the depth taken as {0},",
    "beacon_ids": "with the numbers exchanged ({0}),",
    "beacon_moved": "without beacon {0},",
}


def _if(name: str, value: str) -> str:
    """The assumption in words, before what it explains."""
    if name == "depth" and value not in _DEPTH_LINES:
        sign = "added to" if value.startswith("+") else "subtracted from"
        return f"with {value[1:]} {sign} every depth,"
    return _IF[name].format(value)


_DEPTH_LINES = {
    "positive up": 'depth = { field = "...", scale = -1 }',
    "feet": 'depth = { field = "...", unit = "ft" }',
    "metres given as feet": 'depth = { field = "...", unit = "m" }',
    "tens of metres": 'depth = { field = "...", scale = 10 }',
    "tenths of metres": 'depth = { field = "...", scale = 0.1 }',
    "centimetres": 'depth = { field = "...", unit = "cm" }',
}
#: What stands for times that are a thousand times too short: milliseconds named, seconds logged.
_TOO_SMALL = {"ks": "s"}


def _mend(dive: Dive, best: ScoredAssumption) -> Mend:
    """The line that makes the best reading the one given."""
    value, beacons = best.assumption.value, dive.beacons
    lines: dict[str, Callable[[], Mend]] = {
        "time_one_way": lambda: Mend("one_way = true", _IN_TIMES),
        "turn_around_removed": lambda: Mend('turn_around = "removed"', _IN_TIMES),
        "time_unit": lambda: Mend(
            f'travel_time = {{ field = "...", unit = "{_TOO_SMALL.get(value, value)}" }}', _IN_TIMES
        ),
        "depth": lambda: Mend(_depth_line(value), "under [depth] of the profile"),
        "sound_speed": lambda: sound_speed_mend(dive, float(value.split()[0]) / 100),
        "turn_around": lambda: beacons_mend(
            beacons,
            beacons.position_enu_m,
            beacons.turn_around_s + 1e-3 * float(value.split()[0]),
        ),
        "beacon_ids": lambda: beacons_mend(
            beacons,
            beacons.position_enu_m[list(best.assumption.order)],
            beacons.turn_around_s[list(best.assumption.order)],
        ),
        "beacon_moved": lambda: Mend(
            "",
            f"Check position and turn-around time given for beacon {value}, or leave the beacon "
            "out by listing only the others as [[beacon]] in the settings",
        ),
    }
    return lines[best.assumption.name]()


def _depth_line(value: str) -> str:
    number = value.split(maxsplit=1)[0]
    return _DEPTH_LINES.get(value, f'depth = {{ field = "...", offset = {number} }}')


def sound_speed_mend(dive: Dive, longer: float) -> Mend:
    """The profile in force, slower or faster by what the ranges are too long or short."""
    if dive.water.depth_m is not None:
        mean_mps = float(np.mean(dive.sound_speed.sound_speed_mps))
        line = f"sound_speed_mps = {mean_mps * (1 + longer):.0f}"
        return Mend(line, "under [acoustics] of the settings, or better a measured profile")
    rows = np.unique(np.linspace(0, len(dive.sound_speed) - 1, _LEVELS).astype(int))
    few = dive.sound_speed[rows]
    return Mend(
        f"sound_speed_profile = {_profile_text(few, 1 + longer)}",
        f"{_IN_SETTINGS}, or better a profile measured near the dive",
    )


def _profile_text(profile: SoundSpeed, factor: float) -> str:
    depth = ", ".join(f"{v:.0f}" for v in profile.depth_m.tolist())
    speed = ", ".join(f"{v:.1f}" for v in (factor * profile.sound_speed_mps).tolist())
    return f"{{ depth_m = [{depth}], sound_speed_mps = [{speed}] }}"


def beacons_mend(beacons: Beacons, position_m: Float, turn_around_s: Float) -> Mend:
    """All beacons written out, with other positions or turn-around times."""
    rows = zip(beacons.id.tolist(), position_m.tolist(), turn_around_s.tolist(), strict=True)
    listed = ", ".join(
        f"{{ id = {number}, position_m = [{', '.join(f'{v:.1f}' for v in place)}], "
        f"turn_around_s = {wait_s:.4f} }}"
        for number, place, wait_s in rows
    )
    return Mend(f"beacon = [{listed}]", _IN_SETTINGS)


def _one_among(names: list[str]) -> str:
    """What is not known of which one it is."""
    if len(names) < 2:
        return ""
    return f"The data cannot tell which of beacons {', '.join(names[:-1])} or {names[-1]} it is."


def range_cause(case: Case, scored: list[Suspected]) -> Cause | None:
    """Cause that the likeliest small error of single replies stands for; None without one."""
    if not scored or not scored[0].suspect.name:
        return None
    suspect, value = scored[0].suspect, scored[0].value
    given = next(s.log_likelihood for s in scored if not s.suspect.name)
    evidence = evidence_among([(s.suspect.name, s.log_likelihood) for s in scored], given)
    if suspect.beacon >= 0:
        return _of_one_beacon(case.dive, scored, evidence)
    named: dict[str, Callable[[], Cause | None]] = {
        "lever_arm": lambda: lever_arm_cause(case, value["lever"], evidence),
        "clock_offset": lambda: clock_offset_cause(float(value["clock"][0]), evidence),
        "sound_speed": lambda: _sound_speed(case.dive, float(value["sound"][0]), evidence),
        "turn_around": lambda: common_wait_cause(
            case.dive, 1e-3 * float(value["common_wait"][0]), evidence
        ),
        "beacons": lambda: several_moved_cause(
            case.dive,
            np.array([value[f"beacon_{k}"] for k in range(len(case.dive.beacons))]),
            evidence,
        ),
    }
    # What compass and DVL do is judged by the fixes.
    return named[suspect.name]() if suspect.name in named else None


def _sound_speed(dive: Dive, share: float, evidence: Evidence) -> Cause | None:
    if abs(share) < _LEAST_SOUND:
        return None
    return Cause(
        "sound_speed", "sound_speed", f"{100 * share:+.1f} %", evidence,
        sound_speed_mend(dive, -share),
        f"All ranges are {100 * abs(share):.1f} % too {'long' if share > 0 else 'short'}.",
        _SOUND_OR_WAIT,
    )  # fmt: skip


def common_wait_cause(dive: Dive, late_s: float, evidence: Evidence) -> Cause | None:
    """Replies of all beacons come late or early by one time; None: by little."""
    if abs(late_s) < 1e-3 * _LEAST_WAIT_MS:
        return None
    beacons = dive.beacons
    return Cause(
        "beacons", "turn_around", f"{1e3 * late_s:+.1f} ms", evidence,
        beacons_mend(beacons, beacons.position_enu_m, beacons.turn_around_s + late_s),
        f"The replies of all beacons come {1e3 * abs(late_s):.1f} ms too "
        f"{'late' if late_s > 0 else 'early'}, from near and from far.",
        "It is the turn-around time of all of them, or the receiver's delay. " + _SOUND_OR_WAIT,
    )  # fmt: skip


def several_moved_cause(dive: Dive, moved_m: Float, evidence: Evidence) -> Cause | None:
    """Several beacons (b, 3) lie metres off where they are given; None: by little."""
    far_m = np.hypot(moved_m[:, 0], moved_m[:, 1])
    worst = int(np.argmax(far_m))
    if far_m[worst] < _LEAST_BEACON_M:
        return None
    return Cause(
        "beacons", "beacon_moved", f"up to {far_m[worst]:.1f} m", evidence,
        Mend(f"beacon_sigma_m = {far_m[worst]:.0f}",
             "under [errors] of the settings, where no sigma_m is given for a beacon, or "
             "better let abyssnav calibrate survey the beacons from several dives"),
        f"Several beacons lie metres from where they are given, most of all beacon "
        f"{dive.beacons.id[worst]}, by about {far_m[worst]:.1f} m.",
        "Several seem to; a single one that lies farther off, or wrong turn-around times, would "
        "look much the same.",
    )  # fmt: skip


def _of_one_beacon(dive: Dive, scored: list[Suspected], evidence: Evidence) -> Cause | None:
    best = scored[0]
    row, name = best.suspect.beacon, best.suspect.name
    near = [
        s.suspect for s in scored[1:] if s.log_likelihood > best.log_likelihood - _CLOSE_SUSPECT
    ]
    rivals = dict.fromkeys(s.beacon for s in near if s.beacon not in (row, -1))
    doubt = _one_among([str(dive.beacons.id[k]) for k in (row, *rivals)])
    if name == "turn_around":
        return one_wait_cause(
            dive, row, 1e-3 * float(best.value[f"wait_{row}"][0]), evidence, doubt
        )
    return displaced_cause(dive, row, best.value[f"beacon_{row}"], evidence, doubt)


def one_wait_cause(
    dive: Dive, row: int, late_s: float, evidence: Evidence, doubt: str = ""
) -> Cause | None:
    """One beacon's replies come late or early by one time; None: by little."""
    if abs(late_s) < 1e-3 * _LEAST_WAIT_MS:
        return None
    beacon_id = dive.beacons.id[row]
    wait_s = float(dive.beacons.turn_around_s[row]) + late_s
    return Cause(
        "beacons", "turn_around", f"beacon {beacon_id}: {1e3 * late_s:+.1f} ms", evidence,
        Mend(f"turn_around_s = {wait_s:.4f}", f"for beacon {beacon_id} as [[beacon]] in the "
             "settings, which must then list all beacons"),
        f"Replies of beacon {beacon_id} come {1e3 * abs(late_s):.1f} ms too "
        f"{'late' if late_s > 0 else 'early'} from every side.", doubt,
    )  # fmt: skip


def displaced_cause(
    dive: Dive, row: int, moved_m: Float, evidence: Evidence, doubt: str = ""
) -> Cause | None:
    """One beacon lies (east, north, up) off where it is given; None: by little."""
    far_m = float(np.hypot(*moved_m[:2]))
    if far_m < _LEAST_BEACON_M:
        return None
    beacon_id = dive.beacons.id[row]
    place_m = dive.beacons.position_enu_m[row] + moved_m
    place = ", ".join(f"{v:.1f}" for v in place_m.tolist())
    return Cause(
        "beacons", "beacon_moved", f"beacon {beacon_id}: {far_m:.1f} m", evidence,
        Mend(f"position_m = [{place}]", f"for beacon {beacon_id} as [[beacon]] in the settings, "
             "which must then list all beacons"),
        f"The ranges to beacon {beacon_id} fit one that lies {far_m:.1f} m from where it is "
        f"given, {moved_m[0]:+.1f} m east and {moved_m[1]:+.1f} m north.", doubt,
    )  # fmt: skip


def with_place(dive: Dive, row: int, place: BeaconPlace, cause: Cause) -> Cause:
    """The same cause with where the beacon lies, or how late it answers, by all its replies."""
    if place.place_gain < 0:
        placed = one_wait_cause(dive, row, place.late_s, cause.evidence, cause.doubt)
    else:
        moved_m = np.append(place.moved_m, 0.0)
        placed = displaced_cause(dive, row, moved_m, cause.evidence, cause.doubt)
    if placed is None:
        return cause
    observed = f"{cause.seen} {placed.seen}"
    if placed.name == "beacon_moved":
        observed = f"{observed[:-1]}, give or take {max(2 * place.sigma_m, 0.1):.1f} m."
    return replace(placed, seen=observed)
