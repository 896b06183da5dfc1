# SPDX-License-Identifier: Apache-2.0
"""A published survey, fetched when asked for and turned into a log of the contract.

SAGA.1903.kaiyo_k4: a ship of the Japan Coast Guard over four transponders at 1,340 m; 3,614 two-way
times in 6.2 h, GNSS to the centimetre.  It comes inside a package of the registry, is checked
against its SHA-256 and kept in a cache outside the checkout; nothing of it is part of this project.

What was recorded and what was made of it:

- The navigated point is the GNSS antenna, some 15 m above the sea: its depth is negative, and the
  transducer hangs 23.7 m below it (`vehicle.transducer_offset_m`).
- Positions are given at each ping and each reply only.  Velocity is the derivative of a monotone
  cubic through all of them (straight where there is none for 20 s or more), plus white noise; over
  any ping its integral is the recorded displacement.
- The travel time is reply minus ping as recorded, so it holds the beacons' turn-around.
- `/reference` holds the recorded positions, at their own instants.

`--noisier` makes it as hard as a vehicle's dive: velocity with 3 cm/s of white noise and a slow
error of 1 cm/s (120 s) along each of the body's axes, beacons stated to 3 m.
"""

import argparse
import configparser
import hashlib
import os
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.interpolate import PchipInterpolator
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from abyssnav.formats.mcap.writer import ros2_channel, write_mcap

PACKAGE = "es-sfgtools==0.1.1a1.dev1"
SHA256 = "bec4092e012b1e9a50bb7618ceaca1cdac7df25647ab8b595690c32159142c8c"
SURVEY = "tests/resources/garpos_run/SAGA.1903.kaiyo_k4-"
DAY_NS = int(np.datetime64("2019-03-15", "ns").astype(np.int64))
LATITUDE_DEG, LONGITUDE_DEG = 34.96166667, 139.26333333
TURN_AROUND_S = 1.061507  # mean of RT - ST - TT, which varies by 2 µs

SETTINGS = """\
[acoustics]
travel_time_sigma_s = 0.001

[vehicle]
transducer_offset_m = [1.5547, -1.2690, 23.7295]
"""


class Conversion(NamedTuple):
    """What is added to the survey's own velocity, and what is stated of its beacons."""

    white_mps: float = 0.02
    slow_mps: float = 0.0  #: Gauss-Markov, along each of the body's axes
    slow_time_s: float = 120.0
    beacon_sigma_m: float = 0.0  #: 0: not stated


PLAIN, NOISIER = Conversion(), Conversion(0.03, 0.01, 120.0, 3.0)


class UnavailableError(Exception):
    """The survey cannot be had here, and why."""


