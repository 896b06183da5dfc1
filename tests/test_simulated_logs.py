# SPDX-License-Identifier: Apache-2.0
"""Logs of simulated dives, read by the official library and by ours."""

import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from msgspec.structs import replace

from abyssnav.align import align
from abyssnav.config import Config, load_config, schemas
from abyssnav.profile import load_profile
from abyssnav.read import read
from abyssnav.simulate import Scenario, load_scenario, simulate, to_log, write_log
from abyssnav.simulate import scenario as settings

SAMPLES = Path(__file__).parent.parent / "sample_logs"
SHORT = replace(
    load_scenario("voyage_2"),
    duration_s=300.0,
    dvl=settings.Dvl(gaps_per_hour=0, lost_from_s=100.0, lost_for_s=60.0),
)
CONTRACT = {
    "/imu": "sensor_msgs/msg/Imu",
    "/dvl": "geometry_msgs/msg/TwistWithCovarianceStamped",
    "/depth": "abyssnav_msgs/msg/Depth",
    "/lbl/travel_time": "abyssnav_msgs/msg/TravelTime",
    "/lbl/beacons": "abyssnav_msgs/msg/BeaconArray",
    "/sound_speed/profile": "abyssnav_msgs/msg/SoundSpeedProfile",
    "/reference": "nav_msgs/msg/Odometry",
}


@pytest.fixture(scope="module")
def dive():
    return simulate(SHORT)


@pytest.fixture(scope="module")
def path(dive, tmp_path_factory):
    file = tmp_path_factory.mktemp("logs") / "dive.mcap"
    write_log(dive, file)
    return file


@pytest.fixture(scope="module")
def messages(path):
    """Topic -> messages as the official decoder gives them."""
    found = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, record, message in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((schema.name, record, message))
    return found


def nanoseconds(stamp):
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def test_the_official_library_finds_the_contracts_topics_types_and_counts(messages, dive):
    assert {topic: found[0][0] for topic, found in messages.items()} == CONTRACT
    assert {topic: len(found) for topic, found in messages.items()} == {
        "/imu": 3001,
        "/dvl": 1500,
        "/depth": 300,
        "/lbl/travel_time": len(dive.replies),
        "/lbl/beacons": 1,
        "/sound_speed/profile": 1,
        "/reference": 301,
    }


def test_a_compass_message_points_the_bow_where_the_compass_said(messages, dive):
    for row in (0, 1500, 3000):
        _, record, imu = messages["/imu"][row]
        q = imu.orientation
        bow = np.array(
            [1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y + q.z * q.w), 2 * (q.x * q.z - q.y * q.w)]
        )
        heading, pitch = dive.heading.heading_rad[row], dive.heading.pitch_rad[row]
        level = [np.sin(heading) * np.cos(pitch), np.cos(heading) * np.cos(pitch), np.sin(pitch)]
        np.testing.assert_allclose(bow, level, atol=1e-12)
        starboard_up = -2 * (q.y * q.z + q.x * q.w)  # of the port axis the up component, negated
        assert starboard_up == pytest.approx(
            -np.sin(dive.heading.roll_rad[row]) * np.cos(pitch), abs=1e-12
        )
        assert nanoseconds(imu.header.stamp) == record.log_time
        assert record.log_time == dive.start_ns + round(dive.heading.t_s[row] * 1e9)


def test_a_velocity_message_is_forward_port_up_and_nan_without_bottom_lock(messages, dive):
    for row, (_, _, twist) in enumerate(messages["/dvl"]):
        linear = twist.twist.twist.linear
        np.testing.assert_array_equal(
            [linear.x, -linear.y, -linear.z], dive.velocity.velocity_body_mps[row]
        )
    assert sum(np.isnan(m.twist.twist.linear.x) for _, _, m in messages["/dvl"]) == 300


def test_a_reply_is_stamped_when_it_was_heard(messages, dive):
    for row, (_, _, reply) in enumerate(messages["/lbl/travel_time"]):
        flight_ns = nanoseconds(reply.header.stamp) - nanoseconds(reply.ping_time)
        assert flight_ns == round(reply.travel_time * 1e9)
        assert reply.ping_id == dive.replies.ping_id[row]
        assert reply.beacon_id == dive.beacons.id[dive.replies.beacon[row]]


def test_the_reference_is_the_truth_to_the_millimetre(messages, dive):
    at = [m.pose.pose.position for _, _, m in messages["/reference"]]
    position = np.array([[p.x, p.y, p.z] for p in at])
    np.testing.assert_allclose(position, dive.position_at(np.arange(301.0)), atol=0.00051)


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_what_is_written_reads_back_as_the_log_in_memory(dive, tmp_path, compression):
    path = tmp_path / "dive.mcap"
    write_log(dive, path, compression)
    ours, log = to_log(dive, "dive"), read([path], load_profile())
    assert (log.name, log.profile, dict(log.topics)) == (ours.name, ours.profile, dict(ours.topics))
    assert log.findings == ()
    assert set(log.roles) == set(ours.roles)
    for role, columns in ours.roles.items():
        assert set(log.roles[role]) == set(columns)
        for name, values in columns.items():
            back = log.roles[role][name]
            if role == "heading" and name != "time_ns":  # through sines and cosines
                turned = (back - values + np.pi) % (2 * np.pi) - np.pi
                np.testing.assert_allclose(turned, 0.0, atol=1e-14)
            else:
                np.testing.assert_array_equal(back, values)


