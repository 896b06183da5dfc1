# SPDX-License-Identifier: Apache-2.0
"""The real-time filter by the book, and the worlds its tests run in.

Matrices over all states and derivatives by differences; the model is written down once more, in
plain complex numbers, from `navigation.md`'s equations.
"""

import cmath
import dataclasses
import math
from functools import cache
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import RayGeometry, is_physical, ray_geometry
from abyssnav.align import align
from abyssnav.config import Config
from abyssnav.estimation.dead_reckoning import DeadReckoning, dead_reckon
from abyssnav.estimation.dive_problem import ErrorPriors
from abyssnav.estimation.filter_events import UsableTimes, sums_maker, time_events
from abyssnav.estimation.filter_problem import GateConfig, KnownStart, PositionEvents, Problem
from abyssnav.estimation.fixes import ping_numbers
from abyssnav.estimation.hypotheses import HYPOTHESES, bank_priors
from abyssnav.estimation.tracker import track
from abyssnav.estimation.two_state import BEFORE_START
from abyssnav.simulate import Simulation, load_scenario, simulate, to_log
from abyssnav.tables import Dive, Float, Int, Replies, Start

SIGMA_S = 0.002
PRIORS = ErrorPriors(lever_m=0.1)
#: Nothing is wrong with any sensor.
NO_ERRORS = ErrorPriors(
    position_m2_per_s=0.3, heading_rad=0.0, velocity_mps=0.0, current_mps=0.0, sound_slow_mps=0.0,
    offset_rad=0.0, deviation_rad=(0.0, 0.0), dvl_scale=0.0, sound_mps=0.0, clock_s=0.0,
    lever_m=0.0, beacon_m=0.0, turn_around_s=0.0, gap_velocity_mps=0.0,
)  # fmt: skip
GATE = GateConfig(9.21, 13.8)
NO_POSITIONS = PositionEvents(np.empty(0), np.empty(0, dtype=complex), np.empty((0, 2, 2)))


# --- the model once more -----------------------------------------------------------------------


def moved(x, stretch):
    """Displacement by one complex rotation: e + i n turns counter-clockwise by exp(i eps)."""
    total = stretch.displacement + sum(
        a * d for a, d in zip(x[9:13], stretch.deviation, strict=True)
    )
    total -= complex(x[3], -x[4]) * stretch.ahead
    turned = total * cmath.exp(1j * (x[2] + x[8])) / (1 + x[13])
    return turned + complex(x[5], x[6]) * stretch.duration_s


def flight_time(x, times, i):
    """Both legs of reply i, Eq. 3, seen from the states at the reply, with the beacon's delay."""
    b = 20 + 4 * int(times.beacon[i])
    total = 0.0
    for leg, back in ((0, moved(x, times.since_ping.row(i))), (1, 0.0)):
        lever = sum(a * complex(v) for a, v in zip(x[17:20], times.lever[i, leg], strict=True))
        away = (
            complex(x[0], x[1])
            - back
            + lever
            - times.virtual_beacon[i, leg]
            - complex(x[b], x[b + 1])
        )
        height_m = times.height_m[i, leg] + float(x[17:20] @ times.lever_up[i, leg]) - x[b + 2]
        speed_mps = times.speed_mps[i, leg]
        thinner = 1 - x[15] * times.below_reference_m[i, leg] / speed_mps
        total += math.hypot(away.real, away.imag, height_m) / speed_mps * thinner
    return (1 + x[14] + x[7]) * total + x[16] + x[b + 3]


def derivative(function, x, steps):
    """Central differences of `function` at x, by a size of step for each state."""
    columns = []
    for j, h in enumerate(steps):
        ahead, behind = x.copy(), x.copy()
        ahead[j] += h
        behind[j] -= h
        rise = np.asarray(function(ahead)) - np.asarray(function(behind))
        columns.append(rise / (ahead[j] - behind[j]))
    return np.stack(columns, axis=-1)


