# SPDX-License-Identifier: Apache-2.0
"""What inspect proposes, and what it never does."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from json_logs import START_NS
from vehicles import json_channel, ros_roles, short_dive

from abyssnav.errors import ConfigError
from abyssnav.formats.mcap.writer import Channel, ros2_channel, write_mcap
from abyssnav.profile import Profile, load_profile, profile_from_toml
from abyssnav.read import inspect, read
from abyssnav.tables import Finding


def proposed(tmp_path: Path, channels: list[Channel]) -> tuple[str, Profile]:
    write_mcap(tmp_path / "a.mcap", channels)
    text = inspect([tmp_path / "a.mcap"], load_profile()).proposal
    return text, profile_from_toml(text, "proposal")


def test_neither_the_reference_nor_another_navigator_is_a_sensor(tmp_path: Path) -> None:
    channels = {c.topic: c for c in ros_roles(short_dive()).values()}
    velocity = channels.pop("/dvl")
    for topic in ("/reference/velocity", "/filtered/dvl"):
        channels[topic] = dataclasses.replace(velocity, topic=topic)
    write_mcap(tmp_path / "a.mcap", list(channels.values()))
    text = inspect([tmp_path / "a.mcap"], load_profile()).proposal
    assert '[velocity]\ntopic = "?"' in text
    with pytest.raises(ConfigError, match=r"\[velocity\] topic"):
        profile_from_toml(text, "proposal")


def test_a_compass_that_never_was_one_is_not_proposed(tmp_path: Path) -> None:
    channels = {c.topic: c for c in ros_roles(short_dive()).values()}
    imu = channels.pop("/imu")
    n = len(imu.log_time_ns)
    fields = {"header.stamp": imu.log_time_ns, "orientation.w": 1.0}
    dead = ros2_channel("/imu_raw", "sensor_msgs/msg/Imu", imu.log_time_ns, fields)
    degrees = np.linspace(10.0, 350.0, n)
    compass = json_channel("nav/compass", imu.log_time_ns, [{"yaw": x} for x in degrees.tolist()])
    text, profile = proposed(tmp_path, [*channels.values(), dead, compass])
    assert profile.heading.topic == "nav/compass"
    assert profile.heading.heading == {"field": "yaw", "unit": "deg"} or (
        'heading = { field = "yaw", unit = "deg" }' in text
    )
    assert "yaw: reaches 350, degrees" in text


def test_increments_of_an_angle_are_no_velocity(tmp_path: Path) -> None:
    channels = {c.topic: c for c in ros_roles(short_dive()).values()}
    times = channels.pop("/dvl").log_time_ns
    rows = [
        {"angle_delta": [0.0, 0.1, 0.0], "position_delta": [0.2, 0.0, 0.01], "delta_usec": 200_000}
        for _ in range(len(times))
    ]
    text, profile = proposed(tmp_path, [*channels.values(), json_channel("dvl/delta", times, rows)])
    assert profile.velocity.velocity[0] == "position_delta[0]"
    assert profile.velocity.frame in ("flu", "frd")
    assert 'per = { field = "delta_usec", unit = "us" }' in text


def test_the_stamps_tell_one_way_from_two_way_and_removed_turn_arounds(tmp_path: Path) -> None:
    channels = {c.topic: c for c in ros_roles(short_dive()).values()}
    log = short_dive()
    replies = log.roles["travel_time"]
    net_s = replies["travel_time_s"] - 0.4
    del channels["/lbl/travel_time"]
    for value_s, key in (
        (replies["travel_time_s"], ""),
        (0.5 * net_s, "one_way = true"),
        (net_s, 'turn_around = "removed"'),
    ):
        rows = [
            {"heard_ns": int(h), "asked_ns": int(a), "beacon": int(b), "travel": float(t)}
            for h, a, b, t in zip(
                replies["time_ns"], replies["ping_time_ns"], replies["beacon_id"], value_s,
                strict=True,
            )
        ]  # fmt: skip
        channel = json_channel("lbl/reply", replies["time_ns"], rows)
        text, profile = proposed(tmp_path, [*channels.values(), channel])
        assert profile.travel_time is not None
        assert profile.travel_time.one_way == (key == "one_way = true")
        assert (profile.travel_time.turn_around == "removed") == ("removed" in key)
        assert key in text


def test_gnss_is_proposed_as_position_and_beacons_that_are_nowhere_as_blocks(
    tmp_path: Path,
) -> None:
    channels = {c.topic: c for c in ros_roles(short_dive()).values()}
    del channels["/lbl/beacons"]
    times = channels["/depth"].log_time_ns
    fields = {
        "header.stamp": times, "status.status": 0, "latitude": 35.0, "longitude": 140.0,
        "position_covariance": np.tile(np.eye(3).ravel(), (len(times), 1)),
    }  # fmt: skip
    gnss = ros2_channel("/gnss/fix", "sensor_msgs/msg/NavSatFix", times, fields)
    text, profile = proposed(tmp_path, [*channels.values(), gnss])
    assert profile.position is not None
    assert profile.position.covariance == "position_covariance"
    assert text.count("# [[beacon]]") == len(np.unique(short_dive().roles["beacons"]["id"]))


def bare(topic: str, times: Any, values: Any) -> Channel:
    return ros2_channel(topic, "std_msgs/msg/Float64", times, {"data": values})


def test_bare_numbers_are_judged_by_their_values_not_by_another_vehicle(tmp_path: Path) -> None:
    log = short_dive()
    heading, depth = log.roles["heading"], log.roles["depth"]
    channels = {c.topic: c for c in ros_roles(log).values()}
    del channels["/imu"], channels["/depth"]
    compass = bare("/auv/compass", heading["time_ns"], heading["heading_rad"])
    down = bare("/auv/depth", depth["time_ns"], depth["depth_m"])
    _, profile = proposed(tmp_path, [*channels.values(), compass, down])
    assert (profile.heading.latency_s, profile.depth.latency_s) == (0.0, 0.0)
    columns = read([tmp_path / "a.mcap"], profile).roles
    np.testing.assert_allclose(columns["depth"]["depth_m"], depth["depth_m"])
    np.testing.assert_allclose(columns["heading"]["heading_rad"], heading["heading_rad"])


def test_arrays_of_replies_and_of_beacons_are_proposed_as_rows(tmp_path: Path) -> None:
    log = short_dive()
    replies, beacons = log.roles["travel_time"], log.roles["beacons"]
    rows = []
    for ping in np.unique(replies["ping_id"]).tolist():
        mine = replies["ping_id"] == ping
        listed = [
            {"id": int(b), "tt_ms": 1000 * float(t)}
            for b, t in zip(replies["beacon_id"][mine], replies["travel_time_s"][mine], strict=True)
        ]
        rows.append({"tx_ns": int(replies["ping_time_ns"][mine][0]), "replies": listed})
    places = [
        {"code": int(i), "label": str(n), "tat_ms": 1000 * float(t),
         **dict(zip("xyz", p, strict=True))}
        for i, n, p, t in zip(
            beacons["id"], beacons["name"], beacons["position_enu_m"].tolist(),
            beacons["turn_around_s"], strict=True,
        )
    ]  # fmt: skip
    channels = {c.topic: c for c in ros_roles(log).values()}
    del channels["/lbl/travel_time"], channels["/lbl/beacons"]
    times = np.array([row["tx_ns"] for row in rows]) + 12 * 10**9
    text, profile = proposed(
        tmp_path,
        [
            *channels.values(),
            json_channel("acoustics/ping", times, rows),
            json_channel("acoustics/transponders", beacons["time_ns"][:1], [{"list": places}]),
        ],
    )
    found = read([tmp_path / "a.mcap"], profile).roles
    np.testing.assert_allclose(
        np.sort(found["travel_time"]["travel_time_s"]), np.sort(replies["travel_time_s"])
    )
    assert 'unit = "ms"' in text
    np.testing.assert_allclose(found["beacons"]["position_enu_m"], beacons["position_enu_m"])
    np.testing.assert_allclose(found["beacons"]["turn_around_s"], beacons["turn_around_s"])
    assert found["beacons"]["id"].tolist() == beacons["id"].tolist()


def test_stamps_since_boot_are_told_and_log_time_is_proposed(tmp_path: Path) -> None:
    channels = {c.topic: c for c in ros_roles(short_dive()).values()}
    imu = channels["/imu"]
    since_boot = imu.log_time_ns - imu.log_time_ns[0] + 35 * 10**9
    columns = {"header.stamp": since_boot, "orientation.w": 1.0, "orientation.x": 0.001}
    channels["/imu"] = ros2_channel("/imu", imu.type, imu.log_time_ns, columns)
    write_mcap(tmp_path / "a.mcap", list(channels.values()))
    found = inspect([tmp_path / "a.mcap"], load_profile())
    (clock,) = [f for f in found.findings if f.what == "clock: unset stamps"]
    assert clock.detail.endswith('time = "log_time" takes the recorder\'s')
    offset_s = (imu.log_time_ns[0] - since_boot[0]) / 1e9
    assert f"{offset_s:.3f} s before log time's" in clock.detail
    profile = profile_from_toml(found.proposal, "proposal")
    assert profile.heading.time == "log_time"
    assert profile.depth.time == "header.stamp"


@pytest.mark.parametrize("pings_too", [True, False])
def test_of_replies_stamped_since_boot_the_pings_are_put_right_too(
    tmp_path: Path, pings_too: bool
) -> None:
    log = short_dive()
    channels = {c.topic: c for c in ros_roles(log).values()}
    topic, replies = "/lbl/travel_time", log.roles["travel_time"]
    first_ns = channels[topic].log_time_ns[0] - 35 * 10**9
    moved = ("time_ns", "ping_time_ns") if pings_too else ("time_ns",)
    late = {name: replies[name] - first_ns for name in moved}
    booted = dataclasses.replace(log, roles={**log.roles, "travel_time": {**replies, **late}})
    channels[topic] = dataclasses.replace(
        {c.topic: c for c in ros_roles(booted).values()}[topic],
        log_time_ns=channels[topic].log_time_ns,
    )
    write_mcap(tmp_path / "a.mcap", list(channels.values()))
    found = inspect([tmp_path / "a.mcap"], load_profile())
    (clock,) = [f for f in found.findings if f.what == "clock: unset stamps"]
    assert f"{first_ns / 1e9:.3f} s before log time's" in clock.detail
    assert ('with ping_time = ""' in clock.detail) is pings_too
    proposed_role = profile_from_toml(found.proposal, "proposal").travel_time
    assert proposed_role is not None
    assert proposed_role.time == "log_time"
    assert proposed_role.ping_time == ("" if pings_too else "ping_time")


@pytest.mark.parametrize(
    ("names", "frame", "unit"),
    [
        (("vel_fwd_mm_s", "vel_stbd_mm_s", "vel_down_mm_s"), "frd", "mm/s"),
        (("vel_forward_cmps", "vel_port_cmps", "vel_up_cmps"), "flu", "cm/s"),
        (("vel_north", "vel_east", "vel_down"), "ned", "m/s"),
        (("bt.e", "bt.n", "bt.u"), "enu", "m/s"),
        (("u_kn", "v_kn", "w_kn"), "frd", "kn"),
    ],
)
def test_names_tell_frame_and_unit_of_a_velocity(
    names: tuple[str, str, str], frame: str, unit: str, tmp_path: Path
) -> None:
    channels = {c.topic: c for c in ros_roles(short_dive()).values()}
    times = channels.pop("/dvl").log_time_ns
    factor = {"m/s": 1.0, "cm/s": 100.0, "mm/s": 1000.0, "kn": 1.94}[unit]
    rng = np.random.default_rng(4)
    rows = []
    for speeds in (rng.normal([1.2, 0.0, 0.0], 0.05, (len(times), 3)) * factor).tolist():
        row: dict[str, Any] = {}
        for name, speed in zip(names, speeds, strict=True):
            outer, _, inner = name.rpartition(".")
            (row.setdefault(outer, {}) if outer else row)[inner] = speed
        rows.append(row)
    _, profile = proposed(tmp_path, [*channels.values(), json_channel("auv/dvl", times, rows)])
    assert profile.velocity.frame == frame
    log = read([tmp_path / "a.mcap"], profile)
    first = next(name for name in log.roles["velocity"] if name.startswith("velocity_"))
    speed = np.linalg.norm(log.roles["velocity"][first], axis=1)
    assert np.median(speed) == pytest.approx(1.2, abs=0.02)


def test_words_of_strangers_are_escaped(tmp_path: Path) -> None:
    evil = "/evil\x1b[31m\ntopic"
    write_mcap(tmp_path / "a.mcap", [json_channel(evil, START_NS + np.arange(3), [{"a": 1}] * 3)])
    found = inspect([tmp_path / "a.mcap"], load_profile())
    shown = found.proposal + json.dumps([f.detail for f in found.findings])
    assert "\x1b" not in shown
    assert "/evil\\x1b[31m\\ntopic" in found.proposal
    assert Finding("what\x1b", "a\nb", "c\x07").where == "a\\nb"
