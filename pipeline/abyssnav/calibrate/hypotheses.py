# SPDX-License-Identifier: Apache-2.0
"""What dives do not share, and which of two explanations the data prefer."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from abyssnav.calibrate.adjustment import Normal, log_evidence, solve, sum_dives
from abyssnav.calibrate.evidence import DiveEvidence, Reduced
from abyssnav.calibrate.unknowns import (
    AXES,
    HEADING_LATENCY_BESIDE_LEVER_S,
    Group,
    Layout,
    group_of,
    make_layout,
    redeployed,
)
from abyssnav.tables import Float

#: A group is each dive's own where that is likelier by so many nats,
_GAIN = 8.0
#: and where the dives differ in it by more than so many of its limits.
_LIMITS_APART = 2.0
#: A beacon contradicts its table where that is likelier by so many nats,
_WRONG = 3.0
#: and so do all tables that state how good they are by so many,
_ALL_WRONG = 10.0
#: with one of these factors.
_WORSE_TABLES = (1.0, 3.0, 7.0, 15.0)
#: Groups that may differ between dives, beside the beacons' places and turn-arounds.
_OF_VEHICLE = ("compass", "DVL", "sound speed", "lever arm")
#: A large lever arm, where none is stated.
_LEVER_M = 5.0


def split(dives: Sequence[DiveEvidence], reduced: Sequence[Reduced]) -> frozenset[Group]:
    """Groups of unknowns that the dives do not share, one after the other while it pays.

    Parameters
    ----------
    reduced : each dive where it stands alone, so that no other has spoilt its weights
    """
    own = redeployed(dives)
    while len(dives) > 1:
        layout = make_layout(dives, own)
        together = sum_dives(layout, reduced)
        gains = {}
        for group in _candidates(layout, dives):
            # A table that is wrong for all dives alike is no reason to have several places.
            shared = max(
                log_evidence(together, sigma) for sigma in (layout.sigma, _widened(layout, group))
            )
            other = make_layout(dives, own | {group})
            normal = sum_dives(other, reduced)
            gain = log_evidence(normal, other.sigma) - shared
            if gain > _GAIN and _apart(other, normal, group) > _LIMITS_APART:
                gains[group] = gain
        if not gains:
            break
        own |= {max(gains, key=lambda group: gains[group])}
    return own


def _widened(layout: Layout, group: Group) -> Float:
    """Prior sigmas of which a group's are as wide as where each dive has its own.

    A beacon that is dropped or dragged elsewhere lies no deeper by much.
    """
    sigma: Float = layout.sigma.copy()
    for row in layout.rows(group):
        kind = layout.unknowns[row].kind
        if kind.name != "beacon_up":
            sigma[row] = np.hypot(sigma[row], kind.apart / kind.factor)
    return sigma


def with_wrong_tables(layout: Layout, normal: Normal, *, stated: bool) -> Layout:
    """The layout with wider priors for beacons that contradict their tables.

    Either single ones are wrong, or the tables are all worse than stated, or both: the likelier is
    taken.  Before anything is solved together, as a narrow prior would refuse all replies of such a
    beacon.

    Parameters
    ----------
    stated : whether the tables state how good they are: then all of them are seldom worse
    """
    tried, rare = [], _ALL_WRONG if stated else _WRONG
    for factor in _WORSE_TABLES:
        all_worse = replace(layout, sigma=_scaled_places(layout, factor))
        single, n_single = _with_single_wrong(all_worse, normal)
        rarity = _WRONG * n_single + (0.0 if factor == 1.0 else rare)
        tried.append((log_evidence(normal, single.sigma) - rarity, single))
    return max(tried, key=lambda pair: pair[0])[1]


def _scaled_places(layout: Layout, factor: float) -> Float:
    sigma: Float = layout.sigma.copy()
    for row, unknown in enumerate(layout.unknowns):
        if unknown.kind.group == "place" and unknown.dive is None:
            sigma[row] *= factor
    return sigma


def _with_single_wrong(layout: Layout, normal: Normal) -> tuple[Layout, int]:
    """The layout with wide priors for single beacons, worst first, and how many they are."""
    n_single = 0
    groups = [
        group
        for group in dict.fromkeys(map(group_of, layout.unknowns))
        if group.beacon_id is not None and group not in layout.own
    ]
    while groups:
        now = log_evidence(normal, layout.sigma)
        tried = [replace(layout, sigma=_widened(layout, group)) for group in groups]
        gains = [log_evidence(normal, other.sigma) - now for other in tried]
        best = int(np.argmax(gains))
        if gains[best] < _WRONG:
            break
        layout = tried[best]
        n_single += 1
        del groups[best]
    return layout, n_single


def _candidates(layout: Layout, dives: Sequence[DiveEvidence]) -> list[Group]:
    """Groups of more than one dive that are shared."""
    groups = dict.fromkeys(map(group_of, layout.unknowns))
    n_dives = {g: sum(int(g.beacon_id in dive.beacons.id) for dive in dives) for g in groups}
    return [
        group
        for group in groups
        if group not in layout.own
        and (group.name in _OF_VEHICLE if group.beacon_id is None else n_dives[group] > 1)
    ]


def _apart(layout: Layout, normal: Normal, group: Group) -> float:
    """Largest difference between dives in a group, over the limits of its unknowns."""
    value, cov = solve(normal, layout.sigma)
    rows: dict[str, list[int]] = {}
    for row in layout.rows(group):
        rows.setdefault(layout.unknowns[row].kind.name, []).append(int(row))
    largest = 0.0
    for same in rows.values():
        kind = layout.unknowns[same[0]].kind
        known = [row for row in same if np.sqrt(cov[row, row]) < 0.5 * layout.sigma[row]]
        if len(known) > 1:
            stands = [value[row] + _stated(layout, row) for row in known]
            largest = max(largest, float(np.ptp(stands)) * kind.factor / kind.limit)
    return largest


def _stated(layout: Layout, row: int) -> float:
    """What an unknown of a beacon counts from; 0 for all others."""
    unknown = layout.unknowns[row]
    if unknown.beacon_id is None:
        return 0.0
    key, axis = (unknown.beacon_id, unknown.dive), AXES.get(unknown.kind.name)
    return layout.turn_around_s[key] if axis is None else float(layout.place_m[key][axis])


def with_likelier_arm(layout: Layout, normal: Normal, *, stated: bool) -> Layout:
    """The layout under the likelier of two explanations of what lies ahead of the vehicle.

    At one speed a lever arm ahead and a late compass act alike.  Where no lever arm is stated, it
    is either none and the compass may be late, or it may be metres and the compass is hardly late.
    """
    if stated:
        return layout
    with_arm = _with_sigmas(
        layout, {"lever arm": _LEVER_M, "latency of heading": HEADING_LATENCY_BESIDE_LEVER_S}
    )
    without, with_ = (log_evidence(normal, either.sigma) for either in (layout, with_arm))
    return with_arm if with_ > without else layout


def _with_sigmas(layout: Layout, sigmas: dict[str, float]) -> Layout:
    sigma: Float = layout.sigma.copy()
    for row, unknown in enumerate(layout.unknowns):
        sigma[row] = sigmas.get(unknown.kind.group, sigma[row])
    return replace(layout, sigma=sigma)
