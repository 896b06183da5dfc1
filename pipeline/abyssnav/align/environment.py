# SPDX-License-Identifier: Apache-2.0
"""What the log or the settings say of the water, and where the local frame's zero is."""

from dataclasses import replace

import numpy as np

from abyssnav.align.beacons import DEEPEST_M, has_rows, latest_message
from abyssnav.config import Config, on_earth
from abyssnav.errors import SolveError
from abyssnav.geometry import interpolate
from abyssnav.tables import (
    Beacons,
    Check,
    Columns,
    Depth,
    Float,
    Log,
    Origin,
    SoundSpeed,
    SoundSpeedErrors,
)

#: A profile may end so far above the deepest beacon.
_BELOW_PROFILE_M = 100.0
#: Natural water has 1400 to 1600 m/s.
_FARTHEST_FROM_1500_MPS = 300.0
#: Nominal speed where none is stated; how wrong a speed or profile is, stated or not; and the
#: gradient of deep water.
_NOMINAL_MPS, _KNOWN_SIGMA_MPS, _UNKNOWN_SIGMA_MPS = 1500.0, 1.0, 15.0
_GRADIENT_SIGMA_PER_S = 0.004
#: Layers into which the vehicle's own samples are put, and how many a layer needs.
_LAYER_M, _FEWEST = 10.0, 3
#: Samples farther from their layer's median than so many median deviations are left out.
_OUTLYING = 6.0
#: Down- and up-cast may differ by this much in the mean.
_CASTS_DIFFER_MPS = 2.0


def origin_of(log: Log, config: Config, first_reply_ns: int) -> tuple[Origin | None, list[Check]]:
    """Origin of the local frame, and where it is from.

    The settings', else the log's, else the first beacon's place, else the first position fix's.

    Raises
    ------
    SolveError
        The log's is not on earth.
    """
    origin = _origin(log, config, first_reply_ns)
    if origin is None:
        return None, []
    if not on_earth(origin.latitude_deg, origin.longitude_deg):
        where = f"{origin.source}: origin {origin.latitude_deg}, {origin.longitude_deg}"
        raise SolveError(f"{log.name}: {where} is no latitude and longitude")
    detail = f"{origin.latitude_deg:.7f}, {origin.longitude_deg:.7f}: of the {origin.source}"
    return origin, [Check("align", "origin", origin.latitude_deg, 90.0, "degrees", True, detail)]


def _origin(log: Log, config: Config, first_reply_ns: int) -> Origin | None:
    if config.origin is not None:
        return Origin(config.origin.latitude_deg, config.origin.longitude_deg, "settings")
    beacons = log.roles["beacons"] if has_rows(log, "beacons") else None
    if beacons is not None:
        first = latest_message(beacons, first_reply_ns)
        place = (first["origin_latitude_deg"][0], first["origin_longitude_deg"][0])
        if np.all(np.isfinite(place)):
            return Origin(float(place[0]), float(place[1]), "log")
    for beacon in config.beacon:
        if beacon.latitude_deg is not None and beacon.longitude_deg is not None:
            return Origin(beacon.latitude_deg, beacon.longitude_deg, "beacon")
    if config.beacon or beacons is None:
        return _first_place(log, "position", "position")
    return _first_place(log, "beacons", "beacon")


def _first_place(log: Log, role: str, source: str) -> Origin | None:
    """The first latitude and longitude of a role; None if it has none."""
    if not has_rows(log, role) or "latitude_deg" not in log.roles[role]:
        return None
    columns = log.roles[role]
    latitude_deg, longitude_deg = columns["latitude_deg"], columns["longitude_deg"]
    known = np.flatnonzero(np.isfinite(latitude_deg) & np.isfinite(longitude_deg))
    if not len(known):
        return None
    return Origin(float(latitude_deg[known[0]]), float(longitude_deg[known[0]]), source)


