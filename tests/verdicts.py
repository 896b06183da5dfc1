# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: T201
"""Faults planted alone in simulated dives, and what the verdict makes of them: `make verdicts`.

A fault is named when the first reason has its name, or one that the data cannot tell from it; a
dive without one must be good.  No track that is wrong by more than 20 m, or three times its
radius, for a tenth of the dive may be good.

    python tests/verdicts.py --faults ids,sound --seeds 10
"""

import argparse
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from typing import Any

import numpy as np

from abyssnav.align import align
from abyssnav.diagnose import with_verdict
from abyssnav.errors import PipelineError
from abyssnav.navigate import navigate
from abyssnav.simulate import Simulation, load_scenario, simulate, stated_settings, to_log
from abyssnav.simulate.scenario import Scenario, WaterTrack, with_key
from abyssnav.tables import Columns, Solution

Roles = dict[str, Columns]
Change = Callable[[Roles], Roles]
_MINUTES = 80.0


@dataclass(frozen=True)
class Fault:
    """What is wrong with a dive, and the names that are right for it."""

    names: tuple[str, ...]
    keys: Mapping[str, Any] = field(default_factory=dict)
    change: Change = lambda roles: roles
    scenario: str = "voyage_1"


def column(role: str, name: str, convert: Callable[[Any], Any]) -> Change:
    """A role with one column changed."""
    return lambda roles: {
        **roles,
        role: {**roles[role], name: convert(np.array(roles[role][name]))},
    }


def times(convert: Callable[[Any, Any], Any]) -> Change:
    """Travel times changed, by the time and its beacon's turn-around."""

    def change(roles: Roles) -> Roles:
        replies, beacons = roles["travel_time"], roles["beacons"]
        wait_s = dict(zip(beacons["id"].tolist(), beacons["turn_around_s"].tolist(), strict=True))
        waits_s = np.array([wait_s[i] for i in replies["beacon_id"].tolist()])
        changed = convert(replies["travel_time_s"], waits_s)
        return {**roles, "travel_time": {**replies, "travel_time_s": changed}}

    return change


def later(role: str, late_s: float) -> Change:
    """A role stamped later."""

    def change(roles: Roles) -> Roles:
        moved = dict(roles[role])
        for name in ("time_ns", "ping_time_ns"):
            if name in moved:
                moved[name] = moved[name] + int(late_s * 1e9)
        return {**roles, role: moved}

    return change


def part(role: str, begin: float, end: float) -> Change:
    """A role recorded only from one share of its time to another."""

    def change(roles: Roles) -> Roles:
        time_ns = roles[role]["time_ns"]
        share = (time_ns - time_ns[0]) / (time_ns[-1] - time_ns[0])
        kept = (share >= begin) & (share <= end)
        return {**roles, role: {name: values[kept] for name, values in roles[role].items()}}

    return change


def standing_still(roles: Roles) -> Roles:
    zero = {name: 0 * roles["heading"][name] for name in ("roll_rad", "pitch_rad", "heading_rad")}
    return {**roles, "heading": {**roles["heading"], **zero}}


def earth_frame(roles: Roles) -> Roles:
    """Velocity east and north, under the names of forward and port."""
    velocity, compass = roles["velocity"], roles["heading"]
    heading = np.interp(velocity["time_ns"], compass["time_ns"], np.unwrap(compass["heading_rad"]))
    forward, starboard, down = np.array(velocity["velocity_body_mps"]).T
    east = forward * np.sin(heading) + starboard * np.cos(heading)
    north = forward * np.cos(heading) - starboard * np.sin(heading)
    changed = np.column_stack([east, -north, down])
    return {**roles, "velocity": {**velocity, "velocity_body_mps": changed}}


def exchanged(roles: Roles) -> Roles:
    replies = roles["travel_time"]
    one, other = np.unique(replies["beacon_id"])[:2]
    ids = replies["beacon_id"]
    changed = np.where(ids == one, other, np.where(ids == other, one, ids))
    return {**roles, "travel_time": {**replies, "beacon_id": changed}}


def two_only(roles: Roles) -> Roles:
    replies = roles["travel_time"]
    kept = np.isin(replies["beacon_id"], np.unique(replies["beacon_id"])[:2])
    return {**roles, "travel_time": {name: values[kept] for name, values in replies.items()}}


