# SPDX-License-Identifier: Apache-2.0
"""Stage read: a dive's columns come back as they went in, or are missed aloud."""

import dataclasses
import json
import math
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from vehicles import FOLDER, VEHICLES

from abyssnav.config import BeaconSetting, Config, schemas
from abyssnav.errors import ConfigError, ReadError
from abyssnav.formats.cdr_encoder import encode
from abyssnav.formats.columns import Ragged
from abyssnav.formats.mcap.writer import Channel, ros2_channel, write_mcap
from abyssnav.formats.schema import parse_ros2msg
from abyssnav.profile import Profile, Quantity, TimeField, load_profile, profile_from_toml
from abyssnav.read import inspect, read
from abyssnav.read.roles import euler_of
from abyssnav.simulate import load_scenario, simulate, to_log, write_log
from abyssnav.tables import Columns, Log

DEFAULT = load_profile()


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Log]:
    """Ten minutes of a simulated dive in a file, and the log it should give."""
    scenario = load_scenario(schemas() / "scenarios" / "voyage_1.toml")
    simulation = simulate(msgspec.structs.replace(scenario, duration_s=600.0))
    path = tmp_path_factory.mktemp("dive") / "dive.mcap"
    write_log(simulation, path)
    return path, to_log(simulation)


def assert_equal(ours: Mapping[str, Columns], theirs: Mapping[str, Columns]) -> None:
    assert ours.keys() == theirs.keys()
    for role, columns in theirs.items():
        assert ours[role].keys() == columns.keys(), role
        for name, column in columns.items():
            mine = ours[role][name]
            if column.dtype.kind == "f":
                assert mine == pytest.approx(column, abs=1e-14, rel=1e-14, nan_ok=True), name
            else:
                assert np.array_equal(mine, column), name


def test_a_simulated_dive_comes_back_from_its_file(dive: tuple[Path, Log]) -> None:
    path, truth = dive
    log = read([path], DEFAULT)
    assert_equal(log.roles, truth.roles)
    assert (log.name, log.profile, log.findings) == ("dive", "default", ())
    assert log.topics == truth.topics
    (file,) = log.inputs
    assert file.bytes == path.stat().st_size
    assert file.messages["/imu"] == len(truth.roles["heading"]["time_ns"])


@pytest.fixture
def parts(dive: tuple[Path, Log], tmp_path: Path) -> Path:
    """The same dive split in time over three files, latched topics in the first only."""
    _, truth = dive
    folder = tmp_path / "split"
    folder.mkdir()
    channels = channels_of(truth)
    times = truth.roles["heading"]["time_ns"]
    edges = [0, *np.quantile(times, [0.3, 0.6]).astype(np.int64).tolist(), 2**62]
    for number, (low, high) in enumerate(pairwise(edges)):
        pieces = [rows_between(channel, low, high) for channel in channels]
        some = [piece for piece in pieces if len(piece.log_time_ns)]
        write_mcap(folder / f"dive_{10 - number}.mcap", some)  # names against the order in time
    return folder


def rows_between(channel: Channel, low: int, high: int) -> Channel:
    rows = (channel.log_time_ns >= low) & (channel.log_time_ns < high)
    return dataclasses.replace(
        channel, log_time_ns=channel.log_time_ns[rows], payloads=channel.payloads[rows]
    )


def channels_of(log: Log) -> list[Channel]:
    """A log's roles as ROS 2 messages, in another way than the simulator's."""
    roles = log.roles
    velocity = roles["velocity"]["velocity_body_mps"]
    half = (math.pi / 2 - roles["heading"]["heading_rad"]) / 2
    replies, beacons = roles["travel_time"], roles["beacons"]
    heading_ns, velocity_ns = roles["heading"]["time_ns"], roles["velocity"]["time_ns"]
    depth_ns, first_ns = roles["depth"]["time_ns"], heading_ns[:1]
    east, north, up = beacons["position_enu_m"].T
    return [
        ros2_channel("/imu", "sensor_msgs/msg/Imu", heading_ns, {
            "header.stamp": heading_ns,
            "orientation.z": np.sin(half), "orientation.w": np.cos(half),
        }),
        ros2_channel("/dvl", "geometry_msgs/msg/TwistWithCovarianceStamped", velocity_ns, {
            "header.stamp": velocity_ns, "twist.twist.linear.x": velocity[:, 0],
            "twist.twist.linear.y": -velocity[:, 1], "twist.twist.linear.z": -velocity[:, 2],
        }),
        ros2_channel("/depth", "abyssnav_msgs/msg/Depth", depth_ns, {
            "header.stamp": depth_ns, "depth": roles["depth"]["depth_m"],
        }),
        ros2_channel("/lbl/travel_time", "abyssnav_msgs/msg/TravelTime", replies["time_ns"], {
            "header.stamp": replies["time_ns"], "ping_time": replies["ping_time_ns"],
            "ping_id": replies["ping_id"], "beacon_id": replies["beacon_id"],
            "travel_time": replies["travel_time_s"], "snr": replies["snr_db"],
        }),
        ros2_channel("/lbl/beacons", "abyssnav_msgs/msg/BeaconArray", first_ns, {
            "header.stamp": first_ns, "beacons.id": [beacons["id"]],
            "beacons.name": [beacons["name"]], "beacons.position.x": [east],
            "beacons.position.y": [north], "beacons.position.z": [up],
            "beacons.turn_around_time": [beacons["turn_around_s"]],
        }),
    ]  # fmt: skip


