# SPDX-License-Identifier: Apache-2.0
"""From the readings of compass and DVL to a cause: its name, its size, and what mends it."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from abyssnav.config import Config
from abyssnav.diagnose.cause import REPLIES_CLOCK, Cause, Evidence, Mend
from abyssnav.diagnose.course import recorded
from abyssnav.diagnose.motion import Scored
from abyssnav.tables import Dive, Float

#: Smaller errors than these are what instruments do.
LEAST_TURN_DEG = 6.0
_LEAST_SCALE, _LEAST_CURRENT_MPS = 0.03, 0.03
_LEAST_LEVER_M, _LEAST_CLOCK_S = 1.5, 1.5
#: No vehicle that logs such dives is so long: an arm beyond, along the bow, is a lateness.
_MOST_LEVER_M, _ALONG_BOW = 7.0, 0.3
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
#: What is seen is beside what the profile has already.
_ADDED = "(plus what stands there already, if anything)"
#: Names of readings that are no cause of the contract by themselves.
_PUBLIC: Mapping[str, str] = {
    "turn": "heading_offset",
    "heading_sense_turn": "heading_sense",
    "compass_clock": "clock_offset",
    "dvl_clock": "clock_offset",
    "slow_heading": "noise",
    "slow_velocity": "noise",
    "deviation": "noise",
    "heading": "heading_offset",
    "beacons": "beacon_moved",
    "": "as given",
}


class Case(NamedTuple):
    """What is looked into, and the settings that it was read by."""

    dive: Dive
    config: Config


def evidence_among(names: Sequence[tuple[str, float]], given: float) -> Evidence:
    """What the first name wins by: over everything as given, and over the best other name.

    Parameters
    ----------
    names : name and log likelihood of all, the best first
    given : log likelihood of everything being as given
    """
    winner, best = names[0]
    other, runner_up = next((one for one in names if one[0] != winner), ("", -np.inf))
    return Evidence(best - given, best - runner_up, _PUBLIC.get(other, other))


def motion_cause(case: Case, scored: list[Scored]) -> Cause | None:
    """Cause that the best reading of compass and DVL stands for; None when all is as given."""
    best = scored[0]
    name = best.reading.name
    if not name:
        return None
    given = next(s.log_likelihood for s in scored if not s.reading.name)
    evidence = evidence_among([(s.reading.name, s.log_likelihood) for s in scored], given)
    if name in ("turn", "dvl_scale", "dvl_unit"):
        return _turned_or_scaled(case, best, evidence)
    if name.startswith("heading_"):
        return _heading_read_otherwise(best, evidence)
    named: dict[str, Callable[[], Cause | None]] = {
        "dvl_frame": lambda: _dvl_frame(best.reading.value, evidence),
        "water_track": lambda: _water_track(best, evidence),
        "lever_arm": lambda: lever_arm_cause(case, best.value["lever"], evidence),
        "clock_offset": lambda: clock_offset_cause(float(best.value["clock"][0]), evidence),
        "compass_clock": lambda: _compass_clock(best, evidence),
        "slow_heading": lambda: _wandering_compass(best, evidence),
        "deviation": lambda: _deviation(best, evidence),
        "slow_velocity": lambda: _wandering_dvl(best, evidence),
    }
    return named[name]()


def _factor(best: Scored) -> complex:
    """By what dead reckoning must be turned (argument) and stretched (size) to fit the fixes."""
    return complex(1 + float(best.value["scale"][0]) + 1j * float(best.value["turn"][0]))


def _turned_or_scaled(case: Case, best: Scored, evidence: Evidence) -> Cause | None:
    factor = _factor(best)
    angle_deg, size = float(np.degrees(np.angle(factor))), float(abs(factor))
    bow_mps = float(np.mean(recorded(case.dive).bow_mps))
    if abs(angle_deg) > 150 and bow_mps < 0:
        return Cause(
            "velocity", "dvl_sign", "reversed", evidence,
            Mend("scale = -1", "in the forward and sideways fields of [velocity] of the profile"),
            f"By the DVL the vehicle runs backwards at {-bow_mps:.1f} m/s; the fixes run forwards.",
        )  # fmt: skip
    if abs(angle_deg) > LEAST_TURN_DEG:
        return turned_cause(case, angle_deg, evidence)
    return scaled_cause(size, evidence)


def scaled_cause(size: float, evidence: Evidence) -> Cause | None:
    """The DVL's way must be stretched by a factor; None: by little."""
    unit = next((u for u in _UNITS if abs(size / u - 1) < _UNIT_TOLERANCE), None)
    times = f"{size:,.0f}" if size >= 100 else f"{size:.3g}"
    observed = f"The way between the fixes is {times} times as long as the DVL's."
    where = "in the fields of [velocity] of the profile"
    if unit is not None:
        mend = Mend(f"scale = {unit:g}", f"{where}, or name the unit there")
        return Cause("velocity", "dvl_unit", _UNITS[unit], evidence, mend, observed)
    if abs(size - 1) < _LEAST_SCALE:
        return None
    mend = Mend(f"scale = {size:.3f}", where)
    return Cause("velocity", "dvl_scale", f"{size:.3f}", evidence, mend, observed)