def _heading(convert: Callable[[Any], Any]) -> Change:
    return column("heading", "heading_rad", convert)


def _velocity(factor: Any) -> Change:
    return column("velocity", "velocity_body_mps", lambda v: v * np.array(factor))


_TURNED = ("heading_offset", "dvl_mount", "declination")
_ONE_BEACON = ("beacon_moved", "turn_around")
_ALL_LATE = ("turn_around", "sound_speed")
_CLOCK = ("clock_offset", "no_overlap")
_NOT_STATED = {"beacons.stated_sigma_m": 0.0}


#: A common delay of 5 ms puts fixes 5 m off here and is known to 0.5-1.9 ms. A kilometre farther it
#: is known to 2-5 ms in one dive of three, where nothing can tell it from none.
_OFF_CENTRE = {"vehicle.centre_m": (1500.0, 600.0)}
_FAR_OFF = {"vehicle.centre_m": (2500.0, 1000.0)}
_LINE = {"beacons.layout": "line", "vehicle.pattern": "lawn_mower"}


def _on_water(from_s: float, for_s: float) -> Mapping[str, Any]:
    return {"dvl.water_track": (WaterTrack(from_s=from_s, for_s=for_s, current_mps=0.2),)}


def _arm(pattern: str) -> Fault:
    """A transducer 5 m ahead that nobody gave."""
    keys = {
        "vehicle.transducer_offset_m": (5.0, 0.0, 0.0),
        "vehicle.offset_stated": False,
        "vehicle.pattern": pattern,
    }
    return Fault(("lever_arm",), keys, scenario="nominal")


