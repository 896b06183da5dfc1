# SPDX-License-Identifier: Apache-2.0
"""Prediction and correction of the augmented filter, in plain scalars.

The same equations as `augmented.displacement` and `augmented.observe`, which do whole columns at
once; here one reply at a time, so that a day of replies costs a third of a second.
"""

from math import cos, hypot, inf, sin
from typing import NamedTuple

import numpy as np

from pipeline.nav.acoustics import Legs
from pipeline.nav.augmented import (
    HEADING,
    HELD,
    LINEAR,
    N_STATES,
    SCALE,
    SOUND,
    ErrorModel,
    Steps,
    fading,
)
from pipeline.tables import Float

_IDENTITY = np.eye(N_STATES)
_HUBER_PASSES = 6
Pair = list[float]  #: east, north


class Judge(NamedTuple):
    """How times are judged."""

    sigma_s: float
    gamma: float  #: inf = no gate
    huber: float = inf  #: κ of the Huber weight; inf = least squares


class Rows(NamedTuple):
    """Steps and legs of all replies as plain lists, which single numbers come out of fastest."""

    dt_s: list[float]  #: since the reply before
    run_m: list[Pair]  #: ΔC since the reply before
    linear_e_m: Float  #: (n, 6) ΔC_j since the reply before
    linear_n_m: Float
    since_ping_m: list[Pair]
    ping_linear_e_m: Float  #: (n, 6)
    ping_linear_n_m: Float
    flight_time_s: list[float]
    aim_ping_m: list[Pair]
    aim_reply_m: list[Pair]
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


def rows(steps: Steps, legs: Legs) -> Rows:
    """What `advance` and `correct` need of every reply."""
    grown = np.diff(steps.linear_m, axis=0, prepend=steps.linear_m[:1])
    return Rows(
        np.diff(steps.t_s, prepend=steps.t_s[:1]).tolist(),
        np.diff(steps.run_m, axis=0, prepend=steps.run_m[:1]).tolist(),
        np.ascontiguousarray(grown[..., 0]),
        np.ascontiguousarray(grown[..., 1]),
        steps.since_ping_m.tolist(),
        np.ascontiguousarray(steps.linear_since_ping_m[..., 0]),
        np.ascontiguousarray(steps.linear_since_ping_m[..., 1]),
        *(column.tolist() for column in legs.columns().values()),
    )


def advance(of: Rows, i: int, x: Float, P: Float, model: ErrorModel) -> tuple[Float, Float, Float]:
    """States, covariance and F at reply i from those at the reply before (Eqs. 1 and 6)."""
    (run_e, run_n), dt_s = of.run_m[i], of.dt_s[i]
    linear, s = x[LINEAR], 1.0 + float(x[SCALE])
    c, q = cos(x[HEADING]) / s, sin(x[HEADING]) / s
    h_e, h_n = of.linear_e_m[i], of.linear_n_m[i]
    u_e, u_n = run_e + float(linear @ h_e), run_n + float(linear @ h_n)
    d_e, d_n = c * u_e - q * u_n, q * u_e + c * u_n
    a, noise = fading(dt_s, model.heading_sigma_rad, model.heading_time_s)
    b, held_noise = fading(dt_s, model.held_sigma_mps, model.held_time_s)
    F = _IDENTITY.copy()
    F[0, HEADING], F[1, HEADING], F[HEADING, HEADING] = -d_n, d_e, a
    F[0, SCALE], F[1, SCALE] = -d_e / s, -d_n / s
    F[0, LINEAR] = c * h_e - q * h_n
    F[1, LINEAR] = q * h_e + c * h_n
    F[9, 9] = F[10, 10] = b
    x = x.copy()
    x[0] += d_e
    x[1] += d_n
    x[HEADING] *= a
    x[HELD] *= b
    P = F @ P @ F.T
    grown = model.position_m2_per_s * dt_s
    P[0, 0] += grown
    P[1, 1] += grown
    P[HEADING, HEADING] += noise
    P[9, 9] += held_noise
    P[10, 10] += held_noise
    return x, P, F


