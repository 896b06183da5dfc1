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


#: First and last of the letters that the viewer's only font is known to have: Latin, Greek,
#: Cyrillic, dashes and quotes; and signs that our own words use.
_DRAWN: Final = (
    (0x20, 0x7E),
    (0xA1, 0x148),
    (0x14A, 0x17E),
    (0x391, 0x3A1),
    (0x3A3, 0x3A9),
    (0x3B1, 0x3C9),
)
_DRAWN_MORE: Final = ((0x410, 0x44F), (0x2013, 0x2014), (0x2018, 0x201D))
_DRAWN_SIGNS: Final = frozenset("√∞≤≥→↑⚠✔")


def drawable(text: str) -> str:
    """Text with every letter escaped that the viewer cannot draw.

    Rerun 0.41 ends with a panic at the first letter that its font lacks, such as a beacon's name
    in Chinese; an escaped name can be read, a recording that kills the viewer cannot.
    """
    if text.isascii() and text.isprintable():  # nearly all are
        return text
    return "".join(
        letter
        if letter in _DRAWN_SIGNS
        or any(first <= ord(letter) <= last for first, last in (*_DRAWN, *_DRAWN_MORE))
        else letter.encode("unicode_escape").decode()
        for letter in printable(text)
    )


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

    names = [drawable(str(name or k)) for name, k in zip(beacons.name, beacons.id, strict=True)]
    unique = [
        f"{name} {number}" if names.count(name) > 1 else name
        for name, number in zip(names, beacons.id, strict=True)
    ]
    return {int(k): rr.escape_entity_path_part(u) for k, u in zip(beacons.id, unique, strict=True)}
