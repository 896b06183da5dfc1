# SPDX-License-Identifier: Apache-2.0
"""One short dive as each of the shipped profiles' vehicles would log it.

Run it to write sample_logs/profiles/ anew.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gsw
import msgspec
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

from abyssnav.config import schemas
from abyssnav.formats.columns import Ragged
from abyssnav.formats.mcap.writer import Channel, ros2_channel, write_mcap
from abyssnav.simulate import load_scenario, simulate, to_log
from abyssnav.tables import Columns, Log

ALTITUDE_M = 80.0  #: that the simulated vehicle keeps
FOLDER = Path(__file__).parent.parent / "sample_logs" / "profiles"
LATITUDE_DEG = 35.0


def short_dive() -> Log:
    """Ten minutes of the clean scenario; heading at 1 Hz, velocity at 2.5 Hz to keep it small."""
    scenario = load_scenario(schemas() / "scenarios" / "clean.toml")
    log = to_log(simulate(msgspec.structs.replace(scenario, duration_s=600.0)))
    step = {"heading": 10, "velocity": 2}
    roles = {
        role: {name: column[:: step.get(role, 1)] for name, column in columns.items()}
        for role, columns in log.roles.items()
    }
    return replace(log, roles=roles)


def quaternion(columns: Columns) -> dict[str, Any]:
    """Orientation in ENU/FLU as the product of three half-angle rotations."""
    yaw = np.pi / 2 - columns["heading_rad"]
    product = _times(
        _times(_about(2, yaw), _about(1, -columns["pitch_rad"])), _about(0, columns["roll_rad"])
    )
    return {f"orientation.{axis}": part for axis, part in zip("xyzw", product, strict=True)}


def _about(axis: int, angle: Any) -> list[Any]:
    parts = [np.zeros_like(angle)] * 3 + [np.cos(angle / 2)]
    parts[axis] = np.sin(angle / 2)
    return parts


def _times(a: list[Any], b: list[Any]) -> list[Any]:
    (x, y, z, w), (i, j, k, r) = a, b
    return [w * i + x * r + y * k - z * j, w * j - x * k + y * r + z * i,
            w * k + x * j - y * i + z * r, w * r - x * i - y * j - z * k]  # fmt: skip


def ros_roles(log: Log) -> dict[str, Channel]:
    """The default profile's topics."""
    roles, made = log.roles, {}

    def add(role: str, topic: str, kind: str, fields: Mapping[str, Any]) -> None:
        times = roles[role]["time_ns"]
        times = times[:1] if "message" in roles[role] else times
        fields = {**fields, "header.stamp": times, "header.frame_id": role}
        made[role] = ros2_channel(topic, kind, times, fields)

    add("heading", "/imu", "sensor_msgs/msg/Imu", quaternion(roles["heading"]))
    add(
        "velocity",
        "/dvl",
        "geometry_msgs/msg/TwistWithCovarianceStamped",
        {f"twist.{name}": column for name, column in flu(log, "twist.linear").items()},
    )
    add("depth", "/depth", "abyssnav_msgs/msg/Depth", {"depth": roles["depth"]["depth_m"]})
    replies = roles["travel_time"]
    add(
        "travel_time",
        "/lbl/travel_time",
        "abyssnav_msgs/msg/TravelTime",
        {
            "ping_time": replies["ping_time_ns"],
            "ping_id": replies["ping_id"],
            "beacon_id": replies["beacon_id"],
            "travel_time": replies["travel_time_s"],
            "snr": replies["snr_db"],
        },
    )
    beacons = roles["beacons"]
    place = dict(zip("xyz", beacons["position_enu_m"].T, strict=True))
    add(
        "beacons",
        "/lbl/beacons",
        "abyssnav_msgs/msg/BeaconArray",
        {
            "origin_latitude": beacons["origin_latitude_deg"][:1],
            "origin_longitude": beacons["origin_longitude_deg"][:1],
            "beacons.id": [beacons["id"]],
            "beacons.name": [beacons["name"]],
            "beacons.turn_around_time": [beacons["turn_around_s"]],
            "beacons.position_sigma": [beacons["sigma_m"]],
            **{f"beacons.position.{axis}": [values] for axis, values in place.items()},
        },
    )
    add(
        "sound_speed",
        "/sound_speed/profile",
        "abyssnav_msgs/msg/SoundSpeedProfile",
        {
            "depth": [roles["sound_speed"]["depth_m"]],
            "sound_speed": [roles["sound_speed"]["sound_speed_mps"]],
        },
    )
    place = dict(zip("xyz", roles["reference"]["position_enu_m"].T, strict=True))
    add(
        "reference",
        "/reference",
        "nav_msgs/msg/Odometry",
        {f"pose.pose.position.{axis}": values for axis, values in place.items()},
    )
    return made  # fmt: skip


