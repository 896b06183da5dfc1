# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: T201
"""Monte Carlo of the navigator over simulated dives, on two processes: `make accuracy`.

Errors are horizontal distances of the 1 Hz track to the truth from 5 min after the method's start
to the dive's end.  `x` is a dive's RMS over its own posterior Cramér-Rao bound; NEES is by the
track's own covariance and 2 where that is exact; `held` is the share of the smoothed track within
its leg's 95 % radius, `/p95` the median of that radius over the 95th percentile of its leg's
errors.  A row is one method on one set of dives: medians over the seeds but where it says worst.

    python tests/accuracy.py --sets nominal,water --seeds 5 --json rows.json
"""

import argparse
import json
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from scoring import SETTLED_S, Radius, Score, radius, score

from abyssnav.align import align
from abyssnav.config import Config
from abyssnav.diagnose import with_verdict
from abyssnav.estimation.two_state import ACCEPTED, BEFORE_START, GATED
from abyssnav.navigate import navigate
from abyssnav.simulate import (
    Simulation,
    bound,
    load_scenario,
    settings_toml,
    simulate,
    stated_settings,
    to_log,
    write_log,
)
from abyssnav.simulate.scenario import Scenario, with_key, with_keys
from abyssnav.tables import LEVELS, Solution

#: A time so far from the direct path's is grossly wrong.
_GROSS_S = 0.010


@dataclass(frozen=True)
class DiveSet:
    """Dives of one kind: a scenario, what differs from it, and the figures to reach."""

    scenario: str
    keys: Mapping[str, Any] = field(default_factory=dict)
    #: Figure of a row -> (lowest, highest), by method.
    limits: Mapping[str, Mapping[str, tuple[float, float]]] = field(default_factory=dict)


def _limits(x: float, worst: float, nees: float, least_nees: float = 0.0) -> Mapping[str, Any]:
    return {"x": (0.0, x), "x_worst": (0.0, worst), "nees": (least_nees, nees)}


_ANY = np.inf
_SOUND = {
    "ekf": _limits(1.15, 1.6, 2.4, 1.0),
    "smoother": {**_limits(1.15, _ANY, 2.4, 1.0), "held": (0.95, 1.0), "over_p95": (1.0, 1.8)},
}
_BAD_SENSOR = {"ekf": _limits(1.2, 2.0, 2.0), "smoother": _limits(1.2, 1.6, 2.0)}
_STEP = {"ekf": {"x": (0.0, 1.9)}, "smoother": {"x": (0.0, 1.7)}}


def _water(max_m: float) -> Mapping[str, Any]:
    smoother = {"x": (0.0, 1.7), "x_worst": (0.0, 2.4), "over_fixes": (0.0, 1.0)}
    return {"ekf": {"max_m": (0.0, max_m)}, "smoother": smoother}


_STATED = {"ekf": {"nees": (1.0, 3.0)}, "smoother": {"nees": (1.0, 3.0), "held": (0.9, 1.0)}}
_NOT_STATED = {"ekf": {}, "smoother": {"held_or_named": (0.9, 1.0)}}
_SLOW = {"ekf": {}, "smoother": {"nees": (1.0, 3.0), "held": (0.85, 1.0)}}
_LEVER = {"ekf": {}, "smoother": {"x": (0.0, 1.6)}}
_NO_PROFILE = {"sound.logged": False}
_OFF_CENTRE = {"vehicle.centre_m": (3000.0, 0.0)}


def _nominal(limits: Mapping[str, Any] = _SOUND, **keys: Any) -> DiveSet:
    return DiveSet("nominal", {path.replace("__", "."): v for path, v in keys.items()}, limits)


def _track_on_water(limits: Mapping[str, Any], **stretch: float) -> DiveSet:
    currents = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3)
    choice = tuple(({**stretch, "current_mps": current},) for current in currents)
    return DiveSet("nominal", {"choose.dvl.water_track": choice}, limits)


def _displaced(sigma_m: float, limits: Mapping[str, Any], **keys: float) -> DiveSet:
    displaced = {"beacons.survey_sigma_m": sigma_m, "choose.beacons.count": (3, 4, 8)}
    return DiveSet("nominal", displaced | {f"beacons.{key}": v for key, v in keys.items()}, limits)