def sound_speed_of(
    log: Log, config: Config, beacons: Beacons, dive: tuple[int, int, Depth]
) -> tuple[SoundSpeed, SoundSpeedErrors, list[Check]]:
    """The settings' profile, else the log's, else one of the stated speed, and how wrong it may be.

    The log's is a profile as it was logged, one made of the vehicle's own samples, or the median of
    logged means.  A single speed gets the gradient of deep water about the depth that it is for.

    Parameters
    ----------
    dive : start and first reply, ns; depth of the vehicle

    Raises
    ------
    SolveError
        A profile without a level that is finite and could be water.
    """
    checks, source = list[Check](), "[acoustics] sound_speed_mps of the settings"
    acoustics = config.acoustics
    sigma_mps = acoustics.sound_speed_sigma_mps
    errors = SoundSpeedErrors(_KNOWN_SIGMA_MPS if sigma_mps is None else sigma_mps)
    if config.sound_speed_profile is not None:
        source = "[sound_speed_profile] of the settings"
        depth_m = np.array(config.sound_speed_profile.depth_m, dtype=float)
        speed_mps = np.array(config.sound_speed_profile.sound_speed_mps, dtype=float)
    elif has_rows(log, "sound_speed"):
        source = f"the log's {log.topics['sound_speed']}"
        depth_m, speed_mps, checks = _logged_sound_speed(log, *dive)
    else:
        if acoustics.sound_speed_mps is None:
            source = "no speed is stated: assumed"
            errors = replace(
                errors, sigma_mps=_UNKNOWN_SIGMA_MPS if sigma_mps is None else sigma_mps
            )
        depth_m = np.array([0.0])
        speed_mps = np.array([acoustics.sound_speed_mps or _NOMINAL_MPS])
    if len(depth_m) == 1:
        errors = replace(errors, depth_m=_depth_of_speed(config, beacons, dive[2]))
        if acoustics.sound_speed_gradient_per_s != 0.0:
            errors = replace(errors, gradient_sigma_per_s=_GRADIENT_SIGMA_PER_S)
        depth_m, speed_mps, check = _with_gradient(config, float(speed_mps[0]), errors)
        checks.append(check)
    speed_mps = speed_mps / (1 + config.calibration.sound_speed_scale)
    mean_mps, slowest_mps = float(np.mean(speed_mps)), 1500.0 - _FARTHEST_FROM_1500_MPS
    known = Check("align", "sound_speed_mean", mean_mps, slowest_mps, "m/s", True, source, "min")
    deepest_m = float(np.max(-beacons.position_enu_m[:, 2], initial=0.0))
    reach_m = float(depth_m[-1])
    short = deepest_m > reach_m + _BELOW_PROFILE_M
    detail = f"ends at {reach_m:.0f} m; below, its last speed is held" if short else ""
    checks += [
        known,
        Check(
            "align",
            "beacons_below_sound_speed_profile",
            max(deepest_m - reach_m, 0.0),
            _BELOW_PROFILE_M,
            "m",
            not short,
            detail,
        ),
    ]
    return SoundSpeed(depth_m, speed_mps), errors, checks


def _depth_of_speed(config: Config, beacons: Beacons, depth: Depth) -> float:
    """Depth that a single speed is for: as stated, else the mean of vehicle and beacons."""
    stated_m = config.acoustics.sound_speed_depth_m
    if stated_m is not None:
        return stated_m
    vehicle_m = float(np.median(depth.depth_m))
    if not len(beacons):
        return vehicle_m
    return 0.5 * (vehicle_m - float(np.mean(beacons.position_enu_m[:, 2])))


def _with_gradient(
    config: Config, speed_mps: float, errors: SoundSpeedErrors
) -> tuple[Float, Float, Check]:
    """Depths and speeds of a single speed with the settings' gradient about its depth."""
    gradient, middle_m = config.acoustics.sound_speed_gradient_per_s, errors.depth_m or 0.0
    depth_m = np.array([min(middle_m, 0.0), DEEPEST_M])
    profile_mps = speed_mps + gradient * (depth_m - middle_m)
    if gradient == 0.0:
        profile_mps = np.repeat(speed_mps, 2)
    detail = (
        f"no profile: {speed_mps:.1f} m/s at {middle_m:.0f} m, to {errors.sigma_mps:g} m/s, "
        f"and a gradient of {gradient:g} 1/s are assumed"
    )
    ok = errors.sigma_mps < _UNKNOWN_SIGMA_MPS
    check = Check(
        "align", "sound_speed_assumed", errors.sigma_mps, _UNKNOWN_SIGMA_MPS, "m/s", ok, detail
    )
    return depth_m, profile_mps, check