def turned_cause(case: Case, angle_deg: float, evidence: Evidence) -> Cause:
    """Fixes run counter-clockwise of dead reckoning by an angle: the compass, or the DVL."""
    course = recorded(case.dive)
    bow_mps, starboard_mps = float(np.mean(course.bow_mps)), float(np.mean(course.starboard_mps))
    drift_deg = float(np.degrees(np.arctan2(starboard_mps, bow_mps)))
    side = "left" if angle_deg > 0 else "right"
    observed = (
        f"The fixes run {abs(angle_deg):.0f} degrees to the {side} of dead reckoning throughout."
    )
    off_deg = abs((drift_deg - angle_deg + 180) % 360 - 180)
    if off_deg < 0.5 * abs(angle_deg):
        return Cause(
            "velocity", "dvl_mount", f"{-angle_deg:+.0f} deg", evidence,
            Mend(f"mount_rpy_deg = [0, 0, {-angle_deg:.0f}]", "under [velocity] of the profile"),
            f"{observed} By the DVL the vehicle runs {abs(drift_deg):.0f} degrees off its bow.",
            "A compass that reads a constant angle wrong would look the same.",
        )  # fmt: skip
    return Cause(
        "heading", "heading_offset", f"{angle_deg:+.0f} deg", evidence,
        Mend(f"declination_deg = {-angle_deg:.0f}", f"under [heading] of the profile {_ADDED}"),
        observed,
        "A DVL that sits turned on its mount would look the same.",
    )  # fmt: skip


def _heading_read_otherwise(best: Scored, evidence: Evidence) -> Cause:
    name = best.reading.name
    angle_deg = float(np.degrees(np.angle(_factor(best))))
    if name == "heading_sense_turn":
        name = "heading_reference" if abs(abs(angle_deg) - 90) < 20 else "heading_sense"
    quaternion = (
        "in the profile; where the heading comes as a quaternion, put the other one of "
        'frame = "enu_flu" and frame = "ned_frd" there'
    )
    if name == "heading_unit":
        return Cause(
            "heading", name, "degrees and radians exchanged", evidence,
            Mend(f'heading = {{ field = "...", unit = "{best.reading.value}" }}',
                 "under [heading] of the profile"),
            "Dead reckoning follows the fixes only with the heading in the other unit.",
        )  # fmt: skip
    if name == "heading_sense":
        return Cause(
            "heading", name, "counter-clockwise", evidence,
            Mend('heading = { field = "...", scale = -1 }', f"under [heading] {quaternion}"),
            "Where the fixes turn to the left the heading turns to the right.",
        )  # fmt: skip
    return Cause(
        "heading", name, "from east, counter-clockwise", evidence,
        Mend(
            'heading = { field = "...", unit = "deg", scale = -1, offset = 90 }',
            f"under [heading] {quaternion}",
        ),
        "The heading is 90 degrees less the course of the fixes, as an angle from east is.",
    )  # fmt: skip


