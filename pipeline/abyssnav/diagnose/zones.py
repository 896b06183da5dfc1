# SPDX-License-Identifier: Apache-2.0
"""Clocks that differ by whole quarters of an hour: the shift under which dead reckoning fits."""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from abyssnav.diagnose.motion import READINGS, score_readings
from abyssnav.tables import Dive, Fixes

#: Zones differ by these; so many of the nearest are tried.
_ZONE_S, _MOST_ZONES = 900.0, 16
#: Share of the fixes that must fall within the dive, and evidence a fix that a shift must win.
_LEAST_INSIDE, _LEAST_GAIN = 0.6, 2.0


class Shift(NamedTuple):
    """Seconds to be added to the replies' stamps, and the log likelihood a fix under it."""

    offset_s: float
    log_likelihood: float


def best_shift(dive: Dive, fixes: Fixes, offsets_s: Iterable[float]) -> Shift | None:
    """The shift of the replies under which the fixes fit dead reckoning best; None: none can be."""
    if not len(fixes):
        return None
    as_given = tuple(r for r in READINGS if r.name in ("", "clock_offset"))
    known_s = dive.velocity.t_s[dive.velocity.valid]
    begin_s, end_s = max(known_s[0], dive.heading.t_s[0]), min(known_s[-1], dive.heading.t_s[-1])
    best: Shift | None = None
    for offset_s in offsets_s:
        t_s = fixes.t_mid_s + offset_s
        inside = (t_s >= begin_s) & (t_s <= end_s)
        if np.mean(inside) < _LEAST_INSIDE:
            continue
        shifted = replace(fixes, t_s=fixes.t_s + offset_s, t_mid_s=t_s)
        scored = score_readings(dive, shifted[inside], as_given)
        if not scored:
            continue
        # The replies lie this much of way ahead: their stamps are so much too early still.
        early_s = float(scored[0].value["clock"][0]) if scored[0].reading.name else 0.0
        log_p = scored[0].log_likelihood / max(int(inside.sum()), 1)
        if best is None or log_p > best.log_likelihood:
            best = Shift(offset_s + early_s, log_p)
    return best


def zone_shift(dive: Dive, fixes: Fixes, log_likelihood: float) -> Shift | None:
    """A shift by quarters of an hour that fits far better than the best reading without one."""
    fixes = fixes[fixes.consistent]
    if not len(fixes):
        return None
    steps = np.arange(1, _MOST_ZONES // 2 + 1) * _ZONE_S
    best = best_shift(dive, fixes, np.column_stack([steps, -steps]).ravel().tolist())
    if best is None or best.log_likelihood < log_likelihood / len(fixes) + _LEAST_GAIN:
        return None
    return best


def offset_between(dive: Dive, fixes: Fixes, guess_s: float) -> float:
    """Seconds to be added to the replies' stamps where they share no time with the velocities."""
    fixes = fixes[fixes.consistent]
    near = round(guess_s / _ZONE_S) * _ZONE_S
    best = best_shift(dive, fixes, (near, guess_s, near - _ZONE_S, near + _ZONE_S))
    return guess_s if best is None else best.offset_s
