# SPDX-License-Identifier: Apache-2.0
"""What a benchmark knows of a dive beyond its log: the bound, and which replies are wrong.

    <dive>.bound.parquet     time, filter_m, smoother_m
    <dive>.replies.parquet   ping_id, beacon_id, travel_time_s, direct_s, what

`simulate` writes both beside the logs of a benchmark; no estimator may read them.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from abyssnav.results import read_arrow
from abyssnav.score.given_track import Decisions
from abyssnav.tables import Float, Int, Table

#: A two-way time so far from the direct path's is grossly wrong: 7.5 m of range.
GROSS_S = 0.010


@dataclass(frozen=True, eq=False)
class DiveBound(Table):
    """Smallest possible rms error of a dive over time (posterior Cramér-Rao bound)."""

    time_ns: Int
    filter_m: Float  #: with what was received so far
    smoother_m: Float  #: with the whole dive

    def rms_m(self, time_ns: Int) -> tuple[float, float]:
        """√(mean tr P) over these instants, of a filter and of a smoother."""
        since_s, t_s = ((t - self.time_ns[0]) / 1e9 for t in (self.time_ns, time_ns))
        squared = [np.interp(t_s, since_s, m**2) for m in (self.filter_m, self.smoother_m)]
        return float(np.sqrt(squared[0].mean())), float(np.sqrt(squared[1].mean()))


def load_bound(log_path: Path) -> DiveBound | None:
    """Bound beside a log; None where there is none."""
    path = log_path.with_suffix(".bound.parquet")
    if not path.is_file():
        return None
    table = read_arrow(path, ("time", "filter_m", "smoother_m"))
    time_ns = table["time"].to_numpy().astype("M8[ns]").astype(np.int64)
    return DiveBound(time_ns, table["filter_m"].to_numpy(), table["smoother_m"].to_numpy())


def gate_shares(log_path: Path, decisions: Decisions) -> tuple[float, float] | None:
    """Share of the grossly wrong replies let in, and of the good ones thrown out.

    Among the replies that the gate met; NaN where there were none of a kind.  None where nothing
    beside the log says which are wrong.
    """
    path = log_path.with_suffix(".replies.parquet")
    if not path.is_file():
        return None
    import pandas as pd

    names = ["ping_id", "beacon_id", "travel_time_s"]
    truth, met = read_arrow(path, [*names, "direct_s"]).to_pandas(), pd.DataFrame()
    for name in names:
        met[name] = getattr(decisions, name)
    met["accepted"] = decisions.accepted
    for table in (truth, met):  # a file of decimals has lost the last of them
        table["travel_time_us"] = np.round(table.pop("travel_time_s") * 1e6).astype(np.int64)
    joined = truth.merge(met, on=["ping_id", "beacon_id", "travel_time_us"])
    gross = (joined["travel_time_us"] / 1e6 - joined["direct_s"]).abs() > GROSS_S
    return float(joined["accepted"][gross].mean()), float((~joined["accepted"][~gross]).mean())
