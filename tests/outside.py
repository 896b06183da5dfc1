# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: T201
"""Dives of another simulator: `python tests/outside.py DIR [--seeds 1,2,3] [--kinds a,b]`.

What navigates well on dives of `abyssnav.simulate` may do so because both think alike.  Nothing
is shared with it here: lawn-mower, zigzag and spiral with side slip; a compass that wanders; a DVL
that rounds, drifts and loses the floor in bursts; Student's noise that grows with range; multipath
that comes in spells; sound on exact circular arcs (a constant gradient has them in closed form);
JSON, by the official writer.  No prior and no threshold was fitted to it.

`tests/score_foreign.py DIR` says what the navigator makes of them.
"""

import argparse
import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer
from scipy.signal import lfilter

SCHEMAS = Path(__file__).parent.parent / "schemas" / "json"
START_NS = 1_780_000_000_000_000_000
STEP_S = 0.1
PING_S = 24.0
TYPES = {
    "/imu": "sensor_msgs/msg/Imu",
    "/dvl": "geometry_msgs/msg/TwistWithCovarianceStamped",
    "/depth": "abyssnav_msgs/msg/Depth",
    "/lbl/travel_time": "abyssnav_msgs/msg/TravelTime",
    "/lbl/beacons": "abyssnav_msgs/msg/BeaconArray",
    "/sound_speed/profile": "abyssnav_msgs/msg/SoundSpeedProfile",
    "/reference": "nav_msgs/msg/Odometry",
}


@dataclass(frozen=True)
class Kind:
    """What is planted in a dive; the rest is drawn from ranges."""

    duration_s: float = 3060.0
    beacons: int = 4
    aside_m: float = 0.0  #: from the vehicle's area to the middle of the beacons
    beacon_sigma_m: float = 0.2  #: true, each axis
    stated_beacon_sigma_m: float = 0.2
    one_beacon_m: float = 0.0  #: one is further off
    first_moved_m: float = 0.0  #: the first is towed east by so much, from 1500 s on
    turn_arounds_s: float = 0.0  #: all are later than stated
    one_turn_around_s: float = 0.0
    slow_times_s: float = 0.0  #: rms of what each beacon's times are wrong by for minutes
    lever_m: tuple[float, float] = (0.0, 0.0)  #: forward, starboard; never stated
    drift_rad: float = 0.0  #: of the compass, within 600 s from 900 s on
    step_rad: float = 0.0
    offset_rad: float = 0.0
    deviation_rad: float = 0.0
    mount_rad: float = 0.0
    slow_velocity_mps: float = 0.0
    water_track_s: float = 0.0  #: how long the velocity is that through the water
    descent_s: float = 0.0  #: it sinks, slower than it swims later, before the DVL has the floor
    reply_share: float = 0.88
    wrong_share: float = 0.12
    two_after_s: float = np.inf  #: two beacons fall silent
    profile: bool = True


KINDS = {
    "nominal": Kind(),
    "no_profile": Kind(profile=False),
    "half_wild": Kind(reply_share=0.6, wrong_share=0.35),
    "three_beacons": Kind(beacons=3),
    "two_beacons_later": Kind(two_after_s=1500.0),
    "heading_drift": Kind(drift_rad=np.deg2rad(5)),
    "heading_step": Kind(step_rad=np.deg2rad(12)),
    "heading_20": Kind(offset_rad=np.deg2rad(20)),
    "deviation": Kind(deviation_rad=np.deg2rad(4)),
    "mount": Kind(mount_rad=np.deg2rad(3)),
    "dvl_slow": Kind(slow_velocity_mps=0.02),
    "water_track_15min": Kind(water_track_s=900.0),
    "water_track_400s": Kind(water_track_s=400.0),
    "beacons_3m_stated": Kind(beacon_sigma_m=3.0, stated_beacon_sigma_m=3.0),
    "beacons_3m_not_stated": Kind(beacon_sigma_m=3.0, stated_beacon_sigma_m=0.0),
    "eight_3m_not_stated": Kind(beacons=8, beacon_sigma_m=3.0, stated_beacon_sigma_m=0.0),
    "one_beacon_10m": Kind(one_beacon_m=10.0),
    "beacon_moved_12m": Kind(first_moved_m=12.0),
    "turn_arounds_5ms": Kind(turn_arounds_s=5e-3),
    "turn_arounds_5ms_aside": Kind(turn_arounds_s=5e-3, aside_m=3000.0),
    "one_turn_around_5ms": Kind(one_turn_around_s=5e-3),
    "times_slow_3ms": Kind(slow_times_s=3e-3),
    "lever_5m": Kind(lever_m=(5.0, 0.0)),
    "lever_2m": Kind(lever_m=(1.4, 1.4)),
    "descent": Kind(duration_s=3600.0, descent_s=1500.0),
}


