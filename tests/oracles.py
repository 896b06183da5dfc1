# SPDX-License-Identifier: Apache-2.0
"""Independent versions from the books: slow, one sample at a time, sharing no code with `pipeline`.

Written from the paper's equations and the definitions of WGS 84; matrices where the product has
scalars, loops where it has sums, iteration where it has a closed form.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np

SEMI_MAJOR_M, INVERSE_FLATTENING = 6378137.0, 298.257223563


def rotation_enu_body(roll_rad, pitch_rad, heading_rad):
    """3 x 3 rotation from forward-starboard-down to east-north-up: E Rz(heading) Ry Rx."""
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    ch, sh = math.cos(heading_rad), math.sin(heading_rad)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]])
    enu_from_ned = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    return enu_from_ned @ about_z @ about_y @ about_x


def geodetic_to_ecef(latitude_deg, longitude_deg, height_m):
    """By the ellipse's semi-axes a and b, not by its eccentricity."""
    a, b = SEMI_MAJOR_M, SEMI_MAJOR_M * (1 - 1 / INVERSE_FLATTENING)
    lat, lon = math.radians(latitude_deg), math.radians(longitude_deg)
    norm = math.hypot(a * math.cos(lat), b * math.sin(lat))
    ring = (a * a / norm + height_m) * math.cos(lat)
    z = (b * b / norm + height_m) * math.sin(lat)
    return np.array([ring * math.cos(lon), ring * math.sin(lon), z])


def ecef_to_geodetic(place):
    """Latitude by iterating tan(lat) = (z + e2 N sin lat) / ring until it stands still."""
    x, y, z = (float(value) for value in place)
    e2 = (2 - 1 / INVERSE_FLATTENING) / INVERSE_FLATTENING
    ring, lat = math.hypot(x, y), math.atan2(z, math.hypot(x, y))
    for _ in range(100):
        vertical = SEMI_MAJOR_M / math.sqrt(1 - e2 * math.sin(lat) ** 2)
        lat = math.atan2(z + e2 * vertical * math.sin(lat), ring)
    vertical = SEMI_MAJOR_M / math.sqrt(1 - e2 * math.sin(lat) ** 2)
    if abs(lat) < 0.8:
        height = ring / math.cos(lat) - vertical
    else:
        height = z / math.sin(lat) - vertical * (1 - e2)
    return math.degrees(lat), math.degrees(math.atan2(y, x)), height


def linear_at(t, knots, values):
    """Value between two knots of a column by the two-point formula; the ends are held."""
    if t <= knots[0]:
        return values[0]
    if t >= knots[-1]:
        return values[-1]
    k = next(i for i in range(len(knots) - 1) if knots[i] <= t <= knots[i + 1])
    share = (t - knots[k]) / (knots[k + 1] - knots[k])
    return values[k] + share * (values[k + 1] - values[k])


def harmonic_sound_speed(depth_m, speed_mps, from_m, to_m):
    """Depth difference over the quadrature of 1 / c(z), layer by layer."""
    from scipy.integrate import quad

    low, high = min(from_m, to_m), max(from_m, to_m)
    edges = [low, *[float(z) for z in depth_m if low < z < high], high]
    time_s = sum(
        quad(lambda z: 1 / np.interp(z, depth_m, speed_mps), a, b, epsabs=0, epsrel=1e-13)[0]
        for a, b in itertools.pairwise(edges)
    )
    return (high - low) / time_s


def step_by_step(velocity, heading, stamps_s, gap_sigma_mps, max_gap_s, heading_error=None):
    """Dead reckoning in a loop over `stamps_s`: displacement (n, 2) and gap variance (n,) at each.

    Eqs. 1-2 with the full rotation, trapezoids; the last good body velocity is held, and the
    variance of a held stretch of age a beyond `max_gap_s` is (gap_sigma a)^2.
    `heading_error`, a function of heading, is taken off each heading.
    """
    error = heading_error or (lambda _: 0.0)
    held, held_since = None, None
    first = next(i for i in range(len(velocity)) if velocity.valid[i])
    place, variance = np.zeros(2), 0.0
    places, variances, rate_before = [], [], None
    own = {float(t): i for i, t in enumerate(velocity.t_s)}
    for number, t in enumerate(stamps_s):
        i = own.get(float(t))
        age_before = None if held_since is None else stamps_s[number - 1] - held_since
        age_at_end = None if held_since is None else t - held_since
        if i is not None and velocity.valid[i]:
            held, held_since = velocity.velocity_body_mps[i], t
        body = velocity.velocity_body_mps[first] if held is None else held
        if i is None:
            angles = [
                linear_at(t, heading.t_s, c)
                for c in (heading.roll_rad, heading.pitch_rad, heading.heading_rad)
            ]
        else:
            angles = [velocity.roll_rad[i], velocity.pitch_rad[i], velocity.heading_rad[i]]
        angles[2] = angles[2] - error(angles[2])
        rate = (rotation_enu_body(*angles) @ body)[:2]
        if number:
            place = place + (t - stamps_s[number - 1]) * (rate + rate_before) / 2
        if age_before is None:  # held backwards: ages count down to the first good sample
            t_good = velocity.t_s[first]
            ages = [t_good - stamps_s[number - 1], t_good - t] if number else [0.0, 0.0]
        else:
            ages = [age_at_end, age_before]
        grown = [(gap_sigma_mps * a) ** 2 if a > max_gap_s else 0.0 for a in ages]
        variance += max(grown[0] - grown[1], 0.0)
        places.append(place)
        variances.append(variance)
        rate_before = rate
    return np.array(places), np.array(variances)