def _dvl_frame(frame: str, evidence: Evidence) -> Cause:
    where = "under [velocity] of the profile"
    if not frame:
        frame, where = "frd", f'{where} ("flu" where "frd" stands now)'
    return Cause(
        "velocity", "dvl_frame", frame, evidence, Mend(f'frame = "{frame}"', where),
        "Dead reckoning follows the fixes only once the DVL's axes are taken otherwise.",
    )  # fmt: skip


def _water_track(best: Scored, evidence: Evidence) -> Cause | None:
    steady = best.value["current"]
    slow = best.value["slow_current"].reshape(2, -1)
    speed_mps = np.hypot(*(slow + steady[:, None]))
    fastest_mps, share = float(speed_mps.max()), float(np.mean(speed_mps > _LEAST_CURRENT_MPS))
    if fastest_mps < _LEAST_CURRENT_MPS:
        return None
    return water_track_cause(
        f"{fastest_mps:.2f} m/s", evidence,
        f"In {100 * share:.0f} % of the dive the fixes drift against dead reckoning, by up to "
        f"{fastest_mps:.2f} m/s, whatever the heading.",
    )  # fmt: skip


def water_track_cause(value: str, evidence: Evidence, observed: str) -> Cause:
    """The DVL lost the floor and went on against the water."""
    return Cause(
        "velocity", "water_track", value, evidence,
        Mend(
            'bottom_track = { field = "...", equals = true }',
            "under [velocity] of the profile, with the field by which the driver tells bottom "
            "track from water track",
            "If the log has no such field, use the smoother's track, which follows the current.",
        ),
        observed,
    )  # fmt: skip


def lever_arm_cause(case: Case, lever_m: Float, evidence: Evidence) -> Cause | None:
    """The replies come from off the navigated point, or late where no vehicle is so long.

    None: by little.
    """
    forward_m, starboard_m = lever_m[:2].tolist()
    if np.hypot(forward_m, starboard_m) < _LEAST_LEVER_M:
        return None
    if abs(forward_m) > _MOST_LEVER_M and abs(starboard_m) < _ALONG_BOW * abs(forward_m):
        return clock_offset_cause(forward_m / _speed(case), evidence)
    now_m = case.config.vehicle.lever_arm_m
    x, y, z = now_m[0] + forward_m, now_m[1] + starboard_m, now_m[2]
    return Cause(
        "travel_time", "lever_arm", f"{forward_m:+.1f} m forward, {starboard_m:+.1f} m starboard",
        evidence,
        Mend(
            f"transducer_offset_m = [{x:.1f}, {y:.1f}, {z:.1f}]",
            "(forward, starboard, down; better: as measured on the vehicle) under [vehicle] of the "
            "settings",
        ),
        f"The replies come from a point {abs(forward_m):.1f} m "
        f"{'ahead of' if forward_m > 0 else 'behind'} and {abs(starboard_m):.1f} m to "
        f"{'starboard' if starboard_m > 0 else 'port'} of where the settings put the transducer.",
        _arm_or_clock(case, forward_m),
    )  # fmt: skip


def _arm_or_clock(case: Case, forward_m: float) -> str:
    """What looks like an arm forward at a steady speed: late or early stamps."""
    apart_s = abs(forward_m) / _speed(case)
    if apart_s < 0.5:
        return ""
    replies, compass = ("early", "late") if forward_m > 0 else ("late", "early")
    return (
        f"At a steady speed, replies stamped {apart_s:.1f} s too {replies} or a heading stamped "
        f"{apart_s:.1f} s too {compass} look the same: the data cannot tell."
    )


def _speed(case: Case) -> float:
    return max(float(np.median(np.abs(recorded(case.dive).bow_mps))), 0.1)


