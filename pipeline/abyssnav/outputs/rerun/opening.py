# SPDX-License-Identifier: Apache-2.0
"""At which instant a viewer stands as it opens a recording."""

from pathlib import Path
from time import monotonic, sleep
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import PipelineError
from abyssnav.outputs.rerun.blueprint import BEST_FILTER
from abyssnav.results import read_table
from abyssnav.tables import Int

_WAIT_S: Final = 30.0
_PAUSE_S: Final = 0.3
_AFTER_NS: Final = 1_000_000  #: past the last reply, however its time was rounded


def last_full_ping(ping_id: Int, times: NDArray[Any]) -> Any:
    """Last time of the last ping that has the most rows: there the most circles meet."""
    pings, count = np.unique(ping_id, return_counts=True)
    last = ping_id == pings[np.flatnonzero(count == count.max())[-1]]
    return times[last].max()


def opening_time_ns(folder: Path) -> int | None:
    """UTC at which all circles of a ping meet, of a dive's folder; None where it does not say."""
    try:
        table = read_table(
            folder / "innovations.parquet", ["method", "ping_id", "time", "accepted"]
        ).columns
    except PipelineError:
        return None
    for method in BEST_FILTER:
        rows = (table["method"] == method) & table["accepted"].astype(bool)
        if rows.any():
            last_ns = int(last_full_ping(table["ping_id"][rows], table["time_ns"][rows]))
            return last_ns + _AFTER_NS
    return None


def stand_at(time_ns: int, url: str = "rerun+http://127.0.0.1:9876/proxy") -> bool:
    """Move the time line of a viewer that is opening a recording; whether it could be done.

    A recording itself cannot say where it opens, but for its end (Rerun 0.41).
    """
    end_s = monotonic() + _WAIT_S
    while monotonic() < end_s:
        try:  # the viewer may not listen yet, and this door of it is new and may change
            from rerun.experimental import ViewerClient

            viewer = ViewerClient.connect(url)
            if any(recording.timelines for recording in viewer.get_state().recordings):
                instant = np.datetime64(time_ns, "ns")
                viewer.set_time("time", timestamp=instant, play_state="paused")
                return True
        except ImportError:
            return False
        except Exception:  # what it raises is its own; without it the recording opens at its end
            sleep(_PAUSE_S)
            continue
        sleep(_PAUSE_S)
    return False
