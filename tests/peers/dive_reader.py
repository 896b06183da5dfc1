# SPDX-License-Identifier: Apache-2.0
"""What any script needs first: an MCAP log in arrays, by mcap-ros2-support, pandas and NumPy.

Nothing of abyssnav is imported here or in the peers: this is what a user would write.  The topics
are those of the benchmark's logs; settings and start are the TOML files beside them.  As a program,
`python dive_reader.py LOG` keeps what it read beside the log, so that a comparison reads it once.
"""

import pickle
import sys
import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from peer_settings import POSITION_WALK_M2_PER_S
from scipy.spatial.transform import Rotation

#: The velocity is held where there is none, and off by this for as long: variance (σ age)².
GAP_SIGMA_MPS = 0.1
_TOPICS = (
    "/imu", "/dvl", "/depth", "/lbl/travel_time", "/lbl/beacons", "/sound_speed/profile",
    "/gnss/fix", "/usbl",
)  # fmt: skip


@dataclass
class DiveData:
    """One log; seconds since its first message, metres east, north, up of the origin."""

    start_ns: int
    t_s: Any  #: 10 Hz grid of what follows
    run_m: Any  #: (n, 2) displacement by DVL and compass since the grid's begin
    gap_m2: Any  #: running sum of what losses of the velocity add to the variance of each axis
    up_m: Any
    lever_m: Any  #: (n, 3) transducer from the vehicle, ENU
    replies: pd.DataFrame  #: ping_id, beacon_id, t_ping, t_reply, travel_time, in order received
    beacons: dict[int, tuple[Any, float, float]]  #: position, turn-around, sigma of its position
    sound: tuple[Any, Any]  #: depth and speed
    sound_sigma_mps: float
    travel_time_sigma_s: float
    fixes: list[tuple[float, Any, float]] = field(default_factory=list)  #: time, position, sigma
    start: tuple[float, Any, float] | None = None  #: time, position, sigma
    walk_m2_per_s: float = POSITION_WALK_M2_PER_S  #: of the position, besides `gap_m2`

    def interpolated(self, t_s: float, values: Any) -> Any:
        """Columns of the grid at one instant."""
        columns = np.atleast_2d(values.T)
        return np.array([np.interp(t_s, self.t_s, column) for column in columns])

    def place(self, t_s: float) -> Any:
        """Displacement east and north, and the transducer's place beside it, at one instant."""
        east, north = self.interpolated(t_s, self.run_m)
        return np.array([east, north, self.interpolated(t_s, self.up_m)[0]]) + self.interpolated(
            t_s, self.lever_m
        )

    def mean_speed(self, up_m: float, beacon_up_m: float) -> float:
        """Harmonic mean of the sound speed between two depths."""
        depth_m = np.linspace(-up_m, -beacon_up_m, 50)
        return float(1.0 / np.mean(1.0 / np.interp(depth_m, *self.sound)))


def _stamp(header: Any) -> int:
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def read_messages(path: Path) -> dict[str, list[Any]]:
    """Decoded messages by topic."""
    messages: dict[str, list[Any]] = {topic: [] for topic in _TOPICS}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(topics=list(_TOPICS)):
            messages[channel.topic].append(message)
    return messages


def load_settings(path: Path, start: bool) -> dict[str, Any]:
    """Tables of the TOML files beside a log."""
    tables: dict[str, Any] = {}
    suffixes = (".settings.toml", ".start.toml") if start else (".settings.toml",)
    for suffix in suffixes:
        beside = path.with_suffix(suffix)
        if beside.is_file():
            tables |= tomllib.loads(beside.read_text(encoding="utf-8"))
    return tables


def read_dive(path: Path, start: bool = True) -> DiveData:
    """A log as arrays, dead reckoning included; as `main` left it, where it did."""
    kept = path.with_suffix(".read")
    if kept.is_file():
        dive: DiveData = pickle.loads(kept.read_bytes())
        return dive if start else replace(dive, start=None)
    return parse_dive(path, start)


def parse_dive(path: Path, start: bool = True) -> DiveData:
    """A log as arrays, from its messages."""
    messages, settings = read_messages(path), load_settings(path, start)
    acoustics = settings.get("acoustics", {})
    lever = settings.get("vehicle", {}).get("transducer_offset_m", [0.0, 0.0, 0.0])
    grid = _grid(messages, lever)
    beacons = {}
    for beacon in messages["/lbl/beacons"][0].beacons:
        place = np.array([beacon.position.x, beacon.position.y, beacon.position.z])
        sigma = beacon.position_sigma or 0.5  # 0: the log does not say
        beacons[beacon.id] = (place, beacon.turn_around_time, sigma)
    profile = messages["/sound_speed/profile"]
    speed = acoustics.get("sound_speed_mps", 1500.0)
    sound = (np.array([0.0, 6000.0]), np.array([speed, speed]))
    if profile:
        sound = (np.array(profile[0].depth), np.array(profile[0].sound_speed))
    return DiveData(
        **grid,
        replies=_replies(messages["/lbl/travel_time"], grid["start_ns"]),
        beacons=beacons,
        sound=sound,
        sound_sigma_mps=1.0 if profile or "sound_speed_mps" in acoustics else 15.0,
        travel_time_sigma_s=acoustics.get("travel_time_sigma_s", 0.002),
        fixes=_fixes(messages, grid["start_ns"]),
        start=_start(settings, grid["start_ns"]),
    )


