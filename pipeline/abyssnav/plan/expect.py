# SPDX-License-Identifier: Apache-2.0
"""What a layout lets one expect: the Cramér-Rao bound along a track, over a map, and changed."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import msgspec
import numpy as np

from abyssnav.config import Config
from abyssnav.estimation.leg_accuracy import radius_95
from abyssnav.plan.layout import Layout, beacons_of, origin_of
from abyssnav.simulate import error_model
from abyssnav.simulate.cramer_rao import (
    BeaconErrors,
    Bound,
    TrueReplies,
    TrueTrack,
    posterior_bound,
)
from abyssnav.simulate.limits import GAP_SIGMA_MPS
from abyssnav.simulate.replies import expected_share
from abyssnav.simulate.scenario import Dvl
from abyssnav.tables import Beacons, Float, Origin, Table

#: Of the true motion's rows.
_STEP_S = 1.0
#: Between the rows of what to expect, along the track and where only a median is asked for.
_OFTEN_S, _SELDOM_S = 5.0, 60.0
#: A longer dive's pings are put together: their information adds up.
_MOST_PINGS = 400
#: Of the turn-arounds, each beacon's.
_TURN_AROUND_SIGMA_S = 3e-4
#: A beacon that answers more seldom is not there.
_LEAST_SHARE = 1e-3
#: In each cell of the map the vehicle runs a square of this side, for so long.
_SQUARE_M, _IN_A_CELL_S = 150.0, 1800.0
#: A better compass: a gyroscope's; a cast of the day; a DVL of the next class.
_GYROCOMPASS = {
    "bias_sigma_deg": 0.2, "deviation_sigma_deg": (0.05, 0.05), "slow_sigma_deg": 0.05,
    "white_sigma_deg": 0.05,
}  # fmt: skip
_CAST_MPS = 0.3
_BETTER_DVL = {"scale_sigma": 0.001, "misalignment_sigma_deg": 0.1, "slow_sigma_mps": 0.001}
_SURVEYED_M = 0.2
#: Another beacon or place is told of where it gains so much.
_WORTH_IT = 0.99
#: Places for a beacon more along each side of the map, and for one that moves.
_MORE, _MOVED = 6, 4


@dataclass(frozen=True, eq=False)
class MapCells(Table):
    """What to expect where, one row a cell; the cells of a row of the map follow each other."""

    east_m: Float  #: middle of the cell
    north_m: Float
    radius_95_m: Float  #: of the final track
    filter_radius_95_m: Float  #: in real time


@dataclass(frozen=True, eq=False)
class TrackRadius(Table):
    """What to expect along the planned track."""

    t_s: Float
    position_enu_m: Float  #: (n, 3)
    radius_95_m: Float  #: of the final track
    filter_radius_95_m: Float  #: in real time
    two_beacons_95_m: Float  #: of the final track, with the two nearest beacons only
    one_beacon_95_m: Float


@dataclass(frozen=True)
class Change:
    """What a change of the layout would do to the planned track's median radius."""

    what: str
    radius_95_m: float
    filter_radius_95_m: float


@dataclass(frozen=True, eq=False)
class Plan:
    """A layout and what to expect of it."""

    layout: Layout
    beacons: Beacons
    origin: Origin | None
    cells: MapCells
    side_m: float  #: of a cell
    shape: tuple[int, int]  #: rows and columns of the map, from south to north and west to east
    track: TrackRadius
    changes: tuple[Change, ...]  #: the first is the layout as it is

    @property
    def target_m(self) -> float:
        """Radius that is enough."""
        return self.layout.target_m or 1.5 * float(np.median(self.track.radius_95_m))

    def enough(self, radius_m: Float) -> float:
        """Share of the planned track on which a radius is enough."""
        return float(np.mean(radius_m <= self.target_m))


def expect(layout: Layout, config: Config) -> Plan:
    """Bound of the layout along its track, over a map, and with this or that changed.

    The bound is that of `abyssnav.simulate.cramer_rao`, the same by which `make accuracy` judges;
    each reply counts with the share of pings that its beacon can be expected to answer rightly.

    Raises
    ------
    ConfigError
        As of `beacons_of`.
    """
    beacons = beacons_of(layout, config)
    track = planned_track(layout)
    final, live = _radii(_bound(layout, beacons, track))
    nearest = {n: _radii(_bound(layout, beacons, track, nearest=n))[0] for n in (1, 2)}
    cells, side_m, shape = _map(layout, beacons)
    grid = track[:: round(_OFTEN_S / _STEP_S)]
    along = TrackRadius(grid.t_s, grid.position_enu_m, final, live, nearest[2], nearest[1])
    changes = tuple(_changes(layout, beacons, track, along, cells))
    return Plan(layout, beacons, origin_of(layout, config), cells, side_m, shape, along, changes)