def flu(log: Log, path: str) -> dict[str, Any]:
    """Velocity as x forward, y port, z up, NaN without bottom lock."""
    velocity = log.roles["velocity"]
    shown = np.where(velocity["valid"][:, None], velocity["velocity_body_mps"], np.nan)
    parts = (shown * [1, -1, -1]).T
    return {f"{path}.{axis}": part for axis, part in zip("xyz", parts, strict=True)}


def frd(log: Log) -> dict[str, Any]:
    """Velocity as x forward, y starboard, z down; zero without bottom lock."""
    velocity = log.roles["velocity"]
    parts = np.where(velocity["valid"][:, None], velocity["velocity_body_mps"], 0.0).T
    return {f"velocity.{axis}": part for axis, part in zip("xyz", parts, strict=True)}


def instead(role: str, topic: str, kind: str, fields: Callable[[Log], Mapping[str, Any]],
            late_ns: int = 0, stamped: bool = True) -> Callable[[Log], list[Channel]]:  # fmt: skip
    """The default vehicle with one topic logged in another way."""

    def channels(log: Log) -> list[Channel]:
        times = log.roles[role]["time_ns"]
        stamp = {"header.stamp": times + late_ns} if stamped else {}
        other = ros2_channel(topic, kind, times + late_ns, {**stamp, **fields(log)})
        return list({**ros_roles(log), role: other}.values())

    return channels


def marine_dvl(log: Log) -> dict[str, Any]:
    valid = log.roles["velocity"]["valid"]
    beams = {
        "beam_unit_vec.z": np.full((len(valid), 4), 0.87),
        "range": np.full((len(valid), 4), 50),
    }
    good = {"velocity_mode": 1, "num_good_beams": np.where(valid, 4, 1)}
    return {**frd(log), **beams, **good, "altitude": np.where(valid, ALTITUDE_M, 0.0)}


def waterlinked(log: Log) -> dict[str, Any]:
    """Beams and covariance vary in number, as with a lost beam."""
    valid, times = log.roles["velocity"]["valid"], log.roles["velocity"]["time_ns"]
    n_beams = np.where(valid, 4, 3)
    offsets = np.concatenate([[0], np.cumsum(n_beams)])
    beams = Ragged(np.arange(offsets[-1]) % 4, offsets)
    covariance = Ragged(np.zeros(9 * int(valid.sum())), np.concatenate([[0], np.cumsum(9 * valid)]))
    return {**frd(log), "velocity_valid": valid, "time_of_validity": times // 1000,
            "altitude": np.where(valid, ALTITUDE_M, -1.0), "beams.id": beams,
            "covariance": covariance, "form": "json_v3.1"}  # fmt: skip


def pressure(log: Log) -> dict[str, Any]:
    sea_dbar = gsw.p_from_z(-log.roles["depth"]["depth_m"], LATITUDE_DEG)
    return {"fluid_pressure": sea_dbar * 1e4 + 101_325.0}


def float64(log: Log) -> list[Channel]:
    """Compass and depth as bare numbers, on log time."""
    heading, depth = log.roles["heading"], log.roles["depth"]
    degrees = {"data": np.degrees(heading["heading_rad"])}
    height = {"data": -depth["depth_m"]}
    kind = "std_msgs/msg/Float64"
    bare = {
        "heading": ros2_channel("/compass", kind, heading["time_ns"] + 20_000_000, degrees),
        "depth": ros2_channel("/depth/meters", kind, depth["time_ns"] + 50_000_000, height),
    }
    return list({**ros_roles(log), **bare}.values())


# --- Protobuf -----------------------------------------------------------------------------------

_PROTO_TYPES: dict[str, dict[str, str]] = {
    "Attitude": {"time": "time", "roll_deg": "double", "pitch_deg": "double", "yaw_deg": "double"},
    "Speed": {"forward_mm_s": "double", "right_mm_s": "double", "down_mm_s": "double"},
    "BottomTrack": {"time": "time", "velocity": "Speed", "locked": "bool"},
    "Ctd": {"time": "time", "depth_m": "double", "salinity": "float"},
    "Reply": {"heard": "time", "asked": "time", "number": "uint32", "transponder": "uint32",
              "two_way_us": "double", "snr_db": "float"},
    "Transponder": {"code": "uint32", "label": "string", "east_m": "double", "north_m": "double",
                    "up_m": "double", "turn_around_ms": "double"},
    "Transponders": {"time": "time", "list": "Transponder*"},
    "Position": {"time": "time", "north_m": "double", "east_m": "double", "down_m": "double"},
}  # fmt: skip


