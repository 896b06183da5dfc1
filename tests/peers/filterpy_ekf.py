# SPDX-License-Identifier: Apache-2.0
"""FilterPy's ExtendedKalmanFilter: `python filterpy_ekf.py LOG OUT.csv [GATE [loose]]`.

As its book has it: Jacobian and measurement as functions given to `update`, R per measurement, and
bad measurements kept away by the Mahalanobis distance, 3 standard deviations (chapter "Designing
Kalman Filters", "Detecting and Rejecting Bad Measurement").  GATE: `mahalanobis`; `wide`, the same
at 5, which the chapter names beside 3; `fixed`, 3 sigma of the measurement whatever the filter's
own uncertainty; `range`, that and 1 % of the slant range.  Those last two would never let go of a
start that is 10 m off: until the position is known to 5 m, and when it no longer is, the distance
judges for them too.  `loose`: the position may walk more.
"""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from dive_reader import DiveData, read_dive, write_track
from filterpy.kalman import ExtendedKalmanFilter
from lbl_model import TravelTime, motion, start_of
from peer_settings import LOOSE_WALK_M2_PER_S, RANGE_GATE_SHARE

GATE_SIGMAS = 3.0
WIDE_SIGMAS = 5.0
SETTLED_M = 5.0


def is_inside(gate: str, y: Any, S: Any, R: Any, ranged: float) -> bool:
    """Whether an innovation passes the rule."""
    if gate in {"mahalanobis", "wide"}:
        most = WIDE_SIGMAS if gate == "wide" else GATE_SIGMAS
        return bool(np.sqrt(y @ np.linalg.solve(S, y)) < most)
    wide = GATE_SIGMAS * np.sqrt(np.diag(R)) + (ranged if gate == "range" else 0.0)
    return bool(np.all(np.abs(y) < wide))


class LblEkf(ExtendedKalmanFilter):
    """The five states; `predict` goes to an instant."""

    def __init__(self, dive: DiveData) -> None:
        super().__init__(dim_x=5, dim_z=1)
        self.dive = dive
        self.t_s, self.x, self.P = start_of(dive)

    def predict_to(self, t_s: float) -> None:
        self.moved, self.F, self.Q = motion(self.dive, self.t_s, t_s, self.x)
        self.predict()
        self.t_s = t_s

    def predict_x(self, u: Any = 0) -> None:  # noqa: ARG002  # its way where F is not enough
        self.x = self.x.copy()
        self.x[:2] += self.moved

    def try_update(self, z: Any, hx: Any, H: Any, R: Any, gate: str, ranged: float) -> bool:
        S = H @ self.P @ H.T + R
        if gate != "wide" and np.sqrt(np.trace(self.P[:2, :2])) > SETTLED_M:
            gate = "mahalanobis"
        inside = is_inside(gate, z - hx, S, R, ranged)
        if inside:
            self.update(z, lambda _: H, lambda _: hx, R=R)
        return inside


def run(dive: DiveData, gate: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Track at 1 Hz, and whether each reply was accepted."""
    ekf = LblEkf(dive)
    events = [(row.t_reply, 0, row) for row in dive.replies.itertuples()]
    events += [(t, 1, (t, place, sigma)) for t, place, sigma in dive.fixes]
    events += [(t, 2, None) for t in np.arange(np.ceil(ekf.t_s), dive.t_s[-1])]
    track, decisions = [], []
    for t_s, kind, what in sorted(events, key=lambda event: event[:2]):
        if t_s < ekf.t_s:
            continue
        ekf.predict_to(t_s)
        if kind == 0 and what.beacon_id in dive.beacons:
            reply = TravelTime(dive, what, t_s)
            hx, H = reply.predict(ekf.x)
            z, R = np.array([what.travel_time]), np.array([[reply.variance_s2]])
            ranged = RANGE_GATE_SHARE * (hx - reply.turn_around_s)
            accepted = ekf.try_update(z, np.array([hx]), H[None], R, gate, ranged)
            decisions.append((what.ping_id, what.beacon_id, what.travel_time, accepted))
        elif kind == 1:
            _, place, sigma = what
            ekf.try_update(place, ekf.x[:2], np.eye(2, 5), sigma**2 * np.eye(2), "mahalanobis", 0.0)
        elif kind == 2:
            sigma = np.sqrt(np.diag(ekf.P)[:2])
            track.append((t_s, *ekf.x[:2], *sigma, ekf.P[0, 1]))
    names = ["t", "east_m", "north_m", "sigma_east_m", "sigma_north_m", "cov_east_north_m2"]
    columns = ["ping_id", "beacon_id", "travel_time_s", "accepted"]
    return pd.DataFrame(track, columns=names), pd.DataFrame(decisions, columns=columns)


def main() -> None:
    log, out, *words = sys.argv[1:]
    dive = read_dive(Path(log))
    if words[1:] == ["loose"]:
        dive = replace(dive, walk_m2_per_s=LOOSE_WALK_M2_PER_S)
    write_track(Path(out), dive, *run(dive, *(words[:1] or ["mahalanobis"])))


if __name__ == "__main__":
    main()
