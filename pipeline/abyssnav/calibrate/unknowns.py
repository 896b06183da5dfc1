# SPDX-License-Identifier: Apache-2.0
"""The unknowns that dives share: their names, priors and limits, and which dive has which."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import degrees
from typing import NamedTuple

import numpy as np

from abyssnav.calibrate.clock_offsets import N_FURTHER
from abyssnav.calibrate.evidence import DiveEvidence
from abyssnav.estimation.dive_states import (
    CLOCK,
    GRADIENT,
    LEVER,
    N_BEACON,
    N_COMMON,
    OFFSET,
    SCALE,
    SOUND_SCALE,
)
from abyssnav.geometry import enu_to_geodetic, geodetic_to_enu
from abyssnav.tables import Float, Int, Origin

#: How late stamps are: a compass's filter and driver take time, acoustics time their own pings.
HEADING_LATENCY_S, TRAVEL_LATENCY_S = 0.5, 0.02
#: The compass's, where the lever arm is what the data show: at one speed they act alike.
HEADING_LATENCY_BESIDE_LEVER_S = 0.1

#: A table that has a beacon farther from another dive's is of another deployment.
_REDEPLOYED_M = 30.0


class Kind(NamedTuple):
    """One kind of unknown; sigmas in its unit."""

    name: str
    group: str  #: unknowns that belong together: what differs between dives, differs as a whole
    unit: str
    factor: float  #: from the unit of the equations
    limit: float  #: determined when known to this
    wide: float  #: prior under which the data are asked what they say of it
    apart: float  #: how different it is between dives that do not share it
    motion: str  #: what would determine it


_TURNS = "headings all round: two lawn-mowers across each other, or a circle"
_LEGS = "long straight legs between the beacons, there and back"
_LEVER = "a lawn-mower among the beacons, with legs on several headings"
_SPEEDS = "legs there and back at two speeds, with the lever arm given"
_NEAR = "a circle round the beacon, and a pass above it"
_DEG = degrees(1)

#: Of each dive before its beacons, in the order of `abyssnav.estimation.dive_states`.
COMMON = (
    Kind("heading_bias", "compass", "deg", _DEG, 0.3, 10.0, 2.0, _LEGS),
    Kind("deviation_sin_1", "compass", "deg", _DEG, 0.3, 5.0, 1.0, _TURNS),
    Kind("deviation_cos_1", "compass", "deg", _DEG, 0.3, 5.0, 1.0, _TURNS),
    Kind("deviation_sin_2", "compass", "deg", _DEG, 0.3, 3.0, 0.5, _TURNS),
    Kind("deviation_cos_2", "compass", "deg", _DEG, 0.3, 3.0, 0.5, _TURNS),
    Kind("dvl_scale", "DVL", "", 1.0, 0.002, 0.05, 0.005, _LEGS),
    Kind("sound_speed_scale", "sound speed", "", 1.0, 0.0005, 0.01, 0.001, _NEAR),
    Kind(
        "sound_speed_gradient", "gradient", "1/s", 1.0, 0.002, 0.02, 0.002,
        "a descent among the beacons, or a CTD cast",
    ),
    Kind("clock", "clock", "s", 1.0, 0.001, 0.01, 0.001, _NEAR),
    Kind("lever_arm_forward", "lever arm", "m", 1.0, 0.5, 15.0, 1.0, _LEVER),
    Kind("lever_arm_starboard", "lever arm", "m", 1.0, 0.5, 15.0, 1.0, _LEVER),
    Kind("lever_arm_down", "lever arm", "m", 1.0, 0.5, 15.0, 1.0, "passes above the beacons"),
)  # fmt: skip
FURTHER = (
    Kind("latency_heading", "latency of heading", "s", 1.0, 0.1, 2.0, 0.2, _SPEEDS),
    Kind("latency_travel_time", "latency of travel time", "s", 1.0, 0.1, 2.0, 0.2, _SPEEDS),
)
BEACON = (
    Kind("beacon_east", "place", "m", 1.0, 0.5, 10.0, 10.0, _NEAR),
    Kind("beacon_north", "place", "m", 1.0, 0.5, 10.0, 10.0, _NEAR),
    Kind("beacon_up", "place", "m", 1.0, 0.5, 10.0, 10.0, "a pass above the beacon"),
    Kind("beacon_turn_around", "turn-around", "s", 1.0, 0.001, 0.01, 0.003, _NEAR),
)
#: Unknowns of a beacon's place, and the axis of each.
AXES = {"beacon_east": 0, "beacon_north": 1, "beacon_up": 2}
assert (len(COMMON), len(BEACON), len(FURTHER)) == (N_COMMON, N_BEACON, N_FURTHER)
assert (OFFSET, SCALE, SOUND_SCALE, GRADIENT, CLOCK, LEVER.start) == (0, 5, 6, 7, 8, 9)


class Unknown(NamedTuple):
    """One number to be estimated."""

    kind: Kind
    beacon_id: int | None = None
    dive: str | None = None  #: whose own it is, where the dives do not share it


class Group(NamedTuple):
    """Unknowns that dives share or do not share as a whole."""

    name: str
    beacon_id: int | None = None


@dataclass(frozen=True, eq=False)
class Layout:
    """Which constants of which dive are the same unknown."""

    unknowns: tuple[Unknown, ...]
    columns: tuple[Int, ...]  #: of each dive: unknown of each of its constants
    offset: tuple[Float, ...]  #: of each dive: its constant is the unknown plus this
    stated: Float  #: (x,) prior sigmas by settings and tables; means are zero
    sigma: Float  #: (x,) in force: larger where the dives contradict them
    own: frozenset[Group]  #: that each dive has for itself
    #: By beacon, and dive where each has its own: stated place (3,) ENU that values count from,
    place_m: Mapping[tuple[int, str | None], Float]
    turn_around_s: Mapping[tuple[int, str | None], float]  #: and stated turn-around

    def rows(self, group: Group) -> Int:
        """Unknowns of a group."""
        return np.flatnonzero([group_of(unknown) == group for unknown in self.unknowns])


def group_of(unknown: Unknown) -> Group:
    """Group of an unknown."""
    return Group(unknown.kind.group, unknown.beacon_id)


def make_layout(dives: Sequence[DiveEvidence], own: frozenset[Group]) -> Layout:
    """Unknowns of all dives, shared but for the groups that each has for itself."""
    unknowns: dict[Unknown, int] = {}
    sigma, columns, offsets = list[float](), list[Int](), list[Float]()
    reference_m: dict[tuple[int, str | None], Float] = {}
    reference_s: dict[tuple[int, str | None], float] = {}
    for dive, place_m in zip(dives, stated_places(dives), strict=True):
        prior = np.append(dive.setting.prior.constant_sigma, (HEADING_LATENCY_S, TRAVEL_LATENCY_S))
        offset, kinds = np.zeros(len(prior)), [Unknown(kind) for kind in COMMON]
        boxed_m = np.zeros(place_m.shape) if dive.boxed_m is None else dive.boxed_m
        for row, number in enumerate(dive.beacons.id.tolist()):
            place = (number, dive.name if Group("place", number) in own else None)
            time = (number, dive.name if Group("turn-around", number) in own else None)
            stated_s = float(dive.beacons.turn_around_s[row])
            begin = N_COMMON + N_BEACON * row
            offset[begin : begin + 3] = reference_m.setdefault(place, place_m[row]) - place_m[row]
            offset[begin : begin + 3] -= boxed_m[row]
            offset[begin + 3] = reference_s.setdefault(time, stated_s) - stated_s
            kinds += [Unknown(kind, number) for kind in BEACON]
        kinds += [Unknown(kind) for kind in FURTHER]
        ours = [
            unknown._replace(dive=dive.name) if group_of(unknown) in own else unknown
            for unknown in kinds
        ]
        for unknown, prior_sigma in zip(ours, prior.tolist(), strict=True):
            if unknown not in unknowns:
                unknowns[unknown] = len(unknowns)
                apart = unknown.kind.apart / unknown.kind.factor if unknown.dive else 0.0
                sigma.append(float(np.hypot(prior_sigma, apart)))
        columns.append(np.array([unknowns[unknown] for unknown in ours]))
        offsets.append(offset)
    priors = np.array(sigma)
    return Layout(
        tuple(unknowns), tuple(columns), tuple(offsets), priors, priors, own, reference_m,
        reference_s,
    )  # fmt: skip


def redeployed(dives: Sequence[DiveEvidence]) -> frozenset[Group]:
    """Beacons whose tables have them so far apart in different dives that they were set anew."""
    first: dict[int, Float] = {}
    groups = set()
    for dive, places in zip(dives, stated_places(dives), strict=True):
        for row, number in enumerate(dive.beacons.id.tolist()):
            away_m = float(np.linalg.norm(places[row] - first.setdefault(number, places[row])))
            if away_m > max(_REDEPLOYED_M, 5 * float(np.nan_to_num(dive.beacons.sigma_m[row]))):
                groups.add(Group("place", number))
    return frozenset(groups)


def stated_places(dives: Sequence[DiveEvidence]) -> list[Float]:
    """Stated positions (b, 3) ENU of every dive's beacons, in the frame of the first origin."""
    origin = common_origin(dives)
    return [_in_frame(dive.beacons.position_enu_m, dive.origin, origin) for dive in dives]


def common_origin(dives: Sequence[DiveEvidence]) -> Origin | None:
    """The first dive's origin that is known."""
    return next((dive.origin for dive in dives if dive.origin is not None), None)


def _in_frame(position_m: Float, own: Origin | None, common: Origin | None) -> Float:
    if own is None or common is None or replace(own, source="") == replace(common, source=""):
        return position_m
    place = enu_to_geodetic(own.latitude_deg, own.longitude_deg, position_m)
    return geodetic_to_enu(common.latitude_deg, common.longitude_deg, *place)