def vehicle_files() -> list[Any]:
    """Descriptors of the Protobuf vehicle's messages."""
    field = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="v.proto", package="vehicle", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    for name, members in _PROTO_TYPES.items():
        message = file.message_type.add(name=name)
        for number, (member, kind) in enumerate(members.items(), start=1):
            one = message.field.add(name=member, number=number, label=3 if kind[-1] == "*" else 1)
            if kind in ("double", "float", "bool", "string", "uint32"):
                one.type = getattr(field, f"TYPE_{kind.upper()}")
            else:
                full = f".vehicle.{kind.rstrip('*')}"
                one.type = field.TYPE_MESSAGE
                one.type_name = ".google.protobuf.Timestamp" if kind == "time" else full
    time = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(time)
    return [time, file]


def protobuf_channel(
    topic: str, type_name: str, files: Sequence[Any], times: Any, rows: Sequence[Mapping[str, Any]]
) -> Channel:
    """Messages of a Protobuf type from nested dictionaries; times are nanoseconds."""
    pool = descriptor_pool.DescriptorPool()
    for file in files:
        pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(type_name))
    payloads = Ragged.from_bytes(
        [_message(kind, row).SerializeToString(deterministic=True) for row in rows]
    )
    whole = descriptor_pb2.FileDescriptorSet(file=files).SerializeToString(deterministic=True)
    return Channel(topic, type_name, times, payloads, whole, "protobuf", "protobuf")


def _message(kind: Any, row: Mapping[str, Any]) -> Any:
    message = kind()
    for name, value in row.items():
        field = kind.DESCRIPTOR.fields_by_name[name]
        if field.message_type is None:
            if field.is_repeated:
                getattr(message, name).extend(value)
            else:
                setattr(message, name, value)
        elif field.message_type.full_name == "google.protobuf.Timestamp":
            stamp = getattr(message, name)
            stamp.seconds, stamp.nanos = divmod(int(value), 1_000_000_000)
        elif field.is_repeated:
            inner = message_factory.GetMessageClass(field.message_type)
            getattr(message, name).extend(_message(inner, item) for item in value)
        else:
            inner = message_factory.GetMessageClass(field.message_type)
            getattr(message, name).CopyFrom(_message(inner, value))
    return message


def rows_of(**columns: Any) -> list[dict[str, Any]]:
    """Columns as one dictionary a row, of plain Python values."""
    lists = {name: np.asarray(column).tolist() for name, column in columns.items()}
    return [dict(zip(lists, row, strict=True)) for row in zip(*lists.values(), strict=True)]


def protobuf_vehicle(log: Log) -> list[Channel]:
    roles, files = log.roles, vehicle_files()
    heading, velocity, depth = roles["heading"], roles["velocity"], roles["depth"]
    replies, beacons, truth = roles["travel_time"], roles["beacons"], roles["reference"]
    forward, right, down = velocity["velocity_body_mps"].T * 1000
    speeds = rows_of(forward_mm_s=forward, right_mm_s=right, down_mm_s=down)
    tracks = rows_of(time=velocity["time_ns"], locked=velocity["valid"])
    for track, speed in zip(tracks, speeds, strict=True):
        if track["locked"]:
            track["velocity"] = speed
    east, north, up = beacons["position_enu_m"].T
    transponders = rows_of(code=beacons["id"], label=beacons["name"], east_m=east, north_m=north,
                           up_m=up, turn_around_ms=beacons["turn_around_s"] * 1000)  # fmt: skip
    rows = {
        ("attitude", "Attitude", "heading"): rows_of(
            time=heading["time_ns"], roll_deg=np.degrees(heading["roll_rad"]),
            pitch_deg=np.degrees(heading["pitch_rad"]), yaw_deg=np.degrees(heading["heading_rad"])),
        ("dvl", "BottomTrack", "velocity"): tracks,
        ("ctd", "Ctd", "depth"): rows_of(time=depth["time_ns"], depth_m=depth["depth_m"]),
        ("acoustics", "Reply", "travel_time"): rows_of(
            heard=replies["time_ns"], asked=replies["ping_time_ns"], number=replies["ping_id"],
            transponder=replies["beacon_id"], two_way_us=replies["travel_time_s"] * 1e6,
            snr_db=replies["snr_db"]),
        ("transponders", "Transponders", "beacons"): [
            {"time": beacons["time_ns"][0], "list": transponders}],
        ("truth", "Position", "reference"): rows_of(
            time=truth["time_ns"], east_m=truth["position_enu_m"][:, 0],
            north_m=truth["position_enu_m"][:, 1], down_m=-truth["position_enu_m"][:, 2]),
    }  # fmt: skip
    return [
        protobuf_channel(topic, f"vehicle.{kind}", files, roles[role]["time_ns"][: len(some)], some)
        for (topic, kind, role), some in rows.items()
    ]


