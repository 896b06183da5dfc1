# SPDX-License-Identifier: Apache-2.0
"""Eigenrays: how long sound takes from one depth to another by the bent way that it really goes.

Sound speed is linear between the profile's levels and held outside them.  In such a layer a ray
is an arc of a circle, and its ray parameter p = cos(grazing angle) / c is the same all along.
"""

from dataclasses import dataclass, replace

import numpy as np

from abyssnav.tables import Bool, Float, Int, SoundSpeed

#: A chunk's arrays have about so many elements: what stays in a processor's cache.
_CHUNK = 1 << 17
#: Newton stops when the ray lands this close to its end, as a share of the slant range.  By
#: Fermat's principle its square is what the time is wrong by: 1e-14.
_CLOSE = 1e-7
_PASSES = 100
#: A turning ray sags by up to this share of its horizontal distance; at the limit it would meet
#: its ends at 27 degrees, for which no water has enough contrast.
_SAG = 1 / 8
_STEEPEST = float(np.nextafter(1.0, 0.0))


@dataclass(frozen=True, eq=False)
class _Path:
    """Nodes of n rays, from the slower end to the faster and, where rays may turn, beyond it."""

    thickness_m: Float  #: (n, k - 1)
    speed_mps: Float  #: (n, k)
    ratio2: Float  #: (n, k) (c / c_top)²
    gap: Float  #: (n, k) 1 - (c / c_top)², without cancellation
    beyond: Bool  #: (k - 1,) layers beyond the faster end: crossed twice by rays that turn there
    top_mps: Float  #: (n,) c_top, the fastest water between the ends

    def __getitem__(self, rows: Bool) -> "_Path":
        return replace(
            self,
            thickness_m=self.thickness_m[rows],
            speed_mps=self.speed_mps[rows],
            ratio2=self.ratio2[rows],
            gap=self.gap[rows],
            top_mps=self.top_mps[rows],
        )


def travel_time(
    profile: SoundSpeed, depth_m: Float, other_depth_m: Float, distance_m: Float
) -> Float:
    """Travel time of the direct ray between two depths, a horizontal distance apart.

    The unknown is s, the sine of the grazing angle where the water between the ends is fastest
    (c_top).  With w = sin(grazing) at either face of a layer of thickness h and gradient g,

        p = √(1 - s²) / c_top,            w² = 1 - p² c²
        x = p (c₁ + c₂) h / (w₁ + w₂)                         how far the ray goes in the layer
        t = 2 / g · asinh(g √(x² + h²) / (2 √(c₁ c₂)))        for how long

    (Jensen et al., *Computational Ocean Acoustics*, 3.3; both forms stay exact for g -> 0 and for
    steep rays).  Where s < 0, the ray first passes the faster end, turns where c = 1 / p and comes
    back: x = w / (p g) to the turn, and again from it.  s is found by safeguarded Newton steps for
    all rays at once; then t is corrected by p times what is left of the distance.

    Parameters
    ----------
    depth_m, other_depth_m, distance_m : (n,) or broadcast; m, down; m, horizontal, not negative

    Returns
    -------
    time_s : (n,) s
        NaN where there is no direct ray (shadow): the ends lie on both sides of faster water, or
        no water beyond the faster end turns the ray; and where an argument is NaN.
    """
    a, b, x = np.broadcast_arrays(
        *(np.atleast_1d(np.asarray(v, float)) for v in (depth_m, other_depth_m, distance_m))
    )
    knots_m, speed_mps = _open_ended(profile, a, b, x)
    time_s = np.full(len(x), np.nan)
    known = np.isfinite(a) & np.isfinite(b) & np.isfinite(x)
    # Level in a layer of one speed, sound goes straight: no turn to look for.
    straight = known & (a == b) & (_step_below(knots_m, speed_mps, a) == 0)
    time_s[straight] = x[straight] / np.interp(a[straight], knots_m, speed_mps)
    known &= ~straight
    downwards = _turns_downwards(knots_m, speed_mps, a, b)
    for down, axis_m, axis_mps in (
        (True, knots_m, speed_mps),
        (False, -knots_m[::-1], speed_mps[::-1]),
    ):
        # On its own axis, depth or height, each ray's faster end is the farther one.
        rows = np.flatnonzero(known & (downwards == down))
        y = np.sort(np.stack([a[rows], b[rows]] if down else [-a[rows], -b[rows]]), axis=0)
        time_s[rows] = _one_way_times(axis_m, axis_mps, y[0], y[1], x[rows])
    return time_s


