# SPDX-License-Identifier: Apache-2.0
"""Who answers a ping, what comes of it on the way, and when it is heard."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from abyssnav.geometry import body_to_enu, interpolate
from abyssnav.simulate import scenario as settings
from abyssnav.simulate import sound
from abyssnav.simulate.vehicle import Relief, TrueMotion
from abyssnav.tables import Beacons, Bool, Float, Int, Table

#: What a reply truly is; `HeardReplies.label` is a place in it.
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
class HeardReplies(Table):
    """One row a reply in the order heard, with what nobody aboard knows."""

    ping_id: Int
    beacon: Int  #: row of the beacon under whose name it was heard
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
    floor: settings.Floor
    relief: Relief
    water: sound.Water
    transducer_offset_m: tuple[float, float, float]

    def transducer(self, t_s: Float) -> Float:
        """Transducer's position (n, 3) m ENU: p(t) + R_enu_body(t) · offset."""
        motion = self.motion
        at = [motion.roll_rad, motion.pitch_rad, motion.heading_rad]
        track = np.column_stack([motion.position_enu_m, *at])
        track_at = interpolate(t_s, motion.t_s, track)
        lever = body_to_enu(np.array(self.transducer_offset_m), *track_at[:, 3:].T)
        return np.asarray(track_at[:, :3] + lever)

    def floor_depth(self, position_enu_m: Float) -> Float:
        """Depth of the floor below the positions (n, 3)."""
        return self.relief.depth_m(self.floor.depth_m, position_enu_m[:, :2])


def place_beacons(
    beacons: settings.Beacons, floor: settings.Floor, relief: Relief, rng: Generator
) -> Beacons:
    """True places: evenly around the origin, give or take 15 %, moored above the floor."""
    count = beacons.count
    angle = rng.uniform(0, 2 * np.pi) + 2 * np.pi / count * (
        np.arange(count) + rng.uniform(-0.15, 0.15, count)
    )
    distance = beacons.distance_m * rng.uniform(0.85, 1.15, count)
    horizontal = distance[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    depth = relief.depth_m(floor.depth_m, horizontal) - rng.uniform(*beacons.mooring_m, count)
    return Beacons(
        id=np.arange(1, count + 1),
        name=np.array([f"B{number}" for number in range(1, count + 1)]),
        position_enu_m=np.column_stack([horizontal, -depth]),
        turn_around_s=beacons.turn_around_s
        + beacons.turn_around_step_s * np.arange(count, dtype=np.float64),
        sigma_m=np.full(count, beacons.survey_sigma_m),
    )


def hear_replies(scenario: settings.Scenario, scene: Scene, rng: Generator) -> HeardReplies:
    """All that is heard before the dive ends, sorted by the time of hearing."""
    acoustics, decoy = scenario.acoustics, scenario.decoy
    end_s = scene.motion.t_s[-1]
    t_ping = np.arange(acoustics.first_ping_s, end_s, acoustics.ping_period_s)
    count = len(scene.beacons)
    bad = np.repeat(_bad_periods(acoustics, len(t_ping), rng), count)
    ping = np.repeat(np.arange(len(t_ping)), count)
    beacon = np.tile(np.arange(count), len(t_ping))

    label = _draw_labels(acoustics, bad, rng)
    misled = (t_ping[ping] >= decoy.from_s) & (t_ping[ping] < decoy.from_s + decoy.for_s)
    label[misled & (rng.random(len(label)) < decoy.share)] = _DECOY
    other = (beacon + rng.integers(1, count, len(beacon))) % count
    heard_from = np.where(label == _WRONG, other, beacon)
    offset = np.where((label == _DECOY)[:, None], [*decoy.offset_m, 0.0], 0.0)
    paths = _draw_paths(label, rng)

    direct_s = _travel_time(scene, t_ping[ping], beacon, np.zeros_like(paths), 0.0)
    heard_s = _travel_time(scene, t_ping[ping], heard_from, paths, offset)
    range_m = np.linalg.norm(
        scene.transducer(t_ping[ping]) - scene.beacons.position_enu_m[beacon], axis=-1
    )
    late_s = rng.exponential(acoustics.late_s, len(label))
    heard_s += np.where(label == _LATE, late_s, 0.0)
    any_s = rng.uniform(0, acoustics.listening_s, len(label))
    heard_s = np.where(label == _UNIFORM, any_s, heard_s)
    heard_s += acoustics.sigma_s * rng.normal(size=len(label))
    replies = HeardReplies(
        ping_id=ping + 1,
        beacon=beacon,
        t_ping_s=t_ping[ping],
        travel_time_s=heard_s,
        snr_db=_draw_snr(range_m, label, rng),
        label=label,
        direct_s=direct_s,
    )
    heard = replies[_is_detected(acoustics, bad, range_m, rng)]
    return _in_order_heard(heard, _copies(acoustics, heard, rng), end_s)


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
    place = scene.beacons.position_enu_m[beacon]
    below_beacon = scene.floor_depth(place)

    def leg(vehicle_enu_m: Float, way: int) -> Float:
        floor = np.column_stack([scene.floor_depth(vehicle_enu_m), below_beacon])
        return sound.leg_time(vehicle_enu_m + offset_m, place, paths[:, way], floor, scene.water)

    turn_around_s = scene.beacons.turn_around_s[beacon]
    return sound.two_way_time(scene.transducer, t_ping_s, turn_around_s, leg)


def _draw_snr(range_m: Float, label: Int, rng: Generator) -> Float:
    """Signal-to-noise ratio [dB]: spreading and absorption; wrong replies are weaker, not always.

    Rounded to the single precision in which it is recorded.
    """
    level = 30.0 - 20 * np.log10(range_m / 1000) - 2 * range_m / 1000
    weaker = np.where(label == _DIRECT, 0.0, 5.0)
    snr = level - weaker + rng.normal(0, 2.5, len(label))
    return snr.astype(np.float32).astype(float)


def _is_detected(acoustics: settings.Acoustics, bad: Bool, range_m: Float, rng: Generator) -> Bool:
    excess = (range_m - acoustics.half_range_m) / acoustics.fall_off_m
    left = 0.5 * (1 - np.tanh(0.5 * excess))
    share = np.where(bad, acoustics.bad_detection, acoustics.detection)
    return np.asarray(rng.random(len(bad)) < share * left)


def _copies(acoustics: settings.Acoustics, heard: HeardReplies, rng: Generator) -> HeardReplies:
    """Replies that are heard once more, late."""
    twice = heard[rng.random(len(heard)) < acoustics.duplicates]
    later_s = _PULSE_S + rng.exponential(acoustics.late_s, len(twice))
    return HeardReplies(
        ping_id=twice.ping_id,
        beacon=twice.beacon,
        t_ping_s=twice.t_ping_s,
        travel_time_s=twice.travel_time_s + later_s,
        snr_db=twice.snr_db - 4.0,
        label=np.full(len(twice), _DUPLICATE),
        direct_s=twice.direct_s,
    )


def _in_order_heard(first: HeardReplies, copies: HeardReplies, end_s: float) -> HeardReplies:
    columns = copies.columns()
    both = HeardReplies(
        **{
            name: np.concatenate([column, columns[name]])
            for name, column in first.columns().items()
        }
    )
    t_heard = both.t_ping_s + both.travel_time_s
    order = np.argsort(t_heard, kind="stable")
    return both[order[(t_heard[order] <= end_s) & (both.travel_time_s[order] > 0)]]