@dataclass(frozen=True)
class Water:
    """Sound speed c(z) = c₀ - g z of a height z (up), m/s."""

    surface_mps: float
    gradient_per_s: float

    def at_height(self, up_m):
        return self.surface_mps - self.gradient_per_s * up_m

    def flight_s(self, a_m, b_m):
        """t = arcosh(1 + g² |a - b|² / (2 c_a c_b)) / g, one way: the ray is an arc of a circle."""
        g = self.gradient_per_s
        both = self.at_height(a_m[..., 2]) * self.at_height(b_m[..., 2])
        return np.arccosh(1 + g**2 * ((a_m - b_m) ** 2).sum(-1) / (2 * both)) / g


@dataclass(frozen=True)
class Vehicle:
    """True motion at every `STEP_S`."""

    t_s: np.ndarray
    heading_rad: np.ndarray
    velocity_mps: np.ndarray  #: (n, 2) over ground, forward and starboard
    enu_m: np.ndarray  #: (n, 3)


@dataclass(frozen=True)
class Replies:
    ping_s: list[float] = field(default_factory=list)
    ping_id: list[int] = field(default_factory=list)
    beacon: list[int] = field(default_factory=list)
    travel_time_s: list[float] = field(default_factory=list)

    def add(self, ping_s, ping_id, beacon, travel_time_s):
        self.ping_s.append(ping_s)
        self.ping_id.append(ping_id)
        self.beacon.append(beacon)
        self.travel_time_s.append(travel_time_s)


def gauss_markov(rng, n, sigma, time_s):
    """A fading error of stationary `sigma`, (n,)."""
    fade = np.exp(-STEP_S / time_s)
    kicks = rng.normal(0, sigma * np.sqrt(1 - fade**2), n)
    kicks[0] = rng.normal(0, sigma)
    return lfilter([1.0], [1.0, -fade], kicks)


