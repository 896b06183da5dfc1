# SPDX-License-Identifier: Apache-2.0
"""A solution as ROS 2 messages: `solution.mcap` for Foxglove, rviz and `ros2 bag`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from abyssnav.formats.mcap.writer import Channel, ros2_channel, write_mcap
from abyssnav.tables import (
    ARRIVALS,
    DECISIONS,
    Beacons,
    Dive,
    Fixes,
    Float,
    GateStatistics,
    Innovations,
    Int,
    Solution,
    Track,
)

#: Variance of what a method does not estimate: height, attitude, velocity.  Zero would mean sure.
NOT_ESTIMATED: Final = 1e6
_MAP_PERIOD_S: Final = 10.0
_COVARIANCE_KNOWN: Final = 3  # sensor_msgs/NavSatFix.COVARIANCE_TYPE_KNOWN


def write_messages(
    solution: Solution, geodetic: Mapping[str, tuple[Float, Float]], path: Path
) -> None:
    """One MCAP file, profile ros2, encoding CDR: tracks, fixes, innovations, statistics, beacons.

    Parameters
    ----------
    geodetic : method -> latitude and longitude in degrees of its track; used when there is an
        origin
    """
    dive = solution.dive
    channels = [_beacons(dive), _fixes(solution.fixes, dive.start_ns)]
    for method, track in sorted(solution.tracks.items()):
        time_ns = _utc_ns(dive.start_ns, track.t_s)
        channels.append(_odometry(method, track, time_ns))
        if dive.origin is not None:
            some = _for_a_map(track)
            channels.append(
                _navsatfix(method, track[some], time_ns[some], *(c[some] for c in geodetic[method]))
            )
    for method, innovations in sorted(solution.innovations.items()):
        channels.append(_innovation(method, innovations, dive.start_ns))
    last_ns = _utc_ns(dive.start_ns, np.append(0.0, dive.replies.t_reply_s)[-1:])
    for method, statistics in sorted(solution.statistics.items()):
        channels.append(_statistics(method, statistics, last_ns))
    write_mcap(path, channels, level=-1)


def _for_a_map(track: Track) -> slice:
    """Rows of a track that a map shows: one in ten seconds, which halves a day's file."""
    period_s = float(np.median(np.diff(track.t_s))) if len(track) > 1 else _MAP_PERIOD_S
    return slice(None, None, max(1, round(_MAP_PERIOD_S / period_s)))


def _odometry(method: str, track: Track, time_ns: Int) -> Channel:
    enu_m = track.position_enu_m
    columns: dict[str, Any] = {
        "header.stamp": time_ns,
        "header.frame_id": "map",
        "child_frame_id": "base_link",
        "pose.pose.position.x": enu_m[:, 0],
        "pose.pose.position.y": enu_m[:, 1],
        "pose.pose.position.z": enu_m[:, 2],
        **_yaw(track.heading_rad, "pose.pose.orientation"),
        **_pose_covariance(track.position_cov_m2),
        "twist.covariance": NOT_ESTIMATED * np.eye(6).ravel(),
    }
    return ros2_channel(f"/abyssnav/{method}/odometry", "nav_msgs/msg/Odometry", time_ns, columns)


def _navsatfix(
    method: str, track: Track, time_ns: Int, latitude_deg: Float, longitude_deg: Float
) -> Channel:
    columns: dict[str, Any] = {
        "header.stamp": time_ns,
        "header.frame_id": "base_link",
        "latitude": latitude_deg,
        "longitude": longitude_deg,
        "altitude": track.position_enu_m[:, 2],
        "position_covariance": NOT_ESTIMATED * np.diag([0.0, 0.0, 1.0]).ravel(),
        **_horizontal(track.position_cov_m2, "position_covariance", 3),
        "position_covariance_type": _COVARIANCE_KNOWN,
    }
    return ros2_channel(
        f"/abyssnav/{method}/navsatfix", "sensor_msgs/msg/NavSatFix", time_ns, columns
    )