def test_a_split_recording_is_one_dive_in_whatever_order_its_files_come(
    parts: Path, dive: tuple[Path, Log]
) -> None:
    _, truth = dive
    files = sorted(parts.iterdir())
    logs = [read([parts], DEFAULT), read(files, DEFAULT), read(files[::-1], DEFAULT)]
    assert [log.name for log in logs] == ["split", "dive_10", "dive_10"]
    for log in logs:
        assert_equal(log.roles, logs[0].roles)
        assert [file.name for file in log.inputs] == [file.name for file in files]
    whole = logs[0].roles
    assert np.array_equal(whole["heading"]["time_ns"], truth.roles["heading"]["time_ns"])
    velocity = truth.roles["velocity"]["velocity_body_mps"]
    assert np.array_equal(whole["velocity"]["velocity_body_mps"], velocity, equal_nan=True)
    assert whole["beacons"]["name"].tolist() == truth.roles["beacons"]["name"].tolist()
    turned = whole["heading"]["heading_rad"] - truth.roles["heading"]["heading_rad"]
    assert np.abs(np.sin(turned)).max() < 1e-14


# --- frames and units ---------------------------------------------------------------------------


@pytest.mark.parametrize("frame", ["enu_flu", "ned_frd"])
def test_attitude_agrees_with_rotation_matrices_made_from_it(frame: str) -> None:
    rng = np.random.default_rng(5)
    quat = rng.normal(size=(200, 4))
    roll, pitch, heading = euler_of(*quat.T, frame)  # type: ignore[call-arg]
    for q, r, p, h in zip(quat, roll, pitch, heading, strict=True):
        x, y, z, w = q / np.linalg.norm(q)
        given = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        if frame == "enu_flu":  # to north, east, down from forward, starboard, down
            ned_enu = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
            given = ned_enu @ given @ np.diag([1.0, -1, -1])
        about_down = [[math.cos(h), -math.sin(h), 0], [math.sin(h), math.cos(h), 0], [0, 0, 1]]
        about_east = [[math.cos(p), 0, math.sin(p)], [0, 1, 0], [-math.sin(p), 0, math.cos(p)]]
        about_north = [[1, 0, 0], [0, math.cos(r), -math.sin(r)], [0, math.sin(r), math.cos(r)]]
        made = np.array(about_down) @ np.array(about_east) @ np.array(about_north)
        assert made == pytest.approx(given, abs=1e-12)
        assert 0 <= h < 2 * math.pi


def profile_with(**changes: dict[str, Any]) -> Profile:
    """The default profile with some roles changed."""
    roles = {
        role: msgspec.structs.replace(getattr(DEFAULT, role), **change)
        for role, change in changes.items()
    }
    return msgspec.structs.replace(DEFAULT, **roles)


def test_latency_is_taken_off_and_units_are_ours(dive: tuple[Path, Log]) -> None:
    path, truth = dive
    quantity = load_profile_quantity(field="depth", unit="cm", scale=-1.0, offset=50.0)
    profile = profile_with(depth={"depth": quantity, "latency_s": 0.25})
    log = read([path], profile)
    depth = truth.roles["depth"]
    assert np.array_equal(log.roles["depth"]["time_ns"], depth["time_ns"] - 250_000_000)
    assert log.roles["depth"]["depth_m"] == pytest.approx((50 - depth["depth_m"]) / 100)


def load_profile_quantity(**fields: Any) -> Any:
    return msgspec.convert(fields, type(DEFAULT.depth).__annotations__["depth"])


