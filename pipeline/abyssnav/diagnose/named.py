# SPDX-License-Identifier: Apache-2.0
"""From scores to causes: the name of what won, how large it is, and what mends it."""

from collections.abc import Callable, Mapping

import numpy as np

from abyssnav.diagnose.acoustics import ScoredAssumption
from abyssnav.diagnose.cause import Cause, length
from abyssnav.diagnose.clocks import Apart
from abyssnav.diagnose.course import recorded
from abyssnav.diagnose.motion import Scored
from abyssnav.diagnose.ranges import Suspected
from abyssnav.tables import Dive, Float

#: Smaller errors than these are what instruments do.
_LEAST_TURN_DEG, _LEAST_SCALE, _LEAST_CURRENT_MPS = 6.0, 0.03, 0.03
_LEAST_LEVER_M, _LEAST_CLOCK_S, _LEAST_BEACON_M, _LEAST_WAIT_MS = 1.5, 1.5, 2.0, 2.0
_LEAST_SOUND = 0.004
#: Evidence of what stands in the stamps themselves.
_CERTAIN = 1e6
#: Factors by which units of velocity differ.
_UNITS = {
    0.3048: "feet per second",
    0.514444: "knots",
    0.01: "centimetres per second",
    0.001: "millimetres per second",
    1000.0: "kilometres per second",
    100.0: "hundreds of metres per second",
    1.943844: "metres per second, taken as knots",
    3.28084: "metres per second, taken as feet per second",
    0.277778: "kilometres per hour",
}
_UNIT_TOLERANCE = 0.03


def _runner_up(names: list[tuple[str, float]], winner: str) -> tuple[str, float]:
    """Name and log likelihood of the best one of another name."""
    return next(((n or "as given", ll) for n, ll in names if n != winner), ("as given", -np.inf))


# --- compass and DVL ----------------------------------------------------------------------------


def motion_cause(dive: Dive, scored: list[Scored]) -> Cause | None:
    """Cause that the best reading of compass and DVL stands for; None when all is as given."""
    best = scored[0]
    name = best.reading.name
    if not name:
        return None
    given = next(s.log_likelihood for s in scored if not s.reading.name)
    other, other_ll = _runner_up([(s.reading.name, s.log_likelihood) for s in scored], name)
    evidence = (
        best.log_likelihood - given,
        best.log_likelihood - other_ll,
        _PUBLIC.get(other, other),
    )
    if name in ("turn", "dvl_scale", "dvl_unit"):
        return _turned_or_scaled(dive, best, evidence)
    if name.startswith("heading_"):
        return _heading_read_otherwise(best, evidence)
    named: dict[str, Callable[[], Cause | None]] = {
        "dvl_frame": lambda: _dvl_frame(evidence),
        "water_track": lambda: _water_track(best, evidence),
        "lever_arm": lambda: _lever_arm(best.value["lever"], evidence),
        "clock_offset": lambda: _clock(float(best.value["clock"][0]), evidence),
        "compass_clock": lambda: _compass_clock(best, evidence),
    }
    return named[name]() if name in named else _wandering(name, best, evidence)


_Evidence = tuple[float, float, str]
#: Names of readings that are no cause of the contract by themselves.
_PUBLIC: Mapping[str, str] = {
    "turn": "heading_offset",
    "heading_sense_turn": "heading_sense",
    "compass_clock": "clock_offset",
    "slow_heading": "noise",
    "slow_velocity": "noise",
    "deviation": "noise",
    "heading": "heading_offset",
    "beacons": "beacon_moved",
    "": "as given",
}


def _cause(
    role: str, name: str, value: str, evidence: _Evidence, mend: str, seen: str, doubt: str = ""
) -> Cause:
    gain, ratio, runner_up = evidence
    return Cause(role, name, value, gain, ratio, runner_up, mend, seen, doubt)