def course(rng, t_s, speed_mps):
    """Heading (n,) of a lawn-mower, a zigzag or a spiral, unwrapped and smoothed over 12 s."""
    begin = rng.uniform(0, 2 * np.pi)
    shape = rng.choice(["lawn", "zigzag", "spiral"])
    if shape == "lawn":
        leg_m, gap_m = rng.uniform(350, 700), rng.uniform(40, 90)
        line, along_m = np.divmod(speed_mps * t_s, leg_m + gap_m)
        turn = np.clip((along_m - leg_m) / gap_m, 0, 1) * np.pi
        heading = begin + np.where(line % 2 == 0, turn, np.pi - turn)
    elif shape == "zigzag":
        line = (t_s // rng.uniform(200, 500)).astype(int)
        n = line[-1] + 1
        heading = begin + np.cumsum(rng.uniform(0.6, 2.4, n) * rng.choice([-1, 1], n))[line]
    else:
        radius_m = rng.uniform(60, 250) + 0.04 * speed_mps * t_s
        heading = begin + np.cumsum(speed_mps / radius_m) * STEP_S
    wide = round(12 / STEP_S)
    smooth = [
        np.convolve(np.pad(part(heading), wide, mode="edge"), np.ones(wide), "same")[wide:-wide]
        for part in (np.sin, np.cos)
    ]
    return np.unwrap(np.arctan2(*smooth))


def drive(rng, kind):
    t_s = np.arange(0, kind.duration_s, STEP_S)
    speed_mps = rng.uniform(0.6, 1.6)
    heading = course(rng, t_s, speed_mps)
    forward = speed_mps * (1 + 0.05 * np.sin(2 * np.pi * t_s / rng.uniform(200, 900)))
    starboard = 0.03 * speed_mps * np.sin(2 * np.pi * t_s / rng.uniform(300, 700))
    velocity = np.stack([forward, starboard], -1)
    if kind.descent_s:
        least = rng.uniform(0.1, 0.6)
        velocity *= least + (1 - least) * np.clip((t_s[:, None] - kind.descent_s) / 60 + 1, 0, 1)
    ground = np.cumsum(rotated(velocity, heading), 0) * STEP_S
    depth = rng.uniform(900, 3500) + 15 * np.sin(2 * np.pi * t_s / rng.uniform(600, 2000))
    if kind.descent_s:
        depth *= np.clip(t_s / kind.descent_s, 0.03, 1)
    return Vehicle(t_s, heading, velocity, np.column_stack([ground - ground.mean(0), -depth]))


def rotated(body, heading_rad):
    """Forward and starboard (n, 2) to east and north."""
    s, c = np.sin(heading_rad), np.cos(heading_rad)
    return np.stack([body[..., 0] * s + body[..., 1] * c, body[..., 0] * c - body[..., 1] * s], -1)


def compass(rng, kind, vehicle):
    t_s, heading = vehicle.t_s, vehicle.heading_rad
    error = np.deg2rad(rng.normal(0, 0.4)) + gauss_markov(rng, len(t_s), np.deg2rad(0.5), 900)
    error += kind.offset_rad + kind.drift_rad * np.clip((t_s - 900) / 600, 0, 1)
    error += kind.step_rad * (t_s > rng.uniform(900, 1800))
    error += kind.deviation_rad * (np.sin(heading + 1) + 0.4 * np.sin(2 * heading))
    return heading + error + rng.normal(0, np.deg2rad(0.2), len(t_s))


def doppler(rng, kind, vehicle):
    """Forward and starboard (n, 2) as measured, NaN where the floor is lost."""
    t_s, n = vehicle.t_s, len(vehicle.t_s)
    measured = vehicle.velocity_mps * (1 + rng.normal(0, 0.003)) + rng.normal(0, 0.004, 2)
    measured += np.stack([gauss_markov(rng, n, 0.004, 200) for _ in range(2)], -1)
    slow = np.stack([gauss_markov(rng, n, 1.0, 120) for _ in range(2)], -1)
    measured += kind.slow_velocity_mps * slow
    begin_s, to = rng.uniform(900, 1500), rng.uniform(0, 2 * np.pi)
    current = rng.uniform(0.12, 0.25) * np.array([np.sin(to), np.cos(to)])
    through = ((t_s > begin_s) & (t_s < begin_s + kind.water_track_s))[:, None] * current
    # Its own transpose: what turns the body's vectors to the ground's turns them back.
    measured -= rotated(through, vehicle.heading_rad)
    measured += rng.normal(0, 1, (n, 2)) * 0.008 * (1 + vehicle.velocity_mps[:, :1])
    measured = rotated(measured, np.full(n, np.pi / 2 - kind.mount_rad)) * [1, -1]
    for begin in rng.uniform(0, t_s[-1], rng.poisson(6)):
        measured[(t_s > begin) & (t_s < begin + rng.exponential(12))] = np.nan
    measured[t_s < kind.descent_s] = np.nan
    return measured.round(3)


def array(rng, kind, vehicle):
    """Positions (b, 3) of the beacons as stated and as they are; turn-arounds (b,) likewise."""
    n, to = kind.beacons, rng.uniform(0, 2 * np.pi)
    bearing = rng.uniform(0, 2 * np.pi) + np.arange(n) * 2 * np.pi / n + rng.normal(0, 0.25, n)
    away_m = rng.uniform(900, 2200)
    level = vehicle.enu_m[:, 2].mean() - rng.uniform(20, 150) + rng.uniform(5, 60, n)
    stated = np.column_stack(
        [
            away_m * np.cos(bearing) + kind.aside_m * np.cos(to),
            away_m * np.sin(bearing) + kind.aside_m * np.sin(to),
            level,
        ]
    )
    true = stated + rng.normal(0, kind.beacon_sigma_m, stated.shape)
    odd, side = rng.integers(n), rng.normal(size=2)
    true[odd, :2] += kind.one_beacon_m * side / np.linalg.norm(side)
    stated_s = 0.1 + 0.05 * np.arange(n)
    true_s = stated_s + rng.normal(0, 2e-4) + kind.turn_arounds_s
    true_s[odd] += kind.one_turn_around_s
    return stated, true, stated_s, true_s


def transducer(kind, vehicle, t_s):
    enu = np.array([np.interp(t_s, vehicle.t_s, column) for column in vehicle.enu_m.T])
    heading = np.interp(t_s, vehicle.t_s, vehicle.heading_rad)
    enu[:2] += rotated(np.array(kind.lever_m), heading)
    return enu


def slow_errors(rng, kind, ping_s):
    """What the beacons' times are wrong by (pings, b): two waves each, of 8 min to an hour."""
    if kind.slow_times_s == 0:  # dives of other kinds draw what they drew
        return np.zeros((len(ping_s), kind.beacons))
    each = (2, 1, kind.beacons)
    turns = ping_s[:, None] / rng.uniform(500, 3600, each) + rng.random(each)
    return kind.slow_times_s * np.sin(2 * np.pi * turns).sum(axis=0)


def interrogate(rng, kind, vehicle, true_m, turn_around_s, water):
    """Replies, some of them late by multipath, in spells, or wild."""
    replies, spell = Replies(), np.zeros(kind.beacons, bool)
    silent = rng.permutation(kind.beacons)[2:]
    pings_s = np.arange(rng.uniform(10, 30), kind.duration_s - 30, PING_S)
    slow_s = slow_errors(rng, kind, pings_s)
    for ping, ping_s in enumerate(pings_s):
        start = transducer(kind, vehicle, ping_s)
        for k in range(kind.beacons):
            spell[k] = rng.random() < (0.6 if spell[k] else 0.45 * kind.wrong_share)
            if rng.random() > kind.reply_share or (ping_s > kind.two_after_s and k in silent):
                continue
            place_m = true_m[k] + [kind.first_moved_m * (k == 0 and ping_s > 1500), 0, 0]
            there_s = back_s = water.flight_s(start, place_m)
            for _ in range(3):
                end = transducer(kind, vehicle, ping_s + there_s + turn_around_s[k] + back_s)
                back_s = water.flight_s(end, place_m)
            time_s = there_s + turn_around_s[k] + back_s + slow_s[ping, k]
            time_s += 0.0012 * rng.standard_t(5) * (1 + there_s / 4)
            dice = rng.random()
            if spell[k] and dice < 0.8:
                time_s += 0.004 + rng.exponential(0.03)
            elif dice > 1 - 0.3 * kind.wrong_share:
                time_s = rng.uniform(0.2, 8)
            replies.add(float(ping_s), ping, k, float(max(time_s, 0.01)))
    return replies


def stamp(t_s):
    seconds, nanoseconds = divmod(START_NS + round(float(t_s) * 1e9), 10**9)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": ""}


def point(xyz):
    return dict(zip("xyz", map(float, xyz), strict=True))


def orientation(heading_rad, t_s):
    """ENU/FLU quaternion of a vehicle that rolls and pitches a little."""
    yaw, roll, pitch = np.pi / 2 - heading_rad, 0.02 * np.sin(0.7 * t_s), -0.03 * np.sin(0.5 * t_s)
    (cy, cp, cr), (sy, sp, sr) = (
        [f(angle / 2) for angle in (yaw, pitch, roll)] for f in (np.cos, np.sin)
    )
    return {
        "w": cr * cp * cy + sr * sp * sy,
        "x": sr * cp * cy - cr * sp * sy,
        "y": cr * sp * cy + sr * cp * sy,
        "z": cr * cp * sy - sr * sp * cy,
    }


def beacon_messages(kind, stated_m, stated_s):
    origin = {"origin_latitude": 30.1, "origin_longitude": -20.2}
    beacons = [
        {
            "id": k + 1,
            "name": f"B{k + 1}",
            "position": point(stated_m[k]),
            "turn_around_time": float(stated_s[k]),
            "position_sigma": kind.stated_beacon_sigma_m,
        }
        for k in range(kind.beacons)
    ]
    yield 0.0, "/lbl/beacons", {"header": stamp(0), **origin, "beacons": beacons}


def profile_messages(rng, water):
    """A cast of another day: wrong a little, and in the upper water."""
    depth = np.linspace(0, 4000, 40)
    speed = water.at_height(-depth) + rng.normal(0, 0.15) + 0.3 * np.exp(-depth / 200)
    content = {"depth": depth.tolist(), "sound_speed": speed.tolist()}
    yield 0.0, "/sound_speed/profile", {"header": stamp(0), **content}


def sensor_messages(rng, vehicle, heading, velocity):
    no_turn, level = point(np.zeros(3)), {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    for t, angle in zip(vehicle.t_s[::2], heading[::2], strict=True):
        yield t, "/imu", {"header": stamp(t), "orientation": orientation(angle, t)}
    for t, (forward, starboard) in zip(vehicle.t_s[::3], velocity[::3].tolist(), strict=True):
        linear = {"x": forward, "y": -starboard, "z": 0.0}
        if np.isnan(forward):
            linear = dict.fromkeys("xyz", "NaN")
        twist = {"twist": {"linear": linear, "angular": no_turn}, "covariance": [0.0] * 36}
        yield t, "/dvl", {"header": stamp(t), "twist": twist}
    for t, enu in zip(vehicle.t_s[::10], vehicle.enu_m[::10], strict=True):
        yield t, "/depth", {"header": stamp(t), "depth": float(rng.normal(-enu[2], 0.15))}
        pose = {"pose": {"position": point(enu), "orientation": level}, "covariance": [0.0] * 36}
        yield t, "/reference", {"header": stamp(t), "pose": pose}


def reply_messages(replies):
    columns = (replies.ping_s, replies.ping_id, replies.beacon, replies.travel_time_s)
    for ping_s, ping, k, time_s in zip(*columns, strict=True):
        reply = {
            "header": stamp(ping_s + time_s),
            "ping_id": ping,
            "ping_time": stamp(ping_s)["stamp"],
            "beacon_id": k + 1,
            "travel_time": time_s,
            "snr": "NaN",
        }
        yield ping_s + time_s, "/lbl/travel_time", reply


def simulate(rng, kind):
    """Every (seconds, topic, message), sorted by time, and the sound speed where the vehicle is."""
    vehicle = drive(rng, kind)
    water = Water(rng.uniform(1440, 1480), rng.uniform(0.0155, 0.0175))
    stated_m, true_m, stated_s, true_s = array(rng, kind, vehicle)
    replies = interrogate(rng, kind, vehicle, true_m, true_s, water)
    heading, velocity = compass(rng, kind, vehicle), doppler(rng, kind, vehicle)
    rows = [*beacon_messages(kind, stated_m, stated_s)]
    rows += profile_messages(rng, water) if kind.profile else []
    rows += sensor_messages(rng, vehicle, heading, velocity)
    rows += reply_messages(replies)
    return sorted(rows, key=lambda row: row[0]), float(water.at_height(vehicle.enu_m[0, 2]))


def write_dive(folder: Path, name: str, seed: int, **changes) -> Path:
    """One log `<name>_<seed>.mcap` with its settings beside it; the same bytes for a seed."""
    kind = replace(KINDS[name], **changes)
    rng = np.random.default_rng([seed, *name.encode()])
    rows, speed_mps = simulate(rng, kind)
    path = folder / f"{name}_{seed}.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start("", "outside")
        channels = {}
        for topic, kind_name in TYPES.items():
            package, _, short = kind_name.partition("/msg/")
            content = (SCHEMAS / package / f"{short}.json").read_bytes()
            schema = writer.register_schema(kind_name, "jsonschema", content)
            channels[topic] = writer.register_channel(topic, "json", schema)
        for number, (t, topic, message) in enumerate(rows):
            ns = START_NS + round(float(t) * 1e9)
            writer.add_message(channels[topic], ns, json.dumps(message).encode(), ns, number)
        writer.finish()
    speed = "" if kind.profile else f"sound_speed_mps = {speed_mps:.3f}\n"
    settings = f"[acoustics]\n{speed}travel_time_sigma_s = 0.002\n"
    path.with_suffix(".toml").write_text(settings, encoding="utf-8")
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", default="1", help="numbers, by comma")
    parser.add_argument("--kinds", default=",".join(KINDS), help=", ".join(KINDS))
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    for name in asked.kinds.split(","):
        for seed in asked.seeds.split(","):
            print(write_dive(asked.folder, name, int(seed)).name)


if __name__ == "__main__":
    main()
