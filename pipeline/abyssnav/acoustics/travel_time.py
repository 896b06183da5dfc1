# SPDX-License-Identifier: Apache-2.0
"""Two-way travel time of a moving vehicle, its Jacobian, and the sound speed along each leg."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.ray_tracing import most_saved, travel_time
from abyssnav.tables import Bool, Float, Replies, SoundSpeed, Table

#: Sound speed of a dive without replies: nothing depends on it.
NOMINAL_MPS = 1500.0
#: Noise of the two-way time where none is stated: the paper's.
_SIGMA_S = 0.002
#: The straight ray is left where it may be wrong by more than this share of the noise.
_TOLERATED = 0.1
#: No reply comes from farther; times that say so are wrong, and keep the straight ray.
_FARTHEST_M = 20_000.0
_COUNTABLE_S = 1e12  #: whose squares are numbers still
#: A ray is traced once more where its distance may leave this much of its time.
_TRACED_AGAIN_S = 1e-6


@dataclass(frozen=True, eq=False)
class RayGeometry(Table):
    """Both legs of each ping, one row a reply, as the navigated point sees them.

    A virtual beacon is the beacon's horizontal position less the lever arm's: where the beacon
    would lie if the transducer sat on the navigated point.
    """

    flight_time_s: Float  #: measured two-way time less the beacon's turn-around
    virtual_beacon_ping_m: Float  #: (n, 2) east, north
    virtual_beacon_reply_m: Float  #: (n, 2) east, north
    height_ping_m: Float  #: transducer above the beacon
    height_reply_m: Float
    speed_ping_mps: Float  #: slant range over travel time: harmonic mean, or the bent ray's
    speed_reply_mps: Float

    @property
    def mean_speed_mps(self) -> float:
        """Sound speed that turns times of the whole dive into metres; NaN without replies."""
        return float(np.mean(self.speed_reply_mps)) if len(self) else np.nan


class TravelTimePrediction(NamedTuple):
    """Predicted flight time and its gradients with respect to both positions."""

    time_s: Float  #: (...)
    gradient_ping_spm: Float  #: (..., 2) ∂T/∂p at the ping
    gradient_reply_spm: Float  #: (..., 2) ∂T/∂p at the reply


@dataclass(frozen=True)
class RayCheck:
    """How far the straight ray is from the truth over a dive."""

    n_replies: int
    n_traced: int  #: replies with a bent leg in place of a straight one
    n_shadow: int  #: replies for which a bent leg was looked for, and there is none
    largest_s: float  #: most that the bent ray saves on a two-way time, where traced


def ray_geometry(
    replies: Replies, sound_speed: SoundSpeed, *, sigma_s: float = _SIGMA_S
) -> RayGeometry:
    """Geometry and sound speed of every reply's two legs.

    The speed is the harmonic mean between the depths, which makes a straight ray's time of its
    length.  Where that might put the two-way time wrong by more than σ / 10, the ray is traced:
    its slant range over its travel time takes the place, so that the model stays ρ / c.  That
    speed depends on the horizontal distance, but weakly, so the measured time tells
    it to microseconds.

    Parameters
    ----------
    replies : rows of known beacons only (`beacon` >= 0)
    sigma_s : standard deviation of the two-way time; inf: straight rays
    """
    position_enu_m = replies.beacon_enu_m
    transducer_ping_m = replies.lever_ping_enu_m[:, 2] - replies.depth_ping_m
    transducer_reply_m = replies.lever_reply_enu_m[:, 2] - replies.depth_reply_m
    straight = RayGeometry(
        flight_time_s=replies.travel_time_s - replies.turn_around_s,
        virtual_beacon_ping_m=position_enu_m[:, :2] - replies.lever_ping_enu_m[:, :2],
        virtual_beacon_reply_m=position_enu_m[:, :2] - replies.lever_reply_enu_m[:, :2],
        height_ping_m=transducer_ping_m - position_enu_m[:, 2],
        height_reply_m=transducer_reply_m - position_enu_m[:, 2],
        speed_ping_mps=mean_sound_speed(sound_speed, -transducer_ping_m, -position_enu_m[:, 2]),
        speed_reply_mps=mean_sound_speed(sound_speed, -transducer_reply_m, -position_enu_m[:, 2]),
    )
    depth_m = -position_enu_m[:, 2]
    bent = _doubtful(straight, depth_m, sound_speed, sigma_s)
    if not bent.any():
        return straight
    slower = np.ones(len(replies))
    slower[bent] = 1 - _saved_share(straight[bent], depth_m[bent], sound_speed)
    return replace(
        straight,
        speed_ping_mps=straight.speed_ping_mps / slower,
        speed_reply_mps=straight.speed_reply_mps / slower,
    )


def ray_check(
    geometry: RayGeometry, replies: Replies, sound_speed: SoundSpeed, *, sigma_s: float = _SIGMA_S
) -> RayCheck:
    """What `ray_geometry` did for the replies given: how many it traced, and what that changed.

    Parameters
    ----------
    geometry, replies : the same rows, such as those accepted: wild times tell wild distances
    """
    straight = ray_geometry(replies, sound_speed, sigma_s=np.inf)
    depth_m = -replies.beacon_enu_m[:, 2]
    looked_for = _doubtful(straight, depth_m, sound_speed, sigma_s)
    saved_s = _distance(straight)[2] * (1 / _speed(straight) - 1 / _speed(geometry))
    missing = looked_for & (saved_s == 0)
    return RayCheck(
        n_replies=len(replies),
        n_traced=int(np.sum(looked_for & ~missing)),
        n_shadow=int(np.sum(missing)),
        largest_s=float(np.max(2 * saved_s[looked_for], initial=0.0)),
    )


def _doubtful(
    straight: RayGeometry, beacon_depth_m: Float, sound_speed: SoundSpeed, sigma_s: float
) -> Bool:
    """Replies (n,) of which the straight rays may miss the two-way time by σ / 10."""
    distance_m, height_m, _ = _distance(straight)
    saved_s = most_saved(
        sound_speed, beacon_depth_m - height_m, beacon_depth_m, distance_m, _speed(straight)
    )
    return np.asarray(2 * saved_s > _TOLERATED * sigma_s)


def _saved_share(straight: RayGeometry, beacon_depth_m: Float, sound: SoundSpeed) -> Float:
    """Share q (n,) of the straight ray's time by which the bent one comes sooner; 0 in shadow.

    One ray a reply, half way between ping and reply: what the legs differ by is in q to second
    order only.  The range is longer than the straight one's that gave the distance x; q grows as
    x², which corrects both, and where q is large the ray is traced once more at the distance so
    found.
    """
    x, height_m, measured_m = _distance(straight)
    mean_mps = _speed(straight)
    share, todo = np.zeros(len(x)), np.arange(len(x))
    for _ in range(2):
        distance_m, h, b = x[todo], height_m[todo], beacon_depth_m[todo]
        time_s = travel_time(sound, b - h, b, distance_m)
        value = np.where(
            np.isfinite(time_s), 1 - time_s * mean_mps[todo] / np.hypot(distance_m, h), 0.0
        )
        share[todo] = value * ((measured_m[todo] / (1 - value)) ** 2 - h**2) / distance_m**2
        x = np.sqrt((measured_m / (1 - share)) ** 2 - height_m**2)
        todo = np.flatnonzero(share**2 * measured_m / mean_mps > _TRACED_AGAIN_S)
    return share


def _distance(straight: RayGeometry) -> tuple[Float, Float, Float]:
    """Horizontal distance, height and slant range (n,) half way; a distance of 0 for wild times."""
    height_m = 0.5 * (straight.height_ping_m + straight.height_reply_m)
    with np.errstate(invalid="ignore", over="ignore"):
        range_m = 0.5 * straight.flight_time_s * _speed(straight)
        square_m2 = (range_m - height_m) * (range_m + height_m)
    sane = (square_m2 > 0) & (range_m > 0) & (range_m < _FARTHEST_M)
    distance_m = np.sqrt(np.where(sane, square_m2, 0.0))
    return distance_m, height_m, np.hypot(distance_m, height_m)


def _speed(geometry: RayGeometry) -> Float:
    """Mean of both legs' speeds (n,), as it counts for their time."""
    return np.asarray(2 / (1 / geometry.speed_ping_mps + 1 / geometry.speed_reply_mps))