def test_a_sentinel_and_an_orientation_that_is_none_are_left_out_aloud(tmp_path: Path) -> None:
    times = 10**18 + np.arange(4) * 10**9
    channels = minimal_channels(times)
    no_orientation = np.zeros((4, 9))
    no_orientation[1, 0] = -1
    channels[0] = ros2_channel("/imu", "sensor_msgs/msg/Imu", times, {
        "header.stamp": times, "orientation.w": [1.0, 1.0, 0.0, 1.0],
        "orientation_covariance": no_orientation,
    })  # fmt: skip
    write_mcap(tmp_path / "a.mcap", channels)
    quantity = load_profile_quantity(field="depth", sentinel=3.0)
    log = read([tmp_path / "a.mcap"], profile_with(depth={"depth": quantity}))
    assert log.roles["heading"]["time_ns"].tolist() == times[[0, 3]].tolist()
    assert log.roles["depth"]["depth_m"].tolist() == [0, 1, 2]
    assert [(f.what, f.where, f.detail) for f in log.findings] == [
        ("no heading", "/imu", "2 of 4 messages without a value: left out"),
        ("no depth", "/depth", "1 of 4 messages without a value: left out"),
    ]


def minimal_channels(times: np.ndarray[Any, Any]) -> list[Channel]:
    """The four required roles, four messages each."""
    n = np.arange(len(times), dtype=float)
    stamp = {"header.stamp": times}
    return [
        ros2_channel("/imu", "sensor_msgs/msg/Imu", times, {**stamp, "orientation.w": 1.0}),
        ros2_channel("/dvl", "geometry_msgs/msg/TwistWithCovarianceStamped", times, stamp),
        ros2_channel("/depth", "abyssnav_msgs/msg/Depth", times, {**stamp, "depth": n}),
        ros2_channel("/lbl/travel_time", "abyssnav_msgs/msg/TravelTime", times, stamp),
    ]


def test_velocity_without_bottom_lock_is_not_valid(tmp_path: Path) -> None:
    times = 10**18 + np.arange(4) * 10**9
    channels = minimal_channels(times)
    channels[1] = ros2_channel(channels[1].topic, channels[1].type, times, {
        "twist.twist.linear.x": [1.0, np.nan, 1.0, 1.0],
        "twist.twist.linear.z": [0.0, 0.0, np.inf, 0.0],
    })  # fmt: skip
    write_mcap(tmp_path / "a.mcap", channels)
    log = read([tmp_path / "a.mcap"], DEFAULT)
    assert log.roles["velocity"]["valid"].tolist() == [True, False, False, True]


# --- what is missed -----------------------------------------------------------------------------


@pytest.mark.parametrize("missing", range(4))
def test_a_required_role_without_topic_is_named_with_the_nearest(
    missing: int, tmp_path: Path
) -> None:
    channels = minimal_channels(10**18 + np.arange(4))
    topic = channels[missing].topic
    channels[missing] = dataclasses.replace(channels[missing], topic=f"{topic}/data")
    write_mcap(tmp_path / "dive7.mcap", channels)
    with pytest.raises(ReadError) as refused:
        read([tmp_path / "dive7.mcap"], DEFAULT)
    role = ("heading", "velocity", "depth", "travel_time")[missing]
    assert str(refused.value) == (
        f"dive7.mcap: no topic '{topic}' for the role {role} (profile default); "
        f"nearest: '{topic}/data'; abyssnav inspect proposes a profile, for -p"
    )


def test_an_empty_topic_a_wrong_type_and_a_missing_field_are_told_apart(tmp_path: Path) -> None:
    times, path = 10**18 + np.arange(4), tmp_path / "a.mcap"
    channels = minimal_channels(times)
    write_mcap(path, [*channels[:3], rows_between(channels[3], 0, 1)])
    with pytest.raises(ReadError, match=r"'/lbl/travel_time' for the role travel_time holds no me"):
        read([path], DEFAULT)
    write_mcap(path, channels)
    other = profile_with(velocity={"type": "dvl_msgs/msg/DVL"})
    with pytest.raises(ReadError, match=r"'/dvl': is geometry_msgs/.*; the profile says dvl_msgs"):
        read([path], other)
    other = profile_with(depth={"depth": "dept"})
    with pytest.raises(ReadError, match=r"'/depth': no field 'dept' in .*Depth has: header, depth"):
        read([path], other)


def test_an_optional_role_that_cannot_be_read_is_a_finding(tmp_path: Path) -> None:
    times = 10**18 + np.arange(4)
    channels = minimal_channels(times)
    reference = ros2_channel("/reference", "abyssnav_msgs/msg/Depth", times, {})
    write_mcap(tmp_path / "a.mcap", [*channels, reference])
    log = read([tmp_path / "a.mcap"], DEFAULT)
    assert "reference" not in log.roles
    assert [f.what for f in log.findings] == ["no reference"]