def most_saved(
    profile: SoundSpeed,
    depth_m: Float,
    other_depth_m: Float,
    distance_m: Float,
    sound_speed_mps: Float,
) -> Float:
    """How much sooner, at most and to second order, the bent ray comes than the straight one.

    By Fermat's principle the straight one is never sooner.  To second order a ray over a slant
    range L leaves its chord by slopes y' with y'' = g x / (c L), and saves (1 / 2c) ∫ y'² dl; of
    all slopes with a mean of zero none has more of it than Wirtinger's inequality allows:

        t_straight - t_ray ≤ L / c · (x / c)² · mean(g²) / (2 π²)

    (one gradient everywhere: 1 / 24 instead of 1 / 2π²).  The mean is that between the depths, or
    of the water above or below them that the ray may sag into, whichever is more.  Seldom, in
    jagged water and near the horizontal, a ray finds a steeper place than these means tell.

    Parameters
    ----------
    depth_m, other_depth_m, distance_m, sound_speed_mps : (n,)

    Returns
    -------
    saved_s : (n,) s
    """
    low_m, high_m = np.minimum(depth_m, other_depth_m), np.maximum(depth_m, other_depth_m)
    steepest = np.max(np.abs(_gradients(profile)), initial=0.0)
    sag_m = np.minimum(distance_m**2 * steepest / (8 * sound_speed_mps), _SAG * distance_m)
    squares = [
        _mean_square_gradient(profile, upper_m, lower_m)
        for upper_m, lower_m in ((low_m, high_m), (low_m - sag_m, low_m), (high_m, high_m + sag_m))
    ]
    over_time_s = np.hypot(distance_m, high_m - low_m) / sound_speed_mps
    bent = (distance_m / sound_speed_mps) ** 2 * np.max(squares, axis=0)
    return np.asarray(over_time_s * bent / (2 * np.pi**2))


def _gradients(profile: SoundSpeed) -> Float:
    return np.asarray(np.diff(profile.sound_speed_mps) / np.diff(profile.depth_m))


def _mean_square_gradient(profile: SoundSpeed, upper_m: Float, lower_m: Float) -> Float:
    """Mean of g² between two depths, at least a millimetre apart; none outside the profile."""
    apart_m = np.maximum(lower_m - upper_m, 1e-3)
    layers = _gradients(profile) ** 2 * np.diff(profile.depth_m)
    running = np.concatenate([[0.0], np.cumsum(layers)])
    within = np.interp(upper_m + apart_m, profile.depth_m, running)
    return np.asarray((within - np.interp(upper_m, profile.depth_m, running)) / apart_m)


def _open_ended(profile: SoundSpeed, a: Float, b: Float, x: Float) -> tuple[Float, Float]:
    """The profile with its end values held as far as any ray may go."""
    ends = np.array([a, b, x])
    reach_m = np.max(np.abs(ends), initial=0.0, where=np.isfinite(ends))
    knots_m, speed_mps = profile.depth_m, profile.sound_speed_mps
    return (
        np.array([knots_m[0] - 2 * reach_m - 1, *knots_m, knots_m[-1] + 2 * reach_m + 1]),
        np.concatenate([speed_mps[:1], speed_mps, speed_mps[-1:]]),
    )


def _turns_downwards(knots_m: Float, speed_mps: Float, a: Float, b: Float) -> Bool:
    """Whether the deeper end is the faster; for ends at one depth, whether below them is faster."""
    deep_m, shallow_m = np.maximum(a, b), np.minimum(a, b)
    faster_mps = np.interp(deep_m, knots_m, speed_mps) - np.interp(shallow_m, knots_m, speed_mps)
    return np.where(deep_m > shallow_m, faster_mps, _step_below(knots_m, speed_mps, a)) >= 0


def _step_below(knots_m: Float, speed_mps: Float, depth_m: Float) -> Float:
    """How much faster the water is at the bottom of each depth's layer than at its top."""
    layer = np.clip(np.searchsorted(knots_m, depth_m, side="right"), 1, len(knots_m) - 1)
    return np.asarray(np.diff(speed_mps)[layer - 1])


def _one_way_times(
    knots_m: Float, speed_mps: Float, low_m: Float, high_m: Float, x: Float
) -> Float:
    """Times of rays from `low_m` to `high_m` on an axis along which the far end is the faster."""
    time_s = np.full(len(x), np.nan)
    may_turn = np.zeros(len(x), dtype=bool)
    for part in _chunks(low_m, len(knots_m)):
        time_s[part], may_turn[part] = _passing_times(
            knots_m, speed_mps, low_m[part], high_m[part], x[part]
        )
    # By how much an arc sags in the gradient next to the far end, doubled; then as far as any may.
    gradient = np.interp(high_m + 1, knots_m, speed_mps) - np.interp(high_m, knots_m, speed_mps)
    sag_m = 1 + x**2 * np.maximum(gradient, 0) / (4 * np.interp(high_m, knots_m, speed_mps))
    for past_m in (np.minimum(sag_m, _SAG * x), _SAG * x):
        left = np.flatnonzero(may_turn & np.isnan(time_s))
        for chunk in _chunks(past_m[left], len(knots_m)):
            part = left[chunk]
            path = _path(knots_m, speed_mps, low_m[part], high_m[part], past_m[part])
            time_s[part] = _turning_times(path, x[part], high_m[part] - low_m[part])
    return time_s