@dataclass
class Fate:
    """What the textbook filter made of one reply."""

    decision: str
    predicted_s: float = math.nan
    innovation_s: float = math.nan
    variance_s2: float = math.nan


def two_legs(places, lever, up, c, beacon_m):
    """Time of both legs and the row H of its derivatives, Eq. 3."""
    H, time_s = np.zeros((1, 2)), 0.0
    for leg in (0, 1):
        transducer = [*(places[leg] + lever[leg][:2]), up[leg]]
        ray = np.array(transducer) - beacon_m
        time_s += math.sqrt(ray @ ray) / c[leg]
        H += ray[None, :2] / math.sqrt(ray @ ray) / c[leg]
    return time_s, H


def textbook_filter(dive, start, gamma, *, q, sigma_t, start_sigma, reckoned, speeds_mps):
    """The paper's filter in matrix form, reply by reply; fates and nodes [(t, x, P)].

    `reckoned(t)` gives displacement since any fixed instant (2,) and gap variance;
    `speeds_mps` (n, 2) the sound speed of each reply's legs.  Decisions are made anew from the
    dive's columns.
    """
    fates, used = [], set()
    x, P = np.array([start.east_m, start.north_m]), start_sigma**2 * np.eye(2)
    t_state = start.t_s
    nodes = [(t_state, x, P)]
    for i in range(len(dive.replies)):
        row = {name: column[i] for name, column in dive.replies.columns().items()}
        known = [k for k in range(len(dive.beacons)) if dive.beacons.id[k] == row["beacon_id"]]
        if not known:
            fates.append(Fate("unknown_beacon"))
            continue
        b, tau = dive.beacons.position_enu_m[known[0]], dive.beacons.turn_around_s[known[0]]
        lever = [row["lever_ping_enu_m"], row["lever_reply_enu_m"]]
        depth = [row["depth_ping_m"], row["depth_reply_m"]]
        up = [lever[leg][2] - depth[leg] for leg in (0, 1)]
        c = speeds_mps[i]
        shortest = sum(abs(up[leg] - b[2]) / c[leg] for leg in (0, 1))
        T = row["travel_time_s"]
        if not (math.isfinite(T) and max(tau, 0) < T and T - tau > shortest - 5 * sigma_t):
            fates.append(Fate("not_physical"))
            continue
        t_ping, t_now = row["t_ping_s"], row["t_reply_s"]
        if t_now <= start.t_s:
            used.add((t_ping, row["beacon_id"]))
            fates.append(Fate("before_start"))
            continue
        before, now, at_ping = reckoned(t_state), reckoned(t_now), reckoned(t_ping)
        x = x + now[0] - before[0]
        P = P + (q * (t_now - t_state) + now[1] - before[1]) * np.eye(2)
        t_state = t_now
        places = [x - (now[0] - at_ping[0]), x]
        predicted, H = two_legs(places, lever, up, c, b)
        predicted += tau
        S = (H @ P @ H.T + sigma_t**2)[0, 0]
        nu = T - predicted
        decision = "accepted"
        if (t_ping, row["beacon_id"]) in used:
            decision = "duplicate"
        elif nu**2 / S > gamma:
            decision = "gated"
        fates.append(Fate(decision, predicted, nu, S))
        if decision == "accepted":
            used.add((t_ping, row["beacon_id"]))
            K = P @ H.T / S
            x = x + K[:, 0] * nu
            A = np.eye(2) - K @ H
            P = A @ P @ A.T + sigma_t**2 * K @ K.T
            P = (P + P.T) / 2
            nodes.append((t_state, x, P))
    return fates, nodes


def linear_filter(x, P, steps):
    """Kalman filter of a position: `steps` of (displacement, Q, z, R, gate); accepted (x, P)."""
    kept = []
    for run, Q, z, R, gate in steps:
        x, P = x + run, P + Q
        S = P + R
        if (z - x) @ np.linalg.solve(S, z - x) > gate:
            continue
        information = np.linalg.inv(P) + np.linalg.inv(R)  # the information form of the update
        x = np.linalg.solve(information, np.linalg.solve(P, x) + np.linalg.solve(R, z))
        P = np.linalg.inv(information)
        kept.append((x, P))
    return kept


def two_way_time(position_at, beacon_m, speed_mps, t_ping_s, turn_around_s=0.0):
    """Time from the ping to the reply's hearing for a vehicle on `position_at(t)` (3,) m."""
    time_s = turn_around_s
    out_s = math.dist(position_at(t_ping_s), beacon_m) / speed_mps
    for _ in range(60):
        heard_s = t_ping_s + time_s
        time_s = out_s + turn_around_s + math.dist(position_at(heard_s), beacon_m) / speed_mps
    return time_s


def chain_is_a_track(t_s, places_m, v_min, v_max, a_max):
    """Eqs. 4 and 5 for one chain of fixes, with true time differences."""
    for j in range(1, len(t_s)):
        run = math.dist(places_m[j], places_m[j - 1])
        if not v_min * (t_s[j] - t_s[j - 1]) <= run <= v_max * (t_s[j] - t_s[j - 1]):
            return False
    for j in range(1, len(t_s) - 1):
        after, before = t_s[j + 1] - t_s[j], t_s[j] - t_s[j - 1]
        change = [
            (places_m[j + 1][k] - places_m[j][k]) / after
            - (places_m[j][k] - places_m[j - 1][k]) / before
            for k in (0, 1)
        ]
        if math.hypot(*change) > a_max * (after + before) / 2:
            return False
    return True