def _turned_or_scaled(dive: Dive, best: Scored, evidence: _Evidence) -> Cause | None:
    factor = 1 + float(best.value["scale"][0]) + 1j * float(best.value["turn"][0])
    angle_deg, size = float(np.degrees(np.angle(factor))), float(abs(factor))
    unit = next((u for u in _UNITS if abs(size / u - 1) < _UNIT_TOLERANCE), None)
    course = recorded(dive)
    bow_mps, starboard_mps = float(np.mean(course.bow_mps)), float(np.mean(course.starboard_mps))
    if abs(angle_deg) > 150 and bow_mps < 0:
        return _cause(
            "velocity", "dvl_sign", "reversed", evidence,
            "scale = -1 in the fields of [velocity] of the profile",
            f"The DVL has the vehicle run backwards at {-bow_mps:.1f} m/s, the fixes forwards.",
        )  # fmt: skip
    if abs(angle_deg) > _LEAST_TURN_DEG:
        return _turned(angle_deg, float(np.degrees(np.arctan2(starboard_mps, bow_mps))), evidence)
    seen = f"The fixes run {size:.3g} times as far as the DVL says."
    if unit is not None:
        return _cause(
            "velocity", "dvl_unit", _UNITS[unit], evidence,
            f"scale = {unit:g} in the fields of [velocity] of the profile, or its unit", seen,
        )  # fmt: skip
    if abs(size - 1) < _LEAST_SCALE:
        return None
    return _cause(
        "velocity", "dvl_scale", f"{size:.3f}", evidence,
        f"scale = {size:.3f} in the fields of [velocity] of the profile", seen,
    )  # fmt: skip


def _turned(angle_deg: float, drift_deg: float, evidence: _Evidence) -> Cause:
    """Fixes run counter-clockwise of dead reckoning by an angle: the compass, or the DVL."""
    side = "left" if angle_deg > 0 else "right"
    seen = f"The fixes run {abs(angle_deg):.0f} degrees to the {side} of dead reckoning throughout."
    doubt = "A turned DVL and a turned compass look alike here."
    off_deg = abs((drift_deg - angle_deg + 180) % 360 - 180)
    if off_deg < 0.5 * abs(angle_deg):
        return _cause(
            "velocity", "dvl_mount", f"{-angle_deg:+.0f} deg", evidence,
            f"mount_rpy_deg = [0, 0, {-angle_deg:.0f}] under [velocity] of the profile",
            f"{seen} The DVL has the vehicle run {abs(drift_deg):.0f} degrees off its bow.", doubt,
        )  # fmt: skip
    return _cause(
        "heading", "heading_offset", f"{angle_deg:+.0f} deg", evidence,
        f"declination_deg = {-angle_deg:.0f} under [heading] of the profile", seen, doubt,
    )  # fmt: skip


def _heading_read_otherwise(best: Scored, evidence: _Evidence) -> Cause:
    name = best.reading.name
    factor = 1 + float(best.value["scale"][0]) + 1j * float(best.value["turn"][0])
    angle_deg = float(np.degrees(np.angle(factor)))
    if name == "heading_sense_turn":
        name = "heading_reference" if abs(abs(angle_deg) - 90) < 20 else "heading_sense"
    if name == "heading_unit":
        return _cause(
            "heading", name, "degrees and radians exchanged", evidence,
            'unit = "deg" (or "rad") in the heading of [heading] of the profile',
            "Dead reckoning follows the fixes only with the heading in the other unit.",
        )  # fmt: skip
    if name == "heading_sense":
        return _cause(
            "heading", name, "counter-clockwise", evidence,
            "scale = -1 in the heading of [heading] of the profile",
            "Where the fixes turn left the heading turns right.",
        )  # fmt: skip
    return _cause(
        "heading", name, "from east, counter-clockwise", evidence,
        "scale = -1, offset = 90 (degrees) in the heading of [heading] of the profile",
        "The heading is 90 degrees less the course of the fixes, as an angle from east is.",
    )  # fmt: skip


def _dvl_frame(evidence: _Evidence) -> Cause:
    return _cause(
        "velocity", "dvl_frame", "axes otherwise than given", evidence,
        'under [velocity] of the profile, frame = "flu", "frd", "enu" or "ned" as the driver '
        "has it",
        "Dead reckoning follows the fixes only once the DVL's axes are taken otherwise.",
    )  # fmt: skip


def _compass_clock(best: Scored, evidence: _Evidence) -> Cause | None:
    late_s = -float(best.value["compass_clock"][0])
    if abs(late_s) < _LEAST_CLOCK_S:
        return None
    return _cause(
        "heading", "clock_offset", f"{late_s:+.1f} s", evidence,
        f"latency_s = {late_s:.1f} under [heading] of the profile",
        f"In turns the heading comes {abs(late_s):.1f} s {'late' if late_s > 0 else 'early'}.",
    )  # fmt: skip


