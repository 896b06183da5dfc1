# SPDX-License-Identifier: Apache-2.0
"""The short dive as drivers that people use would log it, for the profiles named after them.

What a driver leaves out (beacons, sound speed, turn-arounds) comes from settings.
"""

from collections.abc import Callable
from typing import Any

import gsw
import numpy as np
from vehicles import ALTITUDE_M, LATITUDE_DEG, instead, json_channel, pressure, ros_roles, rows_of

from abyssnav.config import BeaconSetting, Config, OriginSetting
from abyssnav.formats.mcap.writer import Channel, ros2_channel
from abyssnav.geometry import enu_to_geodetic
from abyssnav.tables import Columns, Float, Log

LONGITUDE_DEG = 140.0
MODEM_MPS = 1500.0  #: with which modems make ranges
LATE_NS = 150_000_000  #: log time after the stamp


def settings(log: Log) -> Config:
    """Beacons and origin of the dive, for logs that have none."""
    rows = log.roles["beacons"]
    beacons = tuple(
        BeaconSetting(id=int(i), name=str(n), position_m=tuple(p), turn_around_s=float(t))
        for i, n, p, t in zip(
            rows["id"], rows["name"], rows["position_enu_m"].tolist(), rows["turn_around_s"],
            strict=True,
        )
    )  # fmt: skip
    return Config(beacon=beacons, origin=OriginSetting(LATITUDE_DEG, LONGITUDE_DEG))


def _net_s(log: Log) -> Float:
    """Travel times without the turn-around."""
    replies, beacons = log.roles["travel_time"], log.roles["beacons"]
    by_id = dict(zip(beacons["id"].tolist(), beacons["turn_around_s"].tolist(), strict=True))
    turn_around_s = np.array([by_id[i] for i in replies["beacon_id"].tolist()])
    return np.asarray(replies["travel_time_s"] - turn_around_s)


def replies_as(
    topic: str, kind: str, fields: Callable[[Log], dict[str, Any]]
) -> Callable[[Log], list[Channel]]:
    """The default vehicle with its replies in another message."""
    return instead("travel_time", topic, kind, fields)


def ping_transponders(log: Log) -> list[Channel]:
    """One message a ping; slots without a reply are -1."""
    replies, way_s = log.roles["travel_time"], _net_s(log) / 2
    ping_ns, row = np.unique(replies["ping_time_ns"], return_inverse=True)
    slots = np.full((4, len(ping_ns)), -1.0)
    slots[replies["beacon_id"] - 1, row] = way_s
    stamp_ns = ping_ns + 12_000_000_000
    fields = {"header.stamp": stamp_ns, "time_of_ping": ping_ns / 1e9}
    fields |= {f"owtt_{letter}": times for letter, times in zip("abcd", slots, strict=True)}
    kind = "ros_acomms_msgs/msg/PingTranspondersReply"
    other = ros2_channel("/ping_transponders_reply", kind, stamp_ns, fields)
    return list({**ros_roles(log), "travel_time": other}.values())


def acoustic_range(log: Log) -> dict[str, Any]:
    way_s = _net_s(log) / 2
    return {
        "measurement_type": 2, "src": log.roles["travel_time"]["beacon_id"], "dest": 9,
        "owtt": way_s, "range_m": way_s * MODEM_MPS, "speed_of_sound_ms": MODEM_MPS,
    }  # fmt: skip


def seatrac(log: Log) -> dict[str, Any]:
    way_s = _net_s(log) / 2
    return {
        "src_id": log.roles["travel_time"]["beacon_id"], "vos": round(MODEM_MPS * 10),
        "includes_range": True, "range_count": np.round(2 * way_s * 16_000).astype(int),
        "range_time": np.round(way_s * 1e7).astype(int),
        "range_dist": np.round(way_s * MODEM_MPS * 10).astype(int),
    }  # fmt: skip


def evologics(log: Log) -> dict[str, Any]:
    beacons = log.roles["travel_time"]["beacon_id"]
    return {
        "source_address": beacons, "propagation_time": np.round(_net_s(log) / 2 * 1e6).astype(int),
        "source_name": np.array([f"m{b}" for b in beacons.tolist()]),
    }  # fmt: skip


