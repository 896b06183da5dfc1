# SPDX-License-Identifier: Apache-2.0
"""A plain script with SciPy over one log: `python scipy_script.py LOG OUT.csv`.

What a user writes in an afternoon: a robust least-squares fix a ping (`least_squares`, whose
documentation advises `soft_l1` against outliers), fixes that do not fit thrown out, and dead
reckoning shifted onto the rest by a running median.  It needs no start and claims no covariance.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from dive_reader import DiveData, read_dive, write_track
from lbl_model import TravelTime
from scipy.optimize import least_squares

#: A fix whose largest residual is larger is none: 5 sigma.
WORST_SIGMAS = 5.0
#: Fixes of the running median: two minutes and a half each way.
WINDOW = 13
#: Where each ping asks one beacon.
CYCLE_S = 60.0


def fix(dive: DiveData, replies: pd.DataFrame, guess: Any) -> tuple[Any, Any] | None:
    """Position at the ping, and the replies' residuals over sigma; None where it is no good."""
    t_ping = replies["t_ping"].iloc[0]
    models = [TravelTime(dive, row, t_ping) for row in replies.itertuples()]
    measured = replies["travel_time"].to_numpy()
    sigma = np.sqrt([model.variance_s2 for model in models])

    def residuals(place: Any) -> Any:
        x = np.array([*place, 0.0, 0.0, 0.0])
        return (np.array([model.predict(x)[0] for model in models]) - measured) / sigma

    result = least_squares(residuals, guess, loss="soft_l1", x_scale=100.0)
    return (result.x, np.abs(residuals(result.x))) if result.success else None


def cycles(replies: pd.DataFrame) -> Any:
    """Number of the fix that a reply serves: its ping's, or its minute's where a ping asks one."""
    if replies.groupby("ping_id").size().median() > 1:
        return replies["ping_id"]
    return replies["t_ping"] // CYCLE_S


def run(dive: DiveData) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Track at 1 Hz, and whether each reply took part in a fix that was kept."""
    middle = np.mean([place[:2] for place, _, _ in dive.beacons.values()], axis=0)
    known = dive.replies[dive.replies["beacon_id"].isin(list(dive.beacons))]
    known = known.drop_duplicates(["ping_id", "beacon_id"])
    known["cycle"] = cycles(known)
    shifts, decisions = [], []
    guess = middle
    for _, replies in known.groupby("cycle", sort=True):
        result = fix(dive, replies, guess) if len(replies) >= 3 else None
        good = np.zeros(len(replies), dtype=bool)
        if result is not None:
            place, off = result
            good = off < WORST_SIGMAS
        if good.sum() >= 3:
            t_ping = replies["t_ping"].iloc[0]
            shifts.append((t_ping, *(place - dive.interpolated(t_ping, dive.run_m))))
            guess = place
        else:
            good[:] = False
        ids = replies[["ping_id", "beacon_id", "travel_time"]].itertuples(index=False)
        decisions += [(*row, bool(kept)) for row, kept in zip(ids, good, strict=True)]
    columns = ["ping_id", "beacon_id", "travel_time_s", "accepted"]
    table = pd.DataFrame(shifts, columns=["t", "east", "north"])
    smooth = table.rolling(WINDOW, center=True, min_periods=1).median()
    t_s = np.arange(np.ceil(table["t"].min()), dive.t_s[-1]) if len(table) else np.empty(0)
    track = {"t": t_s}
    for axis, name in enumerate(("east", "north")):
        shift = np.interp(t_s, table["t"], smooth[name]) if len(table) else t_s
        track[f"{name}_m"] = np.interp(t_s, dive.t_s, dive.run_m[:, axis]) + shift
    return pd.DataFrame(track), pd.DataFrame(decisions, columns=columns)


def main() -> None:
    dive = read_dive(Path(sys.argv[1]), start=False)
    write_track(Path(sys.argv[2]), dive, *run(dive))


if __name__ == "__main__":
    main()