def _water_track(best: Scored, evidence: _Evidence) -> Cause | None:
    steady = best.value["current"]
    slow = best.value["slow_current"].reshape(2, -1)
    speed_mps = np.hypot(*(slow + steady[:, None]))
    fastest_mps, share = float(speed_mps.max()), float(np.mean(speed_mps > _LEAST_CURRENT_MPS))
    if fastest_mps < _LEAST_CURRENT_MPS:
        return None
    return _cause(
        "velocity", "water_track", f"{fastest_mps:.2f} m/s", evidence,
        "bottom_track = ... under [velocity] of the profile, the condition by which the driver "
        "tells bottom from water track",
        f"In {100 * share:.0f} % of the dive the fixes drift against dead reckoning, by up to "
        f"{fastest_mps:.2f} m/s, whatever the heading.",
    )  # fmt: skip


def _lever_arm(lever_m: Float, evidence: _Evidence) -> Cause | None:
    forward_m, starboard_m = lever_m[:2].tolist()
    if np.hypot(forward_m, starboard_m) < _LEAST_LEVER_M:
        return None
    return _cause(
        "travel_time", "lever_arm", f"{forward_m:+.1f} m forward, {starboard_m:+.1f} m starboard",
        evidence,
        f"about [{forward_m:.1f}, {starboard_m:.1f}, 0] more in transducer_offset_m = ... under "
        "[vehicle] of the settings",
        f"The replies come from a point {abs(forward_m):.1f} m "
        f"{'ahead of' if forward_m > 0 else 'behind'} and {abs(starboard_m):.1f} m to "
        f"{'starboard' if starboard_m > 0 else 'port'} of the one that dead reckoning moves.",
        "A clock that is wrong by seconds looks much the same.",
    )  # fmt: skip


def _clock(early_s: float, evidence: _Evidence) -> Cause | None:
    """The replies' positions lie `early_s` of way ahead of the vehicle: their stamps are early."""
    late_s = -early_s
    if abs(late_s) < _LEAST_CLOCK_S:
        return None
    return _cause(
        "travel_time", "clock_offset", f"{late_s:+.1f} s", evidence,
        f"latency_s = {late_s:.1f} under [travel_time] of the profile",
        f"The fixes lie where the vehicle was {abs(late_s):.0f} s "
        f"{'before' if late_s > 0 else 'after'}.",
        "A transducer far from the navigated point looks much the same.",
    )  # fmt: skip


def _wandering(name: str, best: Scored, evidence: _Evidence) -> Cause | None:
    if name == "slow_heading":
        most_deg = float(np.degrees(np.abs(best.value["slow_turn"]).max()))
        if most_deg < _LEAST_TURN_DEG:
            return None
        return _cause(
            "heading", "noise", f"{most_deg:.0f} deg", evidence,
            "Look for iron or currents near the compass; use the smoother's track",
            f"The compass wanders by up to {most_deg:.0f} degrees within the dive.",
        )  # fmt: skip
    if name == "deviation":
        most_deg = float(np.degrees(np.hypot(*best.value["deviation_1"])))
        if most_deg < _LEAST_TURN_DEG:
            return None
        return _cause(
            "heading", "noise", f"{most_deg:.0f} deg", evidence,
            "Have the compass swung (its deviation measured) in the vehicle",
            f"The compass is wrong by up to {most_deg:.0f} degrees, depending on the heading.",
        )  # fmt: skip
    most_mps = float(np.abs(best.value["slow_bow"]).max())
    if most_mps < _LEAST_CURRENT_MPS:
        return None
    return _cause(
        "velocity", "noise", f"{most_mps:.2f} m/s", evidence,
        "Check the DVL's log for poor beams; use the smoother's track",
        f"The DVL wanders by up to {most_mps:.2f} m/s along the vehicle's axes.",
    )  # fmt: skip


# --- travel times -------------------------------------------------------------------------------


