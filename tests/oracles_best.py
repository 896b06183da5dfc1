# SPDX-License-Identifier: Apache-2.0
"""The augmented filter by the book, and the worlds its tests run in.

Matrices over all eleven states, dense solves over a whole dive and derivatives by differences; the
model is written down once more, in complex numbers, from `navigation.md`'s equations.
"""

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import Legs, is_physical, legs
from abyssnav.align import align
from abyssnav.config import Config
from abyssnav.estimation.dead_reckoning import Motion, dead_reckon
from abyssnav.estimation.fixes import ping_numbers
from abyssnav.estimation.model import ErrorModel, Steps, steps
from abyssnav.estimation.update import Judge
from abyssnav.simulate import Simulation, load_scenario, simulate, to_log
from abyssnav.tables import Dive, Int

SIGMA_S = 0.002
MODEL = ErrorModel(
    start_sigma_m=10.0,
    position_m2_per_s=0.002,
    heading_sigma_rad=math.radians(2.0),
    heading_time_s=3000.0,
    dvl_scale_sigma=0.004,
    sound_scale_sigma=1 / 1500,
    deviation_sigma_rad=(math.radians(1.0), math.radians(0.4)),
    held_sigma_mps=0.1,
    held_time_s=600.0,
)
JUDGE = Judge(SIGMA_S, 9.21)


# --- the model once more -----------------------------------------------------------------------


def moved(x, run_m, linear_m):
    """Displacement (2,) by one complex rotation: e + i n turns counter-clockwise by exp(i eps)."""
    total = complex(*run_m) + sum(a * complex(*d) for a, d in zip(x[5:], linear_m, strict=True))
    turned = total * np.exp(1j * x[2]) / (1 + x[3])
    return np.array([turned.real, turned.imag])


def flight_time(x, prepared, paths, i):
    """Both legs of reply i, Eq. 3, seen from the states at the reply."""
    at_ping = x[:2] - moved(x, prepared.since_ping_m[i], prepared.linear_since_ping_m[i])
    out_m = math.hypot(*(at_ping - paths.aim_ping_m[i]), paths.height_ping_m[i])
    back_m = math.hypot(*(x[:2] - paths.aim_reply_m[i]), paths.height_reply_m[i])
    return (1 + x[4]) * (out_m / paths.speed_ping_mps[i] + back_m / paths.speed_reply_mps[i])


def transition(x, prepared, i, model):
    """States at reply i from those at the reply before."""
    dt_s = prepared.t_s[i] - prepared.t_s[i - 1]
    after = x.copy()
    after[:2] += moved(
        x,
        prepared.run_m[i] - prepared.run_m[i - 1],
        prepared.linear_m[i] - prepared.linear_m[i - 1],
    )
    after[2] *= math.exp(-dt_s / model.heading_time_s)
    after[9:] *= math.exp(-dt_s / model.held_time_s)
    return after


def step_noise(prepared, i, model):
    """Q of the step to reply i."""
    dt_s = prepared.t_s[i] - prepared.t_s[i - 1]
    q = np.zeros(11)
    q[:2] = model.position_m2_per_s * dt_s
    q[2] = model.heading_sigma_rad**2 * (1 - math.exp(-2 * dt_s / model.heading_time_s))
    q[9:] = model.held_sigma_mps**2 * (1 - math.exp(-2 * dt_s / model.held_time_s))
    return np.diag(q)


def derivative(function, x, steps_of):
    """Central differences of `function` at x, by the size of step told for each state."""
    columns = []
    for j, h in enumerate(steps_of):
        ahead, behind = x.copy(), x.copy()
        ahead[j] += h
        behind[j] -= h
        rise = np.asarray(function(ahead)) - np.asarray(function(behind))
        columns.append(rise / (ahead[j] - behind[j]))
    return np.stack(columns, axis=-1)


#: Steps for central differences: metres, radians, scales, radians, m/s.
SMALL = np.array([2e-3, 2e-3, *[1e-5] * 7, 1e-4, 1e-4])


def textbook_filter(x, P, prepared, paths, rows, model, judge):
    """Extended Kalman filter in matrices over `rows` after the first; (x, P, accepted) of each."""
    kept = []
    for i in rows:
        F = derivative(lambda y, i=i: transition(y, prepared, i, model), x, SMALL)
        x = transition(x, prepared, i, model)
        P = F @ P @ F.T + step_noise(prepared, i, model)
        H = derivative(lambda y, i=i: [flight_time(y, prepared, paths, i)], x, SMALL)
        S = (H @ P @ H.T)[0, 0] + judge.sigma_s**2
        nu = paths.flight_time_s[i] - flight_time(x, prepared, paths, i)
        accepted = nu**2 / S <= judge.gamma
        if accepted:
            K = P @ H.T / S
            x = x + K[:, 0] * nu
            A = np.eye(11) - K @ H
            P = A @ P @ A.T + judge.sigma_s**2 * K @ K.T
        kept.append((x, P, accepted, nu, S))
    return kept


