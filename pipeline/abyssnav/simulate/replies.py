# SPDX-License-Identifier: Apache-2.0
"""Who answers a ping, what comes of it on the way, and when it is received."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from abyssnav.geometry import body_to_enu, interpolate
from abyssnav.simulate import scenario as settings
from abyssnav.simulate import sound
from abyssnav.simulate.beacons import BeaconMotion
from abyssnav.simulate.vehicle import Relief, TrueMotion, gauss_markov
from abyssnav.tables import Beacons, Bool, Float, Int, Table

#: What a reply truly is; `SimulatedReplies.label` is a place in it.
LABELS = (
    "direct",
    "bottom",
    "surface",
    "late",
    "uniform",
    "wrong_beacon",
    "duplicate",
    "decoy",
)
_DIRECT, _BOTTOM, _SURFACE, _LATE, _UNIFORM, _WRONG, _DUPLICATE, _DECOY = range(len(LABELS))
# A duplicate comes when the first copy has been told from it: one pulse later.
_PULSE_S = 0.02


@dataclass(frozen=True, eq=False)
class SimulatedReplies(Table):
    """One row a reply in the order received, with what nobody aboard knows."""

    ping_id: Int
    beacon: Int  #: row of the beacon under whose name it was received
    t_ping_s: Float
    travel_time_s: Float  #: two-way, as measured
    snr_db: Float
    label: Int  #: place in `LABELS`
    direct_s: Float  #: two-way time of that beacon's direct path, without noise


@dataclass(frozen=True, eq=False)
class Scene:
    """The true world that the sound goes through."""

    motion: TrueMotion
    beacons: Beacons
    beacon_motion: BeaconMotion
    floor: settings.Floor
    relief: Relief
    water: sound.Water
    slowness_drift: Float  #: (n,) share by which sound is slower at each instant of the motion
    transducer_offset_m: tuple[float, float, float]

    def transducer(self, t_s: Float) -> Float:
        """Transducer's position (n, 3) m ENU: p(t) + R_enu_body(t) · offset."""
        motion = self.motion
        attitude = [motion.roll_rad, motion.pitch_rad, motion.heading_rad]
        track = interpolate(t_s, motion.t_s, np.column_stack([motion.position_enu_m, *attitude]))
        lever = body_to_enu(np.array(self.transducer_offset_m), *track[:, 3:].T)
        return np.asarray(track[:, :3] + lever)

    def floor_depth(self, position_enu_m: Float) -> Float:
        """Depth of the floor below the positions (n, 3)."""
        return self.relief.depth_m(self.floor.depth_m, position_enu_m[:, :2])


def simulate_replies(
    scenario: settings.Scenario, scene: Scene, rng: Generator, bias_rng: Generator
) -> SimulatedReplies:
    """All that is received before the dive ends, in that order."""
    acoustics, decoy = scenario.acoustics, scenario.decoy
    end_s = scene.motion.t_s[-1]
    t_ping = np.arange(acoustics.first_ping_s, end_s, acoustics.ping_period_s)
    count = len(scene.beacons)
    bad = np.repeat(_bad_periods(acoustics, len(t_ping), rng), count)
    ping = np.repeat(np.arange(len(t_ping)), count)
    beacon = np.tile(np.arange(count), len(t_ping))

    slow_s = _slow_bias(acoustics, len(t_ping), count, bias_rng)
    label = _draw_labels(acoustics, bad, rng)
    misled = (t_ping[ping] >= decoy.from_s) & (t_ping[ping] < decoy.from_s + decoy.for_s)
    label[misled & (rng.random(len(label)) < decoy.share)] = _DECOY
    other = (beacon + rng.integers(1, max(count, 2), len(beacon))) % count
    answering = np.where(label == _WRONG, other, beacon)
    offset = np.where((label == _DECOY)[:, None], [*decoy.offset_m, 0.0], 0.0)
    paths = _draw_paths(label, rng)

    measured_s = _travel_time(scene, t_ping[ping], answering, paths, offset)
    direct_s = measured_s.copy()
    astray = (answering != beacon) | paths.any(axis=1) | (label == _DECOY)
    direct_s[astray] = _travel_time(
        scene, t_ping[ping[astray]], beacon[astray], np.zeros_like(paths[astray]), 0.0
    )
    place = scene.beacon_motion.place(t_ping[ping], beacon)
    range_m = np.linalg.norm(scene.transducer(t_ping[ping]) - place, axis=-1)
    late_s = rng.exponential(acoustics.late_s, len(label))
    measured_s += np.where(label == _LATE, late_s, 0.0)
    any_s = rng.uniform(0, acoustics.listening_s, len(label))
    measured_s = np.where(label == _UNIFORM, any_s, measured_s)
    measured_s += _noise(acoustics, range_m, rng) + slow_s[ping, beacon]
    replies = SimulatedReplies(
        ping_id=ping + 1,
        beacon=beacon,
        t_ping_s=t_ping[ping],
        travel_time_s=measured_s,
        snr_db=_draw_snr(range_m, label, rng),
        label=label,
        direct_s=direct_s,
    )
    detected = _is_detected(acoustics, bad, range_m, rng)
    received = replies[detected & _is_listened_to(acoustics, t_ping[ping], beacon)]
    return _in_order_received(received, _copies(acoustics, received, rng), end_s)


