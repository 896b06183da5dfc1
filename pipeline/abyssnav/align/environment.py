# SPDX-License-Identifier: Apache-2.0
"""What the log or the settings say of the water and the beacons, and where the frame's zero is."""

import numpy as np

from abyssnav.align.sensors import DEEPEST_M
from abyssnav.config import BeaconSetting, Config, on_earth
from abyssnav.errors import ConfigError, SolveError
from abyssnav.geometry import geodetic_to_enu
from abyssnav.tables import Beacons, Check, Columns, Float, Log, Origin, SoundSpeed

#: A beacon's coordinates, and its turn-around time in seconds, that can be of this planet.
_FARTHEST_M = 1e7
#: A profile may end so far above the deepest beacon.
_BELOW_PROFILE_M = 100.0
#: Natural water has 1400 to 1600 m/s.
_FARTHEST_FROM_1500_MPS = 300.0


def origin_of(log: Log, config: Config, first_reply_ns: int) -> Origin | None:
    """Origin of the local frame: the settings', else the log's, else the first geodetic beacon."""
    if config.origin is not None:
        return Origin(config.origin.latitude_deg, config.origin.longitude_deg)
    if _has(log, "beacons"):
        first = _latest(log.roles["beacons"], first_reply_ns)
        place = (first["origin_latitude_deg"][0], first["origin_longitude_deg"][0])
        if np.all(np.isfinite(place)):
            if not on_earth(*place):
                where = f"{log.topics['beacons']}: origin {place[0]}, {place[1]}"
                raise SolveError(f"{log.name}: {where} is no latitude and longitude")
            return Origin(float(place[0]), float(place[1]))
    for beacon in config.beacon:
        if beacon.latitude_deg is not None and beacon.longitude_deg is not None:
            return Origin(beacon.latitude_deg, beacon.longitude_deg)
    return None


def beacons_of(
    log: Log, config: Config, origin: Origin | None, first_reply_ns: int
) -> tuple[Beacons, list[Check]]:
    """The settings' beacons, else the log's; whether they could lie on a sea floor."""
    if config.beacon:
        beacons = Beacons(
            id=np.array([b.id for b in config.beacon]),
            name=np.array([b.name or str(b.id) for b in config.beacon]),
            position_enu_m=np.array([_placed(b, origin) for b in config.beacon]),
            turn_around_s=np.array([b.turn_around_s for b in config.beacon]),
            sigma_m=np.array([b.sigma_m for b in config.beacon]),
        )
    elif _has(log, "beacons"):
        rows = _latest(log.roles["beacons"], first_reply_ns)
        names = np.where(rows["name"] == "", rows["id"].astype(str), rows["name"])
        beacons = Beacons(
            rows["id"].astype(np.int64), names, rows["position_enu_m"], rows["turn_around_s"],
            np.nan_to_num(rows["sigma_m"]),
        )  # fmt: skip
    else:
        raise SolveError(f"{log.name}: no beacons, neither in the log nor in the settings")
    up_m = _judged(beacons, log).position_enu_m[:, 2]
    odd = np.flatnonzero((up_m > 0) | (up_m < -DEEPEST_M))
    told = ""
    if len(odd):
        first = f"beacon {beacons.id[odd[0]]} lies at {up_m[odd[0]]:+,.0f} m, up"
        told = f"{first}: are unit and sign right?"
    return beacons, [Check("align", "beacons_in_no_sea", len(odd), 0, "", not len(odd), told)]


def _judged(beacons: Beacons, log: Log) -> Beacons:
    """Refuse beacons that no position follows from."""
    ids, count = np.unique(beacons.id, return_counts=True)
    if np.any(count > 1):
        raise SolveError(f"{log.name}: beacon {ids[np.argmax(count)]} is there {count.max()} times")
    numbers = np.column_stack([beacons.position_enu_m, beacons.turn_around_s])
    near = np.all(np.abs(numbers) < _FARTHEST_M, axis=1)
    if not near.all():
        told = "has no finite position and turn-around time, or one from another planet"
        raise SolveError(f"{log.name}: beacon {beacons.id[~near][0]} {told}")
    if len(beacons) < 3:
        raise SolveError(
            f"{log.name}: {len(beacons)} beacons; a position needs 3 (two leave its mirror)"
        )
    n_places = len(np.unique(beacons.position_enu_m.round(2), axis=0))
    if n_places < 3:
        raise SolveError(f"{log.name}: all {len(beacons)} beacons lie in {n_places} places")
    return beacons


