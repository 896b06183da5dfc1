# SPDX-License-Identifier: Apache-2.0
"""A made-up solution with every method, for the tests of what is done with one."""

import dataclasses

import numpy as np

from abyssnav.compare import error_over_time, summarise
from abyssnav.config import Config
from abyssnav.outputs.files import write
from abyssnav.outputs.summary import summarise_dive
from abyssnav.tables import (
    DECISIONS,
    METHODS,
    VERDICTS,
    Beacons,
    Check,
    Depth,
    Dive,
    Evaluation,
    Event,
    Fixes,
    GateIntegrity,
    GateStatistics,
    Heading,
    Innovations,
    InputFile,
    LegAccuracy,
    Log,
    Origin,
    PositionInnovations,
    Positions,
    Reason,
    Reference,
    Replies,
    SensorEstimates,
    Solution,
    SoundSpeed,
    Start,
    Track,
    Velocity,
    Verdict,
)

ORIGIN = Origin(42.5, 145.25)
CONFIG = Config()
START_NS = 1_760_000_000_000_000_000
SPREAD_M = {"dead_reckoning": 40.0, "kf_fix": 5.0, "ekf_ungated": 15.0, "ekf_gated": 2.5}
SPREAD_M |= {"ekf": 1.6, "smoother": 1.0}
BEACONS_ENU_M = np.array(
    [[-900.0, -700.0, -4950.0], [2400, -600, -4940], [2300, 1900, -4960], [-800, 1800, -4930]]
)


def lawn_mower_enu_m(t_s, speed_mps=1.2, leg_m=1400.0, spacing_m=150.0):
    """Position on legs east and west, one `spacing_m` north of the other, at 4,900 m."""
    run_m = np.asarray(t_s, float) * speed_mps
    leg, along_m = np.divmod(run_m, leg_m + spacing_m)
    east_m = np.where(leg % 2 == 0, np.minimum(along_m, leg_m), leg_m - np.minimum(along_m, leg_m))
    north_m = leg * spacing_m + np.maximum(along_m - leg_m, 0.0)
    return np.column_stack([east_m, north_m, np.full_like(run_m, -4900.0)])