def _bad_periods(acoustics: settings.Acoustics, pings: int, rng: Generator) -> Bool:
    """Whether each ping falls into a bad period: good and bad runs of geometric lengths."""
    share, bad_length = acoustics.bad_share, acoustics.bad_pings
    if share == 0:
        return np.zeros(pings, dtype=bool)
    good_length = max(bad_length * (1 - share) / share, 1.0)
    runs = int(pings / 2) + 2
    lengths = np.column_stack(
        [rng.geometric(1 / good_length, runs), rng.geometric(1 / bad_length, runs)]
    )
    # From a random place of the cycle, so that a dive does not always begin well.
    skip = rng.integers(0, round(good_length + bad_length))
    return np.repeat(np.tile([False, True], runs), lengths.ravel())[skip : skip + pings]


def _draw_labels(acoustics: settings.Acoustics, bad: Bool, rng: Generator) -> Int:
    mix = acoustics.mix
    kinds = {
        _BOTTOM: mix.bottom,
        _SURFACE: mix.surface,
        _LATE: mix.late,
        _UNIFORM: mix.uniform,
        _WRONG: mix.wrong_beacon,
    }
    weight = np.array(list(kinds.values()))
    wrong = rng.choice(list(kinds), len(bad), p=weight / weight.sum())
    share = np.where(bad, acoustics.bad_gross, acoustics.gross)
    return np.where(rng.random(len(bad)) < share, wrong, _DIRECT)


def _noise(acoustics: settings.Acoustics, range_m: Float, rng: Generator) -> Float:
    """Noise of the two-way times, of the scenario's shape and standard deviation."""
    n = len(range_m)
    sigma_s = np.hypot(acoustics.sigma_s, acoustics.range_sigma_s_per_km * range_m / 1000)
    if acoustics.noise == "laplace":
        return np.asarray(sigma_s * rng.laplace(scale=np.sqrt(0.5), size=n))
    if acoustics.noise == "student":
        return np.asarray(sigma_s * np.sqrt(0.5) * rng.standard_t(4, size=n))
    if acoustics.noise == "skewed":
        return np.asarray(sigma_s * (rng.gamma(4.0, size=n) - 4.0) / 2)
    return np.asarray(sigma_s * rng.normal(size=n))


def _slow_bias(acoustics: settings.Acoustics, pings: int, count: int, rng: Generator) -> Float:
    """Slow bias (pings, count) of each beacon's times."""
    period_s, time_s = acoustics.ping_period_s, acoustics.slow_time_s
    slow = [gauss_markov(pings, period_s, time_s, rng) for _ in range(count)]
    return acoustics.slow_sigma_s * np.stack(slow, axis=-1)


def _is_listened_to(acoustics: settings.Acoustics, t_ping_s: Float, beacon: Int) -> Bool:
    """Whether no stretch leaves that beacon out."""
    listened = np.ones(len(beacon), dtype=bool)
    for window in acoustics.window:
        inside = (t_ping_s >= window.from_s) & (t_ping_s < window.from_s + window.for_s)
        listened &= ~inside | np.isin(beacon + 1, window.beacons)
    return listened