def small_steps(n_states):
    """Steps for central differences: metres, radians, m/s, scales, seconds."""
    node = [2e-3, 2e-3, 1e-5, 1e-4, 1e-4, 1e-4, 1e-4, 1e-5]
    common = [*[1e-5] * 7, 1e-5, 1e-6, 1e-2, 1e-2, 1e-2]
    return np.array([*node, *common, *[1e-2, 1e-2, 1e-2, 1e-6] * ((n_states - 20) // 4)])


def random_states(n, n_beacons, seed, size=1.0):
    """States all over the place, the heading error up to ten degrees."""
    rng = np.random.default_rng(seed)
    node = [2000, 2000, 0.1, 0.1, 0.1, 0.2, 0.2, 1e-3]
    common = [0.1, *[0.03] * 4, 0.05, 5e-3, 4e-3, 2e-3, 2.0, 2.0, 2.0]
    scale = np.array([*node, *common, *[3.0, 3.0, 3.0, 2e-3] * n_beacons])
    return size * rng.uniform(-1, 1, (n, len(scale))) * scale


# --- simulated dives ---------------------------------------------------------------------------


class Heard(NamedTuple):
    """One simulated dive, prepared as the navigator does it."""

    simulation: Simulation
    dive: Dive
    motion: DeadReckoning
    replies: Replies  #: usable ones
    ping: Int
    geometry: RayGeometry
    rows: Int  #: of the dive's replies

    @property
    def t_s(self):
        return self.replies.t_reply_s

    @property
    def beacon(self):
        return self.replies.beacon

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
    keys = {"seed": seed, "duration_s": duration_s, **changes}
    simulation = simulate(changed(load_scenario(scenario), keys))
    return prepare(simulation, align(to_log(simulation, name="dive"), config or Config()))


def prepare(simulation, dive):
    """Dead reckoning and legs of a dive's usable replies."""
    times = (dive.velocity.t_s, dive.depth.t_s, dive.replies.t_ping_s, dive.replies.t_reply_s)
    span_s = (min(float(t.min()) for t in times), max(float(t.max()) for t in times))
    motion = dead_reckon(dive.velocity, dive.heading, span_s, 0.1, 1.0)
    rows = np.flatnonzero(dive.replies.beacon >= 0)
    paths = ray_geometry(dive.replies[rows], dive.sound_speed)
    physical = is_physical(paths, dive.replies.travel_time_s[rows], SIGMA_S)
    rows, paths = rows[physical], paths[physical]
    heard = dive.replies[rows]
    return Heard(simulation, dive, motion, heard, ping_numbers(heard), paths, rows)


@cache
def cached(seed=1, duration_s=3600.0, scenario="voyage_1"):
    return simulated(seed, duration_s, scenario)


# --- the filters over a dive -------------------------------------------------------------------


class Trail(NamedTuple):
    """History of the filter, one row a usable reply; NaN before the start."""

    x: Float
    P: Float
    segment: Int
    decision: Int
    predicted_s: Float
    variance_s2: Float
    innovation_s: Float
    noise_s2: Float


def posed(heard, priors=PRIORS, hypotheses=HYPOTHESES, gate=GATE, positions=NO_POSITIONS):
    """The dive as the filters see it."""
    sums = sums_maker(heard.motion)
    speed_mps = float(heard.geometry.speed_reply_mps[0]) if len(heard.ping) else 1500.0
    return Problem(
        time_events(
            UsableTimes(heard.replies, heard.ping, heard.geometry), sums, heard.dive.heading
        ),
        heard.geometry,
        positions,
        sums,
        bank_priors(priors, heard.dive.beacons.sigma_m, speed_mps, hypotheses),
        gate,
        10.0,
        priors.travel_time_s,
    )


def run(heard, priors=PRIORS, given=None, *, hypotheses=HYPOTHESES, **changes):
    """Trail and start of the filters over a dive, from a start of theirs or a given one."""
    problem = posed(heard, priors, hypotheses)._replace(**changes)
    known = None if given is None else KnownStart(given, 10.0)
    tracked = track(problem, known)
    return trail_of(tracked.history, len(heard.ping), problem), tracked.start


def trail_of(history, n, problem):
    n_states = 8 + problem.priors.constant_sigma.shape[1]
    x, P = np.full((n, n_states), np.nan), np.full((n, 15, 15), np.nan)
    segment, values = np.full(n, -1), np.full((4, n), np.nan)
    if history is None:
        return Trail(x, P, segment, np.full(n, BEFORE_START), *values)
    nodes, times = history.nodes, history.times
    begun = n - len(nodes.t_s)
    place = slice(max(begun, 0), None)
    x[place], P[place] = nodes.x[-n:], nodes.P[-n:]
    segment[place] = nodes.segment[-n:]
    return Trail(
        x, P, segment, times.decision, times.predicted_s, times.variance_s2, times.innovation_s,
        times.noise_s2,
    )  # fmt: skip


def true_start(heard, row, east_m=0.0, north_m=0.0):
    """The true place at a reply, moved, as a start that somebody else confirmed."""
    e, n = heard.true_m(heard.t_s[[row]])[0]
    return Start(float(heard.t_s[row]), float(e) + east_m, float(n) + north_m, 1, "m_of_n")


def only(heard, rows, **replaced):
    """The dive with some of its replies, columns of them replaced."""
    replies = dataclasses.replace(heard.replies[rows], **replaced)
    return heard._replace(
        replies=replies, ping=heard.ping[rows], geometry=heard.geometry[rows], rows=heard.rows[rows]
    )