def acoustic_cause(scored: list[ScoredAssumption]) -> Cause | None:
    """Cause that the best reading of the travel times stands for; None when it is as given."""
    if not scored or not scored[0].assumption.name:
        return None
    best = scored[0]
    name, value = best.assumption.name, best.assumption.value
    given = next(s for s in scored if not s.assumption.name)
    names = [(s.assumption.name, s.log_likelihood) for s in scored]
    other, other_ll = _runner_up(names, name)
    evidence = (best.log_likelihood - given.log_likelihood, best.log_likelihood - other_ll, other)
    seen = (
        f"As given, the replies of {100 * given.share:.0f} % of the pings agree on a place; "
        f"{_IF[name].format(value)} {100 * best.share:.0f} %."
    )
    role = {"depth": "depth", "sound_speed": "sound_speed"}.get(name, "travel_time")
    doubt = ""
    if name in ("sound_speed", "turn_around"):
        doubt = "A wrong speed of sound and wrong turn-around times look much the same."
    if name == "beacon_moved":
        role = "beacons"
        close = [s.assumption for s in scored[1:] if s.log_likelihood > best.log_likelihood - 20]
        others = [a.value for a in close if a.name == name]
        doubt = f"It is one of beacons {', '.join([value, *others])}." if others else ""
    return _cause(role, name, value, evidence, _MEND[name].format(value), seen, doubt)


_IF = {
    "time_one_way": "taken as {0},",
    "turn_around_removed": "with the turn-around put back,",
    "time_unit": "taken as {0},",
    "sound_speed": "with ranges changed by {0},",
    "turn_around": "with turn-around times changed by {0},",
    "depth": "with the depth taken as {0},",
    "beacon_ids": "if beacon {0},",
    "beacon_moved": "without beacon {0},",
}
_MEND = {
    "time_one_way": "one_way = true under [travel_time] of the profile",
    "turn_around_removed": 'turn_around = "removed" under [travel_time] of the profile',
    "time_unit": 'unit = "{0}" in the travel_time of [travel_time] of the profile',
    "sound_speed": "a measured profile in the settings as [sound_speed_profile], or the right "
    "sound_speed_mps = ... under [acoustics] (now wrong by about {0})",
    "turn_around": "turn_around_s = ... of each [[beacon]] in the settings (longer by about {0})",
    "depth": "the right unit or scale = ... in the depth of [depth] of the profile ({0})",
    "beacon_ids": "id = ... of each [[beacon]] in the settings as they answer ({0})",
    "beacon_moved": "the right position_m = ... of beacon {0} as [[beacon]] in the settings, or "
    "leave it out",
}


def range_cause(dive: Dive, scored: list[Suspected]) -> Cause | None:
    """Cause that the likeliest small error of single replies stands for; None without one."""
    if not scored or not scored[0].suspect.name:
        return None
    best = scored[0]
    suspect, value = best.suspect, best.value
    given = next(s.log_likelihood for s in scored if not s.suspect.name)
    names = [(s.suspect.name, s.log_likelihood) for s in scored]
    other, other_ll = _runner_up(names, suspect.name)
    evidence = (
        best.log_likelihood - given,
        best.log_likelihood - other_ll,
        _PUBLIC.get(other, other),
    )
    if suspect.beacon >= 0:
        return _of_one_beacon(dive, scored, evidence)
    named: dict[str, Callable[[], Cause | None]] = {
        "lever_arm": lambda: _lever_arm(value["lever"], evidence),
        "clock_offset": lambda: _clock(float(value["clock"][0]), evidence),
        "sound_speed": lambda: _sound_speed(float(value["sound"][0]), evidence),
        "turn_around": lambda: _common_wait(float(value["common_wait"][0]), evidence),
        "beacons": lambda: _all_beacons(dive, value, evidence),
    }
    # What compass and DVL do is judged by the fixes.
    return named[suspect.name]() if suspect.name in named else None


def _sound_speed(share: float, evidence: _Evidence) -> Cause | None:
    if abs(share) < _LEAST_SOUND:
        return None
    return _cause(
        "sound_speed", "sound_speed", f"{100 * share:+.1f} %", evidence,
        _MEND["sound_speed"].format(f"{100 * share:+.1f} %"),
        f"All ranges are {100 * abs(share):.1f} % too {'long' if share > 0 else 'short'}.",
        "A wrong speed of sound and wrong turn-around times look much the same.",
    )  # fmt: skip


def _common_wait(late_ms: float, evidence: _Evidence) -> Cause | None:
    if abs(late_ms) < _LEAST_WAIT_MS:
        return None
    return _cause(
        "beacons", "turn_around", f"{late_ms:+.1f} ms", evidence,
        f"turn_around_s = ... of each [[beacon]] in the settings, longer by {late_ms:+.1f} ms",
        f"The replies of all beacons come {abs(late_ms):.1f} ms too "
        f"{'late' if late_ms > 0 else 'early'}, near and far.",
        "A wrong speed of sound looks much the same.",
    )  # fmt: skip