# --- made-up worlds ----------------------------------------------------------------------------


def random_world(n_beacons, n, seed, spread_m=2000.0):
    """Replies of a vehicle that wanders among beacons: steps, legs, beacon rows, ping numbers."""
    rng = np.random.default_rng(seed)
    beacons_m = rng.uniform(-spread_m, spread_m, (n_beacons, 2))
    t_s = np.sort(rng.uniform(0, 24.0 * n / n_beacons, n))
    beacon = np.arange(n) % n_beacons
    grown = rng.normal(0, 20.0, (n, 2))
    prepared = Steps(
        t_s=t_s,
        run_m=np.cumsum(grown, axis=0),
        linear_m=np.cumsum(rng.normal(0, 10.0, (n, 6, 2)), axis=0),
        since_ping_m=rng.normal(0, 5.0, (n, 2)),
        linear_since_ping_m=rng.normal(0, 3.0, (n, 6, 2)),
    )
    height_m = rng.uniform(-40, 120, n)
    paths = Legs(
        flight_time_s=rng.uniform(1, 4, n),
        aim_ping_m=beacons_m[beacon],
        aim_reply_m=beacons_m[beacon] + rng.normal(0, 1.0, (n, 2)),
        height_ping_m=height_m,
        height_reply_m=height_m + rng.normal(0, 1.0, n),
        speed_ping_mps=rng.uniform(1490, 1545, n),
        speed_reply_mps=rng.uniform(1490, 1545, n),
    )
    return prepared, paths, beacon, np.arange(n) // n_beacons


def random_states(n, seed, heading_rad=0.17):
    """States all over the place, the heading error up to ten degrees."""
    rng = np.random.default_rng(seed)
    x = np.empty((n, 11))
    x[:, :2] = rng.uniform(-2000, 2000, (n, 2))
    x[:, 2] = rng.uniform(-heading_rad, heading_rad, n)
    x[:, 3:5] = rng.uniform(-0.05, 0.05, (n, 2))
    x[:, 5:9] = rng.uniform(-0.04, 0.04, (n, 4))
    x[:, 9:] = rng.uniform(-0.2, 0.2, (n, 2))
    return x


# --- simulated dives ---------------------------------------------------------------------------


class Heard(NamedTuple):
    """One simulated dive, prepared as the navigator does it."""

    simulation: Simulation
    dive: Dive
    motion: Motion
    beacon: Int
    ping: Int
    steps: Steps
    legs: Legs
    rows: Int  #: of the dive's replies

    def true_m(self, t_s):
        return self.simulation.position_at(t_s)[:, :2]


def changed(settings, changes):
    """The settings struct with a nested dictionary of changes applied."""
    import msgspec

    return msgspec.structs.replace(
        settings,
        **{
            key: changed(getattr(settings, key), value) if isinstance(value, dict) else value
            for key, value in changes.items()
        },
    )


def simulated(seed=1, duration_s=3600.0, scenario="voyage_1", config=None, **changes):
    """A simulated dive and all that the filter asks for."""
    told = changed(load_scenario(scenario), {"seed": seed, "duration_s": duration_s, **changes})
    simulation = simulate(told)
    return prepare(simulation, align(to_log(simulation, name="dive"), config or Config()))


def prepare(simulation, dive):
    """Dead reckoning, legs and steps of a dive's usable replies."""
    times = (dive.velocity.t_s, dive.depth.t_s, dive.replies.t_ping_s, dive.replies.t_reply_s)
    span_s = (min(float(t.min()) for t in times), max(float(t.max()) for t in times))
    motion = dead_reckon(dive.velocity, dive.heading, span_s, 0.1, 1.0)
    rows = np.flatnonzero(dive.replies.beacon >= 0)
    paths = legs(dive.replies[rows], dive.sound_speed)
    physical = is_physical(paths, dive.replies.travel_time_s[rows], SIGMA_S)
    rows, paths = rows[physical], paths[physical]
    heard = dive.replies[rows]
    return Heard(
        simulation,
        dive,
        motion,
        heard.beacon,
        ping_numbers(heard),
        steps(motion, heard.t_ping_s, heard.t_reply_s),
        paths,
        rows,
    )


@cache
def cached(seed=1, duration_s=3600.0, scenario="voyage_1"):
    return simulated(seed, duration_s, scenario)
