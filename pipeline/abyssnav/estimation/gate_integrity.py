# SPDX-License-Identifier: Apache-2.0
"""Integrity of a gate: minimal detectable bias and external reliability, by beacon and time.

After W. Baarda, "A Testing Procedure for Use in Geodetic Networks" (1968), for a power of one half:
a bias as large as the threshold is found in every other case, so the non-centrality is γ itself.
"""

from typing import NamedTuple

import numpy as np

from abyssnav.estimation.two_state import ACCEPTED, GATED
from abyssnav.geometry import interpolate
from abyssnav.tables import (
    DECISIONS,
    VERDICTS,
    Float,
    GateIntegrity,
    GateStatistics,
    Innovations,
    Int,
    Track,
)

HEALTHY, SILENT, INERT, STARVING, CAPTURED = range(len(VERDICTS))
#: χ² bound of 95 % for one degree of freedom.
NIS_95 = 3.841458820694124
#: A gate this many times wider than noise alone makes it would pass almost anything.
_INERT_FACTOR = 10.0
#: Below this share of accepted replies, over at least so many, the filter lives on reckoning.
_STARVING_SHARE, _STARVING_REPLIES = 1 / 3, 6
#: A filter this far from the smoothed track, and beyond its own claim, follows something else.
_CAPTURED_M, _CAPTURED_SIGMAS = 20.0, 4.0


class GatedFilter(NamedTuple):
    """A method that has run, as its gate is judged by it."""

    innovations: Innovations
    track: Track | None  #: None where the method has none; nothing is captured then
    gamma: float  #: threshold; inf for no gate
    noise_s: Float | float  #: √R, of each reply (n,) where it was learned


