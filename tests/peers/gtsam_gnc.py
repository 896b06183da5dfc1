# SPDX-License-Identifier: Apache-2.0
"""GTSAM's robust batch over one log: `python gtsam_gnc.py LOG OUT.csv [loose]`.

As its range-only example has it (RangeISAMExample_plaza2): Pose2 nodes, BetweenFactorPose2 of the
odometry, RangeFactor2D to landmarks with priors; solved by the outlier-robust optimizer that GTSAM
ships, GncLMOptimizer (graduated non-convexity, truncated least squares), with its defaults (inlier
threshold at 99 %), priors and odometry known as inliers.  All factors are GTSAM's own, in C++.

A node's angle is the compass' offset, so that composing with dead reckoning's displacement turns
it.  A node is the middle of a ping and its reply, where half the two-way time is the range to a few
millimetres; with both depths known it becomes a horizontal range.  `loose`: the position may walk
more between two nodes.
"""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import gtsam
import numpy as np
import pandas as pd
from dive_reader import DiveData, read_dive, write_track
from gtsam.symbol_shorthand import L, X
from lbl_model import motion, start_of
from peer_settings import LOOSE_WALK_M2_PER_S


class Range(NamedTuple):
    """One reply as a horizontal range."""

    reply: Any
    t_s: float  #: halfway between ping and reply
    beacon_id: int
    range_m: float
    sigma_m: float
    lever_m: Any  #: (2,) of the transducer


def ranges(dive: DiveData, from_s: float) -> tuple[list[Range], list[Any]]:
    """Replies as ranges, and those that are no range: shorter than the depth between."""
    good, bad = [], []
    for row in dive.replies.itertuples():
        if row.t_ping < from_s or row.beacon_id not in dive.beacons:
            continue
        beacon_m, turn_around_s, _ = dive.beacons[int(row.beacon_id)]
        t_s = 0.5 * (row.t_ping + row.t_reply)  # the mean of both ways, whatever lies between
        lever = dive.interpolated(t_s, dive.lever_m)
        up_m = dive.interpolated(t_s, dive.up_m)[0] + lever[2]
        speed = dive.mean_speed(up_m, beacon_m[2])
        slant_m = 0.5 * (row.travel_time - turn_around_s) * speed
        level_m = np.sqrt(max(slant_m**2 - (up_m - beacon_m[2]) ** 2, 0.0))
        if slant_m <= 0.0 or level_m < 1.0:
            bad.append(row)
            continue
        # the time's noise, and a sound speed that is as wrong as is said
        sigma_m = np.hypot(
            0.5 * speed * dive.travel_time_sigma_s, slant_m * dive.sound_sigma_mps / speed
        )
        sigma_m *= slant_m / level_m
        good.append(Range(row, t_s, int(row.beacon_id), level_m, sigma_m, lever[:2]))
    return sorted(good, key=lambda one: one.t_s), bad