FAULTS = {
    **{f"sound_{n}": Fault((), {}, scenario=n) for n in ("voyage_1", "voyage_2", "nominal")},
    "sound_three": Fault((), {"beacons.count": 3}, scenario="nominal"),
    "sound_eight": Fault((), {"beacons.count": 8}, scenario="nominal"),
    "sound_foreign": Fault((), {}, scenario="foreign"),
    "sound_off_centre": Fault((), {**_OFF_CENTRE, **_NOT_STATED}, scenario="nominal"),
    "sound_not_stated": Fault(
        (), {**_NOT_STATED, "vehicle.offset_stated": False}, scenario="nominal"
    ),
    "sound_cluster": Fault((), {"beacons.layout": "cluster"}, scenario="nominal"),
    "sound_line": Fault((), _LINE, scenario="nominal"),
    "heading_constant": Fault(("heading_constant",), {}, standing_still),
    "heading_sense": Fault(("heading_sense",), {}, _heading(lambda h: -h)),
    "heading_reference": Fault(("heading_reference",), {}, _heading(lambda h: np.pi / 2 - h)),
    "heading_degrees": Fault(("heading_unit",), {}, _heading(np.degrees)),
    "heading_radians": Fault(("heading_unit",), {}, _heading(np.radians)),
    "heading_quarter": Fault(_TURNED, {}, _heading(lambda h: h + np.pi / 2)),
    "heading_half": Fault((*_TURNED, "dvl_sign"), {}, _heading(lambda h: h + np.pi)),
    "heading_25": Fault(_TURNED, {"compass.bias_deg": 25.0}),
    "declination": Fault(_TURNED, {"compass.bias_deg": -15.0}),
    "dvl_mount": Fault(_TURNED, {"dvl.mount_deg": 45.0}),
    "dvl_port": Fault(
        ("dvl_frame",), {"vehicle.current_mps": (0.2, -0.15)}, _velocity([1, -1, -1])
    ),
    "dvl_earth": Fault(("dvl_frame",), {}, earth_frame),
    "dvl_sign": Fault(("dvl_sign", "heading_offset"), {}, _velocity([-1, -1, 1])),
    "dvl_scale": Fault(("dvl_scale",), {"dvl.scale": 0.15}),
    "dvl_knots": Fault(("dvl_unit",), {}, _velocity(1 / 0.514444)),
    "dvl_millimetres": Fault(("dvl_unit",), {}, _velocity(1e-3)),
    "water_track": Fault(("water_track",), _on_water(0.0, 1e5)),
    "water_track_20min": Fault(("water_track",), _on_water(1200.0, 1200.0)),
    "zeros": Fault(("zeros_when_lost",), {"faults.zeros_when_lost": True, "dvl.gaps_per_hour": 20}),
    "one_way": Fault(("time_one_way",), {}, times(lambda t, wait: (t - wait) / 2)),
    "turn_around_removed": Fault(("turn_around_removed",), {}, times(lambda t, wait: t - wait)),
    "milliseconds": Fault(("time_unit",), {}, times(lambda t, _: 1e3 * t)),
    "ids": Fault(("beacon_ids",), {}, exchanged),
    "beacon_200m": Fault(_ONE_BEACON, {"beacons.one_displaced_m": 200.0}),
    "beacon_30m": Fault(_ONE_BEACON, {"beacons.one_displaced_m": 30.0}),
    "beacon_5m": Fault(
        _ONE_BEACON, {"beacons.one_displaced_m": 5.0, **_NOT_STATED}, scenario="nominal"
    ),
    "turn_around_4ms": Fault(
        _ONE_BEACON,
        {"beacons.one_turn_around_error_s": 0.004, **_NOT_STATED},
        scenario="nominal",
    ),
    "turn_arounds_5ms": Fault(
        _ALL_LATE,
        {"beacons.turn_around_error_s": 0.005, **_OFF_CENTRE, **_NOT_STATED},
        scenario="nominal",
    ),
    "turn_arounds_5ms_far": Fault(
        _ALL_LATE,
        {"beacons.turn_around_error_s": 0.005, **_FAR_OFF, **_NOT_STATED},
        scenario="nominal",
    ),
    "sound_speed": Fault(_ALL_LATE, {"sound.error_mps": 30.0}),
    "lever_arm": Fault(
        ("lever_arm",),
        {
            "vehicle.transducer_offset_m": (5.0, 0.0, 0.0),
            "vehicle.stated_offset_m": (0.0, 0.0, 0.0),
        },
    ),
    "lever_5m_not_stated": _arm("lawn_mower"),
    "lever_5m_meander": _arm("meander"),
    # On one circle the arm is a compass 0.6 degrees off, on a line it is the start: nothing tells.
    "lever_5m_circle": _arm("circle"),
    "lever_5m_transit": _arm("transit"),
    "beacon_moves": Fault(
        _ONE_BEACON,
        {"beacons.one_moved_m": 15.0, "beacons.one_moved_at_s": 1800.0},
        scenario="nominal",
    ),
    "heading_drift": Fault(
        ("noise",),
        {"compass.slow_sigma_deg": 5.0, "compass.slow_time_s": 600.0},
        scenario="nominal",
    ),
    "heading_step": Fault(
        ("noise", *_TURNED),
        {"compass.jump_deg": 15.0, "compass.jump_at_s": 1800.0},
        scenario="nominal",
    ),
    # Drawn, so that one of six stays below 4 degrees; on a line it is a constant error.
    "deviation": Fault(
        ("noise",),
        {"compass.deviation_sigma_deg": (4.0, 1.5), "vehicle.pattern": "circle"},
        scenario="nominal",
    ),
    "dvl_drift": Fault(
        ("noise",), {"dvl.slow_sigma_mps": 0.02, "dvl.slow_time_s": 120.0}, scenario="nominal"
    ),
    "times_noisy": Fault(
        ("noise",),
        {"acoustics.sigma_s": 0.006, "acoustics.stated_sigma_s": 0.002},
        scenario="nominal",
    ),
    "depth_sign": Fault(("depth",), {}, column("depth", "depth_m", lambda d: -d)),
    "depth_feet": Fault(("depth",), {}, column("depth", "depth_m", lambda d: d / 0.3048)),
    "clock_30s": Fault(("clock_offset",), {"clocks.travel_time_s": 30.0}),
    "clock_8s": Fault(("clock_offset",), {}, later("travel_time", 8.0)),
    "clock_3s": Fault(("clock_offset", "lever_arm"), {"clocks.travel_time_s": 3.0}),
    "compass_late": Fault(("clock_offset", "lever_arm"), {"clocks.heading_s": 3.0}),
    "depth_1h": Fault(("sensor_lost", "clock_offset"), {}, later("depth", 3600.0)),
    "depth_30m": Fault(
        ("depth",), {"depth.bias_m": 30.0, "vehicle.altitude_m": 800.0, "dvl.lock_range_m": 2000.0}
    ),
    "geometry": Fault(
        ("geometry",), {"beacons.layout": "cluster", "beacons.cluster_m": 60.0}, scenario="nominal"
    ),
    "replies_1h": Fault(_CLOCK, {}, later("travel_time", 3600.0)),
    "replies_15min": Fault(_CLOCK, {}, later("travel_time", 900.0)),
    "velocity_lost": Fault(("sensor_lost",), {}, part("velocity", 0.0, 0.6)),
    "heading_late": Fault(("sensor_lost",), {}, part("heading", 0.3, 1.0)),
    "two_beacons": Fault(("too_few_beacons", "geometry"), {}, two_only),
}