def test_no_file_and_an_empty_directory_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match="no file to read"):
        read([], DEFAULT)
    with pytest.raises(ReadError, match=r"no \.mcap file in this directory"):
        read([tmp_path], DEFAULT)


# --- damage and variety -------------------------------------------------------------------------


def test_messages_that_do_not_fit_are_left_out_and_the_topic_is_kept(tmp_path: Path) -> None:
    times = 10**18 + np.arange(4)
    channels = minimal_channels(times)
    rows = channels[2].payloads.row_bytes()
    rows[1] = rows[1][:-5]
    bent = dataclasses.replace(channels[2], payloads=Ragged.from_bytes(rows))
    write_mcap(tmp_path / "a.mcap", [*channels[:2], bent, channels[3]])
    log = read([tmp_path / "a.mcap"], DEFAULT)
    assert log.roles["depth"]["depth_m"].tolist() == [0, 2, 3]
    assert [(f.what, f.detail) for f in log.findings] == [
        ("damaged messages", "1 of 4 messages do not fit abyssnav_msgs/msg/Depth: left out")
    ]


def test_texts_of_varying_length_before_the_fields_change_nothing(tmp_path: Path) -> None:
    n = 20_000  # more than one batch, and the first text is the shortest
    times = 10**18 + np.arange(n)
    frames = ["x" * (i % 23) for i in range(n)]
    channels = minimal_channels(times)
    columns = {"header.stamp": times, "header.frame_id": frames, "depth": np.arange(n)}
    channels[2] = ros2_channel("/depth", "abyssnav_msgs/msg/Depth", times, columns)
    write_mcap(tmp_path / "a.mcap", channels)
    log = read([tmp_path / "a.mcap"], DEFAULT)
    assert np.array_equal(log.roles["depth"]["depth_m"], np.arange(n))
    assert np.array_equal(log.roles["depth"]["time_ns"], times)
    assert log.findings == ()


def test_one_topic_under_two_definitions_is_read_from_both(tmp_path: Path) -> None:
    times = 10**18 + np.arange(4) * 10
    channels = minimal_channels(times)
    definition = b"float64 depth\nstd_msgs/Header header\n"
    ours = channels[2].definition.partition(b"=" * 80)
    columns = {"header.stamp": times + 5, "depth": [7.0, 8.0, 9.0, 10.0]}
    text = definition + ours[1] + ours[2]
    tree = parse_ros2msg(text.decode(), "abyssnav_msgs/msg/Depth")
    second = dataclasses.replace(
        channels[2], log_time_ns=times + 5, payloads=encode(tree, columns, 4), definition=text
    )
    write_mcap(tmp_path / "a.mcap", [*channels, second])
    log = read([tmp_path / "a.mcap"], DEFAULT)
    assert log.roles["depth"]["depth_m"].tolist() == [0, 7, 1, 8, 2, 9, 3, 10]


def test_a_definition_that_cannot_be_read_costs_its_topic_only(tmp_path: Path) -> None:
    times = 10**18 + np.arange(4)
    channels = minimal_channels(times)
    odd = dataclasses.replace(channels[2], topic="/odd", definition=b"what is\nthis", type="a/B")
    write_mcap(tmp_path / "a.mcap", [*channels, odd])
    assert read([tmp_path / "a.mcap"], DEFAULT).findings == ()
    write_mcap(tmp_path / "a.mcap", [*channels[:2], channels[3], odd])
    other = profile_with(depth={"topic": "/odd", "type": ""})
    with pytest.raises(ReadError, match=r"a\.mcap, topic '/odd': definition"):
        read([tmp_path / "a.mcap"], other)


def test_an_item_of_an_array_is_read_and_one_behind_its_end_is_refused(tmp_path: Path) -> None:
    times = 10**18 + np.arange(4)
    channels = minimal_channels(times)
    covariance = np.arange(4 * 9.0).reshape(4, 9)
    channels[0] = ros2_channel(channels[0].topic, channels[0].type, times, {
        "header.stamp": times, "orientation_covariance": covariance,
    })  # fmt: skip
    write_mcap(tmp_path / "a.mcap", channels)
    for index, there in ((0, True), (8, True), (9, False)):
        path = f"orientation_covariance[{index}]"
        heading = Quantity(path, "rad")
        profile = profile_with(heading={"heading": heading, "orientation_xyzw": None, "valid": ()})
        if there:
            log = read([tmp_path / "a.mcap"], profile)
            expected = np.mod(covariance[:, index], 2 * np.pi)
            np.testing.assert_array_equal(log.roles["heading"]["heading_rad"], expected)
        else:
            with pytest.raises(ReadError, match=r"no field 'orientation_covariance\[9\]': the arr"):
                read([tmp_path / "a.mcap"], profile)