def lbl_aqualoc(log: Log) -> list[Channel]:
    """A topic for each beacon, with its place; turn-around in none of it."""
    channels = ros_roles(log)
    for role in ("beacons", "sound_speed", "travel_time", "reference"):
        del channels[role]
    imu = channels.pop("heading")
    channels["heading"] = _renamed(imu, "/rtimulib_node/imu")
    depth = log.roles["depth"]["time_ns"]
    channels["depth"] = ros2_channel(
        "/barometer_node/pressure", "sensor_msgs/msg/FluidPressure", depth,
        {"header.stamp": depth, **pressure(log)},
    )  # fmt: skip
    replies, beacons, way_s = log.roles["travel_time"], log.roles["beacons"], _net_s(log) / 2
    water, vehicle_m = log.roles["sound_speed"], np.median(log.roles["depth"]["depth_m"])
    between_m = 0.5 * (vehicle_m - np.mean(beacons["position_enu_m"][:, 2]))
    speed_mps = float(np.interp(between_m, water["depth_m"], water["sound_speed_mps"]))
    for number, place in zip(beacons["id"].tolist(), beacons["position_enu_m"], strict=True):
        mine = replies["beacon_id"] == number
        times = replies["time_ns"][mine]
        channels[f"lbl {number}"] = ros2_channel(
            f"/lbl_{number}", "lbl_data/msg/LBLdata", times,
            {"header.stamp": times, "bouy_id": float(number), "arrival_time": way_s[mine],
             "average_speed_of_sound": speed_mps,
             **{f"bouy_{axis}": float(x) for axis, x in zip("XYZ", place, strict=True)}},
        )  # fmt: skip
    return list(channels.values())


def _renamed(channel: Channel, topic: str) -> Channel:
    return Channel(topic, channel.type, channel.log_time_ns, channel.payloads, channel.definition)


def _mm_s(velocity: Columns) -> Float:
    """Forward, starboard, down in mm/s, -32768 without lock."""
    valid = velocity["valid"][:, None]
    return np.where(valid, velocity["velocity_body_mps"] * 1000, -32768.0)


def teledyne_pd6(log: Log) -> dict[str, Any]:
    velocity = log.roles["velocity"]
    forward, starboard, down = _mm_s(velocity).T
    letter = np.where(velocity["valid"], "A", "V")
    return {
        "bs_longitudinal": forward, "bs_transverse": starboard, "bs_status": letter,
        "bs_normal": np.where(velocity["valid"], -down, down), "bi_x_axis": starboard,
        "bi_y_axis": forward, "bi_status": letter, "ts_sound_speed": 1500.0,
    }  # fmt: skip


def ds_dvl(log: Log) -> dict[str, Any]:
    """Each tenth message is of water track, which is none over ground."""
    velocity = log.roles["velocity"]
    water = np.arange(len(velocity["valid"])) % 10 == 3
    parts = dict(zip("xyz", velocity["velocity_body_mps"].T, strict=True))
    return {
        "velocity_mode": np.where(water, 2, 1), "coordinate_mode": 2,
        "num_good_beams": np.where(velocity["valid"], 4, 2),
        **{f"velocity.{axis}": np.where(water, 9.0, part) for axis, part in parts.items()},
    }  # fmt: skip


def uuv_dvl(log: Log) -> dict[str, Any]:
    velocity = log.roles["velocity"]
    covariance = np.zeros((len(velocity["valid"]), 9))
    covariance[~velocity["valid"], 0] = -1.0
    shown = np.where(velocity["valid"][:, None], velocity["velocity_body_mps"], 0.0) * [1, -1, -1]
    return {
        **{f"velocity.{axis}": part for axis, part in zip("xyz", shown.T, strict=True)},
        "velocity_covariance": covariance, "altitude": np.where(velocity["valid"], ALTITUDE_M, -1),
    }  # fmt: skip


def nortek_dvl(log: Log) -> dict[str, Any]:
    velocity = log.roles["velocity"]
    parts = np.where(velocity["valid"][:, None], velocity["velocity_body_mps"], -32.768).T
    return {f"velocity.{axis}": part for axis, part in zip("xyz", parts, strict=True)}


