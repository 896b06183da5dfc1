# SPDX-License-Identifier: Apache-2.0
"""Prediction and correction of the augmented filter, one reply at a time.

The same equations as `augmented.displacement` and `augmented.observe`, which do whole columns at
once; here in as few NumPy calls as they take, so that a day of replies costs a quarter of a second.
"""

from cmath import rect
from math import hypot, inf, sqrt
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import Legs
from abyssnav.estimation.model import (
    HEADING,
    HELD,
    LINEAR,
    N_STATES,
    SCALE,
    ErrorModel,
    Steps,
    fading,
)
from abyssnav.geometry import Plane, plane
from abyssnav.tables import Float

_DIAGONAL = slice(None, None, N_STATES + 1)  #: of a matrix laid out in a row
_HUBER_PASSES = 6


class Judge(NamedTuple):
    """How times are judged."""

    sigma_s: float
    gamma: float  #: inf = no gate
    huber: float = inf  #: κ of the Huber weight; inf = least squares


class Rows(NamedTuple):
    """Steps and legs of all replies, ready to be taken one by one.

    The horizontal plane is complex here, east + i north: a turn by ε is a factor e^iε, and single
    numbers come out of plain lists fastest.
    """

    fade: Float  #: (n, 11) Gauss-Markov factor a over the step from the reply before, or 1
    noise: Float  #: (n, 11) what the step adds to the diagonal of P
    run_m: list[complex]  #: ΔC since the reply before
    linear_m: Float  #: (n, 6, 2) ΔC_j since the reply before
    linear: Plane  #: (n, 6) the same
    since_ping_m: list[complex]
    linear_since_ping_m: Float  #: (n, 6, 2)
    linear_since_ping: Plane  #: (n, 6) the same
    flight_time_s: list[float]
    aim_ping_m: list[complex]
    aim_reply_m: list[complex]
    height_ping_m: list[float]
    height_reply_m: list[float]
    speed_ping_mps: list[float]
    speed_reply_mps: list[float]


class Correction(NamedTuple):
    """A reply seen from the predicted states, and the states after it if it is believed."""

    predicted_s: float
    variance_s2: float
    innovation_s: float
    x: Float
    P: Float
    inside: bool


def drift(steps: Steps, model: ErrorModel) -> tuple[Float, Float]:
    """Factors (n, 11) of the states over the step from the reply before, and the noise it adds."""
    dt_s = np.diff(steps.t_s, prepend=steps.t_s[:1])
    heading_fade, heading_noise = fading(dt_s, model.heading_sigma_rad, model.heading_time_s)
    held_fade, held_noise = fading(dt_s, model.held_sigma_mps, model.held_time_s)
    fade, noise = np.ones((len(dt_s), N_STATES)), np.zeros((len(dt_s), N_STATES))
    fade[:, HEADING], fade[:, HELD] = heading_fade, held_fade[:, None]
    noise[:, HEADING], noise[:, HELD] = heading_noise, held_noise[:, None]
    noise[:, :2] = (model.position_m2_per_s * dt_s)[:, None]
    return fade, noise


def rows(steps: Steps, legs: Legs, model: ErrorModel) -> Rows:
    """What `advance` and `correct` need of every reply."""
    fade, noise = drift(steps, model)
    linear_m = np.diff(steps.linear_m, axis=0, prepend=steps.linear_m[:1])
    return Rows(
        fade,
        noise,
        plane(np.diff(steps.run_m, axis=0, prepend=steps.run_m[:1])).tolist(),
        linear_m,
        plane(linear_m),
        plane(steps.since_ping_m).tolist(),
        steps.linear_since_ping_m,
        plane(steps.linear_since_ping_m),
        legs.flight_time_s.tolist(),
        plane(legs.aim_ping_m).tolist(),
        plane(legs.aim_reply_m).tolist(),
        legs.height_ping_m.tolist(),
        legs.height_reply_m.tolist(),
        legs.speed_ping_mps.tolist(),
        legs.speed_reply_mps.tolist(),
    )