def _chunks(by: Float, n_knots: int) -> list[Int]:
    """Rows in groups of a size that arrays with a column a level stay small for, by likeness."""
    n_chunks = min(1 + len(by) * n_knots // _CHUNK, len(by))
    return np.array_split(np.argsort(by, kind="stable"), n_chunks) if len(by) else []


def _passing_times(
    knots_m: Float, speed_mps: Float, low_m: Float, high_m: Float, x: Float
) -> tuple[Float, Bool]:
    """Times of rays that do not turn, NaN for the others, and whether those may turn."""
    path = _path(knots_m, speed_mps, low_m, high_m)
    level = np.zeros(len(x))
    in_reach = _reach(path, level)[0] >= x
    time_s = np.full(len(x), np.nan)
    if in_reach.any():
        rays, to_m, height_m = path[in_reach], x[in_reach], (high_m - low_m)[in_reach]
        size_m = np.hypot(to_m, height_m)
        chord = np.minimum(height_m / np.maximum(size_m, 1e-300), _STEEPEST)
        s = _solve(rays, to_m, size_m, level[in_reach], np.full(len(to_m), _STEEPEST), chord)
        time_s[in_reach] = _time(rays, s, to_m)
    return time_s, ~in_reach & (path.speed_mps[:, -1] >= path.top_mps)


def _turning_times(path: _Path, x: Float, height_m: Float) -> Float:
    """Times of rays that turn beyond the far end; NaN where none does that gets there.

    The least sagging ray is taken: the bracket grows from the horizontal until a ray goes too far.
    """
    fastest_mps = path.speed_mps.max(axis=1)
    contrast = (fastest_mps - path.top_mps) * (fastest_mps + path.top_mps)
    last = -np.sqrt(contrast) / fastest_mps * (1 - 1e-9)
    near, end = np.zeros(len(x)), np.zeros(len(x))
    short = last < 0
    step = 1e-3
    while short.any() and step < 4:
        near[short] = end[short]
        end[short] = np.maximum(-step, last[short])
        short[short] = _reach(path[short], end[short])[0] < x[short]
        step *= 4
    reached = ~short & (last < 0)
    time_s = np.full(len(x), np.nan)
    if reached.any():
        rays, to_m, size_m = path[reached], x[reached], np.hypot(x, height_m)[reached]
        s = _solve(rays, to_m, size_m, end[reached], near[reached], 0.5 * (near + end)[reached])
        missed = np.abs(_reach(rays, s)[0] - to_m) > 1e-5 * size_m  # a jump, no root
        time_s[reached] = np.where(missed, np.nan, _time(rays, s, to_m))
    return time_s


def _path(
    knots_m: Float, speed_mps: Float, low_m: Float, high_m: Float, past_m: Float | None = None
) -> _Path:
    """Nodes at each end and at every level between, then at those up to `past_m` past the end."""
    inner = knots_m[(knots_m > low_m.min()) & (knots_m < high_m.max())]
    nodes_m = [low_m, *(np.clip(k, low_m, high_m) for k in inner), high_m]
    n_between = len(nodes_m) - 1
    if past_m is not None:
        # Whole layers only: the company that a ray keeps must not move its last bits.
        last = np.minimum(np.searchsorted(knots_m, high_m + past_m), len(knots_m) - 1)
        outer = knots_m[(knots_m > high_m.min()) & (knots_m <= knots_m[last.max()])]
        nodes_m += [np.clip(k, high_m, knots_m[last]) for k in outer]
    at_m = np.column_stack(nodes_m)
    c = np.interp(at_m, knots_m, speed_mps)
    top_mps = c[:, : n_between + 1].max(axis=1)
    top = top_mps[:, None]
    return _Path(
        thickness_m=np.diff(at_m, axis=1),
        speed_mps=c,
        ratio2=(c / top) ** 2,
        gap=(top - c) * (top + c) / top**2,
        beyond=np.arange(at_m.shape[1] - 1) >= n_between,
        top_mps=top_mps,
    )


def _layers(rays: _Path, s: Float) -> tuple[Float, Float, Float, Float, Float]:
    """Distance x, its derivative by s, thickness and far speed of each layer met; times met."""
    cos2 = (1 - s) * (1 + s)
    p = (np.sqrt(cos2) / rays.top_mps)[:, None]
    w2 = rays.gap + rays.ratio2 * (s**2)[:, None]
    w = np.sqrt(np.maximum(w2, 0.0))
    dw = rays.ratio2 * s[:, None] / np.where(w > 0, w, np.inf)
    c, far, h = rays.speed_mps[:, :-1], rays.speed_mps[:, 1:], rays.thickness_m
    both = w[:, :-1] + w[:, 1:]
    both = np.where(both > 0, both, np.inf)
    dp_over_p = -(s / cos2)[:, None]
    x = p * (c + far) * h / both
    dx = x * (dp_over_p - (dw[:, :-1] + dw[:, 1:]) / both)
    times = np.broadcast_to(np.where(rays.beyond, 0.0, 1.0), h.shape)
    if rays.beyond.any():
        met = rays.beyond & (s < 0)[:, None] & (np.minimum.accumulate(w2, axis=1)[:, :-1] > 0)
        turned = met & (w2[:, 1:] <= 0)
        pg = p * np.where(turned, far - c, 1.0) / np.where(turned, h, 1.0)
        x_turn = w[:, :-1] / pg
        x = np.where(turned, x_turn, x)
        dx = np.where(turned, dw[:, :-1] / pg - x_turn * dp_over_p, dx)
        h = np.where(turned, w[:, :-1] ** 2 / (pg * (1 + p * c)), h)
        far = np.where(turned, 1 / p, far)
        times = np.where(met, 2.0, times)
    return x, dx, h, far, times


def _reach(rays: _Path, s: Float) -> tuple[Float, Float]:
    """How far the ray gets, and the derivative of that by s; infinite where it stays level."""
    x, dx, _, _, times = _layers(rays, s)
    level = (s == 0) & np.any(
        (rays.gap == 0)[:, :-1] & (rays.gap == 0)[:, 1:] & _thick(rays), axis=1
    )
    return np.where(level, np.inf, _sum(x * times)), _sum(dx * times)


def _thick(rays: _Path) -> Bool:
    return np.asarray((rays.thickness_m > 0) & ~rays.beyond)


def _solve(rays: _Path, x: Float, size_m: Float, far: Float, near: Float, s: Float) -> Float:
    """The s at which the ray gets to x, between `far` (gets too far) and `near` (not far enough).

    Newton's step where it stays inside the bracket and the misses shrink; else the middle.
    """
    s, far, near = s.copy(), far.copy(), near.copy()
    last_m = np.full(len(s), np.inf)
    todo = np.arange(len(s))
    path = rays
    for _ in range(_PASSES):
        now = s[todo]
        got_m, slope = _reach(path, now)
        miss_m = got_m - x[todo]
        far[todo], near[todo] = (
            np.where(miss_m > 0, now, far[todo]),
            np.where(miss_m > 0, near[todo], now),
        )
        ends = np.stack([far[todo], near[todo]])
        newton = now - miss_m / np.where(slope < 0, slope, np.inf)
        inside = (newton > ends.min(axis=0)) & (newton < ends.max(axis=0)) & (slope < 0)
        shrinking = np.abs(miss_m) < 0.5 * last_m[todo]
        last_m[todo] = np.abs(miss_m)
        close = (np.abs(miss_m) <= _CLOSE * size_m[todo]) | (np.ptp(ends, axis=0) <= 1e-16)
        s[todo] = np.where(close, now, np.where(inside & shrinking, newton, ends.mean(axis=0)))
        todo, path = todo[~close], path[~close]
        if not len(todo):
            break
    return s


def _time(rays: _Path, s: Float, x_m: Float) -> Float:
    """Travel time at ray parameter s, corrected for the distance that the ray still lacks."""
    x, _, h, far, times = _layers(rays, s)
    c, length_m = rays.speed_mps[:, :-1], np.hypot(x, h)
    mean_mps = np.sqrt(c * far)
    half = length_m * (far - c) / (2 * mean_mps * np.where(h > 0, h, np.inf))
    bent = np.where(np.abs(half) > 1e-8, np.arcsinh(half) / np.where(half == 0, 1, half), 1.0)
    p = np.sqrt((1 - s) * (1 + s)) / rays.top_mps
    left_m = x_m - _sum(x * times)
    return np.asarray(_sum(times * bent * length_m / mean_mps) + p * left_m)


def _sum(layers: Float) -> Float:
    """Sum over the layers in their order, which further ones that are empty do not change."""
    return np.asarray(np.cumsum(layers, axis=1)[:, -1])
