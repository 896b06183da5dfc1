# SPDX-License-Identifier: Apache-2.0
"""Simulated dive -> log of the contract, in memory or in MCAP."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.formats.mcap_writer import Channel, ros2_channel, write_mcap
from pipeline.simulate.dive import Simulation, roles
from pipeline.tables import Columns, Float, Log

# Stated where nothing is estimated, so that no reader takes 0 for certainty.
_UNKNOWN_VARIANCE = 1e6

_TOPICS = {
    "heading": ("/imu", "sensor_msgs/msg/Imu"),
    "velocity": ("/dvl", "geometry_msgs/msg/TwistWithCovarianceStamped"),
    "depth": ("/depth", "abyssnav_msgs/msg/Depth"),
    "travel_time": ("/lbl/travel_time", "abyssnav_msgs/msg/TravelTime"),
    "beacons": ("/lbl/beacons", "abyssnav_msgs/msg/BeaconArray"),
    "sound_speed": ("/sound_speed/profile", "abyssnav_msgs/msg/SoundSpeedProfile"),
    "reference": ("/reference", "nav_msgs/msg/Odometry"),
}


def to_log(simulation: Simulation, name: str = "simulated") -> Log:
    """Dive as `pipeline.read` would give it back from its file, without one."""
    columns = roles(simulation)
    topics = {role: _TOPICS[role][0] for role in columns}
    return Log(name=name, inputs=(), profile="default", topics=topics, roles=columns)


def write_log(simulation: Simulation, path: Path, compression: str = "zstd") -> None:
    """Write the dive as ROS 2 messages on the default profile's topics.

    Parameters
    ----------
    compression : zstd, lz4 or '' for none
    """
    messages = {
        "heading": _imu,
        "velocity": _twist,
        "depth": _depth,
        "travel_time": _travel_time,
        "beacons": _beacon_array,
        "sound_speed": _sound_speed_profile,
        "reference": _odometry,
    }
    channels: list[Channel] = []
    for role, columns in roles(simulation).items():
        fields = messages[role](simulation, columns)
        stamps = np.atleast_1d(fields["header.stamp"])
        channels.append(ros2_channel(*_TOPICS[role], stamps, fields))
    write_mcap(path, channels, compression)


def _imu(simulation: Simulation, columns: Columns) -> Mapping[str, Any]:
    compass = simulation.scenario.compass
    x, y, z, w = _quaternion(columns["roll_rad"], columns["pitch_rad"], columns["heading_rad"])
    tilt = np.radians(compass.tilt_sigma_deg) ** 2
    heading = np.radians(np.hypot(compass.bias_sigma_deg, compass.white_sigma_deg)) ** 2
    return {
        "header.stamp": columns["time_ns"],
        "header.frame_id": "base_link",
        "orientation.x": x,
        "orientation.y": y,
        "orientation.z": z,
        "orientation.w": w,
        "orientation_covariance": np.diag([tilt, tilt, heading]).ravel(),
        # -1 in the first place: the compass measures no rates and no accelerations.
        "angular_velocity_covariance": np.eye(1, 9)[0] * -1,
        "linear_acceleration_covariance": np.eye(1, 9)[0] * -1,
    }


def _twist(simulation: Simulation, columns: Columns) -> Mapping[str, Any]:
    forward, starboard, down = columns["velocity_body_mps"].T
    variance = np.hypot(simulation.scenario.dvl.white_sigma_mps, 0.001) ** 2
    return {
        "header.stamp": columns["time_ns"],
        "header.frame_id": "base_link",
        "twist.twist.linear.x": forward,
        "twist.twist.linear.y": -starboard,
        "twist.twist.linear.z": -down,
        "twist.covariance": np.diag([variance] * 3 + [_UNKNOWN_VARIANCE] * 3).ravel(),
    }


def _depth(_: Simulation, columns: Columns) -> Mapping[str, Any]:
    return {
        "header.stamp": columns["time_ns"],
        "header.frame_id": "base_link",
        "depth": columns["depth_m"],
    }


def _travel_time(_: Simulation, columns: Columns) -> Mapping[str, Any]:
    return {
        "header.stamp": columns["time_ns"],
        "header.frame_id": "base_link",
        "ping_id": columns["ping_id"],
        "ping_time": columns["ping_time_ns"],
        "beacon_id": columns["beacon_id"],
        "travel_time": columns["travel_time_s"],
        "snr": columns["snr_db"],
    }


def _beacon_array(_: Simulation, columns: Columns) -> Mapping[str, Any]:
    east, north, up = columns["position_enu_m"].T
    return {
        "header.stamp": columns["time_ns"][:1],
        "header.frame_id": "map",
        "origin_latitude": columns["origin_latitude_deg"][:1],
        "origin_longitude": columns["origin_longitude_deg"][:1],
        "beacons.id": columns["id"][None, :],
        "beacons.name": [columns["name"].tolist()],
        "beacons.position.x": east[None, :],
        "beacons.position.y": north[None, :],
        "beacons.position.z": up[None, :],
        "beacons.turn_around_time": columns["turn_around_s"][None, :],
        "beacons.position_sigma": columns["sigma_m"][None, :],
    }


def _sound_speed_profile(_: Simulation, columns: Columns) -> Mapping[str, Any]:
    return {
        "header.stamp": columns["time_ns"][:1],
        "header.frame_id": "map",
        "depth": columns["depth_m"][None, :],
        "sound_speed": columns["sound_speed_mps"][None, :],
    }


def _odometry(_: Simulation, columns: Columns) -> Mapping[str, Any]:
    east, north, up = columns["position_enu_m"].T
    unknown = np.full(3, _UNKNOWN_VARIANCE)
    return {
        "header.stamp": columns["time_ns"],
        "header.frame_id": "map",
        "child_frame_id": "base_link",
        "pose.pose.position.x": east,
        "pose.pose.position.y": north,
        "pose.pose.position.z": up,
        "pose.pose.orientation.w": 1.0,
        "pose.covariance": np.diag(np.concatenate([np.full(3, 1e-6), unknown])).ravel(),
        "twist.covariance": np.diag(np.concatenate([unknown, unknown])).ravel(),
    }


def _quaternion(roll_rad: Float, pitch_rad: Float, heading_rad: Float) -> tuple[Float, ...]:
    """Orientation (x, y, z, w) of forward-port-up in ENU (REP-103).

    Roll is the same about the forward axis, pitch turns round with the port axis, and
    yaw = π/2 - heading.
    """
    half_roll, half_pitch = 0.5 * roll_rad, -0.5 * pitch_rad
    half_yaw = 0.5 * (0.5 * np.pi - heading_rad)
    sin_roll, cos_roll = np.sin(half_roll), np.cos(half_roll)
    sin_pitch, cos_pitch = np.sin(half_pitch), np.cos(half_pitch)
    sin_yaw, cos_yaw = np.sin(half_yaw), np.cos(half_yaw)
    return (
        sin_roll * cos_pitch * cos_yaw - cos_roll * sin_pitch * sin_yaw,
        cos_roll * sin_pitch * cos_yaw + sin_roll * cos_pitch * sin_yaw,
        cos_roll * cos_pitch * sin_yaw - sin_roll * sin_pitch * cos_yaw,
        cos_roll * cos_pitch * cos_yaw + sin_roll * sin_pitch * sin_yaw,
    )