def predict_travel_time(
    position_ping_m: Float, position_reply_m: Float, geometry: RayGeometry
) -> TravelTimePrediction:
    """Flight time of both legs and how it changes with the position at either end (Eq. 3).

        T - τ = |p_p - b| / c_p + |p_r - b| / c_r
        ∂T/∂p = (p - b) / (c |p - b|)          horizontal part, one for each leg

    Both legs move with the state, so the filter's H is the sum of the two gradients.

    Parameters
    ----------
    position_ping_m, position_reply_m : (..., 2) m, ENU
        Navigated point; the leading axes broadcast against the rows of `geometry`.

    Returns
    -------
    TravelTimePrediction
        time_s (...) and gradients (..., 2) in s/m.
    """
    from_ping_m = position_ping_m - geometry.virtual_beacon_ping_m
    from_reply_m = position_reply_m - geometry.virtual_beacon_reply_m
    range_ping_m = slant_range(from_ping_m, geometry.height_ping_m)
    range_reply_m = slant_range(from_reply_m, geometry.height_reply_m)
    return TravelTimePrediction(
        range_ping_m / geometry.speed_ping_mps + range_reply_m / geometry.speed_reply_mps,
        from_ping_m / (range_ping_m * geometry.speed_ping_mps)[..., None],
        from_reply_m / (range_reply_m * geometry.speed_reply_mps)[..., None],
    )