# --- JSON ---------------------------------------------------------------------------------------


def json_channel(topic: str, times: Any, rows: Sequence[Mapping[str, Any]]) -> Channel:
    """Messages without a schema."""
    payloads = Ragged.from_bytes([json.dumps(row, allow_nan=False).encode() for row in rows])
    return Channel(topic, "", times, payloads, b"", "json", "")


def json_vehicle(log: Log) -> list[Channel]:
    roles = log.roles
    heading, velocity, depth = roles["heading"], roles["velocity"], roles["depth"]
    replies, beacons, cast = roles["travel_time"], roles["beacons"], roles["sound_speed"]
    angles = rows_of(r=np.degrees(heading["roll_rad"]), p=np.degrees(heading["pitch_rad"]))
    compass = rows_of(t=heading["time_ns"].astype(str), hdg=np.degrees(heading["heading_rad"]))
    for row, angle in zip(compass, angles, strict=True):
        row["rpy"] = angle
    dvl = rows_of(t=velocity["time_ns"].astype(str), vel=velocity["velocity_body_mps"])
    for row, valid in zip(dvl, velocity["valid"], strict=True):
        row["vel"] = row["vel"] if valid else None
    dbar = gsw.p_from_z(-depth["depth_m"], LATITUDE_DEG)
    listed = rows_of(id=beacons["id"], name=beacons["name"], enu=beacons["position_enu_m"],
                     tat_s=beacons["turn_around_s"], sigma_m=beacons["sigma_m"])  # fmt: skip
    first, cast_ns = beacons["time_ns"][:1], cast["time_ns"][:1]
    origin = {"lat": beacons["origin_latitude_deg"][0], "lon": beacons["origin_longitude_deg"][0]}
    return [
        json_channel("nav/compass", heading["time_ns"], compass),
        json_channel("nav/dvl", velocity["time_ns"], dvl),
        json_channel("nav/pressure", depth["time_ns"],
                     rows_of(t=depth["time_ns"].astype(str), dbar=dbar)),
        json_channel("lbl/reply", replies["time_ns"], rows_of(
            heard=replies["time_ns"].astype(str), asked=replies["ping_time_ns"].astype(str),
            ping=replies["ping_id"], beacon=replies["beacon_id"],
            twt_ms=replies["travel_time_s"] * 1000)),
        json_channel("lbl/beacons", first,
                     [{"t": str(first[0]), "origin": origin, "beacons": listed}]),
        json_channel("ctd/profile", cast_ns, [{
            "t": str(cast_ns[0]), "depth": cast["depth_m"].tolist(),
            "speed": cast["sound_speed_mps"].tolist()}]),
    ]  # fmt: skip


VEHICLES: dict[str, Callable[[Log], list[Channel]]] = {
    "default": lambda log: list(ros_roles(log).values()),
    "marine_dvl": instead("velocity", "/dvl", "marine_acoustic_msgs/msg/Dvl", marine_dvl),
    "waterlinked": instead("velocity", "/dvl/data", "dvl_msgs/msg/DVL", waterlinked, 120_000_000),
    "twist": instead("velocity", "/dvl/twist", "geometry_msgs/msg/TwistStamped",
                     lambda log: flu(log, "twist.linear")),
    "odometry": instead("velocity", "/dvl/odometry", "nav_msgs/msg/Odometry",
                        lambda log: flu(log, "twist.twist.linear")),
    "pressure": instead("depth", "/pressure", "sensor_msgs/msg/FluidPressure", pressure),
    "float64": float64,
    "protobuf_vehicle": protobuf_vehicle,
    "json_vehicle": json_vehicle,
}  # fmt: skip

if __name__ == "__main__":
    from drivers import DRIVERS

    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, channels in {**VEHICLES, **DRIVERS}.items():
        if name != "default":
            write_mcap(FOLDER / f"{name}.mcap", channels(short_dive()))