def _wander(rng, n, size_m):
    """Slow two-dimensional error whose standard deviation is about `size_m`."""
    steps = rng.normal(size=(n // 60 + 2, 2)).cumsum(axis=0)
    steps *= size_m / max(steps.std(), 1e-9)
    at = np.arange(n) / 60.0
    return np.column_stack([np.interp(at, np.arange(len(steps)), steps[:, k]) for k in (0, 1)])


def _track(rng, method, duration_s, rate_hz):
    t_s = np.arange(0.0 if method == "smoother" else 120.0, duration_s, 1.0 / rate_hz)
    enu_m = lawn_mower_enu_m(t_s)
    enu_m[:, :2] += _wander(rng, len(t_s), SPREAD_M[method])
    cov_m2 = np.zeros((len(t_s), 2, 2))
    cov_m2[:, 0, 0] = SPREAD_M[method] ** 2
    cov_m2[:, 1, 1] = 1.5 * SPREAD_M[method] ** 2
    cov_m2[:, 0, 1] = cov_m2[:, 1, 0] = 0.3 * SPREAD_M[method] ** 2
    step = np.diff(lawn_mower_enu_m(np.append(t_s, t_s[-1] + 1.0)), axis=0)
    heading_rad = np.arctan2(step[:, 0], step[:, 1])
    roll_rad, pitch_rad = 0.02 * np.sin(t_s), 0.03 * np.cos(t_s / 5)
    forward_mps, altitude_m = np.full_like(t_s, 1.2), np.where(t_s % 100 < 50, 60.0, np.nan)
    state = (roll_rad, pitch_rad, forward_mps, 0.01 * np.sin(t_s), altitude_m)
    return Track(t_s, enu_m, cov_m2, heading_rad, *state)


def _replies(rng, duration_s, beacons_enu_m):
    n_pings, n_beacons = int(duration_s // 24), len(beacons_enu_m)
    ping, beacon = np.divmod(np.arange(n_pings * n_beacons), n_beacons)
    keep = rng.uniform(size=len(ping)) < 0.8
    ping, beacon = ping[keep], beacon[keep]
    t_ping_s = 24.0 * ping
    gross_s = np.where(rng.uniform(size=len(ping)) < 0.12, rng.uniform(0.03, 3.0, len(ping)), 0.0)
    enu_m = lawn_mower_enu_m(t_ping_s)
    range_m = np.linalg.norm(enu_m - beacons_enu_m[beacon], axis=1)
    travel_s = 2 * range_m / 1500.0 + 0.5 + gross_s + rng.normal(0, 0.002, len(ping))
    order = np.argsort(t_ping_s + travel_s, kind="stable")
    columns = {
        "ping_id": ping + 1,
        "beacon_id": beacon + 11,
        "beacon": beacon,
        "t_ping_s": t_ping_s,
        "t_reply_s": t_ping_s + travel_s,
        "travel_time_s": travel_s,
        "snr_db": np.full(len(ping), np.nan),
        "depth_ping_m": np.full(len(ping), 4900.0),
        "depth_reply_m": np.full(len(ping), 4900.0),
        "lever_ping_enu_m": np.zeros((len(ping), 3)),
        "lever_reply_enu_m": np.zeros((len(ping), 3)),
        "beacon_enu_m": beacons_enu_m[beacon],
        "turn_around_s": np.full(len(ping), 0.5),
        "beacon_sigma_m": np.zeros(len(ping)),
    }
    return Replies(**columns)[order], gross_s[order]


def _innovations(rng, method, replies, gross_s):
    known = replies.t_ping_s > 120.0
    sigma_s = np.where(known, 0.002 + 0.001 * rng.uniform(size=len(replies)), np.nan)
    nu_s = np.where(known, gross_s + sigma_s * rng.normal(size=len(replies)), np.nan)
    nis = (nu_s / sigma_s) ** 2
    passed = known & ((nis <= 9.21) | (method == "ekf_ungated"))
    decision = np.where(passed, 0, np.where(known, 1, DECISIONS.index("before_start")))
    arrival = np.where(known, np.where(nis <= 9.21, 1, 2 + (gross_s > 1.0)), 0)
    columns = {
        "ping_id": replies.ping_id,
        "beacon_id": replies.beacon_id,
        "t_ping_s": replies.t_ping_s,
        "t_reply_s": replies.t_reply_s,
        "travel_time_s": replies.travel_time_s,
        "predicted_s": replies.travel_time_s - nu_s,
        "innovation_s": nu_s,
        "innovation_sigma_s": sigma_s,
        "nis": nis,
        "decision": decision,
        "arrival": arrival,
        "explanation": arrival,
    }
    return Innovations(**{f.name: columns[f.name] for f in dataclasses.fields(Innovations)})


def _statistics(innovations):
    ids = np.unique(innovations.beacon_id)
    mine = innovations.beacon_id[:, None] == ids
    counts = [(mine & (innovations.decision[:, None] == k)).sum(0) for k in range(len(DECISIONS))]
    met = np.where(mine & (innovations.decision[:, None] <= 1), innovations.nis[:, None], np.nan)
    sigma_s = np.where(mine, innovations.innovation_sigma_s[:, None], np.nan)
    return GateStatistics(
        ids,
        mine.sum(0),
        *counts,
        mean_nis=np.nanmean(met, axis=0),
        nis_inside_95=np.nanmean(np.where(np.isnan(met), np.nan, met < 3.84), axis=0),
        smallest_visible_outlier_m=0.5 * 1500 * np.sqrt(9.21) * np.nanmedian(sigma_s, axis=0),
        largest_unseen_step_m=np.full(len(ids), 2.0),
        verdict=np.zeros(len(ids), dtype=int),
    )


def _watch(innovations, duration_s):
    begin_s = np.arange(120.0, duration_s, 900.0)
    ids, first_s = np.repeat(np.unique(innovations.beacon_id), len(begin_s)), begin_s
    t_begin_s = np.tile(first_s, len(ids) // len(begin_s))
    now = (innovations.t_reply_s[:, None] >= t_begin_s) & (
        innovations.t_reply_s[:, None] < t_begin_s + 900.0
    )
    mine = now & (innovations.beacon_id[:, None] == ids)
    verdict = np.zeros(len(ids), dtype=int)
    verdict[-1] = VERDICTS.index("starving")
    return GateIntegrity(
        ids,
        t_begin_s,
        t_begin_s + 900.0,
        (mine & (innovations.decision[:, None] == 0)).sum(0),
        (mine & (innovations.decision[:, None] == 1)).sum(0),
        np.full(len(ids), 5.0),
        np.full(len(ids), 2.0),
        verdict,
    )


def _estimates(duration_s):
    t_s = np.arange(120.0, duration_s, 24.0)
    flat = np.ones_like(t_s)
    wave = np.sin(t_s / 1000.0)
    return SensorEstimates(
        t_s, 0.02 * wave, 0.01 * flat, 0.003 * wave, 0.001 * flat, 1e-4 * wave, 1e-4 * flat
    )


def _accuracy(duration_s):
    begin_s = np.arange(0.0, duration_s, 1200.0)
    flat = np.ones_like(begin_s)
    radii_m = (1.2 * flat, 1.7 * flat, 1.6 * flat, 1.0 * flat, 0.9 * flat, np.nan * flat)
    return LegAccuracy(
        begin_s,
        begin_s + 1200.0,
        0.5 * np.pi * flat,
        1440.0 * flat,
        np.full(len(flat), 160),
        *radii_m,
        2.0 + 0.1 * np.arange(len(flat)),
    )


def _fixes(rng, duration_s):
    ping = np.arange(1, int(duration_s // 24) + 1)[rng.uniform(size=int(duration_s // 24)) < 0.6]
    t_s = (ping - 1) * 24.0 + 8.0
    consistent = rng.uniform(size=len(ping)) < 0.85
    enu_m = lawn_mower_enu_m(t_s)
    enu_m[:, :2] += rng.normal(size=(len(ping), 2)) * np.where(consistent, 3.0, 80.0)[:, None]
    return Fixes(
        t_s,
        t_s - 4.0,
        ping,
        ping - 1,
        enu_m,
        np.tile(np.eye(2) * 4.0, (len(ping), 1, 1)),
        np.full(len(ping), 4),
        np.where(consistent, 0.002, 0.2),
        consistent,
    )


def _dive(replies, duration_s, name, names, origin):
    t_s = np.arange(0.0, duration_s, 1.0)
    flat, enu_m = np.zeros(len(t_s)), lawn_mower_enu_m(t_s)
    forward = np.column_stack([flat + 1.2, flat, flat])
    return Dive(
        name=name,
        start_ns=START_NS,
        origin=origin,
        heading=Heading(t_s, flat, flat, flat),
        velocity=Velocity(t_s, forward, flat == 0, flat, flat, flat),
        depth=Depth(t_s, -enu_m[:, 2]),
        replies=replies,
        beacons=Beacons(
            np.arange(11, 11 + len(names)),
            np.array(names),
            BEACONS_ENU_M[: len(names)],
            np.full(len(names), 0.5),
            np.full(len(names), 1.0),
        ),
        sound_speed=SoundSpeed(np.array([0.0, 6000.0]), np.array([1500.0, 1500.0])),
        checks=(Check("align", "velocity gap", 31.0, 1.0, "s", False, "at 4,000 s"),),
    )


def make_solution(
    duration_s=3 * 3600.0,
    rate_hz=1.0,
    seed=1,
    name="dive_1",
    beacon_names=("Alpha", "Bravo", "Charlie", "Delta"),
    origin=ORIGIN,
):
    """Solution with all methods whose errors are about `SPREAD_M`, and its reference."""
    rng = np.random.default_rng(seed)
    methods = [method for method in METHODS if method != "fix"]
    replies, gross_s = _replies(rng, duration_s, BEACONS_ENU_M[: len(beacon_names)])
    innovations = {m: _innovations(rng, m, replies, gross_s) for m in methods[2:5]}
    solution = Solution(
        dive=_dive(replies, duration_s, name, beacon_names, origin),
        tracks={m: _track(rng, m, duration_s, rate_hz) for m in methods},
        fixes=_fixes(rng, duration_s),
        innovations=innovations,
        statistics={m: _statistics(i) for m, i in innovations.items()},
        starts={m: Start(120.0, 144.0, 0.0, 5, "m_of_n") for m in methods},
        gamma=9.21,
        estimates={m: _estimates(duration_s) for m in ("ekf", "smoother")},
        watch={m: _watch(i, duration_s) for m, i in innovations.items()},
        accuracy=_accuracy(duration_s),
        events=(Event(1000.0, "ekf", "recovered by consensus"),),
        checks=(Check("navigate", "replies gated", 0.12, 0.5, "", True, "of ekf_gated"),),
    )
    t_s = np.arange(0.0, duration_s, 1.0)
    time_ns = START_NS + (t_s * 1e9).astype(np.int64)
    return solution, Reference(time_ns, lawn_mower_enu_m(t_s))


def stripped(solution, **of_dive):
    """The dive with nothing made of it; `of_dive` takes the place of the dive's own tables."""
    return dataclasses.replace(
        solution,
        dive=dataclasses.replace(solution.dive, **of_dive),
        tracks={},
        innovations={},
        statistics={},
        starts={},
        estimates={},
        watch={},
        accuracy=None,
        events=(),
        fixes=solution.fixes[:0],
    )


def with_positions(solution, n=90):
    """The solution with fixes of another kind, 4 m before the navigated point; a tenth is wrong."""
    t_s = np.linspace(60.0, solution.dive.depth.t_s[-1] - 60.0, n)
    wrong = np.arange(n) % 10 == 7
    enu_m = lawn_mower_enu_m(t_s)[:, :2] + np.where(wrong, 90.0, 2.0)[:, None]
    off_m = np.tile(np.where(wrong, 90.0, 2.0)[:, None], (1, 2))
    sigma_m, nis = np.full((n, 2), 5.0), (off_m**2).sum(axis=1) / 25.0
    lever_m = np.tile([4.0, 0.0, 1.0], (n, 1))
    cov_m2 = np.tile(25.0 * np.eye(2), (n, 1, 1))
    early = np.where(t_s < 120.0, DECISIONS.index("before_start"), wrong)
    judged_by = {
        method: PositionInnovations(t_s, enu_m, sigma_m, off_m, nis, decision)
        for method, decision in (("ekf", early), ("smoother", wrong.astype(int)))
    }
    table = Positions(t_s, enu_m + lever_m[:, :2], cov_m2, lever_m)
    dive = dataclasses.replace(solution.dive, positions=table)
    return dataclasses.replace(solution, dive=dive, positions=judged_by)


def judged(solution, level):
    """The solution with a verdict of that level; what is below good has two reasons."""
    reasons = (
        Reason(
            "heading_constant",
            "The compass never changes.",
            "Heading varies by 0.0° while the fixes turn by 540°.",
            "Check the compass topic in the profile.",
        ),
        Reason(
            "beacon_moved",
            "Beacon Bravo is not where it was surveyed.",
            "Its replies are 6.1 ms late on all bearings.",
            "Survey it again, or leave it out.",
        ),
    )
    verdict = Verdict(level, () if level == "good" else reasons)
    accuracy = solution.accuracy
    if level == "unusable" and accuracy is not None:
        nothing = np.full(len(accuracy), np.nan)
        accuracy = dataclasses.replace(accuracy, uncertainty_95_m=nothing)
    return dataclasses.replace(solution, verdict=verdict, accuracy=accuracy)


def unpositioned(solution):
    """Dead reckoning from nowhere: no replies, fixes, starts or other tracks."""
    bare = stripped(solution, replies=solution.dive.replies[:0])
    way = {"dead_reckoning": solution.tracks["dead_reckoning"]}
    return judged(dataclasses.replace(bare, tracks=way), "unusable")


def make_log(solution):
    """Log that the solution could have come from, as far as the outputs look at it."""
    messages = {"/lbl/travel_time": len(solution.dive.replies), "/dvl": 5}
    inputs = (InputFile(f"{solution.dive.name}.mcap", 1234, messages),)
    return Log(solution.dive.name, inputs, "default", {"velocity": "/dvl"}, {}, ())


def make_summary(solution, comparison, log=None, config=CONFIG):
    """What `summary.json` could hold of a solution, but for what only `run` knows."""
    log = log or make_log(solution)
    hashes = {file.name: "ab" * 32 for file in log.inputs}
    return summarise_dive(solution, comparison, log, config, hashes)


def write_dive(folder, solution, reference=None):
    """Tables and messages of a solution in a folder that is made for them."""
    folder.mkdir()
    errors = error_over_time(solution, reference)
    write(Evaluation(solution, summarise(errors), errors, reference), folder)
    return folder