def _all_beacons(dive: Dive, value: Mapping[str, Float], evidence: _Evidence) -> Cause | None:
    moved_m = [float(np.linalg.norm(value[f"beacon_{k}"][:2])) for k in range(len(dive.beacons))]
    if max(moved_m) < _LEAST_BEACON_M:
        return None
    worst = int(np.argmax(moved_m))
    return _cause(
        "beacons", "beacon_moved", f"up to {moved_m[worst]:.1f} m", evidence,
        "Survey the beacons again (beacons.parquet holds where the smoother puts them), or put "
        "sigma_m = ... of each [[beacon]] in the settings as large as that",
        f"Several beacons lie metres from where they are given, beacon {dive.beacons.id[worst]} "
        f"by {moved_m[worst]:.1f} m.",
    )  # fmt: skip


def _of_one_beacon(dive: Dive, scored: list[Suspected], evidence: _Evidence) -> Cause | None:
    best = scored[0]
    row, name = best.suspect.beacon, best.suspect.name
    near = [s.suspect for s in scored[1:] if s.log_likelihood > best.log_likelihood - 5]
    rivals = list(dict.fromkeys(s.beacon for s in near if s.beacon not in (row, -1)))
    doubt = ""
    if rivals:
        names = ", ".join(str(dive.beacons.id[k]) for k in (row, *rivals))
        doubt = f"The data cannot tell which one of beacons {names} it is."
    beacon_id = dive.beacons.id[row]
    if name == "turn_around":
        late_ms = float(best.value[f"wait_{row}"][0])
        if abs(late_ms) < _LEAST_WAIT_MS:
            return None
        wait_s = float(dive.beacons.turn_around_s[row]) + 1e-3 * late_ms
        return _cause(
            "beacons", name, f"beacon {beacon_id}: {late_ms:+.1f} ms", evidence,
            f"turn_around_s = {wait_s:.4f} of beacon {beacon_id} as [[beacon]] in the settings",
            f"Replies of beacon {beacon_id} come {abs(late_ms):.1f} ms too "
            f"{'late' if late_ms > 0 else 'early'} from every side.", doubt,
        )  # fmt: skip
    moved_m = best.value[f"beacon_{row}"]
    far_m = float(np.hypot(*moved_m[:2]))
    if far_m < _LEAST_BEACON_M:
        return None
    place = ", ".join(f"{v:.1f}" for v in (dive.beacons.position_enu_m[row] + moved_m).tolist())
    return _cause(
        "beacons", name, f"beacon {beacon_id}: {far_m:.1f} m", evidence,
        f"position_m = [{place}] of beacon {beacon_id} as [[beacon]] in the settings",
        f"The ranges to beacon {beacon_id} fit one that lies {far_m:.1f} m from where it is "
        f"given, {moved_m[0]:+.1f} m east and {moved_m[1]:+.1f} m north.", doubt,
    )  # fmt: skip


# --- clocks -------------------------------------------------------------------------------------


def apart_cause(apart: Apart, offset_s: float) -> Cause:
    """Replies and velocities that were not recorded at the same time."""
    direction = "later" if offset_s < 0 else "earlier"
    return Cause(
        "travel_time", "no_overlap", f"{-offset_s:+.0f} s", _CERTAIN, _CERTAIN, "as given",
        f"latency_s = {-offset_s:.0f} under [travel_time] of the profile",
        f"Replies and DVL velocities share only {100 * apart.overlap:.0f} % of the time of the "
        f"replies; the replies' stamps are {length(abs(offset_s))} {direction}.",
    )  # fmt: skip


def clock_cause(offset_s: float) -> Cause:
    """Replies stamped in another time zone that still share part of the dive's time."""
    direction = "late" if offset_s < 0 else "early"
    return Cause(
        "travel_time", "clock_offset", f"{-offset_s:+.0f} s", _CERTAIN, _CERTAIN,
        "as given",
        f"latency_s = {-offset_s:.0f} under [travel_time] of the profile",
        f"Fixes and dead reckoning fit each other once the replies' stamps, "
        f"{length(abs(offset_s))} {direction}, are put right.",
    )  # fmt: skip