def test_a_json_field_that_no_message_has_is_told(tmp_path: Path) -> None:
    log = read([FOLDER / "json_vehicle.mcap"], load_profile("json_vehicle"))
    assert log.findings == ()
    profile = load_profile("json_vehicle")
    spec = msgspec.structs.replace(profile.depth, depth=Quantity("dbra", "dbar"))
    with pytest.raises(ReadError, match=r"'nav/pressure' for the role depth: no message has a va"):
        read([FOLDER / "json_vehicle.mcap"], msgspec.structs.replace(profile, depth=spec))
    spec = msgspec.structs.replace(profile.travel_time, snr="noise")
    other = msgspec.structs.replace(profile, travel_time=spec)
    (finding,) = read([FOLDER / "json_vehicle.mcap"], other).findings
    assert finding.detail == "noise is unknown in every message"


# --- inspect ------------------------------------------------------------------------------------


def test_a_survey_counts_topics_finds_roles_and_has_nothing_to_remark(
    dive: tuple[Path, Log],
) -> None:
    path, truth = dive
    found = inspect([path], DEFAULT)
    assert found.roles == truth.topics
    assert found.findings == ()
    heading = next(topic for topic in found.topics if topic.topic == "/imu")
    times = truth.roles["heading"]["time_ns"]
    assert (heading.messages, heading.type, heading.encoding) == (
        len(times), "sensor_msgs/msg/Imu", "cdr",
    )  # fmt: skip
    assert (heading.first_ns, heading.last_ns) == (times[0], times[-1])
    assert heading.rate_hz == pytest.approx(10)
    assert heading.longest_gap_s == pytest.approx(0.1)
    plain = json.loads(json.dumps(found.plain()))
    keys = {"topics", "roles", "findings", "profile", "conventions", "latencies"}
    assert plain.keys() == keys
    shown = {"topic", "type", "encoding", "messages", "first_ns", "last_ns"}
    assert all(topic.keys() == shown for topic in plain["topics"])


def test_a_survey_of_a_file_with_nothing_of_ours_says_what_is_missed(tmp_path: Path) -> None:
    write_mcap(tmp_path / "empty.mcap", [])
    found = inspect([tmp_path / "empty.mcap"], DEFAULT)
    assert found.topics == ()
    assert found.roles == {}
    assert [f.what for f in found.findings] == [
        "no heading", "no velocity", "no depth", "no travel_time", "optional roles",
    ]  # fmt: skip
    assert "no topic for beacons, sound_speed, reference" in found.findings[-1].detail
    channel = dataclasses.replace(minimal_channels(np.arange(4))[0], message_encoding="ros1")
    write_mcap(tmp_path / "odd.mcap", [channel])
    found = inspect([tmp_path / "odd.mcap"], DEFAULT)
    assert [topic.messages for topic in found.topics] == [4]
    assert "/imu" not in found.roles.values()


def test_a_survey_of_any_cut_of_a_file_ends_well(dive: tuple[Path, Log], tmp_path: Path) -> None:
    data = dive[0].read_bytes()
    for length in np.linspace(8, len(data) - 1, 25).astype(int).tolist():
        (tmp_path / "cut.mcap").write_bytes(data[:length])
        found = inspect([tmp_path / "cut.mcap"], DEFAULT)
        assert any(finding.what == "cut short" for finding in found.findings)
        json.dumps(found.plain())


def test_clocks_that_are_unset_run_back_or_differ_are_found(tmp_path: Path) -> None:
    log_ns = 1_700_000_000 * 10**9 + np.arange(6) * 10**9
    own_ns = log_ns - 3_100_000_000
    own_ns[2] = 0
    own_ns[4] = own_ns[3] - 5
    channels = minimal_channels(log_ns)
    columns = {"header.stamp": own_ns}
    channels[2] = ros2_channel("/depth", "abyssnav_msgs/msg/Depth", log_ns, columns)
    write_mcap(tmp_path / "a.mcap", channels)
    clocks = [f for f in inspect([tmp_path / "a.mcap"], DEFAULT).findings if "clock" in f.what]
    assert [(f.what, f.where, f.detail) for f in clocks] == [
        ("clock: unset stamps", "/depth", "1 of 6 messages have no stamp (before 1990)"),
        ("clock: stamps run back", "/depth", "1 times, in order of log time"),
        ("clock: stamp and log differ", "/depth",
         "log time is +3.100 s after the depth stamps, in the median"),
    ]  # fmt: skip


