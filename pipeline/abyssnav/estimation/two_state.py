# SPDX-License-Identifier: Apache-2.0
"""The paper's filters: two states, predicted by dead reckoning, corrected by times or by fixes."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import hypot, nan
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import RayGeometry
from abyssnav.estimation.dead_reckoning import DeadReckoning
from abyssnav.estimation.fixes import ping_numbers, repeated
from abyssnav.geometry import pairs, plane
from abyssnav.tables import (
    DECISIONS,
    Bool,
    Fixes,
    Float,
    Innovations,
    Int,
    Replies,
    Start,
    Table,
)

ACCEPTED, GATED, DUPLICATE, UNKNOWN_BEACON, BEFORE_START, NOT_PHYSICAL = range(len(DECISIONS))
#: Virtual beacons at ping (as seen from the reply) and reply, heights and sound speeds, as in
#: `RayGeometry`; the plane is complex, east + i north.
_Legs = tuple[complex, complex, float, float, float, float]


@dataclass(frozen=True, eq=False)
class Nodes(Table):
    """Estimates at the instants where a measurement moved them; the first is the start."""

    t_s: Float
    position_m: Float  #: (n, 2) east, north
    position_cov_m2: Float  #: (n, 2, 2)


@dataclass(frozen=True)
class EkfConfig:
    """Noise and threshold of a two-state filter."""

    start_sigma_m: float
    position_m2_per_s: float  #: q of Eq. 6, Q = q Δt
    measurement_sigma: float  #: s for travel times, m for fixes
    gamma: float  #: inf = no gate


class TravelTimes(NamedTuple):
    """All replies of a dive, and the rays of those that are of use."""

    replies: Replies  #: n rows
    usable: Bool  #: (n,) of a known beacon, physical, its first of the ping
    geometry: RayGeometry  #: of the usable ones


def filter_travel_times(
    times: TravelTimes, motion: DeadReckoning, start: Start | None, config: EkfConfig
) -> tuple[Nodes | None, Innovations]:
    """The paper's extended Kalman filter on raw travel times, gated or not (Eqs. 1, 3, 6-11).

    Replies are filtered one by one as they are heard; between them the state moves by the
    difference of dead reckoning's running sums, so the filter runs at the replies only.

        p⁻ = p + ΔC                          P⁻ = P + (q Δt + gap) I                        (1, 6)
        ν = T - τ - (ρ_p / c_p + ρ_r / c_r)  at p⁻ - d (ping) and p⁻ (reply)                (3)
        H = e_p / c_p + e_r / c_r            S = H P⁻ Hᵀ + σ_t²                             (9)
        ν² / S ≤ γ:  K = P⁻ Hᵀ / S,  p = p⁻ + K ν,  P = (I - K H) P⁻ (I - K H)ᵀ + K σ_t² Kᵀ  (8)

    Of several replies of one beacon to one ping, the first inside the gate counts; none does when
    one of them was heard before the start, which was made of such replies.

    Parameters
    ----------
    times : in the order heard
    start : None leaves every reply `before_start`
    config : `measurement_sigma` in s

    Returns
    -------
    nodes, innovations : the first is None without a start; the second has a row for every reply.
    """
    decision = undecided(times.replies, times.usable)
    if start is None:
        return None, innovation_rows(times, decision, np.full((len(decision), 3), nan))
    rows = list(_rows(times, motion))
    begun = sum(t_reply <= start.t_s for t_reply, *_ in rows)
    taken = {row[3] for row in rows[:begun]}  # the start was made of these
    fates, values = [BEFORE_START] * begun, [(nan, nan, nan)] * begun
    p, t = complex(start.east_m, start.north_m), start.t_s
    p_ee = p_nn = config.start_sigma_m**2
    p_en, q, r = 0.0, config.position_m2_per_s, config.measurement_sigma**2
    begin = motion.interpolate(np.array([t]))
    c, gap = complex(plane(begin.displacement_m)[0]), float(begin.gap_variance_m2[0])
    t_nodes, nodes = [t], [(p, p_ee, p_en, p_nn)]
    for t_now, run, gap_now, key, time, legs in rows[begun:]:
        p += run - c
        grown = q * (t_now - t) + gap_now - gap
        p_ee, p_nn = p_ee + grown, p_nn + grown
        t, c, gap = t_now, run, gap_now

        predicted, h_e, h_n = _observe(p, legs)
        g_e, g_n = p_ee * h_e + p_en * h_n, p_en * h_e + p_nn * h_n
        s = h_e * g_e + h_n * g_n + r
        nu = time - predicted
        inside = nu * nu / s <= config.gamma
        fate = DUPLICATE if key in taken else ACCEPTED if inside else GATED
        fates.append(fate)
        values.append((predicted, s, nu))
        if fate == ACCEPTED:
            taken.add(key)
            k_e, k_n = g_e / s, g_n / s
            p += complex(k_e * nu, k_n * nu)
            p_ee, p_en, p_nn = _joseph((p_ee, p_en, p_nn), (h_e, h_n), (k_e, k_n), r)
            t_nodes.append(t)
            nodes.append((p, p_ee, p_en, p_nn))
    decision[times.usable] = fates
    every = np.full((len(decision), 3), nan)
    every[times.usable] = np.reshape(values, (-1, 3))
    return _nodes(t_nodes, nodes), innovation_rows(times, decision, every)


def _rows(
    times: TravelTimes, motion: DeadReckoning
) -> Iterator[tuple[float, complex, float, tuple[int, int], float, _Legs]]:
    """What the filter needs of each usable reply, as plain numbers: NumPy is slow one by one.

    Time heard, dead reckoning's sums then, ping and beacon, flight time measured, and both legs.
    """
    taken, geometry = times.replies[times.usable], times.geometry
    at_ping, at_reply = motion.interpolate(taken.t_ping_s), motion.interpolate(taken.t_reply_s)
    since_ping_m = at_reply.displacement_m - at_ping.displacement_m
    legs = zip(
        plane(geometry.virtual_beacon_ping_m + since_ping_m).tolist(),
        plane(geometry.virtual_beacon_reply_m).tolist(),
        geometry.height_ping_m.tolist(),
        geometry.height_reply_m.tolist(),
        geometry.speed_ping_mps.tolist(),
        geometry.speed_reply_mps.tolist(),
        strict=True,
    )
    return zip(
        taken.t_reply_s.tolist(),
        plane(at_reply.displacement_m).tolist(),
        at_reply.gap_variance_m2.tolist(),
        zip(ping_numbers(times.replies)[times.usable].tolist(), taken.beacon.tolist(), strict=True),
        geometry.flight_time_s.tolist(),
        legs,
        strict=True,
    )


def _observe(p: complex, legs: _Legs) -> tuple[float, float, float]:
    """Predicted flight time at the reply's position p and its H (Eqs. 3 and 9)."""
    b_p, b_r, h_p, h_r, c_p, c_r = legs
    ping, reply = p - b_p, p - b_r
    range_p, range_r = hypot(ping.real, ping.imag, h_p), hypot(reply.real, reply.imag, h_r)
    slope = ping / (range_p * c_p) + reply / (range_r * c_r)
    return range_p / c_p + range_r / c_r, slope.real, slope.imag