@dataclass(frozen=True)
class Judged:
    """What the verdict says of one dive, beside the truth."""

    level: str
    causes: tuple[str, ...]
    named: bool  #: a fault by its name and below good, a sound dive good
    rms_m: float
    lie: bool  #: good, and wrong for a tenth of the dive


def scenario_with(fault: Fault) -> Scenario:
    """Scenario of a fault, without its seed."""
    scenario = load_scenario(fault.scenario)
    if fault.scenario.startswith("voyage"):
        for path, value in {"duration_s": 60 * _MINUTES, "beacons.survey_sigma_m": 0.2}.items():
            scenario = with_key(scenario, path, value)
    for path, value in fault.keys.items():
        scenario = with_key(scenario, path, value)
        for draws in ("vary", "choose"):
            kept = {key: v for key, v in getattr(scenario, draws).items() if key != path}
            scenario = with_key(scenario, draws, kept)
    return scenario


def judge(name: str, seed: int) -> Judged:
    """Verdict of one dive with one fault."""
    fault = FAULTS[name]
    simulation = simulate(scenario_with(fault), seed)
    log = to_log(simulation, name=name)
    config = stated_settings(simulation)
    try:
        dive = align(replace(log, roles=fault.change(dict(log.roles))), config)
    except PipelineError:
        return Judged("refused", (), False, np.nan, False)
    solution = with_verdict(navigate(dive, config), config)
    verdict = solution.verdict
    causes = tuple(reason.name for reason in verdict.reasons)
    named = causes[:1] != () and causes[0] in fault.names if fault.names else not causes
    rms_m, wrong = _errors(solution, simulation)
    return Judged(verdict.level, causes, named, rms_m, wrong > 0.1 and verdict.level == "good")


def _errors(solution: Solution, simulation: Simulation) -> tuple[float, float]:
    """RMS of the smoothed track, and the share of it that is wrong."""
    track, legs = solution.tracks.get("smoother"), solution.accuracy
    if track is None:
        return np.nan, 0.0
    off_m = np.hypot(*(track.position_enu_m - simulation.position_at(track.t_s))[:, :2].T)
    wrong = off_m > 20.0
    if legs is not None and len(legs):
        leg = np.clip(np.searchsorted(legs.t_begin_s, track.t_s, side="right") - 1, 0, None)
        wrong |= off_m > 3 * np.nan_to_num(legs.uncertainty_95_m[leg], nan=np.inf)
    return float(np.sqrt(np.mean(off_m**2))), float(np.mean(wrong))


def main() -> None:
    """Print a line a fault: how often it is named, the levels, and what else was said."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--faults", default="", help="names, or parts of them, between commas")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    parts = given.faults.split(",")
    names = [name for name in FAULTS if any(one in name for one in parts)]
    seeds = range(given.first, given.first + given.seeds)
    with ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool:
        waiting = {name: [pool.submit(judge, name, seed) for seed in seeds] for name in names}
        for name, results in waiting.items():
            rows = [result.result() for result in results]
            levels = Counter(row.level for row in rows)
            causes = Counter(row.causes[0] for row in rows if row.causes)
            rms_m = np.median([np.nan_to_num(row.rms_m, nan=np.inf) for row in rows])
            named, lies = sum(row.named for row in rows), sum(row.lie for row in rows)
            print(f"{name:20s} {named:2d} of {len(rows)}, lies {lies}, rms {rms_m:6.1f} m", end=" ")
            print(dict(levels), dict(causes), flush=True)


if __name__ == "__main__":
    main()
