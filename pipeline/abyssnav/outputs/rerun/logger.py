# SPDX-License-Identifier: Apache-2.0
"""Columns into a recording, on the dive's clocks."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from abyssnav.errors import printable
from abyssnav.tables import Beacons, Dive, Float, Int

if TYPE_CHECKING:
    import rerun as rr

_SLICE: Final = 1 << 16


@dataclass(frozen=True, eq=False)
class RerunLogger:
    """An open recording and the dive it is of."""

    recording: "rr.RecordingStream"
    dive: Dive

    def static(self, path: str, archetype: Any) -> None:
        """Log what does not change."""
        self.recording.log(path, archetype, static=True)

    def columns(
        self, path: str, t_s: Float, archetype: Callable[[slice], Any], with_ping: bool = True
    ) -> None:
        """Send rows at `t_s`; `archetype` makes the columns of a slice of them."""
        import rerun as rr

        offset_ns = np.rint(t_s * 1e9).astype(np.int64)
        ping = self._pings_at(t_s) if with_ping else None
        for begin in range(0, len(t_s), _SLICE):
            rows = slice(begin, begin + _SLICE)
            utc_ns = self.dive.start_ns + offset_ns[rows]
            times = [  # datetime64, as int64 would be read as seconds and end as nulls
                rr.TimeColumn("time", timestamp=utc_ns.view("M8[ns]")),
                rr.TimeColumn("dive_time", duration=offset_ns[rows].view("m8[ns]")),
            ]
            if ping is not None:
                times.append(rr.TimeColumn("ping", sequence=ping[rows]))
            self.recording.send_columns(path, times, archetype(rows))

    @cached_property
    def _pings(self) -> tuple[Float, Int]:
        """Times and numbers of the pings that were answered, rising, after one before all."""
        order = np.argsort(self.dive.replies.t_ping_s, kind="stable")
        numbers = np.append(0, self.dive.replies.ping_id[order])
        return np.append(-np.inf, self.dive.replies.t_ping_s[order]), numbers

    def _pings_at(self, t_s: Float) -> Int:
        """Return the last answered ping sent by `t_s`; 0 before the first."""
        t_ping_s, number = self._pings
        return number[np.searchsorted(t_ping_s, t_s, side="right") - 1]


def beacon_parts(beacons: Beacons) -> dict[int, str]:
    """Beacon id -> its part of an entity path: the escaped name, with the id where two share it."""
    import rerun as rr

    names = [printable(str(name or k)) for name, k in zip(beacons.name, beacons.id, strict=True)]
    unique = [
        f"{name} {number}" if names.count(name) > 1 else name
        for name, number in zip(names, beacons.id, strict=True)
    ]
    return {int(k): rr.escape_entity_path_part(u) for k, u in zip(beacons.id, unique, strict=True)}
