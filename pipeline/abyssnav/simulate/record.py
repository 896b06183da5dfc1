# SPDX-License-Identifier: Apache-2.0
"""Simulated dive -> log of the contract, in memory or in MCAP."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from abyssnav.formats.mcap.writer import Channel, ros2_channel, write_mcap
from abyssnav.geometry import enu_to_geodetic
from abyssnav.profile import Role, TravelTimeRole, load_profile, quantities
from abyssnav.simulate.dive import Simulation, roles
from abyssnav.simulate.scenario import Scenario
from abyssnav.tables import Columns, Float, Log

_PROFILE = "default"
#: Topics of position fixes; the default profile leaves them to others.
_POSITION_TOPICS = {"gnss": "/gnss/fix", "usbl": "/usbl"}
# Stated where nothing is estimated, so that no reader takes 0 for certainty.
_UNKNOWN_VARIANCE = 1e6
# REP-145: -1 in the first place says that this is not measured at all.
_NOT_MEASURED = np.append(-1.0, np.zeros(8))


def to_log(simulation: Simulation, name: str = "simulated") -> Log:
    """Dive as `abyssnav.read` would give it back from its file, without one.

    Its position fixes are there as a profile with both their topics would read them.
    """
    specs, columns = load_profile(_PROFILE).roles(), dict(roles(simulation))
    topics = {role: specs[role].where for role in columns}
    if simulation.positions:
        columns["position"] = _position_columns(simulation)
        topics["position"] = ", ".join(_POSITION_TOPICS[kind] for kind in simulation.positions)
    return Log(name=name, inputs=(), profile=_PROFILE, topics=topics, roles=columns)


def _position_columns(simulation: Simulation) -> Columns:
    """Fixes of all kinds by their time."""
    kinds = simulation.positions.values()
    t_s = np.concatenate([fixes.t_s for fixes in kinds])
    order = np.argsort(t_s, kind="stable")
    variance_m2 = np.concatenate([fixes.sigma_m for fixes in kinds])[order] ** 2
    position_m = np.concatenate([fixes.position_enu_m[:, :2] for fixes in kinds])
    return {
        "time_ns": simulation.start_ns + np.round(t_s[order] * 1e9).astype(np.int64),
        "position_enu_m": position_m[order],
        "cov_m2": variance_m2[:, None, None] * np.eye(2),
    }


def write_log(simulation: Simulation, path: Path, compression: str = "zstd") -> None:
    """Write the dive as ROS 2 messages, on the topics and in the fields of the default profile.

    Parameters
    ----------
    compression : zstd, lz4 or '' for none
    """
    specs = load_profile(_PROFILE).roles()
    channels: list[Channel] = []
    for role, columns in roles(simulation).items():
        spec = specs[role]
        stamps = columns["time_ns"]
        if "message" in columns:  # with a row a beacon or level
            stamps = stamps[np.flatnonzero(np.diff(columns["message"], prepend=-1))]
        paths = _paths(spec)
        fields = {paths[name]: values for name, values in _VALUES[role](columns).items()}
        fields |= {str(spec.time): stamps, **_surroundings(role, simulation.scenario)}
        channels.append(ros2_channel(spec.where, spec.type, stamps, fields))
    channels += [_position_channel(simulation, kind) for kind in simulation.positions]
    write_mcap(path, channels, compression)


def _position_channel(simulation: Simulation, kind: str) -> Channel:
    """Fixes of a kind on a topic that the default profile leaves to others."""
    fixes, scenario, topic = simulation.positions[kind], simulation.scenario, _POSITION_TOPICS[kind]
    stamps_ns = simulation.start_ns + np.round(fixes.t_s * 1e9).astype(np.int64)
    variance_m2 = (fixes.sigma_m**2)[:, None, None] * np.eye(3)
    header = {"header.stamp": stamps_ns, "header.frame_id": "map"}
    if kind == "gnss":
        latitude_deg, longitude_deg, height_m = enu_to_geodetic(
            scenario.origin_latitude_deg, scenario.origin_longitude_deg, fixes.position_enu_m
        )
        fields = {
            "latitude": latitude_deg,
            "longitude": longitude_deg,
            "altitude": height_m,
            "position_covariance": variance_m2.reshape(-1, 9),
            "position_covariance_type": np.full(len(fixes), 2, dtype=np.uint8),
        }
        return ros2_channel(topic, "sensor_msgs/msg/NavSatFix", stamps_ns, header | fields)
    covariance = np.zeros((len(fixes), 6, 6))
    covariance[:, :3, :3] = variance_m2
    covariance[:, 3:, 3:] = _UNKNOWN_VARIANCE * np.eye(3)
    place = dict(zip("xyz", fixes.position_enu_m.T, strict=True))
    fields = {
        **{f"pose.pose.position.{axis}": values for axis, values in place.items()},
        "pose.pose.orientation.w": 1.0,
        "pose.covariance": covariance.reshape(-1, 36),
    }
    type_name = "geometry_msgs/msg/PoseWithCovarianceStamped"
    return ros2_channel(topic, type_name, stamps_ns, header | fields)


def _paths(spec: Role) -> dict[str, str]:
    """Field of the message by our name for it."""
    paths = {name: quantity.field for name, quantity in quantities(spec).items()}
    if isinstance(spec, TravelTimeRole):
        paths["ping_time"] = str(spec.ping_time)
    return paths


def _heading(columns: Columns) -> Mapping[str, Any]:
    parts = _quaternion(columns["roll_rad"], columns["pitch_rad"], columns["heading_rad"])
    return {f"orientation_xyzw[{place}]": part for place, part in enumerate(parts)}


def _velocity(columns: Columns) -> Mapping[str, Any]:
    forward, starboard, down = columns["velocity_body_mps"].T
    return {"velocity[0]": forward, "velocity[1]": -starboard, "velocity[2]": -down}


def _depth(columns: Columns) -> Mapping[str, Any]:
    return {"depth": columns["depth_m"]}


def _travel_time(columns: Columns) -> Mapping[str, Any]:
    return {
        "ping_time": columns["ping_time_ns"],
        "ping_id": columns["ping_id"],
        "beacon_id": columns["beacon_id"],
        "travel_time": columns["travel_time_s"],
        "snr": columns["snr_db"],
    }


def _beacons(columns: Columns) -> Mapping[str, Any]:
    n_messages = int(columns["message"][-1]) + 1
    rows = {name: c.reshape(n_messages, -1, *c.shape[1:]) for name, c in columns.items()}
    return {
        "id": rows["id"],
        "name": rows["name"].tolist(),
        **{f"position[{axis}]": rows["position_enu_m"][..., axis] for axis in range(3)},
        "turn_around": rows["turn_around_s"],
        "position_sigma": rows["sigma_m"],
        "origin_latitude": rows["origin_latitude_deg"][:, 0],
        "origin_longitude": rows["origin_longitude_deg"][:, 0],
    }


def _sound_speed(columns: Columns) -> Mapping[str, Any]:
    return {
        "depth": columns["depth_m"][None, :],
        "sound_speed": columns["sound_speed_mps"][None, :],
    }


def _reference(columns: Columns) -> Mapping[str, Any]:
    return {f"position[{axis}]": columns["position_enu_m"][:, axis] for axis in range(3)}


_VALUES: Mapping[str, Callable[[Columns], Mapping[str, Any]]] = {
    "heading": _heading,
    "velocity": _velocity,
    "depth": _depth,
    "travel_time": _travel_time,
    "beacons": _beacons,
    "sound_speed": _sound_speed,
    "reference": _reference,
}


def _surroundings(role: str, scenario: Scenario) -> Mapping[str, Any]:
    """What a complete message says besides: frames, and variances where the type has them."""
    compass, dvl = scenario.compass, scenario.dvl
    unknown = [_UNKNOWN_VARIANCE] * 3
    if role == "heading":
        tilt, turn = np.radians([compass.tilt_sigma_deg, compass.bias_sigma_deg]) ** 2
        return {
            "header.frame_id": "base_link",
            "orientation_covariance": np.diag([tilt, tilt, turn]).ravel(),
            "angular_velocity_covariance": _NOT_MEASURED,
            "linear_acceleration_covariance": _NOT_MEASURED,
        }
    if role == "velocity":
        white = [dvl.white_sigma_mps**2] * 3
        return {
            "header.frame_id": "base_link",
            "twist.covariance": np.diag(white + unknown).ravel(),
        }
    if role == "reference":
        return {
            "header.frame_id": "map",
            "child_frame_id": "base_link",
            "pose.pose.orientation.w": 1.0,
            "pose.covariance": np.diag([1e-6] * 3 + unknown).ravel(),
            "twist.covariance": np.diag(unknown + unknown).ravel(),
        }
    return {"header.frame_id": "map" if role in ("beacons", "sound_speed") else "base_link"}


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
