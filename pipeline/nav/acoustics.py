# SPDX-License-Identifier: Apache-2.0
"""Two-way travel time of a moving vehicle, its Jacobian, and the sound speed along each leg."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pipeline.tables import Beacons, Bool, Float, Replies, SoundSpeed, Table


@dataclass(frozen=True, eq=False)
class Legs(Table):
    """Both legs of each ping, one row a reply, as the navigated point sees them.

    An `aim` is the beacon's horizontal position less the lever arm's: where the beacon would lie
    if the transducer sat on the navigated point.
    """

    flight_time_s: Float  #: measured two-way time less the beacon's turn-around
    aim_ping_m: Float  #: (n, 2) east, north
    aim_reply_m: Float  #: (n, 2) east, north
    height_ping_m: Float  #: transducer above the beacon
    height_reply_m: Float
    speed_ping_mps: Float  #: harmonic mean over the leg
    speed_reply_mps: Float


class Flight(NamedTuple):
    """Predicted flight time and its gradients with respect to both positions."""

    time_s: Float  #: (...)
    gradient_ping_spm: Float  #: (..., 2) ∂T/∂p at the ping
    gradient_reply_spm: Float  #: (..., 2) ∂T/∂p at the reply


def legs(replies: Replies, beacons: Beacons, sound_speed: SoundSpeed) -> Legs:
    """Geometry and sound speed of every reply's two legs.

    Parameters
    ----------
    replies : rows of known beacons only (`beacon` >= 0)
    """
    position_enu_m = beacons.position_enu_m[replies.beacon]
    transducer_ping_m = replies.lever_ping_enu_m[:, 2] - replies.depth_ping_m
    transducer_reply_m = replies.lever_reply_enu_m[:, 2] - replies.depth_reply_m
    return Legs(
        flight_time_s=replies.travel_time_s - beacons.turn_around_s[replies.beacon],
        aim_ping_m=position_enu_m[:, :2] - replies.lever_ping_enu_m[:, :2],
        aim_reply_m=position_enu_m[:, :2] - replies.lever_reply_enu_m[:, :2],
        height_ping_m=transducer_ping_m - position_enu_m[:, 2],
        height_reply_m=transducer_reply_m - position_enu_m[:, 2],
        speed_ping_mps=mean_sound_speed(sound_speed, -transducer_ping_m, -position_enu_m[:, 2]),
        speed_reply_mps=mean_sound_speed(sound_speed, -transducer_reply_m, -position_enu_m[:, 2]),
    )


def flight(position_ping_m: Float, position_reply_m: Float, of: Legs) -> Flight:
    """Flight time of both legs and how it changes with the position at either end (Eq. 3).

        T - τ = |p_p - b| / c_p + |p_r - b| / c_r
        ∂T/∂p = (p - b) / (c |p - b|)          horizontal part, one for each leg

    Both legs move with the state, so the filter's H is the sum of the two gradients.

    Parameters
    ----------
    position_ping_m, position_reply_m : (..., 2) m, ENU
        Navigated point; the leading axes broadcast against the rows of `of`.

    Returns
    -------
    Flight
        time_s (...) and gradients (..., 2) in s/m.
    """
    from_ping_m = position_ping_m - of.aim_ping_m
    from_reply_m = position_reply_m - of.aim_reply_m
    range_ping_m = _slant_range(from_ping_m, of.height_ping_m)
    range_reply_m = _slant_range(from_reply_m, of.height_reply_m)
    return Flight(
        range_ping_m / of.speed_ping_mps + range_reply_m / of.speed_reply_mps,
        from_ping_m / (range_ping_m * of.speed_ping_mps)[..., None],
        from_reply_m / (range_reply_m * of.speed_reply_mps)[..., None],
    )


def _slant_range(from_m: Float, height_m: Float) -> Float:
    """|(e, n, h)|, a nanometre at least: right at the beacon the gradient is none, not 0 / 0."""
    level_m = np.hypot(from_m[..., 0], from_m[..., 1])
    return np.asarray(np.maximum(np.hypot(level_m, height_m), 1e-9))


def is_physical(of: Legs, travel_time_s: Float, sigma_s: float) -> Bool:
    """Whether some position explains each time.

    Not so when the time is not finite, not above the turn-around, or more than 5 σ shorter than
    sound needs for the difference in depth.  There is no upper bound: it would hide how far
    wild times lead an ungated filter.
    """
    vertical_s = (
        np.abs(of.height_ping_m) / of.speed_ping_mps
        + np.abs(of.height_reply_m) / of.speed_reply_mps
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(
            np.isfinite(travel_time_s)
            & (travel_time_s > 0)
            & (of.flight_time_s > 0)
            & (of.flight_time_s > vertical_s - 5 * sigma_s)
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