def test_a_clock_that_drifts_or_jumps_is_told_with_how_much(tmp_path: Path) -> None:
    log_ns = 1_700_000_000 * 10**9 + np.arange(400) * 10**9
    noise_ns = np.random.default_rng(5).normal(0, 5e6, 400).astype(np.int64)
    drifting_ns = log_ns - noise_ns - np.arange(400) * 2_000_000  # 2 ms a second
    jumping_ns = log_ns - noise_ns + np.where(np.arange(400) > 250, 7 * 10**9, 0)
    for stamps_ns, kind, words in (
        (drifting_ns, "clock: drift", "an hour against log time, 0."),
        (jumping_ns, "clock: jump", "jump by +"),
        (log_ns - noise_ns, "", ""),
    ):
        channels = minimal_channels(log_ns)
        columns = {"header.stamp": stamps_ns}
        channels[2] = ros2_channel("/depth", "abyssnav_msgs/msg/Depth", log_ns, columns)
        write_mcap(tmp_path / "a.mcap", channels)
        clocks = [f for f in inspect([tmp_path / "a.mcap"], DEFAULT).findings if "clock" in f.what]
        assert [f.what for f in clocks] == ([kind] if kind else [])
        assert all(words in f.detail and "log_time" in f.detail for f in clocks)


# --- proposals ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(set(VEHICLES) - {"default"}))
def test_where_the_default_does_not_fit_the_proposal_reads_the_log(
    name: str, tmp_path: Path
) -> None:
    sample = FOLDER / f"{name}.mcap"
    found = inspect([sample], DEFAULT)
    path = tmp_path / "proposal.toml"
    path.write_text(found.proposal, encoding="utf-8")
    proposed = load_profile(path)
    assert proposed.name == "my_vehicle"
    right = load_profile(name)
    again = inspect([sample], proposed)
    assert set(again.roles) >= {"heading", "velocity", "depth", "travel_time"}
    for role in right.roles():
        ours, theirs = (getattr(p, role) for p in (proposed, right))
        assert ours == theirs, role


def test_the_profile_that_fits_is_proposed_and_none_where_nothing_is_ours(tmp_path: Path) -> None:
    channels = minimal_channels(10**18 + np.arange(4))
    write_mcap(tmp_path / "a.mcap", channels)
    fits = inspect([tmp_path / "a.mcap"], DEFAULT)
    assert fits.profile_fits
    proposed = profile_from_toml(fits.proposal, "proposal")
    for role in ("heading", "velocity", "depth", "travel_time"):
        assert getattr(proposed, role) == getattr(DEFAULT, role)
    write_mcap(tmp_path / "b.mcap", [])
    assert inspect([tmp_path / "b.mcap"], DEFAULT).proposal == ""


def test_unknown_types_are_proposed_by_the_names_of_their_fields(tmp_path: Path) -> None:
    times = 10**18 + np.arange(4)
    channels = minimal_channels(times)
    texts = {
        "/a/nav": ("a_msgs/msg/Nav", "builtin_interfaces/Time stamp\nfloat64 heading\n"),
        "/a/speed": ("a_msgs/msg/Speed", "float64 pad\na_msgs/V velocity_body\n====\n"
                     "MSG: a_msgs/V\nfloat64 x\nfloat64 y\nfloat64 z\n"),
        "/a/depth_m": ("a_msgs/msg/D", "builtin_interfaces/Time stamp\nfloat32 depth_m\n"),
    }  # fmt: skip
    odd = []
    for topic, (kind, text) in texts.items():
        stamps = {"stamp": times} if "stamp" in text else {}
        payloads = encode(parse_ros2msg(text, kind), stamps, 4)
        odd.append(Channel(topic, kind, times, payloads, text.encode()))
    write_mcap(tmp_path / "a.mcap", [*odd, channels[3]])
    path = tmp_path / "proposal.toml"
    path.write_text(inspect([tmp_path / "a.mcap"], DEFAULT).proposal, encoding="utf-8")
    proposed = load_profile(path)
    assert proposed.heading.heading == Quantity("heading", "deg")
    assert proposed.heading.time == "stamp"
    assert proposed.velocity.velocity == tuple(f"velocity_body.{axis}" for axis in "xyz")
    assert proposed.velocity.time == "log_time"
    assert proposed.depth.depth == "depth_m"
    assert read([tmp_path / "a.mcap"], proposed).roles.keys() >= {"heading", "velocity", "depth"}