def planned_track(layout: Layout) -> TrueTrack:
    """The way along the waypoints at the planned speed, a row a second."""
    corners = np.array(layout.track.waypoints_m, dtype=float)
    step = np.diff(corners, axis=0)
    length_m = np.hypot(*step.T)
    goes_on = length_m > 0
    corners, step, length_m = corners[np.append(True, goes_on)], step[goes_on], length_m[goes_on]
    t_corner = np.concatenate([[0.0], np.cumsum(length_m)]) / layout.track.speed_mps
    t_s = np.arange(0.0, t_corner[-1] + 1e-9, _STEP_S)
    place = np.column_stack([np.interp(t_s, t_corner, axis) for axis in corners.T])
    leg = np.clip(np.searchsorted(t_corner, t_s, side="right") - 1, 0, len(step) - 1)
    course = np.unwrap(np.arctan2(step[:, 0], step[:, 1]))
    nothing = np.zeros(len(t_s))
    position = np.column_stack([place, nothing - layout.track.depth_m])
    return TrueTrack(t_s, position, course[leg], _lost_m2(layout.dvl, t_s), nothing)


def _lost_m2(dvl: Dvl, t_s: Float) -> Float:
    """Running variance (n,) that losses of bottom lock add, evenly spaced over the dive."""
    apart_s = 3600 / dvl.gaps_per_hour if dvl.gaps_per_hour > 0 else np.inf
    into_s = (t_s + 0.5 * apart_s) % apart_s if np.isfinite(apart_s) else np.full(len(t_s), np.inf)
    grown_m2 = np.where(into_s < dvl.gap_s, (GAP_SIGMA_MPS * into_s) ** 2, 0.0)
    return np.asarray(np.cumsum(np.maximum(np.diff(grown_m2, prepend=0.0), 0.0)))


def _bound(
    layout: Layout, beacons: Beacons, track: TrueTrack, nearest: int = 99, step_s: float = _OFTEN_S
) -> Bound:
    """Bound along a track with the `nearest` beacons of each ping."""
    count = len(beacons)
    errors = BeaconErrors(
        np.broadcast_to(beacons.sigma_m[:, None], (count, 3)),
        np.full(count, _TURN_AROUND_SIGMA_S),
        np.full(count, layout.acoustics.slow_sigma_s),
    )
    depth_m = float(-beacons.position_enu_m[:, 2].mean())
    model = error_model(layout.scenario(), errors, depth_m)
    replies = expected_replies(layout, beacons, track, nearest)
    return posterior_bound(track, replies, model, step_s=step_s)


def expected_replies(
    layout: Layout, beacons: Beacons, track: TrueTrack, nearest: int
) -> TrueReplies:
    """Replies with as much information as can be expected, those of a ping at one instant."""
    acoustics, speed_mps = layout.acoustics, layout.sound.speed_mps
    period_s = acoustics.ping_period_s
    together = max(1, int(np.ceil(track.t_s[-1] / period_s / _MOST_PINGS)))
    t_ping = np.arange(acoustics.first_ping_s, track.t_s[-1], period_s * together)
    place = np.column_stack([np.interp(t_ping, track.t_s, a) for a in track.position_enu_m.T])
    range_m = np.linalg.norm(place[:, None, :] - beacons.position_enu_m, axis=-1)
    share = expected_share(acoustics, range_m)
    share[np.argsort(np.argsort(range_m, axis=1), axis=1) >= nearest] = 0.0
    t_reply = t_ping + 2 * range_m.mean(axis=1) / speed_mps + beacons.turn_around_s.mean()
    ping, beacon = np.nonzero((share > _LEAST_SHARE) & (t_reply <= track.t_s[-1])[:, None])
    sigma_s = np.hypot(acoustics.sigma_s, acoustics.range_sigma_s_per_km * range_m / 1000)
    return TrueReplies(
        t_ping[ping],
        t_reply[ping],
        beacon,
        beacons.position_enu_m[beacon],
        np.full(len(ping), speed_mps),
        (sigma_s / np.sqrt(np.maximum(share, _LEAST_SHARE) * together))[ping, beacon],
    )


def _radii(bound: Bound) -> tuple[Float, Float]:
    """95 % radius of the final track and in real time."""
    return radius_95(bound.smoother_cov_m2), radius_95(bound.filter_cov_m2)


# --- the map ------------------------------------------------------------------------------------


def _map(layout: Layout, beacons: Beacons) -> tuple[MapCells, float, tuple[int, int]]:
    """What to expect where the vehicle works for half an hour."""
    low, high = _extent(layout, beacons)
    side_m = float((high - low).max()) / layout.map.cells
    n_columns, n_rows = np.maximum(np.ceil((high - low) / side_m - 1e-9).astype(int), 1).tolist()
    east = low[0] + side_m * (np.arange(n_columns) + 0.5)
    north = low[1] + side_m * (np.arange(n_rows) + 0.5)
    places = np.array(list(product(north, east)))
    radii = np.array([_in_a_cell(layout, beacons, place[::-1]) for place in places])
    cells = MapCells(places[:, 1], places[:, 0], radii[:, 0], radii[:, 1])
    return cells, side_m, (n_rows, n_columns)