def predict(of: Rows, i: int, x: Float) -> tuple[float, Float]:
    """Flight time of reply i and its gradient H (11,) by the states at the reply (Eq. 3)."""
    e, n, k, s = float(x[0]), float(x[1]), 1.0 + float(x[SOUND]), 1.0 + float(x[SCALE])
    c, q = cos(x[HEADING]) / s, sin(x[HEADING]) / s
    h_e, h_n = of.ping_linear_e_m[i], of.ping_linear_n_m[i]
    u_e = of.since_ping_m[i][0] + float(x[LINEAR] @ h_e)
    u_n = of.since_ping_m[i][1] + float(x[LINEAR] @ h_n)
    d_e, d_n = c * u_e - q * u_n, q * u_e + c * u_n
    ping_e, ping_n = e - d_e - of.aim_ping_m[i][0], n - d_n - of.aim_ping_m[i][1]
    reply_e, reply_n = e - of.aim_reply_m[i][0], n - of.aim_reply_m[i][1]
    range_ping = hypot(ping_e, ping_n, of.height_ping_m[i])
    range_reply = hypot(reply_e, reply_n, of.height_reply_m[i])
    time_s = range_ping / of.speed_ping_mps[i] + range_reply / of.speed_reply_mps[i]
    per_ping = k / (range_ping * of.speed_ping_mps[i])
    per_reply = k / (range_reply * of.speed_reply_mps[i])
    g_e, g_n = ping_e * per_ping, ping_n * per_ping
    H = np.empty(N_STATES)
    H[0], H[1] = g_e + reply_e * per_reply, g_n + reply_n * per_reply
    H[HEADING] = g_e * d_n - g_n * d_e
    H[SCALE] = (g_e * d_e + g_n * d_n) / s
    H[SOUND] = time_s
    H[LINEAR] = (g_e * q - g_n * c) * h_n - (g_e * c + g_n * q) * h_e
    return k * time_s, H


def correct(of: Rows, i: int, x: Float, P: Float, judge: Judge) -> Correction:
    """Gate of reply i, and the states after it in Joseph's form (Eqs. 8-9)."""
    predicted_s, H = predict(of, i, x)
    PH = P @ H
    variance_s2 = float(H @ PH) + judge.sigma_s**2
    innovation_s = of.flight_time_s[i] - predicted_s
    if innovation_s**2 / variance_s2 > judge.gamma:
        return Correction(predicted_s, variance_s2, innovation_s, x, P, inside=False)
    noise_s2 = judge.sigma_s**2
    if judge.huber < inf:
        after, H, noise_s2 = _huber(of, i, x, P, judge)
        PH = P @ H
        K = PH / (float(H @ PH) + noise_s2)
    else:
        K = PH / variance_s2
        after = x + K * innovation_s
    column = K[:, None]
    keep = _IDENTITY - column * H
    P = keep @ P @ keep.T + (noise_s2 * column) * K
    return Correction(predicted_s, variance_s2, innovation_s, after, P, inside=True)


def _huber(of: Rows, i: int, prior: Float, P: Float, judge: Judge) -> tuple[Float, Float, float]:
    """State, gradient and noise of an iterated update with Huber's weight 1 / max(1, |r| / κ)."""
    x, H, noise_s2 = prior, np.zeros(N_STATES), judge.sigma_s**2
    for _ in range(_HUBER_PASSES):
        predicted_s, H = predict(of, i, x)
        residual = (of.flight_time_s[i] - predicted_s) / judge.sigma_s
        noise_s2 = judge.sigma_s**2 * max(1.0, abs(residual) / judge.huber)
        PH = P @ H
        innovation_s = of.flight_time_s[i] - predicted_s + float(H @ (x - prior))
        x = prior + PH * (innovation_s / (float(H @ PH) + noise_s2))
    return x, H, noise_s2