def cache() -> Path:
    """Folder for what was fetched, outside the checkout."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "abyssnav"


def survey() -> Path:
    """Folder with the survey's three files, fetched once.

    Raises
    ------
    UnavailableError
        The registry cannot be reached, or the package is not the one that was studied.
    """
    folder = cache() / "saga-1903"
    if not folder.is_dir():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent) as place:
            fresh = Path(place) / "fresh"
            fresh.mkdir()
            _unpack(_download(Path(place)), fresh)
            fresh.rename(folder)
    return folder


def _download(place: Path) -> Path:
    name = PACKAGE.split("==", maxsplit=1)[0]
    pip = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-binary", name]
    ended = subprocess.run(
        [*pip, PACKAGE, "--dest", str(place)], check=False, capture_output=True, text=True
    )
    found = list(place.glob("*.tar.gz"))
    if ended.returncode or len(found) != 1:
        lines = [line for line in ended.stderr.splitlines() if line.startswith("ERROR")]
        raise UnavailableError(f"{PACKAGE} cannot be fetched: {(lines or ['no network?'])[-1]}")
    digest = hashlib.sha256(found[0].read_bytes()).hexdigest()
    if digest != SHA256:
        raise UnavailableError(f"{PACKAGE} has SHA-256 {digest}, not {SHA256}")
    return found[0]


def _unpack(archive: Path, folder: Path) -> None:
    with tarfile.open(archive) as package:
        for member in package.getmembers():
            _, _, inside = member.name.partition("/")
            if inside.startswith(SURVEY):
                content = package.extractfile(member)
                assert content is not None
                name = inside.removeprefix(SURVEY)
                (folder / name).write_bytes(content.read())


def write_survey_log(
    path: Path, outliers: float = 0.0, seed: int = 1903, conversion: Conversion = PLAIN
) -> None:
    """Write the survey as an MCAP log of the default profile.

    Parameters
    ----------
    outliers : share of the travel times that come 5-300 ms late or early, as drawn with `seed`
    """
    folder = survey()
    shots = pd.read_csv(folder / "obs.csv").sort_values("RT", kind="stable")
    generator = np.random.default_rng(seed)
    ship = _ship(shots, generator, conversion)
    channels = {
        ("/imu", "sensor_msgs/msg/Imu"): _imu(ship),
        ("/dvl", "geometry_msgs/msg/TwistWithCovarianceStamped"): _velocity(ship),
        ("/depth", "abyssnav_msgs/msg/Depth"): {
            "header.stamp": ship["time_ns"],
            "depth": -ship["enu_m"][:, 2],
        },
        ("/lbl/travel_time", "abyssnav_msgs/msg/TravelTime"): _replies(shots, outliers, generator),
        ("/lbl/beacons", "abyssnav_msgs/msg/BeaconArray"): _beacons(
            folder, ship["time_ns"][:1], conversion.beacon_sigma_m
        ),
        ("/sound_speed/profile", "abyssnav_msgs/msg/SoundSpeedProfile"): _sound_speed(
            folder, ship["time_ns"][:1]
        ),
        ("/reference", "nav_msgs/msg/Odometry"): _reference(shots),
    }
    write_mcap(
        path,
        [
            ros2_channel(topic, kind, np.atleast_1d(fields["header.stamp"]), dict(fields))
            for (topic, kind), fields in channels.items()
        ],
    )


def _epochs(shots: pd.DataFrame) -> tuple[Any, Any, Any]:
    """Every instant with a position: time of day, ENU of the antenna, unwrapped attitude."""
    both = [
        shots[["ST", "ant_e0", "ant_n0", "ant_u0", "roll0", "pitch0", "head0"]].to_numpy(),
        shots[["RT", "ant_e1", "ant_n1", "ant_u1", "roll1", "pitch1", "head1"]].to_numpy(),
    ]
    rows = np.concatenate(both)
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    return rows[:, 0], rows[:, 1:4], np.unwrap(np.radians(rows[:, 4:]), axis=0)


def _ship(
    shots: pd.DataFrame,
    generator: np.random.Generator,
    conversion: Conversion,
    rate_hz: float = 5.0,
) -> Any:
    """Position, velocity and attitude on an even grid that spans the survey."""
    t_s, enu_m, attitude_rad = _epochs(shots)
    grid_s = np.arange(np.floor(t_s[0]) - 1.0, t_s[-1] + 1.0, 1.0 / rate_hz)
    silent = np.flatnonzero(np.diff(t_s) > 20.0)
    extra_s = np.concatenate([np.arange(t_s[i] + 5.0, t_s[i + 1] - 4.0, 5.0) for i in silent])
    straight = [np.interp(extra_s, t_s, column) for column in enu_m.T]
    knots_s = np.concatenate([t_s, extra_s])
    order = np.argsort(knots_s)
    knots_m = np.concatenate([enu_m, np.stack(straight, axis=-1)])[order]
    track = PchipInterpolator(knots_s[order], knots_m, axis=0)
    inside_s = np.clip(grid_s, t_s[0], t_s[-1])
    velocity_mps = track.derivative()(inside_s)
    velocity_mps += generator.normal(0.0, conversion.white_mps, velocity_mps.shape)
    fade = np.exp(-1 / (rate_hz * conversion.slow_time_s))
    kicks = generator.normal(0.0, conversion.slow_mps, velocity_mps.shape)
    kicks[1:] *= np.sqrt(1 - fade**2)
    return {
        "time_ns": DAY_NS + np.round(grid_s * 1e9).astype(np.int64),
        "enu_m": track(inside_s),
        "velocity_enu_mps": velocity_mps,
        "slow_flu_mps": lfilter([1.0], [1.0, -fade], kicks, axis=0),
        "attitude_rad": np.stack(
            [np.interp(grid_s, t_s, column) for column in attitude_rad.T], axis=-1
        ),
    }


def _enu_flu(attitude_rad: Any) -> Rotation:
    """Rotation of forward-port-up into ENU, from roll, pitch and heading of the survey."""
    roll, pitch, heading = attitude_rad.T
    angles = np.stack([0.5 * np.pi - heading, -pitch, roll], axis=-1)
    return Rotation.from_euler("ZYX", angles)


def _imu(ship: Any) -> Mapping[str, Any]:
    quaternion = _enu_flu(ship["attitude_rad"]).as_quat()
    axes = ("x", "y", "z", "w")
    return {"header.stamp": ship["time_ns"], "header.frame_id": "antenna"} | {
        f"orientation.{axis}": quaternion[:, place] for place, axis in enumerate(axes)
    }


def _velocity(ship: Any) -> Mapping[str, Any]:
    velocity_flu_mps = _enu_flu(ship["attitude_rad"]).apply(ship["velocity_enu_mps"], inverse=True)
    velocity_flu_mps += ship["slow_flu_mps"]
    return {"header.stamp": ship["time_ns"], "header.frame_id": "antenna"} | {
        f"twist.twist.linear.{axis}": velocity_flu_mps[:, place]
        for place, axis in enumerate(("x", "y", "z"))
    }


def _replies(
    shots: pd.DataFrame, outliers: float, generator: np.random.Generator
) -> Mapping[str, Any]:
    ping_ns = np.round(shots["ST"].to_numpy() * 1e9).astype(np.int64)
    reply_ns = np.round(shots["RT"].to_numpy() * 1e9).astype(np.int64)
    n = len(shots)
    wrong = generator.random(n) < outliers
    late_s = generator.uniform(0.005, 0.3, n) * generator.choice([-1.0, 1.0], n)
    # The stamp moves with the time: the sonar would have heard the reply then.
    late_ns = np.where(wrong, np.round(late_s * 1e9), 0.0).astype(np.int64)
    return {
        "header.stamp": DAY_NS + reply_ns + late_ns,
        "ping_id": np.argsort(np.argsort(ping_ns, kind="stable")),
        "ping_time": DAY_NS + ping_ns,
        "beacon_id": shots["MT"].str[1:].astype(int).to_numpy(),
        "travel_time": (reply_ns + late_ns - ping_ns) / 1e9,
        "snr": np.full(n, np.nan),
    }


def _beacons(folder: Path, stamp_ns: Any, sigma_m: float) -> Mapping[str, Any]:
    listed = configparser.ConfigParser()
    listed.read(folder / "initcfg.ini")
    site = listed["Model-parameter"]
    names = listed["Site-parameter"]["Stations"].split()
    enu_m = np.array([[float(v) for v in site[f"{name}_dPos"].split()[:3]] for name in names])
    return {
        "header.stamp": stamp_ns,
        "origin_latitude": LATITUDE_DEG,
        "origin_longitude": LONGITUDE_DEG,
        "beacons.id": np.array([[int(name[1:]) for name in names]]),
        "beacons.name": [names],
        "beacons.position.x": enu_m[None, :, 0],
        "beacons.position.y": enu_m[None, :, 1],
        "beacons.position.z": enu_m[None, :, 2],
        "beacons.turn_around_time": np.full((1, len(names)), TURN_AROUND_S),
        "beacons.position_sigma": np.full((1, len(names)), sigma_m),
    }


def _sound_speed(folder: Path, stamp_ns: Any) -> Mapping[str, Any]:
    cast = pd.read_csv(folder / "svp.csv")
    return {
        "header.stamp": stamp_ns,
        "depth": cast["depth"].to_numpy()[None, :],
        "sound_speed": cast["speed"].to_numpy()[None, :],
    }


def _reference(shots: pd.DataFrame) -> Mapping[str, Any]:
    t_s, enu_m, _ = _epochs(shots)
    return {
        "header.stamp": DAY_NS + np.round(t_s * 1e9).astype(np.int64),
        "header.frame_id": "map",
        "pose.pose.orientation.w": 1.0,
    } | {f"pose.pose.position.{axis}": enu_m[:, place] for place, axis in enumerate("xyz")}


def main() -> None:
    """Fetch, convert and run; the results lie in out/saga_1903 or out/saga_1903_noisier."""
    from abyssnav.cli import app

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--noisier", action="store_true", help="with the errors of a vehicle's dive"
    )
    noisier = parser.parse_args().noisier
    name = "saga_1903_noisier" if noisier else "saga_1903"

    try:
        survey()
    except UnavailableError as reason:
        sys.exit(f"no real log: {reason}")
    folder = cache() / "logs"
    folder.mkdir(exist_ok=True)
    log, settings = folder / f"{name}.mcap", folder / f"{name}.toml"
    write_survey_log(log, conversion=NOISIER if noisier else PLAIN)
    settings.write_text(SETTINGS, encoding="utf-8")
    app(["run", str(log), "--config", str(settings)])


if __name__ == "__main__":
    main()
