# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: T201
"""Monte Carlo of the navigator over simulated dives, spread over the cores: `make accuracy`.

Errors are horizontal distances of the 1 Hz track to the truth from 5 min after the method's start
(the smoother: from 5 min after the dive's), medians over the seeds; `x` is that over the posterior
Cramér-Rao bound of the same dive.
"""

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from abyssnav.align import align
from abyssnav.config import Config
from abyssnav.estimation.two_state import ACCEPTED, BEFORE_START, GATED
from abyssnav.navigate import navigate
from abyssnav.simulate import bound, load_scenario, simulate, to_log
from abyssnav.tables import Solution


def _sweep(gross: float, **more: Any) -> tuple[str, dict[str, Any]]:
    acoustics = {"detection": 0.8, "gross": gross, "duplicates": 0.01}
    return "clean", {"duration_s": 7200.0, **more, "acoustics": acoustics}


#: Name -> shipped scenario and what differs from it.
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "voyage_1": ("voyage_1", {"duration_s": 10800.0}),
    "voyage_2": ("voyage_2", {"duration_s": 10800.0}),
    **{f"outliers {share} %": _sweep(share / 100) for share in (0, 10, 20, 30, 40, 50)},
    "heading bias 10 deg": _sweep(0.1, compass={"bias_deg": 10.0}),
    "sound speed + 5 m/s": _sweep(0.1, sound={"error_mps": 5.0}),
    "DVL scale 2 %": _sweep(0.1, dvl={"scale": 0.02}),
    "DVL lost 10 min": _sweep(0.1, dvl={"lost_from_s": 3000.0, "lost_for_s": 600.0}),
    "DVL lost 30 min": _sweep(0.1, dvl={"lost_from_s": 3000.0, "lost_for_s": 1800.0}),
    "beacons 3 m wrong": _sweep(0.1, beacons={"survey_sigma_m": 3.0}),
    "noise 5 ms, 2 told": (
        "clean",
        {
            "duration_s": 7200.0,
            "acoustics": {"detection": 0.8, "gross": 0.1, "duplicates": 0.01, "sigma_s": 0.005},
        },
    ),
    "3 beacons": _sweep(0.1, beacons={"count": 3}),
    "8 beacons": _sweep(0.1, beacons={"count": 8}),
    "decoy": _sweep(
        0.1, decoy={"from_s": 3000.0, "for_s": 600.0, "share": 0.9, "offset_m": (280.0, 100.0)}
    ),
    "a quarter heard": (
        "clean",
        {"duration_s": 7200.0, "acoustics": {"detection": 0.25, "gross": 0.1}},
    ),
}


@dataclass(frozen=True)
class Result:
    """One method on one dive."""

    rms_m: float
    ratio: float
    max_m: float
    lost: float
    nees: float
    nis: float
    gross_accepted: float
    good_rejected: float
    start_error_m: float
    cycles: int
    covered: float  #: share of the track within its leg's 95 % radius
    radius_m: float  #: median of that radius


def changed(settings: Any, changes: dict[str, Any]) -> Any:
    """The settings struct with a nested dictionary of changes applied."""
    return msgspec.structs.replace(
        settings,
        **{
            key: changed(getattr(settings, key), value) if isinstance(value, dict) else value
            for key, value in changes.items()
        },
    )


def measure(case: str, seed: int, config: Config) -> dict[str, Result]:
    """Every method's result on one simulated dive."""
    base, changes = CASES[case]
    scenario = load_scenario(base)
    if base == "clean":
        scenario = changed(load_scenario("voyage_1"), {"acoustics": {"duplicates": 0.0}})
    simulation = simulate(changed(scenario, {**changes, "seed": seed}))
    dive = align(to_log(simulation, name=case), config)
    solution = navigate(dive, config)
    best = bound(simulation)
    gross = np.abs(simulation.replies.travel_time_s - simulation.replies.direct_s) > 0.010
    return {
        method: _result(solution, method, simulation, best, gross)
        for method in solution.tracks
        if method in solution.starts
        and solution.tracks[method].t_s[-1] > _settled_s(solution, method)
    }


def _settled_s(solution: Solution, method: str) -> float:
    """From when on errors count."""
    return float(solution.tracks[method].t_s[0]) + 300.0


