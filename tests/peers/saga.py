# SPDX-License-Identifier: Apache-2.0
"""The survey SAGA.1903 as two logs for all peers: as recorded, and a tenth of its replies wrong.

What was recorded and what was made of it is in tests/real_logs.py.  The outliers are planted, so it
is known which they are; of the survey itself nobody knows.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parent.parent))
from real_logs import SETTINGS, UnavailableError, write_survey_log

from abyssnav.align import reference
from abyssnav.profile import load_profile
from abyssnav.read import read_optional

__all__ = ["UnavailableError", "write_saga"]

#: The reference at the first ping, so far off along each axis.
_OFF_M = (7.0, -6.0)
_WRONG = 0.1


def write_saga(folder: Path) -> None:
    """Both logs with settings and start; nothing where they are."""
    folder.mkdir(parents=True, exist_ok=True)
    logs = {"saga_1903": 0.0, "saga_1903_outliers_10": _WRONG}
    if all((folder / f"{name}.mcap").is_file() for name in logs):
        return
    replies = {}
    for name, outliers in logs.items():
        path = folder / f"{name}.mcap"
        write_survey_log(path, outliers)
        path.with_suffix(".settings.toml").write_text(SETTINGS, encoding="utf-8")
        log = read_optional([path], load_profile(), ("reference", "travel_time"))
        replies[name] = pd.DataFrame(
            {
                key: log.roles["travel_time"][key]
                for key in ("ping_id", "beacon_id", "travel_time_s")
            }
        )
        first_ns = int(log.roles["travel_time"]["ping_time_ns"].min())
        truth = reference(log)
        assert truth is not None
        place = [
            float(np.interp(0.0, (truth.time_ns - first_ns) / 1e9, axis))
            for axis in truth.position_enu_m[:, :2].T
        ]
        first = np.datetime64(first_ns, "ns").astype("M8[us]")
        east, north = (round(p + off, 2) for p, off in zip(place, _OFF_M, strict=True))
        path.with_suffix(".start.toml").write_text(
            f"[start]\nposition_m = [{east}, {north}]\nsigma_m = 10.0\nat = {first}Z\n",
            encoding="utf-8",
        )
    clean, spoilt = replies.values()
    clean = clean.rename(columns={"travel_time_s": "direct_s"})
    both = spoilt.merge(clean, on=["ping_id", "beacon_id"])
    both.to_parquet(folder / "saga_1903_outliers_10.replies.parquet")