def _extent(layout: Layout, beacons: Beacons) -> tuple[Float, Float]:
    """South-west and north-east corner of the map."""
    places = np.concatenate([beacons.position_enu_m[:, :2], layout.track.waypoints_m])
    low, high = places.min(axis=0), places.max(axis=0)
    margin_m = layout.map.margin * max(float((high - low).max()), _SQUARE_M)
    return low - margin_m, high + margin_m


def _in_a_cell(layout: Layout, beacons: Beacons, place_m: Float) -> tuple[float, float]:
    """Radius of the final track and in real time, once settled, around a place."""
    half_m = 0.5 * _SQUARE_M
    corners = place_m + half_m * np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
    rounds = int(np.ceil(_IN_A_CELL_S * layout.track.speed_mps / (4 * _SQUARE_M))) + 1
    way = np.concatenate([np.tile(corners, (rounds, 1)), corners[:1]])
    local = msgspec.structs.replace(
        layout.track, waypoints_m=tuple((float(e), float(n)) for e, n in way)
    )
    track = planned_track(msgspec.structs.replace(layout, track=local))
    track = track[track.t_s <= _IN_A_CELL_S]
    final, live = _radii(_bound(layout, beacons, track, step_s=_SELDOM_S))
    quarter = len(final) // 4
    return float(np.median(final[quarter:-quarter])), float(np.median(live[-2 * quarter :]))


# --- changes ------------------------------------------------------------------------------------


def _changes(
    layout: Layout, beacons: Beacons, track: TrueTrack, along: TrackRadius, cells: MapCells
) -> Iterator[Change]:
    """The layout as it is, then with other beacons and with other sensors."""
    now_m = np.median(along.radius_95_m), np.median(along.filter_radius_95_m)
    yield Change("as planned", *map(float, now_m))
    for row in range(len(beacons)) if len(beacons) > 1 else ():
        fewer = beacons[np.arange(len(beacons)) != row]
        yield _changed(f"without beacon {beacons.name[row]}", layout, fewer, track)
    for variants in (_with_one_more(beacons, cells), _with_one_moved(beacons, cells)):
        tried = [_changed(what, layout, other, track) for what, other in variants]
        best = min(tried, key=lambda change: change.radius_95_m)
        if best.radius_95_m < _WORTH_IT * now_m[0]:
            yield best
    for what, other in _with_better_sensors(layout):
        yield _changed(what, other, beacons, track)
    surveyed = replace(beacons, sigma_m=np.minimum(beacons.sigma_m, _SURVEYED_M))
    yield _changed(f"beacons surveyed to {_SURVEYED_M:g} m", layout, surveyed, track)


def _changed(what: str, layout: Layout, beacons: Beacons, track: TrueTrack) -> Change:
    final, live = _radii(_bound(layout, beacons, track, step_s=_SELDOM_S))
    return Change(what, float(np.median(final)), float(np.median(live)))


def _with_better_sensors(layout: Layout) -> Iterator[tuple[str, Layout]]:
    part = msgspec.structs.replace
    yield "a gyrocompass", part(layout, compass=part(layout.compass, **_GYROCOMPASS))
    yield "a DVL of 0.1 %", part(layout, dvl=part(layout.dvl, **_BETTER_DVL))
    cast = part(layout.sound, profile="munk", logged=True, error_sigma_mps=_CAST_MPS)
    yield "a CTD cast of the day", part(layout, sound=cast)


def _with_one_more(beacons: Beacons, cells: MapCells) -> Iterator[tuple[str, Beacons]]:
    """Layouts with one beacon more, as good as the others, at their mean depth."""
    newest = int(beacons.id.max()) + 1
    for east_m, north_m in _places(cells, _MORE):
        place = [east_m, north_m, beacons.position_enu_m[:, 2].mean()]
        yield (
            f"one beacon more, at {east_m:+.0f} m east, {north_m:+.0f} m north",
            Beacons(
                id=np.append(beacons.id, newest),
                name=np.append(beacons.name, str(newest)),
                position_enu_m=np.vstack([beacons.position_enu_m, place]),
                turn_around_s=np.append(beacons.turn_around_s, beacons.turn_around_s.mean()),
                sigma_m=np.append(beacons.sigma_m, beacons.sigma_m.mean()),
            ),
        )


def _with_one_moved(beacons: Beacons, cells: MapCells) -> Iterator[tuple[str, Beacons]]:
    """Layouts with one beacon at another place of its own depth."""
    for row, (east_m, north_m) in product(range(len(beacons)), _places(cells, _MOVED)):
        position_m = beacons.position_enu_m.copy()
        position_m[row, :2] = east_m, north_m
        what = f"beacon {beacons.name[row]} at {east_m:+.0f} m east, {north_m:+.0f} m north"
        yield what, replace(beacons, position_enu_m=position_m)


def _places(cells: MapCells, n: int) -> list[tuple[float, float]]:
    """Places (n², 2) all over the map."""
    axes = [np.linspace(a.min(), a.max(), n).tolist() for a in (cells.east_m, cells.north_m)]
    return list(product(*axes))
