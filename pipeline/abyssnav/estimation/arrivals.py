# SPDX-License-Identifier: Apache-2.0
"""How each reply came: straight, by a bounce, late, or as somebody else's answer."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import (
    RayGeometry,
    mean_sound_speed,
    predict_travel_time,
    ray_geometry,
)
from abyssnav.tables import (
    ARRIVALS,
    EXPLANATIONS,
    Beacons,
    Float,
    Int,
    Replies,
    SoundSpeed,
)

UNKNOWN, DIRECT, MULTIPATH, OUTLIER = range(len(ARRIVALS))
#: A late copy comes within this time; what comes later is explained by something else or nothing.
_LATEST_COPY_S = 0.5
#: Images are told apart from chance by residuals within this many standard deviations.
_EXPLAINED = 3.0
#: What relief and the straight ray leave of an image's time, for each bounce.
_IMAGE_SIGMA_S = 0.002


@dataclass(frozen=True, eq=False)
class Places:
    """Where the vehicle was at every usable reply, as the smoothed track has it."""

    ping_m: Float  #: (n, 2)
    reply_m: Float  #: (n, 2)
    earlier_ping_m: Float  #: (n, 2) at the ping before
    position_cov_m2: Float  #: (n, 2, 2)
    sound_scale: Float  #: (n,) speed used over true speed, less one


class Received(NamedTuple):
    """The usable replies, n rows, in the order heard."""

    replies: Replies
    geometry: RayGeometry  #: of the direct path
    sigma_s: Float | float  #: noise of the times, of each or of all


class Environment(NamedTuple):
    """What sound meets on its way."""

    beacons: Beacons
    sound_speed: SoundSpeed
    floor_depth_m: Float  #: (n,) below the vehicle; NaN where it is not known: no image in it


def previous_pings(t_ping_s: Float) -> Float:
    """Instant (n,) of the ping before each reply's; its own where that was the first."""
    pings_s, number = np.unique(t_ping_s, return_inverse=True)
    return np.asarray(pings_s[np.maximum(number - 1, 0)])


def classify(
    places: Places, received: Received, environment: Environment, gamma: float
) -> tuple[Int, Int]:
    """Class of each usable reply, and what explains it.

    `direct` is inside the gate of the direct path with no image that fits better.  Image sources:
    the beacon mirrored in the floor (z -> 2 z_floor - z) or the surface (z -> -z), on the way out,
    back or both; the best within 3 σ makes a reply `multipath`.  So does a delay of up to half a
    second (a late copy).  The rest are `outlier`, explained where another beacon's answer or an
    answer to the ping before fits within 3 σ.

    Parameters
    ----------
    places, received : n rows each, in the same order
    gamma : threshold of the gate; where it is infinite, the 3 σ of the images

    Returns
    -------
    arrival, explanation : (n,) places in `ARRIVALS` and `EXPLANATIONS`
    """
    replies, own, sigma_s = received
    direct_s, spread_s = _direct(places, own, sigma_s)
    late_s = own.flight_time_s - direct_s
    direct_misfit = np.abs(late_s) / spread_s
    bounce, bounce_misfit = _best_image(places, received, environment, spread_s)
    limit = np.sqrt(gamma) if np.isfinite(gamma) else _EXPLAINED
    rules = (
        ((direct_misfit <= limit) & (direct_misfit <= bounce_misfit), DIRECT, "direct"),
        (bounce_misfit <= _EXPLAINED, MULTIPATH, ""),
        (direct_misfit <= limit, DIRECT, "direct"),
        (_wrong_beacon(places, replies, environment, spread_s), OUTLIER, "wrong_beacon"),
        (_previous_ping(places, own, replies, spread_s), OUTLIER, "previous_ping"),
        ((late_s > 0) & (late_s < _LATEST_COPY_S), MULTIPATH, "late_copy"),
    )
    conditions = [rule[0] for rule in rules]
    arrival = np.select(conditions, [rule[1] for rule in rules], OUTLIER)
    names = [bounce if not name else EXPLANATIONS.index(name) for _, _, name in rules]
    return arrival, np.select(conditions, names, EXPLANATIONS.index(""))


def _direct(places: Places, own: RayGeometry, sigma_s: Float | float) -> tuple[Float, Float]:
    """Predicted flight time of the direct path and its standard deviation, the track's included."""
    predicted = predict_travel_time(places.ping_m, places.reply_m, own)
    gradient = predicted.gradient_ping_spm + predicted.gradient_reply_spm
    track_s2 = np.einsum("ni,nij,nj->n", gradient, places.position_cov_m2, gradient)
    return (1 + places.sound_scale) * predicted.time_s, np.sqrt(track_s2 + sigma_s**2)