def _draw_paths(label: Int, rng: Generator) -> Int:
    """Path of the way out and of the way back (n, 2); the floor may be met on both."""
    which = rng.integers(0, 3, len(label))
    bounced = np.stack([which != 1, which != 0], axis=-1)
    once = np.stack([which == 0, which != 0], axis=-1)
    bottom = np.where(bounced, sound.BOTTOM, sound.DIRECT)
    surface = np.where(once, sound.SURFACE, sound.DIRECT)
    return np.where(
        (label == _BOTTOM)[:, None],
        bottom,
        np.where((label == _SURFACE)[:, None], surface, sound.DIRECT),
    )


def _travel_time(
    scene: Scene, t_ping_s: Float, beacon: Int, paths: Int, offset_m: Float | float
) -> Float:
    turn_around_s = scene.beacons.turn_around_s[beacon]
    slower = 1 + np.interp(t_ping_s, scene.motion.t_s, scene.slowness_drift)
    place = scene.beacon_motion.place(t_ping_s, beacon)
    if len(scene.beacon_motion) > 1:  # where it is when it answers; it goes slowly
        apart_m = np.linalg.norm(scene.transducer(t_ping_s) - place, axis=-1)
        t_answer_s = t_ping_s + apart_m / sound.NOMINAL_MPS + turn_around_s
        place = scene.beacon_motion.place(t_answer_s, beacon)
    below_beacon = scene.floor_depth(place)

    def leg(vehicle_enu_m: Float, way: int) -> Float:
        floor = np.column_stack([scene.floor_depth(vehicle_enu_m), below_beacon])
        water, path = scene.water, paths[:, way]
        return slower * sound.leg_time(vehicle_enu_m + offset_m, place, path, floor, water)

    return sound.two_way_time(scene.transducer, t_ping_s, turn_around_s, leg)


def _draw_snr(range_m: Float, label: Int, rng: Generator) -> Float:
    """Signal-to-noise ratio [dB]: spreading and absorption; wrong replies are weaker, not always.

    Rounded to the single precision in which it is recorded.
    """
    level = 30.0 - 20 * np.log10(range_m / 1000) - 2 * range_m / 1000
    weaker = np.where(label == _DIRECT, 0.0, 5.0)
    snr = level - weaker + rng.normal(0, 2.5, len(label))
    return snr.astype(np.float32).astype(float)


def expected_share(acoustics: settings.Acoustics, range_m: Float) -> Float:
    """Share of the pings that a beacon at each slant range answers rightly, good periods and bad.

    Parameters
    ----------
    range_m : (n,)
    """
    good = acoustics.detection * (1 - acoustics.gross)
    bad = acoustics.bad_detection * (1 - acoustics.bad_gross)
    mean = (1 - acoustics.bad_share) * good + acoustics.bad_share * bad
    return np.asarray(mean * _share_in_reach(acoustics, range_m))


def _share_in_reach(acoustics: settings.Acoustics, range_m: Float) -> Float:
    """What range leaves of the detections."""
    excess = (range_m - acoustics.half_range_m) / acoustics.fall_off_m
    return np.asarray(0.5 * (1 - np.tanh(0.5 * excess)))


def _is_detected(acoustics: settings.Acoustics, bad: Bool, range_m: Float, rng: Generator) -> Bool:
    share = np.where(bad, acoustics.bad_detection, acoustics.detection)
    return np.asarray(rng.random(len(bad)) < share * _share_in_reach(acoustics, range_m))


def _copies(
    acoustics: settings.Acoustics, received: SimulatedReplies, rng: Generator
) -> SimulatedReplies:
    """Replies that are received once more, late."""
    twice = received[rng.random(len(received)) < acoustics.duplicates]
    later_s = _PULSE_S + rng.exponential(acoustics.late_s, len(twice))
    return SimulatedReplies(
        ping_id=twice.ping_id,
        beacon=twice.beacon,
        t_ping_s=twice.t_ping_s,
        travel_time_s=twice.travel_time_s + later_s,
        snr_db=twice.snr_db - 4.0,
        label=np.full(len(twice), _DUPLICATE),
        direct_s=twice.direct_s,
    )


def _in_order_received(
    first: SimulatedReplies, copies: SimulatedReplies, end_s: float
) -> SimulatedReplies:
    columns = copies.columns()
    both = SimulatedReplies(
        **{
            name: np.concatenate([column, columns[name]])
            for name, column in first.columns().items()
        }
    )
    t_received = both.t_ping_s + both.travel_time_s
    order = np.argsort(t_received, kind="stable")
    return both[order[(t_received[order] <= end_s) & (both.travel_time_s[order] > 0)]]