def build(
    dive: DiveData, times: Any, rows: list[Range]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, int]:
    """Graph, first guess, and how many of its first factors are known good."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    t0, x0, P0 = start_of(dive)
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(np.diag(P0)[:3]))
    graph.add(gtsam.PriorFactorPose2(X(0), gtsam.Pose2(*x0[:3]), noise))
    for number, (place, _, sigma_m) in dive.beacons.items():
        prior = gtsam.noiseModel.Isotropic.Sigma(2, sigma_m)
        graph.add(gtsam.PriorFactorPoint2(L(number), place[:2], prior))
        values.insert(L(number), place[:2])
    origin = dive.interpolated(t0, dive.run_m)
    for i, t_s in enumerate(times):
        run = dive.interpolated(t_s, dive.run_m)
        values.insert(X(i), gtsam.Pose2(*(x0[:2] + run - origin), 0.0))
        if i + 1 < len(times):
            moved, _, Q = motion(dive, t_s, times[i + 1], np.zeros(5))
            noise = gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(np.diag(Q)[:3] + 1e-10))
            step = gtsam.Pose2(*moved, 0.0)
            graph.add(gtsam.BetweenFactorPose2(X(i), X(i + 1), step, noise))
    known_good = graph.size()
    for t_s, place, sigma_m in dive.fixes:
        if t_s >= t0:
            node = X(int(np.searchsorted(times, t_s)))
            noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([sigma_m, sigma_m, 1e3]))
            graph.add(gtsam.PriorFactorPose2(node, gtsam.Pose2(*place, 0.0), noise))
    for row in rows:
        node = X(int(np.searchsorted(times, row.t_s)))
        noise = gtsam.noiseModel.Isotropic.Sigma(1, row.sigma_m)
        if np.any(row.lever_m):
            sensor = gtsam.Pose2(*row.lever_m, 0.0)
            factor = gtsam.RangeFactorWithTransform2D(
                node, L(row.beacon_id), row.range_m, noise, sensor
            )
        else:
            factor = gtsam.RangeFactor2D(node, L(row.beacon_id), row.range_m, noise)
        graph.add(factor)
    return graph, values, known_good


def run(dive: DiveData) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Track at 1 Hz, and whether each reply was accepted."""
    t0 = start_of(dive)[0]
    rows, bad = ranges(dive, t0)
    fixes_s = [t for t, _, _ in dive.fixes if t >= t0]
    times = np.unique([t0, *(row.t_s for row in rows), *fixes_s, dive.t_s[-1]])
    graph, values, known_good = build(dive, times, rows)
    params = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    params.setKnownInliers(list(range(known_good)))
    optimizer = gtsam.GncLMOptimizer(graph, values, params)
    values = optimizer.optimize()
    inlier = optimizer.getWeights() > 0.5
    kept = gtsam.NonlinearFactorGraph()
    for i in np.flatnonzero(inlier):
        kept.add(graph.at(int(i)))
    decisions = [(*_ids(row), False) for row in bad]
    decisions += [
        (*_ids(row.reply), bool(good))
        for row, good in zip(rows, inlier[graph.size() - len(rows) :], strict=True)
    ]
    columns = ["ping_id", "beacon_id", "travel_time_s", "accepted"]
    marginals = gtsam.Marginals(kept, values)
    poses = [values.atPose2(X(i)) for i in range(len(times))]
    cov = np.array([_position_cov(marginals.marginalCovariance(X(i)), pose)
                    for i, pose in enumerate(poses)])  # fmt: skip
    nodes = np.array([[pose.x(), pose.y(), pose.theta(), 0.0, 0.0] for pose in poses])
    return between_nodes(dive, times, nodes, cov), pd.DataFrame(decisions, columns=columns)


def _ids(row: Any) -> tuple[int, int, float]:
    return row.ping_id, row.beacon_id, row.travel_time


def _position_cov(cov: Any, pose: gtsam.Pose2) -> Any:
    """GTSAM's covariance is in the pose's own axes."""
    R = pose.rotation().matrix()
    return R @ cov[:2, :2] @ R.T


def between_nodes(dive: DiveData, times: Any, nodes: Any, cov: Any) -> pd.DataFrame:
    """1 Hz between the nodes: dead reckoning, its closing error spread evenly."""
    rows = []
    for t_s in np.arange(np.ceil(times[0]), times[-1]):
        i = min(int(np.searchsorted(times, t_s, side="right")) - 1, len(times) - 2)
        share = (t_s - times[i]) / (times[i + 1] - times[i])
        moved = motion(dive, times[i], t_s, nodes[i])[0]
        whole, _, Q = motion(dive, times[i], times[i + 1], nodes[i])
        closing = nodes[i + 1, :2] - nodes[i, :2] - whole
        place = nodes[i, :2] + moved + share * closing
        P = (1 - share) * cov[i] + share * cov[i + 1] + share * (1 - share) * Q[:2, :2]
        rows.append((t_s, *place, *np.sqrt(np.diag(P)), P[0, 1]))
    names = ["t", "east_m", "north_m", "sigma_east_m", "sigma_north_m", "cov_east_north_m2"]
    return pd.DataFrame(rows, columns=names)


def main() -> None:
    dive = read_dive(Path(sys.argv[1]))
    if sys.argv[3:] == ["loose"]:
        dive = replace(dive, walk_m2_per_s=LOOSE_WALK_M2_PER_S)
    write_track(Path(sys.argv[2]), dive, *run(dive))


if __name__ == "__main__":
    main()
