# SPDX-License-Identifier: Apache-2.0
"""Where the beacons are, and where those that move are at any instant."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from abyssnav.config import BeaconSetting, Config
from abyssnav.errors import ConfigError, SolveError
from abyssnav.geometry import bracket, geodetic_to_enu
from abyssnav.tables import Beacons, Bool, Check, Columns, Float, Int, Log, Origin

#: A beacon's coordinates, and its turn-around time in seconds, that can be of this planet.
_FARTHEST_M = 1e7
#: No more beacons answer in one dive; of more those that answered most are taken.
MOST_BEACONS = 64
#: No sea is deeper.
DEEPEST_M = 12_000.0
#: A standard deviation beyond this says nothing of a place.
_LARGEST_SIGMA_M = 1e5
#: Logged places that differ by more than this and by so many sigma are of a beacon that moves.
_MOVED_M, _MOVED_SIGMAS = 3.0, 3.0
#: Places of a moving beacon may be this far apart in time before a reply between them is doubtful.
_LONGEST_UNSEEN_S = 60.0
#: Places that a line may go through, and instants at which that is tried.
_NEIGHBOURS, _MOST_TRIED = (2, 4, 6, 8, 12, 16, 24, 32), 2000
#: What a line misses may be so many sigma before it is motion.
_EXPLAINED_BY_NOISE = 1.5
_FOREVER_NS = (1 << 63) - 1
#: A second difference of white noise has six times its variance.
_SECOND_DIFFERENCE = np.sqrt(6.0)


@dataclass(frozen=True, eq=False)
class Places:
    """A beacon's places over time."""

    time_ns: Int  #: (k,) rising
    position_enu_m: Float  #: (k, 3)
    turn_around_s: Float  #: (k,)
    sigma_m: Float  #: (k,) of each axis; 0: not stated
    in_steps: bool  #: it stays at each until the next, rather than moves between them
    neighbours: int = 2  #: places that a line goes through at each instant; two: interpolation
    until_ns: Int | None = None  #: (k,) when it left each, where settings say so


@dataclass(frozen=True, eq=False)
class BeaconField:
    """Every beacon at the dive's first reply, and the places of those that have several."""

    beacons: Beacons
    moving: Mapping[int, Places]  #: by row of `beacons`

    def at_replies(self, row: Int, time_ns: Int) -> tuple[Float, Float, Float]:
        """Position (n, 3), turn-around (n,) and sigma (n,) of beacons at their instants.

        The sigma is of each interpolated place, 0 for beacons that stay; NaN for row -1.
        """
        known, fixed = row >= 0, self.beacons
        position_m = np.where(known[:, None], fixed.position_enu_m[row], np.nan)
        turn_around_s = np.where(known, fixed.turn_around_s[row], np.nan)
        sigma_m = np.zeros(len(row))
        for beacon, places in self.moving.items():
            rows = np.flatnonzero(row == beacon)
            if len(rows):
                position_m[rows], turn_around_s[rows], sigma_m[rows] = _at(places, time_ns[rows])
        return position_m, turn_around_s, sigma_m

    def stands(self, row: Int, time_ns: Int) -> Bool:
        """Whether the settings have a place for each beacon (n,) at its instant."""
        known = row >= 0
        for beacon, places in self.moving.items():
            rows = np.flatnonzero(row == beacon)
            if places.until_ns is not None and len(rows):
                step = np.searchsorted(places.time_ns, time_ns[rows], side="right") - 1
                left = places.until_ns[np.maximum(step, 0)]
                known[rows] = (step >= 0) & (time_ns[rows] <= left)
        return np.asarray(known)

    def unseen_s(self, row: Int, time_ns: Int) -> float:
        """Longest time between a reply of a moving beacon and its nearest logged place."""
        longest_s = 0.0
        for beacon, places in self.moving.items():
            asked_ns = time_ns[row == beacon]
            if places.in_steps or not len(asked_ns):
                continue
            left, right, _ = bracket(asked_ns.astype(float), places.time_ns.astype(float))
            away = np.abs(asked_ns - places.time_ns[left])
            away = np.minimum(away, np.abs(asked_ns - places.time_ns[right]))
            longest_s = max(longest_s, float(away.max()) / 1e9)
        return longest_s