def _joseph(
    P: tuple[float, float, float], H: tuple[float, float], K: tuple[float, float], r: float
) -> tuple[float, float, float]:
    """(I - K H) P (I - K H)ᵀ + K R Kᵀ for two states and one number (Bucy and Joseph, 1968)."""
    (p_ee, p_en, p_nn), (h_e, h_n), (k_e, k_n) = P, H, K
    a, b, c, d = 1 - k_e * h_e, -k_e * h_n, -k_n * h_e, 1 - k_n * h_n
    return (
        a * (a * p_ee + b * p_en) + b * (a * p_en + b * p_nn) + k_e * k_e * r,
        c * (a * p_ee + b * p_en) + d * (a * p_en + b * p_nn) + k_e * k_n * r,
        c * (c * p_ee + d * p_en) + d * (c * p_en + d * p_nn) + k_n * k_n * r,
    )


def _nodes(t_s: list[float], rows: list[tuple[complex, float, float, float]]) -> Nodes:
    p, ee, en, nn = zip(*rows, strict=True)
    cov_m2 = np.array([ee, en, en, nn]).T.reshape(-1, 2, 2)
    return Nodes(np.array(t_s), pairs(np.array(p)), cov_m2)


def undecided(replies: Replies, usable: Bool) -> Int:
    """Decisions (n,) before any filter has run: why a reply is of no use, or `before_start`.

    Parameters
    ----------
    usable : (n,) physical, of a known beacon, its first of the ping
    """
    of_no_use = np.where(repeated(replies), DUPLICATE, NOT_PHYSICAL)
    of_no_use = np.where(replies.beacon < 0, UNKNOWN_BEACON, of_no_use)
    return np.where(usable, BEFORE_START, of_no_use)


def innovation_rows(times: TravelTimes, decision: Int, values: Float) -> Innovations:
    """Every reply's row; the turn-around goes back into the prediction.

    Parameters
    ----------
    decision : (n,) places in `DECISIONS`
    values : (n, 3) flight time s, variance of the innovation s², innovation s; NaN: no prediction
    """
    replies, usable, geometry = times
    turn_around_s = np.full(len(replies), nan)
    turn_around_s[usable] = replies.travel_time_s[usable] - geometry.flight_time_s
    flight_s, variance_s2, innovation_s = values.T
    return Innovations(
        ping_id=replies.ping_id,
        beacon_id=replies.beacon_id,
        t_ping_s=replies.t_ping_s,
        t_reply_s=replies.t_reply_s,
        travel_time_s=replies.travel_time_s,
        predicted_s=flight_s + turn_around_s,
        innovation_s=innovation_s,
        innovation_sigma_s=np.sqrt(variance_s2),
        nis=innovation_s**2 / variance_s2,
        decision=decision,
        arrival=np.zeros(len(replies), dtype=np.int64),
        explanation=np.zeros(len(replies), dtype=np.int64),
    )