def odd_json_vehicle() -> list[Channel]:
    """Names, units and times as no shipped profile has them; a minute."""
    rows: dict[str, list[dict[str, Any]]] = {
        "gyro": [{"yaw_deg": 350.0 + k, "roll_deg": 1.0, "pitch_deg": 2.0} for k in range(60)],
        "dvl/bottom": [{"u_mms": 1200, "v_mms": 10, "w_mms": -5, "lock": True}] * 60,
        "ctd": [{"utc": 1.7e9 + k, "kpa": 20_000.0 + k} for k in range(60)],
        "lbl/ranging": [
            {
                "asked_at": 1.7e9 + 10.0 * k,
                "cycle": k,
                "transponder": f"B{k % 3 + 1}",
                "tof_ms": 900,
            }
            for k in range(6)
        ],
        "usbl/fix": [{"n": 1.0, "e": 2.0, "d": 100.0}] * 6,
        "array": [{"beacons": [{"no": 1, "at": [0, 1, 2]}], "long": list(range(9))}],
    }
    return [
        Channel(
            topic, "", int(1.7e18) + 10**9 * np.arange(len(of)),
            Ragged.from_bytes([json.dumps(row).encode() for row in of]),
            message_encoding="json", schema_encoding="",
        )
        for topic, of in rows.items()
    ]  # fmt: skip