def _placed(beacon: BeaconSetting, origin: Origin | None) -> Float:
    """ENU position of a beacon of the settings."""
    if beacon.position_m is not None:
        return np.array(beacon.position_m)
    place = (beacon.latitude_deg, beacon.longitude_deg, beacon.depth_m)
    if None in place or origin is None:
        raise ConfigError(
            f"[[beacon]] {beacon.id}: give position_m, or latitude_deg, longitude_deg and depth_m"
        )
    latitude_deg, longitude_deg, depth_m = (np.float64(value or 0.0) for value in place)
    east_m, north_m, _ = geodetic_to_enu(
        origin.latitude_deg,
        origin.longitude_deg,
        np.array(latitude_deg),
        np.array(longitude_deg),
        np.array(-depth_m),
    )
    return np.array([east_m, north_m, -depth_m])


def sound_speed_of(
    log: Log, config: Config, beacons: Beacons, first_reply_ns: int
) -> tuple[SoundSpeed, list[Check]]:
    """The settings' profile, else the log's, else the constant as two equal levels.

    Raises
    ------
    SolveError
        A profile without a level that is finite and could be water.
    """
    checks, source = list[Check](), "[acoustics] sound_speed_mps of the settings"
    if config.sound_speed_profile is not None:
        source = "[sound_speed_profile] of the settings"
        depth_m = np.array(config.sound_speed_profile.depth_m, dtype=float)
        speed_mps = np.array(config.sound_speed_profile.sound_speed_mps, dtype=float)
    elif _has(log, "sound_speed"):
        source = f"the log's {log.topics['sound_speed']}"
        rows, where = _latest(log.roles["sound_speed"], first_reply_ns), log.topics["sound_speed"]
        good = np.abs(rows["depth_m"]) < DEEPEST_M
        good &= np.abs(rows["sound_speed_mps"] - 1500.0) < _FARTHEST_FROM_1500_MPS
        if not good.any():
            raise SolveError(f"{log.name}: no level of {where} holds a depth and a speed of water")
        lost = int(np.sum(~good))
        name, told = "sound_speed_levels_without_value", f"{where}: left out" if lost else ""
        checks.append(Check("align", name, lost, 0, "levels", lost == 0, told))
        depth_m, first = np.unique(rows["depth_m"][good], return_index=True)
        speed_mps = rows["sound_speed_mps"][good][first]
    else:
        depth_m, speed_mps = np.array([0.0]), np.array([config.acoustics.sound_speed_mps])
    if len(depth_m) == 1:
        depth_m, speed_mps = np.array([0.0, DEEPEST_M]), np.repeat(speed_mps, 2)
    mean_mps, slowest_mps = float(np.mean(speed_mps)), 1500.0 - _FARTHEST_FROM_1500_MPS
    known = Check("align", "sound_speed_mean", mean_mps, slowest_mps, "m/s", True, source)
    deepest_m, reach_m = float(-beacons.position_enu_m[:, 2].min()), float(depth_m[-1])
    short = deepest_m > reach_m + _BELOW_PROFILE_M
    told = f"ends at {reach_m:.0f} m; below, its last speed is held" if short else ""
    checks += [
        known,
        Check(
            "align",
            "beacons_below_sound_speed_profile",
            max(deepest_m - reach_m, 0.0),
            _BELOW_PROFILE_M,
            "m",
            not short,
            told,
        ),
    ]
    return SoundSpeed(depth_m, speed_mps), checks


def _latest(columns: Columns, first_reply_ns: int) -> Columns:
    """Rows of the last message before the first reply, or of the first message."""
    order = np.argsort(columns["time_ns"], kind="stable")
    before = int(np.sum(columns["time_ns"] <= first_reply_ns))
    chosen = columns["message"][order[max(before - 1, 0)]]
    return {name: column[columns["message"] == chosen] for name, column in columns.items()}


def _has(log: Log, role: str) -> bool:
    return role in log.roles and len(log.roles[role]["time_ns"]) > 0