def _logged_sound_speed(
    log: Log, start_ns: int, first_reply_ns: int, depth: Depth
) -> tuple[Float, Float, list[Check]]:
    """Depths and speeds of the log's profile, samples or means; what was left out of them."""
    columns, where = log.roles["sound_speed"], log.topics["sound_speed"]
    is_profile = "message" in columns
    rows = dict(latest_message(columns, first_reply_ns) if is_profile else columns)
    if "depth_m" in rows and "message" not in rows:
        t_s = (rows["time_ns"] - start_ns) / 1e9
        own_m = interpolate(t_s, depth.t_s, depth.depth_m)
        rows["depth_m"] = np.where(np.isfinite(rows["depth_m"]), rows["depth_m"], own_m)
    level_m = rows.get("depth_m", np.zeros(len(rows["time_ns"])))
    good = np.abs(level_m) < DEEPEST_M
    good &= np.abs(rows["sound_speed_mps"] - 1500.0) < _FARTHEST_FROM_1500_MPS
    if not good.any():
        raise SolveError(f"{log.name}: no level of {where} holds a depth and a speed of water")
    lost = int(np.sum(~good))
    name, detail = "sound_speed_levels_without_value", f"{where}: left out" if lost else ""
    checks = [Check("align", name, lost, 0, "levels", lost == 0, detail)]
    rows = {key: column[good] for key, column in rows.items()}
    if "depth_m" not in rows:
        return np.zeros(1), np.median(rows["sound_speed_mps"])[None], checks
    if "message" in rows:
        depth_m, first = np.unique(rows["depth_m"], return_index=True)
        return depth_m, rows["sound_speed_mps"][first], checks
    depth_m, speed_mps, more = _profile_of_samples(rows, where)
    return depth_m, speed_mps, [*checks, *more]


def _profile_of_samples(rows: Columns, where: str) -> tuple[Float, Float, list[Check]]:
    """Profile from the vehicle's own samples: medians of layers, without what lies far off them.

    Samples before the greatest depth are the down-cast, later ones the up-cast; how far their
    layers differ says whether the water, or the sensor's lag, changed in between.
    """
    depth_m, speed_mps = rows["depth_m"], rows["sound_speed_mps"]
    layer = np.floor(depth_m / _LAYER_M).astype(np.int64)
    middle_mps, spread_mps = _layers(layer, speed_mps, layer)
    kept = np.abs(speed_mps - middle_mps) <= _OUTLYING * np.maximum(spread_mps, 0.05)
    left_out = int(np.sum(~kept))
    layers = np.unique(layer[kept])
    level_m = np.array([np.mean(depth_m[kept & (layer == one)]) for one in layers])
    level_mps = np.array([np.median(speed_mps[kept & (layer == one)]) for one in layers])
    down = np.arange(len(depth_m)) <= int(np.argmax(depth_m))
    casts = [
        {
            one: float(np.median(speed_mps[cast & (layer == one)]))
            for one in layers.tolist()
            if np.sum(cast & (layer == one)) >= _FEWEST
        }
        for cast in (kept & down, kept & ~down)
    ]
    both = sorted(casts[0].keys() & casts[1].keys())
    apart_mps = float(np.mean([abs(casts[0][k] - casts[1][k]) for k in both])) if both else 0.0
    detail = f"{where}: {len(both)} layers of {_LAYER_M:.0f} m seen going down and coming up"
    return level_m, level_mps, [
        Check("align", "sound_speed_samples_left_out", left_out, 0.02 * len(kept), "samples",
              left_out <= 0.02 * len(kept), f"{where}: far from their layer's median"),
        Check("align", "sound_speed_casts_differ", apart_mps, _CASTS_DIFFER_MPS, "m/s",
              apart_mps <= _CASTS_DIFFER_MPS, detail),
    ]  # fmt: skip


def _layers(layer: np.ndarray, values: Float, asked: np.ndarray) -> tuple[Float, Float]:
    """Median and scaled median deviation of each asked layer's values."""
    every, row = np.unique(layer, return_inverse=True)
    middle = np.array([np.median(values[row == k]) for k in range(len(every))])
    away = np.abs(values - middle[row])
    spread = 1.4826 * np.array([np.median(away[row == k]) for k in range(len(every))])
    place = np.searchsorted(every, asked)
    return middle[place], spread[place]