def test_odd_json_is_proposed_by_names_units_and_what_the_times_can_be(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", odd_json_vehicle())
    found = inspect([tmp_path / "a.mcap"], DEFAULT)
    path = tmp_path / "proposal.toml"
    path.write_text(found.proposal, encoding="utf-8")
    proposed = load_profile(path)
    assert proposed.heading.heading == Quantity("yaw_deg", "deg")
    assert proposed.heading.roll == Quantity("roll_deg", "deg")
    assert proposed.heading.time == "log_time"
    assert proposed.velocity.velocity == tuple(Quantity(f"{a}_mms", "mm/s") for a in "uvw")
    assert proposed.velocity.frame == "frd"
    assert proposed.depth.depth == Quantity("kpa", "kPa")
    assert proposed.depth.time == TimeField("utc", "s")
    assert proposed.travel_time.ping_time == TimeField("asked_at", "s")
    assert proposed.travel_time.ping_id == "cycle"
    assert proposed.travel_time.travel_time == Quantity("tof_ms", "ms")
    assert proposed.position is not None
    assert (proposed.position.position, proposed.position.frame) == (("n", "e"), "ned")
    assert proposed.reference is None
    assert (
        '\nframe = "frd"  # forward, starboard, down; or "flu": forward, port, up\n'
        in found.proposal
    )
    assert "#   array: beacons.no, beacons.at, long\n" in found.proposal
    log = read([tmp_path / "a.mcap"], proposed)
    assert log.roles["velocity"]["velocity_body_mps"][0].tolist() == [1.2, 0.01, -0.005]
    assert log.roles["travel_time"]["beacon_id"].tolist() == [1, 2, 3, 1, 2, 3]
    assert set(inspect([tmp_path / "a.mcap"], proposed).roles) == {
        "heading", "velocity", "depth", "travel_time", "position",
    }  # fmt: skip


def test_what_cannot_be_guessed_is_a_blank_with_the_fields_to_choose_from(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", odd_json_vehicle()[4:])
    found = inspect([tmp_path / "a.mcap"], DEFAULT)
    assert '[travel_time]\ntopic = "?"' in found.proposal
    path = tmp_path / "proposal.toml"
    path.write_text(found.proposal, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"\[heading\] topic '\?': name one of the log's"):
        load_profile(path)


def test_a_profile_without_beacons_is_told_unless_the_settings_have_them(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", minimal_channels(10**18 + np.arange(4)))
    bare = msgspec.structs.replace(DEFAULT, beacons=None)
    told = [f.what for f in inspect([tmp_path / "a.mcap"], bare).findings]
    assert told.count("no beacons") == 1
    config = Config(beacon=(BeaconSetting(id=1, turn_around_s=0.1, position_m=(0, 0, -100)),))
    assert "no beacons" not in [
        f.what for f in inspect([tmp_path / "a.mcap"], bare, config).findings
    ]


def json_replies(*values: dict[str, Any]) -> Channel:
    rows = [json.dumps(value).encode() for value in values]
    times = 10**18 + np.arange(len(rows))
    return Channel(
        "/lbl/travel_time", "", times, Ragged.from_bytes(rows),
        message_encoding="json", schema_encoding="",
    )  # fmt: skip


def replies_of(tmp_path: Path, *values: dict[str, Any], **changes: Any) -> Columns:
    channels = minimal_channels(10**18 + np.arange(4))
    write_mcap(tmp_path / "a.mcap", [*channels[:3], json_replies(*values)])
    bare = {"type": "", "time": "log_time", "ping_time": TimeField("asked", "s"), "snr": None}
    profile = profile_with(travel_time=bare | changes)
    return read([tmp_path / "a.mcap"], profile).roles["travel_time"]


def test_beacons_named_in_text_go_by_the_number_and_pings_not_counted_by_their_time(
    tmp_path: Path,
) -> None:
    rows = [
        {"asked": 1e9 + 24 * (k // 2), "beacon_id": f"B{k + 7}", "travel_time": 1.0}
        for k in range(4)
    ]
    replies = replies_of(tmp_path, *rows, ping_id="")
    assert replies["beacon_id"].tolist() == [7, 8, 9, 10]
    assert replies["ping_id"].tolist() == [0, 0, 1, 1]
    for odd, told in (("north", "'north' has not one number in it"),
                      ("A7", "is another's number too")):  # fmt: skip
        with pytest.raises(ReadError, match=f"beacon_id of /lbl/travel_time: .*{told}"):
            replies_of(tmp_path, *rows, rows[0] | {"beacon_id": odd}, ping_id="")
    with pytest.raises(ReadError, match="is no whole number"):
        replies_of(tmp_path, rows[0] | {"beacon_id": 1.5}, ping_id="")


def test_a_time_that_no_message_has_is_refused_with_the_cure(tmp_path: Path) -> None:
    row = {"asked": 1e9, "ping_id": 1, "beacon_id": None, "travel_time": 1.0}
    assert replies_of(tmp_path, row)["beacon_id"].tolist() == [-1]
    with pytest.raises(ReadError, match="heard of /lbl/travel_time is unknown in every message"):
        replies_of(tmp_path, row, time="heard")
    some = replies_of(tmp_path, row | {"heard": 1.5e9}, row, time=TimeField("heard", "s"))
    assert some["time_ns"].tolist() == [1_500_000_000_000_000_000, 0]


def test_degrees_read_as_radians_are_told(tmp_path: Path) -> None:
    channels = minimal_channels(10**18 + np.arange(4))
    channels[0] = dataclasses.replace(
        json_replies(*({"hdg": angle} for angle in (10.0, 100.0, 200.0, 359.5))), topic="/imu"
    )
    write_mcap(tmp_path / "a.mcap", channels)
    compass = {"type": "", "time": "log_time", "orientation_xyzw": None, "valid": ()}
    profile = profile_with(heading=compass | {"heading": "hdg"})
    (told,) = read([tmp_path / "a.mcap"], profile).findings
    assert (told.what, told.where) == ("odd heading", "/imu")
    assert told.detail == 'hdg reaches 360 rad: does the profile lack unit = "deg"?'
    profile = profile_with(heading=compass | {"heading": Quantity("hdg", "deg")})
    assert read([tmp_path / "a.mcap"], profile).findings == ()


def test_a_file_cut_before_its_first_topic_says_so(dive: tuple[Path, Log], tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(dive[0].read_bytes()[:60])
    with pytest.raises(ReadError, match=r"cut\.mcap at byte \d+: cut short before any message"):
        read([tmp_path / "cut.mcap"], DEFAULT)
    (tmp_path / "empty.mcap").write_bytes(b"")
    with pytest.raises(ReadError, match=r"empty\.mcap: not MCAP: it is empty"):
        read([tmp_path / "empty.mcap"], DEFAULT)


def test_recordings_of_different_dives_are_refused_together():
    samples = Path(__file__).parent.parent / "sample_logs"
    both = [samples / "voyage_1.mcap", samples / "voyage_2.mcap"]
    with pytest.raises(ReadError, match=r"voyage_1.mcap and voyage_2.mcap lie 79 days apart on"):
        read(both, load_profile())


def test_recordings_of_the_same_time_are_refused_together():
    samples = Path(__file__).parent.parent / "sample_logs"
    both = [samples / "voyage_1.mcap", samples / "cut_short.mcap"]
    with pytest.raises(ReadError, match="of the same time: not parts of one recording"):
        read(both, load_profile())