def test_the_same_scenario_gives_the_same_bytes(dive, path, tmp_path):
    again = tmp_path / "again.mcap"
    write_log(simulate(SHORT), again)
    assert again.read_bytes() == path.read_bytes()


def test_a_constant_sound_speed_leaves_no_profile_in_the_log(tmp_path):
    constant = Scenario(duration_s=60.0, sound=settings.Sound(profile="constant"))
    write_log(simulate(constant), tmp_path / "dive.mcap")
    assert "sound_speed" not in read([tmp_path / "dive.mcap"], load_profile()).roles


@pytest.mark.parametrize("name", ["voyage_1", "voyage_2", "clean"])
def test_the_sample_logs_are_their_scenarios(name):
    """`make sample` makes them anew; the tolerances are one step of the output."""
    path = SAMPLES / f"{name}.mcap"
    assert path.stat().st_size < 3_000_000
    log, ours = read([path], load_profile()), to_log(simulate(load_scenario(name)), name)
    for role, tolerance in [("travel_time", 1e-6), ("velocity", 1.1e-3), ("reference", 1.1e-3)]:
        for column, values in ours.roles[role].items():
            np.testing.assert_allclose(log.roles[role][column], values, rtol=0, atol=tolerance)


def test_the_cut_log_ends_in_the_middle_of_a_chunk():
    cut = (SAMPLES / "cut_short.mcap").read_bytes()
    assert (SAMPLES / "voyage_1.mcap").read_bytes().startswith(cut)
    place, opcode, length = 8, 0, 0
    while place + 9 <= len(cut):
        opcode, length = struct.unpack_from("<BQ", cut, place)
        place += 9 + length
    assert place > len(cut)
    assert opcode == 0x06


@pytest.mark.parametrize("kind", ["gnss", "usbl"])
def test_position_fixes_are_read_back_by_a_profile_that_names_their_topic(tmp_path, kind):
    fixes_every_s = {"position": settings.Position(gnss_period_s=1.0, usbl_period_s=20.0)}
    surface = settings.Vehicle(descent_s=280.0, surface_s=120.0)
    floor = settings.Floor(depth_m=500.0)
    dive = simulate(replace(SHORT, vehicle=surface, floor=floor, **fixes_every_s))
    write_log(dive, tmp_path / "dive.mcap")
    fields = {
        "gnss": 'topic = "/gnss/fix"\ntype = "sensor_msgs/msg/NavSatFix"\nlatitude = "latitude"\n'
        'longitude = "longitude"\ncovariance = "position_covariance"',
        "usbl": 'topic = "/usbl"\ntype = "geometry_msgs/msg/PoseWithCovarianceStamped"\n'
        'position = ["pose.pose.position.x", "pose.pose.position.y", "pose.pose.position.z"]\n'
        'covariance = "pose.covariance"',
    }
    profile = tmp_path / "mine.toml"
    default = (schemas() / "profiles" / "default.toml").read_text(encoding="utf-8")
    profile.write_text(f"{default}\n[position]\n{fields[kind]}\n", encoding="utf-8")
    log = read([tmp_path / "dive.mcap"], load_profile(str(profile)))
    aligned, fixes = align(log, Config()), dive.positions[kind]
    assert len(aligned.positions) == len(fixes) > 10
    np.testing.assert_allclose(
        aligned.positions.position_enu_m, fixes.position_enu_m[:, :2], atol=0.02
    )
    np.testing.assert_allclose(
        aligned.positions.position_cov_m2, (fixes.sigma_m**2)[:, None, None] * np.eye(2)
    )


def test_buoys_are_read_back_as_beacons_that_move(tmp_path):
    dive = simulate(
        replace(
            SHORT,
            buoys=settings.Buoys(drift_mps=0.5),
            floor=settings.Floor(depth_m=300.0, relief_m=10.0),
            beacons=settings.Beacons(distance_m=600.0),
        )
    )
    write_log(dive, tmp_path / "dive.mcap")
    aligned = align(read([tmp_path / "dive.mcap"], load_profile()), Config())
    assert aligned.beacons.moving.all()
    replies = aligned.replies
    true = dive.truth.beacon_motion.place(replies.t_reply_s, replies.beacon)
    off_m = np.linalg.norm(replies.beacon_enu_m - true, axis=1)[replies.t_reply_s < 270.0]
    assert 0.5 < np.sqrt(np.mean(off_m**2)) < 4.0


def test_settings_that_a_log_cannot_hold_are_written_beside_it(abyssnav, tmp_path):
    scenario = tmp_path / "mine.toml"
    scenario.write_text(
        "duration_s = 60.0\nsound.logged = false\nvehicle.transducer_offset_m = [1.0, 0.0, 2.0]\n",
        encoding="utf-8",
    )
    ended = abyssnav("simulate", scenario, "-o", tmp_path / "dive.mcap")
    assert "dive.settings.toml: give it to abyssnav run with --config" in ended.out
    settings = load_config(tmp_path / "dive.settings.toml")
    assert settings.vehicle.transducer_offset_m == (1.0, 0.0, 2.0)
    assert 1540 < settings.acoustics.sound_speed_mps < 1560


def test_a_dive_that_needs_no_settings_has_none_beside_it(abyssnav, tmp_path):
    scenario = tmp_path / "mine.toml"
    scenario.write_text("duration_s = 60.0\n", encoding="utf-8")
    abyssnav("simulate", scenario, "-o", tmp_path / "dive.mcap")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dive.mcap", "mine.toml"]