def _result(solution: Solution, method: str, simulation: Any, best: Any, gross: Any) -> Result:
    track = solution.tracks[method]
    error_m = (track.position_enu_m - simulation.position_at(track.t_s))[:, :2]
    late = track.t_s >= _settled_s(solution, method)
    distance_m = np.hypot(*error_m[late].T)
    rms_m = float(np.sqrt(np.mean(distance_m**2)))
    limits = best.rms_m(_settled_s(solution, method))
    nees = np.einsum(
        "ni,nij,nj->n", error_m[late], np.linalg.inv(track.position_cov_m2[late]), error_m[late]
    )
    nis = gross_accepted = good_rejected = np.nan
    innovations = solution.innovations.get(method)
    if innovations is not None:
        met = innovations.decision != BEFORE_START
        accepted, gated = innovations.decision == ACCEPTED, innovations.decision == GATED
        nis = float(np.median(innovations.nis[accepted]) / 0.4549)
        gross_accepted = float(np.sum(accepted & gross) / max(1, np.sum(gross & met)))
        good_rejected = float(np.sum(gated & ~gross) / max(1, np.sum(~gross & met)))
    start = solution.starts[method]
    true_start = simulation.position_at(np.array([start.t_s]))[0, :2]
    return Result(
        rms_m,
        rms_m / limits[1 if method == "smoother" else 0],
        float(distance_m.max()),
        float(np.mean(distance_m > 20.0)),
        float(nees.mean()),
        nis,
        gross_accepted,
        good_rejected,
        float(np.hypot(start.east_m - true_start[0], start.north_m - true_start[1])),
        start.cycles,
        *_coverage(solution, simulation, method),
    )


def _coverage(solution: Solution, simulation: Any, method: str) -> tuple[float, float]:
    legs, track = solution.accuracy, solution.tracks[method]
    if method != "smoother" or legs is None:
        return np.nan, np.nan
    off_m = (track.position_enu_m - simulation.position_at(track.t_s))[:, :2]
    leg = np.clip(np.searchsorted(legs.t_begin_s, track.t_s, side="right") - 1, 0, None)
    held = np.hypot(*off_m.T) <= legs.uncertainty_95_m[leg]
    return float(np.mean(held)), float(np.median(legs.uncertainty_95_m))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--cases", default="", help="part of the names, commas between")
    parser.add_argument("--methods", default="kf_fix,ekf_gated,ekf,smoother")
    parser.add_argument("--set", default="", help="errors.heading_sigma_deg=1,... (experiments)")
    arguments = parser.parse_args()
    config = Config()
    for change in filter(None, arguments.set.split(",")):
        path, value = change.split("=")
        section, key = path.split(".")
        number = tuple(map(float, value.split("/"))) if "/" in value else float(value)
        config = changed(config, {section: {key: number}})
    cases = [c for c in CASES if any(part in c for part in arguments.cases.split(","))]
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    print(
        f"{'case':20} {'method':10} {'rms m':>6} {'x':>5} {'worst m':>8} {'lost':>5} {'NEES':>5} "
        f"{'NIS':>5} {'gross acc':>9} {'good rej':>8} {'start m':>8} {'cycles':>6} "
        f"{'covered':>7} {'radius':>6}"
    )
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        jobs = {
            case: [pool.submit(measure, case, seed, config) for seed in seeds] for case in cases
        }
        for case, futures in jobs.items():
            results = [future.result() for future in futures]
            for method in arguments.methods.split(","):
                _print_row(case, method, [r[method] for r in results if method in r], len(results))


def _print_row(case: str, method: str, rows: list[Result], n: int) -> None:
    if not rows:
        print(f"{case:20} {method:10} never started")
        return
    middle = {
        name: float(np.median([getattr(row, name) for row in rows]))
        for name in Result.__dataclass_fields__
    }
    lost = sum(row.lost > 0.02 for row in rows)
    worst_start = max(row.start_error_m for row in rows)
    print(
        f"{case:20} {method:10} {middle['rms_m']:6.2f} {middle['ratio']:5.2f} "
        f"{max(row.max_m for row in rows):8.1f} {lost:5d} {middle['nees']:5.2f} "
        f"{middle['nis']:5.2f} {np.mean([r.gross_accepted for r in rows]):9.4f} "
        f"{np.mean([r.good_rejected for r in rows]):8.4f} {worst_start:8.1f} "
        f"{middle['cycles']:6.0f} {np.mean([r.covered for r in rows]):7.3f} "
        f"{middle['radius_m']:6.2f}"
        + ("" if len(rows) == n else f"  ({len(rows)} of {n} started)"),
        flush=True,
    )


if __name__ == "__main__":
    main()