def _fixes(fixes: Fixes, start_ns: int) -> Channel:
    time_ns, enu_m = _utc_ns(start_ns, fixes.t_s), fixes.position_enu_m
    columns: dict[str, Any] = {
        "header.stamp": time_ns,
        "header.frame_id": "map",
        "pose.pose.position.x": enu_m[:, 0],
        "pose.pose.position.y": enu_m[:, 1],
        "pose.pose.position.z": enu_m[:, 2],
        "pose.pose.orientation.w": 1.0,
        **_pose_covariance(fixes.position_cov_m2),
    }
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    return ros2_channel("/abyssnav/fix", kind, time_ns, columns)


def _innovation(method: str, innovations: Innovations, start_ns: int) -> Channel:
    time_ns = _utc_ns(start_ns, innovations.t_reply_s)
    columns: dict[str, Any] = {
        "header.stamp": time_ns,
        "header.frame_id": "map",
        "ping_id": innovations.ping_id,
        "ping_time": _utc_ns(start_ns, innovations.t_ping_s),
        "beacon_id": innovations.beacon_id,
        "travel_time": innovations.travel_time_s,
        "predicted": innovations.predicted_s,
        "innovation": innovations.innovation_s,
        "innovation_sigma": innovations.innovation_sigma_s,
        "nis": innovations.nis,
        "accepted": innovations.decision == DECISIONS.index("accepted"),
        "decision": np.array(DECISIONS)[innovations.decision],
        "arrival": np.array(ARRIVALS)[innovations.arrival],
    }
    kind = "abyssnav_msgs/msg/TravelTimeInnovation"
    return ros2_channel(f"/abyssnav/{method}/innovation", kind, time_ns, columns)


def _statistics(method: str, statistics: GateStatistics, time_ns: Int) -> Channel:
    columns: dict[str, Any] = {"header.stamp": time_ns, "header.frame_id": "map", "method": method}
    for name, values in statistics.columns().items():
        columns[f"beacons.{name.removesuffix('_m')}"] = values[None, :]
    kind = "abyssnav_msgs/msg/GateStatistics"
    return ros2_channel(f"/abyssnav/{method}/statistics", kind, time_ns, columns)


def _beacons(dive: Dive) -> Channel:
    beacons: Beacons = dive.beacons
    time_ns = np.array([dive.start_ns], dtype=np.int64)
    columns: dict[str, Any] = {
        "header.stamp": time_ns,
        "header.frame_id": "map",
        "origin_latitude": dive.origin.latitude_deg if dive.origin else np.nan,
        "origin_longitude": dive.origin.longitude_deg if dive.origin else np.nan,
        "beacons.id": beacons.id[None, :],
        "beacons.name": [beacons.name.tolist()],
        "beacons.position.x": beacons.position_enu_m[None, :, 0],
        "beacons.position.y": beacons.position_enu_m[None, :, 1],
        "beacons.position.z": beacons.position_enu_m[None, :, 2],
        "beacons.turn_around_time": beacons.turn_around_s[None, :],
        "beacons.position_sigma": beacons.sigma_m[None, :],
    }
    return ros2_channel("/lbl/beacons", "abyssnav_msgs/msg/BeaconArray", time_ns, columns)


def _pose_covariance(cov_m2: Float) -> dict[str, Float]:
    """Row-major 6 x 6 of x, y, z and rotations, from the horizontal 2 x 2."""
    not_estimated = NOT_ESTIMATED * np.diag([0.0, 0.0, 1.0, 1.0, 1.0, 1.0]).ravel()
    return {"pose.covariance": not_estimated, **_horizontal(cov_m2, "pose.covariance", 6)}


def _horizontal(cov_m2: Float, path: str, size: int) -> dict[str, Float]:
    """The four elements of a row-major covariance that a method estimates."""
    places = {(0, 0): 0, (0, 1): 1, (1, 0): size, (1, 1): size + 1}
    return {f"{path}[{k}]": cov_m2[:, row, column] for (row, column), k in places.items()}


def _yaw(heading_rad: Float, path: str) -> dict[str, Float]:
    """Quaternion of yaw = π/2 - heading, counter-clockwise from east."""
    half_rad = 0.5 * (0.5 * np.pi - heading_rad)
    return {f"{path}.z": np.sin(half_rad), f"{path}.w": np.cos(half_rad)}


def _utc_ns(start_ns: int, t_s: Float) -> Int:
    return start_ns + np.rint(t_s * 1e9).astype(np.int64)