def _grid(messages: dict[str, list[Any]], lever: list[float]) -> dict[str, Any]:
    """Dead reckoning: velocity turned by the attitude, summed up."""
    imu_ns = np.array([_stamp(m.header) for m in messages["/imu"]])
    dvl_ns = np.array([_stamp(m.header) for m in messages["/dvl"]])
    depth_ns = np.array([_stamp(m.header) for m in messages["/depth"]])
    start_ns = int(min(imu_ns[0], dvl_ns[0], depth_ns[0]))
    end_s = (max(imu_ns[-1], dvl_ns[-1]) - start_ns) / 1e9
    t_s = np.arange(0.0, end_s + 0.1, 0.1)
    xyzw = np.array(
        [[m.orientation.x, m.orientation.y, m.orientation.z, m.orientation.w]
         for m in messages["/imu"]]
    )  # fmt: skip
    body = np.array(
        [[m.twist.twist.linear.x, m.twist.twist.linear.y, m.twist.twist.linear.z]
         for m in messages["/dvl"]]
    )  # fmt: skip
    valid = np.isfinite(body).all(axis=1)
    imu_s, dvl_s = (imu_ns - start_ns) / 1e9, (dvl_ns - start_ns) / 1e9
    nearest = np.clip(np.searchsorted(imu_s, t_s), 0, len(imu_s) - 1)
    attitude = Rotation.from_quat(xyzw[nearest])
    last = np.clip(np.searchsorted(dvl_s[valid], t_s, side="right") - 1, 0, None)
    velocity = attitude.apply(body[valid][last])[:, :2]
    steps = 0.1 * 0.5 * (velocity[1:] + velocity[:-1])
    age_s = t_s - dvl_s[valid][last]
    growth = np.diff((GAP_SIGMA_MPS * np.where(age_s > 1.0, age_s, 0.0)) ** 2, prepend=0.0)
    depth = [m.depth for m in messages["/depth"]]
    return {
        "start_ns": start_ns,
        "t_s": t_s,
        "run_m": np.vstack([np.zeros(2), np.cumsum(steps, axis=0)]),
        "gap_m2": np.cumsum(np.maximum(growth, 0.0)),
        "up_m": -np.interp(t_s, (depth_ns - start_ns) / 1e9, depth),
        "lever_m": attitude.apply([lever[0], -lever[1], -lever[2]]),
    }


def _replies(messages: list[Any], start_ns: int) -> pd.DataFrame:
    rows = [
        {
            "ping_id": m.ping_id,
            "beacon_id": m.beacon_id,
            "t_ping": (m.ping_time.sec * 10**9 + m.ping_time.nanosec - start_ns) / 1e9,
            "t_reply": (_stamp(m.header) - start_ns) / 1e9,
            "travel_time": m.travel_time,
        }
        for m in messages
    ]
    return pd.DataFrame(rows).sort_values("t_reply", kind="stable").reset_index(drop=True)


def _fixes(messages: dict[str, list[Any]], start_ns: int) -> list[tuple[float, Any, float]]:
    """GNSS and USBL as east and north, with the sigma that they state."""
    rows = []
    for m in messages["/usbl"]:
        place = np.array([m.pose.pose.position.x, m.pose.pose.position.y])
        rows.append(((_stamp(m.header) - start_ns) / 1e9, place, m.pose.covariance[0] ** 0.5))
    origin = messages["/lbl/beacons"][0]
    latitude = np.radians(origin.origin_latitude)
    flat = 1.0 - 0.00669437999 * np.sin(latitude) ** 2  # WGS 84, near the origin
    across_m = 6378137.0 / flat**0.5
    along_m = 6378137.0 * (1.0 - 0.00669437999) / flat**1.5
    for m in messages["/gnss/fix"]:
        east = np.radians(m.longitude - origin.origin_longitude) * np.cos(latitude) * across_m
        north = np.radians(m.latitude - origin.origin_latitude) * along_m
        t_s = (_stamp(m.header) - start_ns) / 1e9
        rows.append((t_s, np.array([east, north]), m.position_covariance[0] ** 0.5))
    return sorted(rows, key=lambda row: row[0])


def _start(settings: dict[str, Any], start_ns: int) -> tuple[float, Any, float] | None:
    start = settings.get("start")
    if start is None:
        return None
    t_s = start["at"].timestamp() - start_ns / 1e9
    return float(t_s), np.array(start["position_m"]), float(start["sigma_m"])


def write_track(path: Path, dive: DiveData, track: pd.DataFrame, decisions: pd.DataFrame) -> None:
    """A track as `abyssnav score` takes it, and what became of each reply."""
    track = track.assign(time=dive.start_ns + (track.pop("t") * 1e9).round().astype("int64"))
    track.to_csv(path, index=False)
    decisions.to_csv(path.with_suffix(".decisions.csv"), index=False)


def main() -> None:
    from dive_reader import parse_dive  # not of __main__, or no other program could load it

    path = Path(sys.argv[1])
    path.with_suffix(".read").write_bytes(pickle.dumps(parse_dive(path)))


if __name__ == "__main__":
    main()