#: `make accuracy`: the figures to reach, set by set.
SETS: dict[str, DiveSet] = {
    "nominal": _nominal(),
    "nominal_no_profile": DiveSet("nominal", _NO_PROFILE, _SOUND),
    "voyage_1": DiveSet("voyage_1", {"beacons.survey_sigma_m": 0.2}, _SOUND),
    "voyage_2": DiveSet("voyage_2", {"beacons.survey_sigma_m": 0.2}, _SOUND),
    "wrong_40": _nominal(acoustics__gross=0.4),
    "three_beacons": _nominal(beacons__count=3),
    "eight_beacons": _nominal(beacons__count=8),
    "foreign": DiveSet("foreign", {}, _SOUND),
    "foreign_no_profile": DiveSet("foreign", _NO_PROFILE, _SOUND),
    "heading_drift_2deg_60s": _nominal(
        _BAD_SENSOR,
        compass__slow_sigma_deg=2.0,
        compass__slow_time_s=60.0,
    ),
    "heading_drift_5deg_600s": _nominal(
        _BAD_SENSOR,
        compass__slow_sigma_deg=5.0,
        compass__slow_time_s=600.0,
    ),
    "deviation_4deg": _nominal(_BAD_SENSOR, compass__deviation_sigma_deg=(4.0, 1.5)),
    "slow_dvl_2cms": _nominal(
        _BAD_SENSOR,
        dvl__slow_sigma_mps=0.02,
        dvl__slow_time_s=120.0,
    ),
    "scale_15": _nominal(_BAD_SENSOR, dvl__scale=0.15),
    "heading_25deg_off": _nominal(_BAD_SENSOR, compass__bias_deg=25.0),
    "heading_step_15deg": _nominal(
        _STEP, compass__jump_deg=15.0, vary__compass__jump_at_s=(1200.0, 2400.0)
    ),
    "water_track_5min": _track_on_water(_water(20.0), from_s=1500.0, for_s=300.0),
    "water_track_20min": _track_on_water(_water(30.0), from_s=1200.0, for_s=1200.0),
    "water_track_whole": _track_on_water(_water(30.0), for_s=3600.0),
    "beacons_1m_stated": _displaced(1.0, _STATED),
    "beacons_3m_stated": _displaced(3.0, _STATED),
    "beacons_5m_stated": _displaced(5.0, _STATED),
    "beacons_1m_not_stated": _displaced(1.0, _NOT_STATED, stated_sigma_m=0.0),
    "beacons_3m_not_stated": _displaced(3.0, _NOT_STATED, stated_sigma_m=0.0),
    "beacons_5m_not_stated": _displaced(5.0, _NOT_STATED, stated_sigma_m=0.0),
    "one_beacon_5m": _nominal(_NOT_STATED, beacons__one_displaced_m=5.0),
    "one_turn_around_4ms": _nominal(_NOT_STATED, beacons__one_turn_around_error_s=0.004),
    "turn_arounds_5ms": DiveSet(
        "nominal", {"beacons.turn_around_error_s": 0.005, **_OFF_CENTRE}, _NOT_STATED
    ),
    "lever_not_stated": _nominal({}, vehicle__offset_stated=False),
    "lever_5m_not_stated": _nominal(
        _LEVER,
        vehicle__offset_stated=False,
        vehicle__transducer_offset_m=(5.0, 0.0, 0.0),
    ),
    "one_beacon_moved": _nominal({}, beacons__one_moved_m=15.0, beacons__one_moved_at_s=1800.0),
    "slow_range_bias": _nominal(_SLOW, acoustics__slow_sigma_s=0.003),
    "noise_x2.5": _nominal({}, acoustics__sigma_s=0.005, acoustics__stated_sigma_s=0.002),
    "noise_by_range": _nominal({}, acoustics__range_sigma_s_per_km=0.001),
    "noise_skewed": _nominal({}, acoustics__noise="skewed"),
    "noise_student": _nominal({}, acoustics__noise="student"),
    "profile_wrong_shape": _nominal({}, sound__shape_sigma_mps=2.0),
    "clocks": _nominal({}, clocks__heading_s=0.4, clocks__travel_time_s=0.2),
    "windows": _nominal(
        {},
        acoustics__window=(
            {"from_s": 900.0, "for_s": 600.0, "beacons": (1, 2)},
            {"from_s": 1800.0, "for_s": 400.0, "beacons": (3,)},
            {"from_s": 2600.0, "for_s": 300.0},
        ),
    ),
    "spiral_down": _nominal({}, vehicle__descent_s=2400.0, duration_s=5400.0),
    "hover": _nominal({}, vehicle__pattern="hover"),
    "slow_30cms": _nominal({}, vehicle__speed_mps=(0.3, 0.3)),
    "line": _nominal({}, beacons__layout="line", vehicle__pattern="lawn_mower"),
    "cluster": _nominal({}, beacons__layout="cluster"),
    "buoys": _nominal(
        {},
        buoys__drift_mps=0.3,
        floor__depth_m=600.0,
        floor__relief_m=20.0,
        beacons__distance_m=1200.0,
    ),
    "gnss_and_usbl": _nominal(
        {},
        vehicle__descent_s=1800.0,
        vehicle__surface_s=120.0,
        floor__depth_m=1500.0,
        position__gnss_period_s=1.0,
        position__usbl_period_s=60.0,
        position__usbl_gross=0.05,
    ),
    "array_left": _nominal({}, vehicle__centre_m=(4000.0, 0.0), vehicle__pattern="transit"),
}