def slant_range(from_m: Float, height_m: Float) -> Float:
    """|(e, n, h)| (...) m, a nanometre at least: at the beacon the gradient is none, not 0 / 0."""
    square_m2 = from_m[..., 0] ** 2 + from_m[..., 1] ** 2 + height_m**2
    return np.asarray(np.maximum(np.sqrt(square_m2), 1e-9))


def is_physical(geometry: RayGeometry, travel_time_s: Float, sigma_s: float) -> Bool:
    """Whether some position explains each time (n,).

    Not so when the time is not finite, not above the turn-around, or more than 5 σ shorter than
    sound needs for the difference in depth.  There is no upper bound but that of
    arithmetic: another would hide how far wild times lead an ungated filter.
    """
    vertical_s = (
        np.abs(geometry.height_ping_m) / geometry.speed_ping_mps
        + np.abs(geometry.height_reply_m) / geometry.speed_reply_mps
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(
            (travel_time_s < _COUNTABLE_S)
            & (travel_time_s > 0)
            & (geometry.flight_time_s > 0)
            & (geometry.flight_time_s > vertical_s - 5 * sigma_s)
        )


def mean_sound_speed(profile: SoundSpeed, depth_m: Float, other_depth_m: Float) -> Float:
    """Harmonic mean of the sound speed between two depths: c_h = Δz / ∫ dz / c(z).

    The speed that turns a straight ray's length into its travel time.  Where the depths agree it
    is c(z) itself.  Above the first and below the last level the profile is held.

    Parameters
    ----------
    depth_m, other_depth_m : (n,) m, down

    Returns
    -------
    sound_speed_mps : (n,) m/s
    """
    thickness_m = np.asarray(other_depth_m - depth_m)
    level = np.abs(thickness_m) < 1e-3
    slowness_s = _slowness_integral(profile, other_depth_m) - _slowness_integral(profile, depth_m)
    middle_m = depth_m + 0.5 * thickness_m
    here_mps = np.interp(middle_m, profile.depth_m, profile.sound_speed_mps)
    return np.asarray(
        np.where(level, here_mps, np.where(level, 1, thickness_m) / np.where(level, 1, slowness_s))
    )


def _slowness_integral(profile: SoundSpeed, depth_m: Float) -> Float:
    """∫ dz / c(z) from the profile's first level down to each depth, exact for linear layers.

    Within a layer of c = c₁ + g z the integral is ln(c₂ / c₁) / g = Δz / c₁ · ln(1 + x) / x with
    x = c₂ / c₁ - 1, which stays exact when g goes to zero.
    """
    knots_m, speed_mps = profile.depth_m, profile.sound_speed_mps
    thickness_m = np.diff(knots_m)
    whole_s = thickness_m / speed_mps[:-1] * _log1p_over_x(speed_mps[1:] / speed_mps[:-1] - 1)
    down_to_s = np.concatenate([[0.0], np.cumsum(whole_s)])
    inside_m = np.clip(depth_m, knots_m[0], knots_m[-1])
    outside_m = depth_m - inside_m
    layer = np.clip(np.searchsorted(knots_m, inside_m, side="right") - 1, 0, len(knots_m) - 1)
    top_mps = speed_mps[layer]
    here_mps = np.interp(inside_m, knots_m, speed_mps)
    partial_s = (inside_m - knots_m[layer]) / top_mps * _log1p_over_x(here_mps / top_mps - 1)
    return np.asarray(down_to_s[layer] + partial_s + outside_m / here_mps)


def _log1p_over_x(x: Float) -> Float:
    small = np.abs(x) < 1e-8
    return np.where(small, 1 - x / 2, np.log1p(x) / np.where(small, 1, x))