def clock_offset_cause(early_s: float, evidence: Evidence) -> Cause | None:
    """The replies' positions lie `early_s` of way ahead of the vehicle; None: by little."""
    late_s = -early_s
    if abs(late_s) < _LEAST_CLOCK_S:
        return None
    return Cause(
        "travel_time", "clock_offset", f"{late_s:+.1f} s", evidence,
        Mend(f"latency_s.travel_time = {late_s:.1f}", REPLIES_CLOCK),
        f"The fixes lie where the vehicle was {abs(late_s):.0f} s "
        f"{'before' if late_s > 0 else 'after'}: the replies are stamped too "
        f"{'late' if late_s > 0 else 'early'}.",
        "A heading stamped as much the other way, or a transducer far from the navigated point, "
        "looks the same at a steady speed: the data cannot tell.",
    )  # fmt: skip


def _compass_clock(best: Scored, evidence: Evidence) -> Cause | None:
    late_s = -float(best.value["compass_clock"][0])
    if abs(late_s) < _LEAST_CLOCK_S:
        return None
    return Cause(
        "heading", "clock_offset", f"{late_s:+.1f} s", evidence,
        Mend(f"latency_s = {late_s:.1f}", f"under [heading] of the profile {_ADDED}"),
        f"In turns the heading comes {abs(late_s):.1f} s {'late' if late_s > 0 else 'early'} "
        "against DVL and fixes.",
        "Replies stamped as much the other way look the same at a steady speed.",
    )  # fmt: skip


def _wandering_compass(best: Scored, evidence: Evidence) -> Cause | None:
    most_deg = float(np.degrees(np.abs(best.value["slow_turn"]).max()))
    return None if most_deg < LEAST_TURN_DEG else compass_drift_cause(most_deg, evidence)


def compass_drift_cause(most_deg: float, evidence: Evidence) -> Cause:
    """The compass drifts or jumps within the dive."""
    return Cause(
        "heading", "noise", f"{most_deg:.1f} deg", evidence,
        Mend(
            "",
            "Look for iron or electric currents near the compass and have it calibrated; of this "
            "dive use the smoother's track, which follows the drift",
        ),
        f"The heading drifts or jumps by about {most_deg:.0f} degrees within the dive.",
        "It is the compass.",
    )  # fmt: skip


def _deviation(best: Scored, evidence: Evidence) -> Cause | None:
    most_deg = float(np.degrees(np.hypot(*best.value["deviation_1"])))
    return None if most_deg < LEAST_TURN_DEG else deviation_cause(most_deg, evidence)


def deviation_cause(most_deg: float, evidence: Evidence) -> Cause:
    """The compass is wrong by an angle that depends on the heading."""
    return Cause(
        "heading", "noise", f"{most_deg:.0f} deg", evidence,
        Mend(
            "",
            "Have the compass swung (its deviation measured) in the vehicle; of this dive use the "
            "smoother's track, which has it estimated",
        ),
        f"The heading is wrong by up to {most_deg:.0f} degrees, depending on the heading itself.",
        "It is the deviation of the compass.",
    )  # fmt: skip


def _wandering_dvl(best: Scored, evidence: Evidence) -> Cause | None:
    most_mps = float(np.abs(best.value["slow_bow"]).max())
    return None if most_mps < _LEAST_CURRENT_MPS else dvl_drift_cause(most_mps, evidence)


def dvl_drift_cause(most_mps: float, evidence: Evidence) -> Cause:
    """The DVL's velocity is wrong for minutes at a time."""
    return Cause(
        "velocity", "noise", f"{100 * most_mps:.1f} cm/s", evidence,
        Mend(
            "",
            "Look into the DVL's own log for poor beams or water track; of this dive use the "
            "smoother's track, which follows the error",
        ),
        f"The DVL's velocity is wrong by about {100 * most_mps:.1f} cm/s for minutes at a time.",
        "It is the DVL; a weak water current under water track would look much the same.",
    )  # fmt: skip