def filter_fixes(fixes: Fixes, motion: DeadReckoning, start: Start, config: EkfConfig) -> Nodes:
    """The conventional Kalman filter: fixes correct dead reckoning (Section 2.2, first approach).

    A fix fits best at mid-flight, so it is carried from there to its stamp by dead reckoning:

        z = fix + C(t) - C(t_mid),   R = cov(fix) + σ² I,   (z - p⁻)ᵀ (P⁻ + R)⁻¹ (z - p⁻) ≤ γ
        K = P⁻ (P⁻ + R)⁻¹,   p = p⁻ + K (z - p⁻),   P = (I - K) P⁻

    Parameters
    ----------
    config : `measurement_sigma` in m, added to each fix's own covariance; `gamma` for two degrees
        of freedom
    """
    after_start = fixes[fixes.t_s > start.t_s]
    at_fix, at_middle = motion.interpolate(after_start.t_s), motion.interpolate(after_start.t_mid_s)
    carried_m = after_start.position_enu_m[:, :2] + at_fix.displacement_m - at_middle.displacement_m
    cov_m2 = after_start.position_cov_m2 + config.measurement_sigma**2 * np.eye(2)
    begin = motion.interpolate(np.array([start.t_s]))
    p, t = complex(start.east_m, start.north_m), start.t_s
    p_ee, p_en, p_nn = config.start_sigma_m**2, 0.0, config.start_sigma_m**2
    c, gap = complex(plane(begin.displacement_m)[0]), float(begin.gap_variance_m2[0])
    t_nodes, nodes = [t], [(p, p_ee, p_en, p_nn)]
    for t_now, run, gap_now, z, (r_ee, r_en, _, r_nn) in zip(
        after_start.t_s.tolist(),
        plane(at_fix.displacement_m).tolist(),
        at_fix.gap_variance_m2.tolist(),
        plane(carried_m).tolist(),
        cov_m2.reshape(-1, 4).tolist(),
        strict=True,
    ):
        p += run - c
        grown = config.position_m2_per_s * (t_now - t) + gap_now - gap
        p_ee, p_nn = p_ee + grown, p_nn + grown
        t, c, gap = t_now, run, gap_now

        s_ee, s_en, s_nn, miss = p_ee + r_ee, p_en + r_en, p_nn + r_nn, z - p
        det = s_ee * s_nn - s_en * s_en
        u_e = (s_nn * miss.real - s_en * miss.imag) / det  # u = S⁻¹ (z - p⁻)
        u_n = (s_ee * miss.imag - s_en * miss.real) / det
        if u_e * miss.real + u_n * miss.imag <= config.gamma:
            p += complex(p_ee * u_e + p_en * u_n, p_en * u_e + p_nn * u_n)
            k_ee, k_en = (p_ee * s_nn - p_en * s_en) / det, (p_en * s_ee - p_ee * s_en) / det
            k_ne, k_nn = (p_en * s_nn - p_nn * s_en) / det, (p_nn * s_ee - p_en * s_en) / det
            p_ee, p_en, p_nn = (
                p_ee - k_ee * p_ee - k_en * p_en,
                p_en - k_ee * p_en - k_en * p_nn,
                p_nn - k_ne * p_en - k_nn * p_nn,
            )
            t_nodes.append(t)
            nodes.append((p, p_ee, p_en, p_nn))
    return _nodes(t_nodes, nodes)


def propagate(
    nodes: Nodes, motion: DeadReckoning, instants: DeadReckoning, position_m2_per_s: float
) -> tuple[Float, Float]:
    """Positions and covariances at any times from the last node before each (Eqs. 1 and 6).

    Parameters
    ----------
    instants : m rows of `motion` at those times, none before the first node

    Returns
    -------
    position_m, position_cov_m2 : (m, 2) m and (m, 2, 2) m²
    """
    last, at_nodes = (
        np.searchsorted(nodes.t_s, instants.t_s, side="right") - 1,
        motion.interpolate(nodes.t_s),
    )
    run_m = instants.displacement_m - at_nodes.displacement_m[last]
    grown_m2 = position_m2_per_s * (instants.t_s - nodes.t_s[last])
    grown_m2 = grown_m2 + instants.gap_variance_m2 - at_nodes.gap_variance_m2[last]
    cov_m2 = nodes.position_cov_m2[last]
    cov_m2[:, [0, 1], [0, 1]] += grown_m2[:, None]
    return nodes.position_m[last] + run_m, cov_m2