def _sweep(gross: float, **keys: Any) -> DiveSet:
    acoustics = {"acoustics.detection": 0.8, "acoustics.gross": gross, "duration_s": 7200.0}
    return DiveSet("voyage_1", acoustics | {path.replace("__", "."): v for path, v in keys.items()})


#: `--table methods`: the older table, two and three hours a dive, beacons where they are said.
METHOD_SETS: dict[str, DiveSet] = {
    "voyage_1, 3 h": DiveSet("voyage_1", {"duration_s": 10800.0}),
    "voyage_2, 3 h": DiveSet("voyage_2", {"duration_s": 10800.0}),
    **{f"outliers {share} %": _sweep(share / 100) for share in (0, 10, 20, 30, 40, 50)},
    "heading bias 10 deg": _sweep(0.1, compass__bias_deg=10.0),
    "sound speed + 5 m/s": _sweep(0.1, sound__error_mps=5.0),
    "DVL scale 2 %": _sweep(0.1, dvl__scale=0.02),
    "DVL lost 10 min": _sweep(0.1, dvl__lost_from_s=3000.0, dvl__lost_for_s=600.0),
    "DVL lost 30 min": _sweep(0.1, dvl__lost_from_s=3000.0, dvl__lost_for_s=1800.0),
    "beacons 3 m wrong": _sweep(0.1, beacons__survey_sigma_m=3.0),
    "noise 5 ms, 2 stated": _sweep(0.1, acoustics__sigma_s=0.005, acoustics__stated_sigma_s=0.002),
    "3 beacons": _sweep(0.1, beacons__count=3),
    "8 beacons": _sweep(0.1, beacons__count=8),
    "decoy": _sweep(
        0.1,
        decoy__from_s=3000.0,
        decoy__for_s=600.0,
        decoy__share=0.9,
        decoy__offset_m=(280.0, 100.0),
    ),
    "a quarter heard": _sweep(0.1, acoustics__detection=0.25, acoustics__duplicates=0.0),
}
_EVERY_SET = SETS | METHOD_SETS


@dataclass(frozen=True)
class Gate:
    """What became of the replies, and how the method began."""

    nis: float  #: median over its expectation: 1 where the innovations are as large as claimed
    gross_accepted: float
    good_rejected: float
    start_error_m: float
    cycles: int


@dataclass(frozen=True)
class Measured:
    """One method on one dive."""

    score: Score
    x: float
    bound_m: float
    gate: Gate
    radius: Radius


def scenario_of(name: str) -> Scenario:
    """Scenario of a set, without its seed; a key that is given is no longer drawn."""
    return with_keys(load_scenario(_EVERY_SET[name].scenario), _EVERY_SET[name].keys)