def blueos_mavlink(log: Log) -> list[Channel]:
    """Attitude in rad, increments over 400 ms, pressure in hPa; only log time counts."""
    roles = log.roles
    heading, depth, replies = roles["heading"], roles["depth"], roles["travel_time"]
    velocity = {name: column[roles["velocity"]["valid"]] for name, column in
                roles["velocity"].items()}  # fmt: skip
    boot_ms = (heading["time_ns"] - heading["time_ns"][0]) // 1_000_000 + 35_000
    yaw = (heading["heading_rad"] + np.pi) % (2 * np.pi) - np.pi
    hpa = gsw.p_from_z(-depth["depth_m"], LATITUDE_DEG) * 100 + 1013.25

    def channel(topic: str, times: Any, **columns: Any) -> Channel:
        kind = topic.rsplit("/", 1)[-1]
        rows = [{"message": {"type": kind, **row}} for row in rows_of(**columns)]
        return json_channel(topic, times, rows)

    end_ns = velocity["time_ns"] + 200_000_000  # of the interval, whose middle is the velocity's
    return [
        channel("mavlink/1/1/ATTITUDE", heading["time_ns"], time_boot_ms=boot_ms,
                roll=heading["roll_rad"], pitch=heading["pitch_rad"], yaw=yaw),
        channel("mavlink/255/0/VISION_POSITION_DELTA", end_ns,
                time_usec=np.zeros(len(end_ns), int),
                time_delta_usec=np.full(len(end_ns), 400_000),
                angle_delta=np.zeros((len(end_ns), 3)),
                position_delta=velocity["velocity_body_mps"] * 0.4),
        channel("mavlink/1/1/SCALED_PRESSURE2", depth["time_ns"],
                time_boot_ms=(depth["time_ns"] - depth["time_ns"][0]) // 1_000_000 + 35_000,
                press_abs=hpa, press_diff=np.zeros(len(hpa))),
        json_channel("lbl/reply", replies["time_ns"], rows_of(
            t_heard_ns=replies["time_ns"], asked_ns=replies["ping_time_ns"],
            beacon=replies["beacon_id"], twt_s=replies["travel_time_s"])),
    ]  # fmt: skip


def imc_json(log: Log) -> list[Channel]:
    """Ranges at 1500 m/s, beacons in radians with turn-arounds in ms."""
    roles = log.roles
    heading, velocity, depth = roles["heading"], roles["velocity"], roles["depth"]
    replies, beacons = roles["travel_time"], roles["beacons"]
    latitude_deg, longitude_deg, _ = enu_to_geodetic(
        LATITUDE_DEG, LONGITUDE_DEG, beacons["position_enu_m"]
    )
    listed = rows_of(
        beacon=[f"lbl{i}" for i in beacons["id"]], lat=np.radians(latitude_deg),
        lon=np.radians(longitude_deg), depth=-beacons["position_enu_m"][:, 2],
        transponder_delay=np.round(beacons["turn_around_s"] * 1000).astype(int),
    )  # fmt: skip

    def channel(abbrev: str, times: Any, **columns: Any) -> Channel:
        rows = rows_of(timestamp=times / 1e9, **columns)
        return json_channel(abbrev, times, [{"abbrev": abbrev, **row} for row in rows])

    x, y, z = np.where(velocity["valid"][:, None], velocity["velocity_body_mps"], 0.0).T
    first = beacons["time_ns"][:1]
    config = {"abbrev": "LblConfig", "timestamp": float(first[0] / 1e9), "op": 1, "beacons": listed}
    return [
        channel("EulerAngles", heading["time_ns"], phi=heading["roll_rad"],
                theta=heading["pitch_rad"], psi=heading["heading_rad"]),
        channel("GroundVelocity", velocity["time_ns"], validity=np.where(velocity["valid"], 7, 0),
                x=x, y=y, z=z),
        channel("Depth", depth["time_ns"], value=depth["depth_m"]),
        channel("LblRange", replies["time_ns"], id=replies["beacon_id"],
                range=_net_s(log) / 2 * MODEM_MPS),
        json_channel("LblConfig", first, [config]),
    ]  # fmt: skip


DRIVERS: dict[str, Callable[[Log], list[Channel]]] = {
    "ping_transponders": ping_transponders,
    "acoustic_range": replies_as(
        "/acoustic_range", "ros_acomms_msgs/msg/AcousticRange", acoustic_range),
    "seatrac": replies_as("/modem_rec", "seatrac_interfaces/msg/ModemRec", seatrac),
    "evologics": replies_as("/evologics/receive", "dmac/msg/DMACPayload", evologics),
    "lbl_aqualoc": lbl_aqualoc,
    "teledyne_pd6": instead("velocity", "/teledyne_navigator/ensemble",
                            "teledyne_navigator/msg/Ensemble", teledyne_pd6),
    "ds_dvl": instead("velocity", "/devices/dvl/dvl", "ds_sensor_msgs/msg/Dvl", ds_dvl),
    "uuv_dvl": instead("velocity", "/dvl", "uuv_sensor_ros_plugins_msgs/msg/DVL", uuv_dvl),
    "nortek_dvl": instead("velocity", "/nortek_dvl/dvl", "nortek_dvl/msg/Dvl", nortek_dvl),
    "blueos_mavlink": blueos_mavlink,
    "imc_json": imc_json,
}  # fmt: skip