def advance(of: Rows, i: int, x: Float, P: Float) -> tuple[Float, Float, Float]:
    """States and covariance at reply i from those at the reply before, and F P (Eqs. 1 and 6)."""
    turn = rect(1.0 / (1.0 + x.item(SCALE)), x.item(HEADING))
    run_m = turn * (of.run_m[i] + complex(*x[LINEAR].dot(of.linear_m[i]).tolist()))
    by_scale_m, by_linear_m = -abs(turn) * run_m, turn * of.linear[i]
    F = np.zeros((N_STATES, N_STATES))
    F.ravel()[_DIAGONAL] = of.fade[i]
    F[0, HEADING], F[1, HEADING] = -run_m.imag, run_m.real
    F[0, SCALE], F[1, SCALE] = by_scale_m.real, by_scale_m.imag
    F[0, LINEAR], F[1, LINEAR] = by_linear_m.real, by_linear_m.imag
    x = x * of.fade[i]
    x[0] += run_m.real
    x[1] += run_m.imag
    FP = F.dot(P)
    P = FP.dot(F.T)
    P.ravel()[_DIAGONAL] += of.noise[i]
    return x, P, FP


def predict(of: Rows, i: int, x: Float) -> tuple[float, Float]:
    """Flight time of reply i and its gradient H (11,) by the states at the reply (Eq. 3)."""
    e, n, heading_rad, scale, sound = x[:5].tolist()
    turn = rect(1.0 / (1.0 + scale), heading_rad)
    known_m = complex(*x[LINEAR].dot(of.linear_since_ping_m[i]).tolist())
    run_m = turn * (of.since_ping_m[i] + known_m)
    reply_m = complex(e, n) - of.aim_reply_m[i]
    ping_m = complex(e, n) - run_m - of.aim_ping_m[i]
    range_ping_m = hypot(ping_m.real, ping_m.imag, of.height_ping_m[i])
    range_reply_m = hypot(reply_m.real, reply_m.imag, of.height_reply_m[i])
    time_s = range_ping_m / of.speed_ping_mps[i] + range_reply_m / of.speed_reply_mps[i]
    g_ping = ping_m * ((1.0 + sound) / (range_ping_m * of.speed_ping_mps[i]))
    g = g_ping + reply_m * ((1.0 + sound) / (range_reply_m * of.speed_reply_mps[i]))
    along_m = g_ping.conjugate() * run_m  # real part: by scale; imaginary: by heading
    H = np.empty(N_STATES)
    H[:5] = g.real, g.imag, along_m.imag, along_m.real / (1.0 + scale), time_s
    H[LINEAR] = ((-turn * g_ping.conjugate()) * of.linear_since_ping[i]).real
    return (1.0 + sound) * time_s, H


def correct(
    of: Rows, i: int, x: Float, P: Float, judge: Judge, noise_s2: float | None = None
) -> Correction:
    """Gate of reply i, and the states after it (Eqs. 8-9); R is `noise_s2`, or σ_t² by default.

    With the optimal gain K = P Hᵀ / S Joseph's form is P - S K Kᵀ, which is symmetric as it stands.
    """
    predicted_s, H = predict(of, i, x)
    PH = P.dot(H)
    noise_s2 = judge.sigma_s**2 if noise_s2 is None else noise_s2
    variance_s2 = H.dot(PH).item() + noise_s2
    innovation_s = of.flight_time_s[i] - predicted_s
    if innovation_s**2 / variance_s2 > judge.gamma:
        return Correction(predicted_s, variance_s2, innovation_s, x, P, inside=False)
    if judge.huber < inf:
        after, PH, S = _huber(of, i, x, P, judge.huber, noise_s2)
    else:
        after, S = x + PH * (innovation_s / variance_s2), variance_s2
    root = (PH / sqrt(S)).reshape(N_STATES, 1)
    P = P - root.dot(root.T)
    return Correction(predicted_s, variance_s2, innovation_s, after, P, inside=True)


def _huber(
    of: Rows, i: int, prior: Float, P: Float, kappa: float, noise_s2: float
) -> tuple[Float, Float, float]:
    """State, P Hᵀ and S of an iterated update with Huber's weight 1 / max(1, |r| / κ)."""
    x, PH, S = prior, np.zeros(N_STATES), inf
    for _ in range(_HUBER_PASSES):
        predicted_s, H = predict(of, i, x)
        late_s = of.flight_time_s[i] - predicted_s
        PH = P @ H
        S = float(H @ PH) + noise_s2 * max(1.0, abs(late_s) / sqrt(noise_s2) / kappa)
        x = prior + PH * ((late_s + float(H @ (x - prior))) / S)
    return x, PH, S