def _best_image(
    places: Places, received: Received, environment: Environment, spread_s: Float
) -> tuple[Int, Float]:
    """The bounce that explains each time best, and by how many standard deviations it fails."""
    replies, own, _ = received
    _, sound_speed, floor_depth_m = environment
    beacon_depth_m = -replies.beacon_enu_m[:, 2]
    surface = _mirrored(own, beacon_depth_m, np.zeros(len(replies)), sound_speed)
    images = [("surface", own, surface), ("surface", surface, own), ("surface", surface, surface)]
    if np.isfinite(floor_depth_m).any():
        floor = _mirrored(own, beacon_depth_m, floor_depth_m, sound_speed)
        images += [("bottom", own, floor), ("bottom", floor, own), ("bottom", floor, floor)]
    misfits = []
    for _, out, back in images:
        path = replace(
            own,
            height_ping_m=out.height_ping_m,
            speed_ping_mps=out.speed_ping_mps,
            height_reply_m=back.height_reply_m,
            speed_reply_mps=back.speed_reply_mps,
        )
        time_s = (1 + places.sound_scale) * predict_travel_time(
            places.ping_m, places.reply_m, path
        ).time_s
        misfit = np.abs(own.flight_time_s - time_s) / np.hypot(spread_s, _IMAGE_SIGMA_S)
        misfits.append(np.where(np.isnan(misfit), np.inf, misfit))
    best = np.argmin(misfits, axis=0)
    codes = np.array([EXPLANATIONS.index(name) for name, _, _ in images])
    return codes[best], np.min(misfits, axis=0)


def _mirrored(
    own: RayGeometry, beacon_depth_m: Float, plane_m: Float, sound: SoundSpeed
) -> RayGeometry:
    """Geometry to the beacon's image in a horizontal plane (n,) m deep; sound goes there and back.

    The image lies as far behind the plane as the beacon before it, so the height is the sum of
    both distances to the plane, and the speed the harmonic mean over both stretches.
    """

    def way(height_m: Float) -> tuple[Float, Float]:
        depth_m = beacon_depth_m - height_m
        to_plane_m, from_plane_m = np.abs(depth_m - plane_m), np.abs(beacon_depth_m - plane_m)
        slow_s = to_plane_m / mean_sound_speed(sound, depth_m, plane_m)
        slow_s = slow_s + from_plane_m / mean_sound_speed(sound, plane_m, beacon_depth_m)
        return to_plane_m + from_plane_m, (to_plane_m + from_plane_m) / np.maximum(slow_s, 1e-9)

    height_ping_m, speed_ping_mps = way(own.height_ping_m)
    height_reply_m, speed_reply_mps = way(own.height_reply_m)
    return replace(
        own,
        height_ping_m=height_ping_m,
        height_reply_m=height_reply_m,
        speed_ping_mps=speed_ping_mps,
        speed_reply_mps=speed_reply_mps,
    )


def _wrong_beacon(
    places: Places, replies: Replies, environment: Environment, spread_s: Float
) -> np.ndarray:
    """Whether another beacon's answer would have come at that time (by straight rays)."""
    explained = np.zeros(len(replies), dtype=bool)
    beacons, sound_speed = environment.beacons, environment.sound_speed
    for other in range(len(beacons)):
        asked = replace(
            replies,
            beacon_enu_m=np.broadcast_to(beacons.position_enu_m[other], (len(replies), 3)),
            turn_around_s=np.full(len(replies), beacons.turn_around_s[other]),
        )
        path = ray_geometry(asked, sound_speed, sigma_s=np.inf)
        predicted = predict_travel_time(places.ping_m, places.reply_m, path)
        missed_s = np.abs(path.flight_time_s - (1 + places.sound_scale) * predicted.time_s)
        explained |= (missed_s <= _EXPLAINED * spread_s) & (replies.beacon != other)
    return explained


def _previous_ping(
    places: Places, own: RayGeometry, replies: Replies, spread_s: Float
) -> np.ndarray:
    """Whether the beacon's answer to the ping before would have come at that time."""
    before_s = previous_pings(replies.t_ping_s)
    predicted = predict_travel_time(places.earlier_ping_m, places.reply_m, own)
    waited_s = own.flight_time_s + replies.t_ping_s - before_s
    missed_s = np.abs(waited_s - (1 + places.sound_scale) * predicted.time_s)
    return np.asarray((before_s < replies.t_ping_s) & (missed_s <= _EXPLAINED * spread_s))