def assess_gate(
    method: GatedFilter,
    smoothed: Track | None,
    beacon_ids: Int,
    sound_speed_mps: float,
    stretch_s: float,
) -> GateIntegrity:
    """What a method's gate could see of each beacon in each stretch of time, and a verdict.

        smallest visible outlier  = ½ c √(γ S)                       one-way range
        largest unseen step       = ½ c √(γ S) · (S - R) / S         what the gain makes of it

    by the median S and R of the replies that met the gate.  *silent*: none did.  *inert*: it passes
    what is ten times as wrong as noise.  *starving*: it rejects two of three, so that the filter
    lives on dead reckoning.  *captured*: the track lies beyond 4 σ and 20 m off the smoothed one
    while replies are accepted.  Where several hold it is the first of silent, captured, starving
    and inert: a wide gate that yet rejects most is that of a filter that is lost.

    Parameters
    ----------
    smoothed : None where the smoother has no track; nothing is captured then
    beacon_ids : (b,) of the dive
    stretch_s : length of a stretch
    """
    innovations, track, gamma, noise_s = method
    met = np.isin(innovations.decision, (ACCEPTED, GATED))
    first_s = float(innovations.t_reply_s[met].min()) if met.any() else 0.0
    last_s = float(innovations.t_reply_s[met].max()) if met.any() else 0.0
    n_stretches = int((last_s - first_s) // stretch_s) + 1
    begin_s = np.asarray(first_s + stretch_s * np.arange(n_stretches), dtype=np.float64)
    stretch = np.clip((innovations.t_reply_s - first_s) // stretch_s, 0, n_stretches - 1)
    cell = np.searchsorted(beacon_ids, innovations.beacon_id) * n_stretches + stretch.astype(int)
    n_cells = len(beacon_ids) * n_stretches
    accepted = _count(cell[innovations.decision == ACCEPTED], n_cells)
    gated = _count(cell[innovations.decision == GATED], n_cells)
    sigma = _median_by(cell[met], innovations.innovation_sigma_s[met], n_cells)
    every_s = np.broadcast_to(noise_s, len(innovations))
    noise = _median_by(cell[met], every_s[met], n_cells)
    visible_m = 0.5 * sound_speed_mps * np.sqrt(gamma) * sigma
    with np.errstate(invalid="ignore"):
        step_m = visible_m * np.maximum(sigma**2 - noise**2, 0) / sigma**2
    off = np.tile(_captured(track, smoothed, begin_s, stretch_s), len(beacon_ids))
    noise_m = 0.5 * sound_speed_mps * np.sqrt(gamma) * noise
    verdict = np.select(
        [
            accepted + gated == 0,
            off & (accepted > 0),
            (accepted < _STARVING_SHARE * (accepted + gated))
            & (accepted + gated >= _STARVING_REPLIES),
            np.isinf(visible_m) | (visible_m > _INERT_FACTOR * noise_m),
        ],
        [SILENT, CAPTURED, STARVING, INERT],
        HEALTHY,
    )
    return GateIntegrity(
        beacon_id=np.repeat(beacon_ids, n_stretches),
        t_begin_s=np.tile(begin_s, len(beacon_ids)),
        t_end_s=np.tile(begin_s + stretch_s, len(beacon_ids)),
        accepted=accepted,
        gated=gated,
        smallest_visible_outlier_m=visible_m,
        largest_unseen_step_m=step_m,
        verdict=verdict,
    )


def _count(cell: Int, n_cells: int) -> Int:
    return np.bincount(cell, minlength=n_cells).astype(np.int64)


def _median_by(cell: Int, values: Float, n_cells: int) -> Float:
    """Median of the values of each cell; NaN where there are none."""
    order = np.lexsort((values, cell))
    count = np.bincount(cell, minlength=n_cells)
    begin = np.cumsum(count) - count
    medians = np.full(n_cells, np.nan)
    filled = count > 0
    ranked = values[order]
    low, high = begin + (count - 1) // 2, begin + count // 2
    medians[filled] = 0.5 * (ranked[low[filled]] + ranked[high[filled]])
    return medians


def _captured(
    track: Track | None, smoothed: Track | None, begin_s: Float, stretch_s: float
) -> np.ndarray:
    """Stretches in which half of the track lies implausibly far off the smoothed one."""
    if track is None or smoothed is None or track is smoothed or not len(track):
        return np.zeros(len(begin_s), dtype=bool)
    best_m = interpolate(track.t_s, smoothed.t_s, smoothed.position_enu_m)
    apart_m = np.hypot(*(track.position_enu_m - best_m)[:, :2].T)
    sigma_m = np.sqrt(np.trace(track.position_cov_m2, axis1=1, axis2=2))
    off = (apart_m > _CAPTURED_M) & (apart_m > _CAPTURED_SIGMAS * sigma_m)
    place = np.searchsorted(begin_s, track.t_s, side="right") - 1
    inside = (place >= 0) & (track.t_s < begin_s[-1] + stretch_s)
    n_off = np.bincount(place[inside], weights=off[inside], minlength=len(begin_s))
    n_all = np.bincount(place[inside], minlength=len(begin_s))
    return np.asarray(n_off > 0.5 * np.maximum(n_all, 1))


def gate_statistics(
    innovations: Innovations,
    beacon_ids: Int,
    gamma: float,
    sound_speed_mps: float,
    watch: GateIntegrity,
) -> GateStatistics:
    """What the gate did with each beacon's replies.

    The smallest outlier that it could still see is ½ c √(γ S) of one-way range, by its median.

    Parameters
    ----------
    beacon_ids : known ones; ids met only in replies follow them
    gamma : threshold; inf makes the gate inert, and the smallest outlier infinite
    watch : by stretches, of which the worst counts
    """
    strangers = np.setdiff1d(innovations.beacon_id, beacon_ids)
    ids = np.concatenate([beacon_ids, strangers])
    counts = np.zeros((len(ids), len(DECISIONS)), dtype=np.int64)
    quality = np.full((len(ids), 4), np.nan)
    verdict = np.full(len(ids), SILENT)
    for place, beacon_id in enumerate(ids):
        rows = innovations[innovations.beacon_id == beacon_id]
        counts[place] = np.bincount(rows.decision, minlength=len(DECISIONS))
        nis = rows.nis[rows.decision == ACCEPTED]
        sigma_s = rows.innovation_sigma_s[np.isfinite(rows.innovation_sigma_s)]
        if len(nis):
            quality[place, :2] = nis.mean(), np.mean(nis <= NIS_95)
        if len(sigma_s):
            quality[place, 2] = 0.5 * sound_speed_mps * np.sqrt(gamma) * np.median(sigma_s)
        own = watch[watch.beacon_id == beacon_id]
        if len(own):
            quality[place, 3] = np.max(
                own.largest_unseen_step_m, initial=-1.0, where=own.accepted > 0
            )
            verdict[place] = own.verdict.max()
    quality[quality[:, 3] < 0, 3] = np.nan
    return GateStatistics(
        beacon_id=ids,
        replies=counts.sum(axis=1),
        **{name: counts[:, code] for code, name in enumerate(DECISIONS)},
        mean_nis=quality[:, 0],
        nis_inside_95=quality[:, 1],
        smallest_visible_outlier_m=quality[:, 2],
        largest_unseen_step_m=quality[:, 3],
        verdict=verdict,
    )