def measure(name: str, seed: int, changes: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Every method's result on one simulated dive, and what the run says of itself.

    Parameters
    ----------
    changes : settings by their dotted path, for experiments
    """
    simulation = simulate(scenario_of(name), seed)
    config = stated_settings(simulation)
    for path, value in (changes or {}).items():
        config = with_key(config, path, value)
    began = perf_counter()
    solution = navigated(simulation, config, name)
    seconds = perf_counter() - began
    limit = bound(simulation)
    truth = simulation.truth.motion.t_s, simulation.truth.motion.position_enu_m
    methods = {}
    for method, track in solution.tracks.items():
        from_s = float(track.t_s[0]) + SETTLED_S
        if method not in solution.starts or track.t_s[-1] <= from_s:
            continue
        result = score(track, truth, from_s, np.inf)
        bound_m = limit.rms_m(from_s)[method == "smoother"]
        methods[method] = asdict(
            Measured(
                result,
                result.rms_m / bound_m,
                bound_m,
                _gate(solution, method, simulation),
                radius(solution, truth),
            )
        )
    fixes = solution.fixes
    off_m = np.hypot(*(fixes.position_enu_m - simulation.position_at(fixes.t_mid_s))[:, :2].T)
    return {
        "set": name,
        "seed": seed,
        "methods": methods,
        "fix_median_m": float(np.median(off_m)) if len(off_m) else np.nan,
        "seconds": seconds,
        "level": solution.verdict.level,
        "causes": [reason.name for reason in solution.verdict.reasons],
        "learned": {
            f"{p.name}{'' if p.beacon_id is None else f' {p.beacon_id}'}": [p.value, p.sigma]
            for p in solution.learned
        },
    }


def write_logs(names: list[str], seeds: range, folder: Path) -> None:
    """Logs of the sets with their reference, and their settings, for anybody's filter."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        for seed in seeds:
            simulation = simulate(scenario_of(name), seed)
            path = folder / f"{name.replace(' ', '_')}_{seed}.mcap"
            write_log(simulation, path)
            settings = settings_toml(simulation)
            if settings:
                path.with_suffix(".toml").write_text(settings, encoding="utf-8")


def navigated(simulation: Simulation, config: Config, name: str) -> Solution:
    """Solution of a dive, its verdict included."""
    dive = align(to_log(simulation, name=name), config)
    return with_verdict(navigate(dive, config), config)


def _gate(solution: Solution, method: str, simulation: Simulation) -> Gate:
    nis = gross_accepted = good_rejected = np.nan
    innovations = solution.innovations.get(method)
    replies = simulation.replies
    if innovations is not None and len(innovations) == len(replies):
        gross = np.abs(replies.travel_time_s - replies.direct_s) > _GROSS_S
        met = innovations.decision != BEFORE_START
        accepted, gated = innovations.decision == ACCEPTED, innovations.decision == GATED
        nis = float(np.median(innovations.nis[accepted]) / 0.4549) if accepted.any() else np.nan
        gross_accepted = float(np.sum(accepted & gross) / max(1, np.sum(gross & met)))
        good_rejected = float(np.sum(gated & ~gross) / max(1, np.sum(~gross & met)))
    start = solution.starts[method]
    true = simulation.position_at(np.array([start.t_s]))[0, :2]
    off_m = float(np.hypot(start.east_m - true[0], start.north_m - true[1]))
    return Gate(nis, gross_accepted, good_rejected, off_m, start.cycles)


def summarise(rows: list[dict[str, Any]], method: str) -> dict[str, Any] | None:
    """One row of the table; None where the method never started."""
    known = [row for row in rows if method in row["methods"]]
    if not known:
        return None

    def column(part: str, name: str) -> Any:
        return np.array([row["methods"][method][part][name] for row in known], dtype=float)

    x = np.array([row["methods"][method]["x"] for row in known])
    held = column("radius", "held")
    named = np.array([bool(row["causes"]) and row["level"] != LEVELS[0] for row in known])
    rms_m = column("score", "rms_m")
    return {
        "set": rows[0]["set"],
        "method": method,
        "dives": len(rows),
        "started": len(known),
        "rms_m": float(np.median(rms_m)),
        "x": float(np.median(x)),
        "x_worst": float(x.max()),
        "max_m": float(column("score", "max_m").max()),
        "lost": int(np.sum(column("score", "lost") > 0.02)),
        "nees": float(np.median(column("score", "nees"))),
        "nees_mean": float(np.mean(column("score", "nees"))),
        "over_fixes": float(np.max(rms_m / [row["fix_median_m"] for row in known])),
        "nis": float(np.median(column("gate", "nis"))),
        "gross_accepted": float(np.mean(column("gate", "gross_accepted"))),
        "good_rejected": float(np.mean(column("gate", "good_rejected"))),
        "start_m": float(column("gate", "start_error_m").max()),
        "cycles": float(np.median(column("gate", "cycles"))),
        "held": float(np.mean(np.nan_to_num(held, nan=1.0))),
        "held_worst": float(np.min(np.nan_to_num(held, nan=1.0))),
        "held_or_named": float(np.mean(np.where(named, 1.0, np.nan_to_num(held, nan=1.0)))),
        "radius_m": _median(column("radius", "median_m")),
        "over_p95": _median(column("radius", "over_p95")),
        "levels": [sum(row["level"] == level for row in rows) for level in LEVELS],
        "causes": dict(Counter(cause for row in rows for cause in set(row["causes"]))),
        "seconds": float(np.median([row["seconds"] for row in rows])),
    }


def _median(values: Any) -> float:
    return float(np.nanmedian(values)) if np.isfinite(values).any() else np.nan


def missed(row: dict[str, Any]) -> list[str]:
    """Figures of a row outside the limits of its set, in words."""
    limits = _EVERY_SET[row["set"]].limits.get(row["method"], {})
    return [
        f"{name} {row[name]:.2f} not in {low:g}..{high:g}"
        for name, (low, high) in limits.items()
        if not low <= round(row[name], 2) <= high
    ]


_HEAD = (
    f"{'set':24} {'method':9} {'rms m':>6} {'x':>5} {'worst':>6} {'max m':>7} {'lost':>4} "
    f"{'NEES':>5} {'mean':>6} {'held':>5} {'worst':>5} {'rad m':>6} {'/p95':>5} {'NIS':>5} "
    f"{'gross':>6} {'good':>6} {'start':>6} {'cyc':>4} {'s':>5}  good/check/unusable, causes"
)


def shown(row: dict[str, Any]) -> str:
    """One line of the table."""
    causes = ", ".join(f"{name} {count}" for name, count in sorted(row["causes"].items()))
    below = [] if row["started"] == row["dives"] else [f"{row['started']} of {row['dives']} began"]
    return (
        f"{row['set'][:24]:24} {row['method']:9} {row['rms_m']:6.2f} {row['x']:5.2f} "
        f"{row['x_worst']:6.2f} {row['max_m']:7.1f} {row['lost']:4d} {row['nees']:5.2f} "
        f"{row['nees_mean']:6.2f} {row['held']:5.3f} {row['held_worst']:5.2f} "
        f"{row['radius_m']:6.2f} {row['over_p95']:5.2f} {row['nis']:5.2f} "
        f"{row['gross_accepted']:6.4f} {row['good_rejected']:6.4f} {row['start_m']:6.1f} "
        f"{row['cycles']:4.0f} {row['seconds']:5.2f}  {'/'.join(map(str, row['levels']))} {causes}"
        + "".join(f"  ** {what}" for what in [*below, *missed(row)])
    )


def chosen(names: str, table: str) -> list[str]:
    """Sets of these names, or whose names have these parts, commas between; else the table's."""
    if not names:
        return list(SETS if table == "trust" else METHOD_SETS)
    kept = {
        name
        for part in names.split(",")
        for name in ([part] if part in _EVERY_SET else _EVERY_SET)
        if part in name
    }
    return [name for name in _EVERY_SET if name in kept]


def changes_of(words: str) -> dict[str, Any]:
    """Settings of `errors.heading_sigma_deg=1,...`; a slash makes a tuple."""
    changes: dict[str, Any] = {}
    for word in filter(None, words.split(",")):
        path, value = word.split("=")
        changes[path] = tuple(map(float, value.split("/"))) if "/" in value else float(value)
    return changes


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sets", default="", help="names, or parts of names, commas between")
    parser.add_argument("--table", choices=("trust", "methods"), default="trust")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--methods", default="", help="default: ekf,smoother; of methods, four")
    parser.add_argument("--change", default="", help="errors.heading_sigma_deg=1,... (experiments)")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", type=Path, help="write rows and dives there")
    parser.add_argument("--logs", type=Path, help="only write the dives' logs there")
    arguments = parser.parse_args()
    default = "ekf,smoother" if arguments.table == "trust" else "kf_fix,ekf_gated,ekf,smoother"
    methods = (arguments.methods or default).split(",")
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    if arguments.logs:
        write_logs(chosen(arguments.sets, arguments.table), seeds, arguments.logs)
        return
    changes = changes_of(arguments.change)
    print(_HEAD)
    table, dives = [], []
    with ProcessPoolExecutor(arguments.jobs, get_context("spawn")) as pool:
        jobs = {
            name: [pool.submit(measure, name, seed, changes) for seed in seeds]
            for name in chosen(arguments.sets, arguments.table)
        }
        for name, futures in jobs.items():
            rows = [future.result() for future in futures]
            dives += rows
            for method in methods:
                row = summarise(rows, method)
                table += [row] if row else []
                print(shown(row) if row else f"{name:24} {method:9} never started", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps({"rows": table, "dives": dives}), encoding="utf-8")


if __name__ == "__main__":
    main()