def _at(places: Places, time_ns: Int) -> tuple[Float, Float, Float]:
    if places.in_steps:
        step = np.maximum(np.searchsorted(places.time_ns, time_ns, side="right") - 1, 0)
        stays = np.zeros(len(time_ns))
        return places.position_enu_m[step], places.turn_around_s[step], stays
    t_s = (np.clip(time_ns, places.time_ns[0], places.time_ns[-1]) - places.time_ns[0]) / 1e9
    since_s = (places.time_ns - places.time_ns[0]) / 1e9
    rows, weight = _line_through(t_s, since_s, places.neighbours)
    nearest = np.take_along_axis(rows, np.argmax(weight, axis=1)[:, None], axis=1)[:, 0]
    return (
        np.einsum("nk,nki->ni", weight, places.position_enu_m[rows]),
        places.turn_around_s[nearest],
        np.sqrt(np.sum(np.square(weight * places.sigma_m[rows]), axis=1)),
    )


def _line_through(t_s: Float, knots_s: Float, neighbours: int) -> tuple[Int, Float]:
    """Rows (n, k) of the nearest knots and their weights in a least-squares line's value at t.

        w_j = 1/k + (t - τ̄) (τ_j - τ̄) / Σ (τ - τ̄)²

    Of two knots this is interpolation.
    """
    k = min(neighbours, len(knots_s))
    first = np.clip(np.searchsorted(knots_s, t_s, side="right") - k // 2, 0, len(knots_s) - k)
    rows = first[:, None] + np.arange(k)
    middle_s = knots_s[rows].mean(axis=1)
    away_s = knots_s[rows] - middle_s[:, None]
    square_s2 = np.maximum(np.sum(away_s**2, axis=1), 1e-18)
    slope = (t_s - middle_s) / square_s2
    return rows, 1 / k + slope[:, None] * away_s


def best_neighbours(t_s: Float, position_m: Float, sigma_m: float) -> int:
    """How many places a line should go through, by cross-validation: each from its neighbours.

    Drift is smooth where positions are noisy: a line through many places has less of their noise,
    until the beacon's own motion bends it.  More than two only where what the line misses is no
    more than the stated noise: a beacon that swings between its places is interpolated.

    Parameters
    ----------
    sigma_m : stated, of each axis; 0: not stated, and two are taken
    """
    tried = np.unique(np.linspace(1, len(t_s) - 2, _MOST_TRIED).astype(int))
    tried = tried[(tried > 0) & (tried < len(t_s) - 1)]
    scores: dict[int, float] = {}
    for k in _NEIGHBOURS:
        if k > len(t_s) // 2 or not len(tried):
            continue
        half = k // 2
        inside = tried[(tried >= half) & (tried < len(t_s) - half)]
        offsets = np.concatenate([np.arange(-half, 0), np.arange(1, half + 1)])
        rows = inside[:, None] + offsets
        middle_s = t_s[rows].mean(axis=1)
        away_s = t_s[rows] - middle_s[:, None]
        slope = (t_s[inside] - middle_s) / np.sum(away_s**2, axis=1)
        weight = 1 / k + slope[:, None] * away_s
        missed_m = np.einsum("nk,nki->ni", weight, position_m[rows]) - position_m[inside]
        squares_m2 = np.sort(np.sum(missed_m[:, :2] ** 2, axis=1))
        scores[k] = float(np.mean(squares_m2[: max(1, int(0.9 * len(squares_m2)))]))
    noise_m2 = 2 * (_EXPLAINED_BY_NOISE * sigma_m) ** 2
    scores = {k: score for k, score in scores.items() if k == 2 or score <= noise_m2}
    if not scores:
        return 2
    least = min(scores.values())
    return next(k for k, score in scores.items() if score <= 1.02 * least)


def beacons_of(
    log: Log, config: Config, origin: Origin | None, first_reply_ns: int
) -> tuple[BeaconField, list[Check]]:
    """The settings' beacons, else the log's; whether they could lie on a sea floor.

    Raises
    ------
    SolveError
        No beacons, one only, two of one number, one without a place or on another planet.
    ConfigError
        A beacon of the settings without a place.
    """
    if config.beacon:
        field, checks = _of_settings(config.beacon, origin, first_reply_ns)
    elif has_rows(log, "beacons"):
        field, checks = _of_log(log, origin, first_reply_ns)
    else:
        raise SolveError(f"{log.name}: no beacons, neither in the log nor in the settings")
    beacons, check = _stated_sigma(field.beacons)
    field = BeaconField(beacons, field.moving)
    _refuse_impossible(beacons, log)
    return field, [*checks, check, _count_of(beacons), _in_no_sea(beacons)]


def no_beacons() -> BeaconField:
    """What a dive without acoustics has."""
    nothing = np.zeros(0)
    return BeaconField(
        Beacons(
            id=np.zeros(0, np.int64),
            name=np.zeros(0, np.str_),
            position_enu_m=np.zeros((0, 3)),
            turn_around_s=nothing,
            sigma_m=nothing,
        ),
        {},
    )


def answering(field: BeaconField, heard_id: Int) -> tuple[BeaconField, list[Check]]:
    """Of more beacons than a dive can have, those that were heard, most often first.

    A catalogue of all that was ever moored may stand in the settings or the log; each beacon has
    four errors that every method carries along.

    Parameters
    ----------
    heard_id : (n,) number of the beacon of each reply
    """
    ids = field.beacons.id
    if len(ids) <= MOST_BEACONS:
        return field, []
    number, count = np.unique(heard_id, return_counts=True)
    place = np.minimum(np.searchsorted(number, ids), max(len(number) - 1, 0))
    replies = np.where(number[place] == ids, count[place], 0) if len(number) else np.zeros(len(ids))
    most = np.argsort(-replies, kind="stable")[:MOST_BEACONS]
    kept = np.sort(most[replies[most] > 0]) if replies.any() else most
    lost = int(replies.sum() - replies[kept].sum())
    moving = {row: field.moving[old] for row, old in enumerate(kept) if old in field.moving}
    detail = f"of {len(ids):,} beacons; {lost:,} replies of theirs are taken for strangers'"
    check = Check("align", "beacons_left_out", len(ids) - len(kept), 0, "", lost == 0, detail)
    return BeaconField(field.beacons[kept], moving), [check]


def has_rows(log: Log, role: str) -> bool:
    """Whether a log holds something of a role."""
    return role in log.roles and len(log.roles[role]["time_ns"]) > 0


def _in_no_sea(beacons: Beacons) -> Check:
    up_m = beacons.position_enu_m[:, 2]
    odd = np.flatnonzero((up_m > 0) | (up_m < -DEEPEST_M))
    detail = ""
    if len(odd):
        first = f"beacon {beacons.id[odd[0]]} lies at {up_m[odd[0]]:+,.0f} m, up"
        detail = f"{first}: are unit and sign right?"
    return Check("align", "beacons_in_no_sea", len(odd), 0, "", not len(odd), detail)


def _count_of(beacons: Beacons) -> Check:
    places = len(np.unique(beacons.position_enu_m.round(2), axis=0))
    detail = f"{len(beacons)} beacons in {places} places: the mirrored side is as good"
    ok = places >= 3
    return Check("align", "beacons", places, 3, "places", ok, "" if ok else detail, bound="min")


def _stated_sigma(beacons: Beacons) -> tuple[Beacons, Check]:
    """Leave out standard deviations that say nothing; 0 is not stated."""
    sigma_m = np.asarray(beacons.sigma_m, float)
    stated = np.nan_to_num(sigma_m, nan=0.0, posinf=np.inf, neginf=-np.inf)
    odd = (stated < 0) | (stated > _LARGEST_SIGMA_M)
    beacons = Beacons(**(beacons.columns() | {"sigma_m": np.where(odd, 0.0, stated)}))
    detail = ""
    if odd.any():
        which = int(np.argmax(odd))
        detail = f"beacon {beacons.id[which]}: sigma of {sigma_m[which]:g} m left out"
    return beacons, Check(
        "align", "beacon_sigma_of_no_place", int(odd.sum()), 0, "", not odd.any(), detail
    )


def _refuse_impossible(beacons: Beacons, log: Log) -> None:
    """Refuse beacons that no position follows from."""
    numbers = np.column_stack([beacons.position_enu_m, beacons.turn_around_s])
    near = np.all(np.abs(numbers) < _FARTHEST_M, axis=1)
    if not near.all():
        problem = "has no finite position and turn-around time, or one from another planet"
        raise SolveError(f"{log.name}: beacon {beacons.id[~near][0]} {problem}")
    if has_rows(log, "position"):
        return
    if len(beacons) < 2:
        raise SolveError(
            f"{log.name}: {len(beacons)} beacon; a position needs 3, or 2 and a known start"
        )
    n_places = len(np.unique(beacons.position_enu_m.round(2), axis=0))
    if n_places < 2:
        raise SolveError(f"{log.name}: all {len(beacons)} beacons lie in {n_places} places")


# --- of the settings ----------------------------------------------------------------------------


def _of_settings(
    settings: Sequence[BeaconSetting], origin: Origin | None, first_reply_ns: int
) -> tuple[BeaconField, list[Check]]:
    """Beacons of the settings; one number several times has `from` and `until`."""
    by_id: dict[int, list[BeaconSetting]] = {}
    position_m = {id(beacon): _placed(beacon, origin) for beacon in settings}
    for beacon in settings:
        by_id.setdefault(beacon.id, []).append(beacon)
    moving, first = dict[int, Places](), list[BeaconSetting]()
    for row, (number, entries) in enumerate(by_id.items()):
        stays = len(entries) == 1 and entries[0].from_ is None and entries[0].until is None
        if not stays:
            entries.sort(key=lambda entry: nanoseconds(entry.from_))
            if any(entry.from_ is None for entry in entries[1:]):
                raise ConfigError(
                    f"[[beacon]] {number} is there {len(entries)} times; with from and until, each "
                    "is a place of its own time"
                )
            moving[row] = Places(
                time_ns=np.array([nanoseconds(entry.from_) for entry in entries], np.int64),
                position_enu_m=np.array([position_m[id(entry)] for entry in entries]),
                turn_around_s=np.array([entry.turn_around_s for entry in entries]),
                sigma_m=np.array([entry.sigma_m for entry in entries]),
                in_steps=True,
                until_ns=np.array(
                    [nanoseconds(entry.until) if entry.until else _FOREVER_NS for entry in entries],
                    np.int64,
                ),
            )
        began = [entry for entry in entries if nanoseconds(entry.from_) <= first_reply_ns]
        first.append(began[-1] if began else entries[0])
    ids = np.array([b.id for b in first])
    beacons = Beacons(
        id=ids,
        name=np.array([b.name or str(b.id) for b in first]),
        position_enu_m=np.array([position_m[id(b)] for b in first]),
        turn_around_s=np.array([b.turn_around_s for b in first]),
        sigma_m=np.array([b.sigma_m for b in first]),
        moving=np.array(
            [row in moving and len(moving[row].time_ns) > 1 for row in range(len(ids))]
        ),
    )
    return BeaconField(beacons, moving), []


def nanoseconds(instant: datetime | None) -> int:
    """UTC nanoseconds of an instant of the settings; None: before everything."""
    if instant is None:
        return 0
    utc = instant if instant.tzinfo else instant.replace(tzinfo=UTC)
    since = utc - datetime(1970, 1, 1, tzinfo=UTC)
    return ((since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds) * 1000


def _placed(beacon: BeaconSetting, origin: Origin | None) -> Float:
    """ENU position of a beacon of the settings."""
    if beacon.position_m is not None:
        return np.array(beacon.position_m, dtype=np.float64)
    place = (beacon.latitude_deg, beacon.longitude_deg, beacon.depth_m)
    if None in place or origin is None:
        raise ConfigError(
            f"[[beacon]] {beacon.id}: give position_m, or latitude_deg, longitude_deg and depth_m"
        )
    latitude_deg, longitude_deg, depth_m = (np.float64(value or 0.0) for value in place)
    place_on_earth = np.array([[latitude_deg, longitude_deg, depth_m]])
    return np.asarray(_geodetic(origin, place_on_earth)[0])


def _geodetic(origin: Origin, place: Float) -> Float:
    """ENU (n, 3) of latitude, longitude and depth; depth is what is measured, and stays."""
    latitude_deg, longitude_deg, depth_m = place.T
    enu_m = geodetic_to_enu(
        origin.latitude_deg, origin.longitude_deg, latitude_deg, longitude_deg, -depth_m
    )
    return np.column_stack([enu_m[:, :2], -depth_m])


# --- of the log ---------------------------------------------------------------------------------


def _of_log(
    log: Log, origin: Origin | None, first_reply_ns: int
) -> tuple[BeaconField, list[Check]]:
    """The log's beacons: each as it was logged last before the first reply, or first.

    One whose logged places differ is followed from each to the next; two places are a correction,
    of which the later one is taken.
    """
    rows = _placed_rows(log, origin)
    chosen = latest_message(rows, first_reply_ns)["id"]
    every = np.unique(rows["id"])
    ids = chosen if len(np.unique(chosen)) == len(every) else every
    if len(ids) > len(every):
        number, count = np.unique(ids, return_counts=True)
        twice = number[np.argmax(count)]
        raise SolveError(f"{log.name}: beacon {twice} is there {count.max()} times")
    picked, moving = list[int](), dict[int, Places]()
    checks, corrected = list[Check](), list[str]()
    for row, number in enumerate(ids):
        own = np.flatnonzero(rows["id"] == number)
        own = own[np.argsort(rows["time_ns"][own], kind="stable")]
        before = int(np.sum(rows["time_ns"][own] <= first_reply_ns))
        now = int(own[max(before - 1, 0)])
        places, corrected_row = _followed(rows, own)
        if places is not None:
            moving[row] = places
        elif corrected_row is not None:
            moved_m = np.linalg.norm(np.ptp(rows["position_enu_m"][own], axis=0))
            corrected.append(f"beacon {number} by {moved_m:.1f} m")
            now = corrected_row
        picked.append(now)
    field = BeaconField(_table(rows, np.array(picked), moving, first_reply_ns), moving)
    if corrected:
        detail = f"{', '.join(corrected)}: the later place is taken for the whole dive"
        checks.append(Check("align", "beacons_corrected", len(corrected), 0, "", False, detail))
    if moving:
        detail = ", ".join(_path_of(field.beacons, row, moving[row]) for row in moving)
        checks.append(Check("align", "beacons_moving", len(moving), 0, "", True, detail))
    return field, checks


def _table(rows: Columns, picked: Int, moving: Mapping[int, Places], now_ns: int) -> Beacons:
    names = np.where(rows["name"] == "", rows["id"].astype(str), rows["name"])
    position_m = rows["position_enu_m"][picked].copy()
    for row, places in moving.items():
        position_m[row] = _at(places, np.array([now_ns]))[0][0]
    return Beacons(
        id=rows["id"][picked].astype(np.int64),
        name=names[picked],
        position_enu_m=position_m,
        turn_around_s=rows["turn_around_s"][picked],
        sigma_m=np.nan_to_num(rows["sigma_m"][picked], posinf=np.inf),
        moving=np.isin(np.arange(len(picked)), list(moving)),
    )


def _path_of(beacons: Beacons, row: int, places: Places) -> str:
    length_m = np.linalg.norm(np.ptp(places.position_enu_m, axis=0))
    return f"{beacons.name[row]} over {length_m:.0f} m, {len(places.time_ns)} places"


def _placed_rows(log: Log, origin: Origin | None) -> Columns:
    """The log's rows of beacons with their positions in ENU."""
    rows = dict(log.roles["beacons"])
    if "position_enu_m" in rows:
        return rows
    if origin is None:
        raise SolveError(f"{log.name}: no beacon on {log.topics['beacons']} has a place on earth")
    place = np.column_stack([rows["latitude_deg"], rows["longitude_deg"], rows["depth_m"]])
    return rows | {"position_enu_m": _geodetic(origin, place)}


def _followed(rows: Columns, own: Int) -> tuple[Places | None, int | None]:
    """A beacon's places if it moves; else the row of its correction, if there is one."""
    position_m = rows["position_enu_m"][own]
    good = np.isfinite(position_m).all(axis=1) & (np.abs(position_m) < _FARTHEST_M).all(axis=1)
    own, position_m = own[good], position_m[good]
    if len(own) < 2:
        return None, None
    sigma_m = np.nan_to_num(rows["sigma_m"][own], posinf=0.0)
    sigma_m = np.where((sigma_m > 0) & (sigma_m < _LARGEST_SIGMA_M), sigma_m, 0.0)
    limit_m = max(_MOVED_M, _MOVED_SIGMAS * float(np.median(sigma_m)))
    if np.ptp(position_m, axis=0).max() <= limit_m:
        return None, None
    if len(np.unique(position_m, axis=0)) == 2:
        return None, int(own[-1])
    time_ns, first = np.unique(rows["time_ns"][own], return_index=True)
    position_m = position_m[first]
    stated = sigma_m[first]
    noise_m = np.where(stated > 0, stated, _noise_m(position_m))
    turn_around_s = rows["turn_around_s"][own][first]
    neighbours = best_neighbours((time_ns - time_ns[0]) / 1e9, position_m, float(np.median(stated)))
    return Places(time_ns, position_m, turn_around_s, noise_m, False, neighbours), None


def _noise_m(position_m: Float) -> float:
    """Standard deviation of each axis of places that nobody stated, from their second differences.

    A steady drift has none, so what they have is noise: robust, by the median.
    """
    if len(position_m) < 5:
        return 0.0
    second_m = np.diff(position_m[:, :2], n=2, axis=0)
    return float(1.4826 * np.median(np.abs(second_m)) / _SECOND_DIFFERENCE)


def latest_message(columns: Columns, first_reply_ns: int) -> Columns:
    """Rows of the last message before the first reply, or of the first message."""
    order = np.argsort(columns["time_ns"], kind="stable")
    before = int(np.sum(columns["time_ns"] <= first_reply_ns))
    chosen = columns["message"][order[max(before - 1, 0)]]
    return {name: column[columns["message"] == chosen] for name, column in columns.items()}


def longest_unseen(field: BeaconField, row: Int, time_ns: Int) -> list[Check]:
    """Whether moving beacons answered where none of their places is near in time."""
    if not field.moving:
        return []
    unseen_s = field.unseen_s(row, time_ns)
    ok = unseen_s <= _LONGEST_UNSEEN_S
    detail = "" if ok else "replies so long before or after a logged place: interpolated, or held"
    return [Check("align", "moving_beacons_unseen", unseen_s, _LONGEST_UNSEEN_S, "s", ok, detail)]
