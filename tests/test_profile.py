# SPDX-License-Identifier: Apache-2.0
"""Profiles: what is refused, and with which hint."""

from pathlib import Path

import pytest

from abyssnav.errors import ConfigError
from abyssnav.profile import (
    REQUIRED,
    Quantity,
    load_profile,
    profile_names,
    quantities,
)

TEXT = """
[heading]
topic = "/imu"
orientation_xyzw = ["q.x", "q.y", "q.z", "q.w"]
[velocity]
topic = "/dvl"
velocity = ["v.x", { field = "v.y", unit = "cm/s", scale = -1.0 }, "v.z"]
[depth]
topic = "/depth"
depth = { field = "p", unit = "dbar", offset = 10.1325 }
[travel_time]
topic = "/lbl"
travel_time = { field = "tt", unit = "ms" }
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "vehicle.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_default_profile_is_that_of_the_contract() -> None:
    profile = load_profile()
    assert profile.name == "default"
    assert {role: (spec.topic, spec.type) for role, spec in profile.roles().items()} == {
        "heading": ("/imu", "sensor_msgs/msg/Imu"),
        "velocity": ("/dvl", "geometry_msgs/msg/TwistWithCovarianceStamped"),
        "depth": ("/depth", "abyssnav_msgs/msg/Depth"),
        "travel_time": ("/lbl/travel_time", "abyssnav_msgs/msg/TravelTime"),
        "beacons": ("/lbl/beacons", "abyssnav_msgs/msg/BeaconArray"),
        "sound_speed": ("/sound_speed/profile", "abyssnav_msgs/msg/SoundSpeedProfile"),
        "reference": ("/reference", "nav_msgs/msg/Odometry"),
    }


@pytest.mark.parametrize("name", profile_names())
def test_every_shipped_profile_loads_and_maps_what_is_required(name: str) -> None:
    profile = load_profile(name)
    assert profile.name == name
    assert profile.about
    assert set(REQUIRED) <= set(profile.roles())


def test_a_profile_of_a_vehicle_takes_its_name_from_the_file(tmp_path: Path) -> None:
    profile = load_profile(written(tmp_path, TEXT))
    assert profile.name == "vehicle"
    assert quantities(profile.velocity)["velocity[1]"] == Quantity("v.y", "cm/s", -1.0)
    assert quantities(profile.depth) == {"depth": Quantity("p", "dbar", offset=10.1325)}


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("topic = \"/dvl\"", "topik = \"/dvl\"", r"unknown key \[velocity\] topik; nearest: topic"),
        ("[depth]", "[dept]", "unknown key dept; nearest: depth"),
        ('unit = "ms"', 'unit = "msec"', "unknown unit 'msec'; nearest: ms"),
        ('unit = "ms"', 'unit = "m"', r"\[travel_time\] travel_time: m is a unit of length"),
        ('unit = "dbar"', 'unit = "deg"', r"\[depth\] depth: deg is a unit of angle"),
        ('orientation_xyzw = ["q.x", "q.y", "q.z", "q.w"]', "", "needs orientation_xyzw or"),
        ('topic = "/lbl"', 'topic = "/lbl"\ntime = { field = "t", unit = "m" }', "no unit of time"),
        ("velocity = [", "speed = [", "unknown key"),
        ("[heading]", "[heading", "not TOML"),
        ('topic = "/imu"', "topic = 3", r"Expected `str \| array`, got `int`"),
        ("[depth]\ntopic", "[depth]\nframe", "unknown key"),
        ('topic = "/lbl"', 'topic = "?"', r"\[travel_time\] topic '\?': name one of the log's"),
        ('topic = "/lbl"', 'topic = "/lbl"\nbeacon_id = ""', r"\[travel_time\] needs beacon_id"),
        ('field = "p"', 'field = "?"', r"\[depth\] needs depth"),
        ('unit = "dbar"', 'unit = "feet"', "unknown unit 'feet'; nearest: .*; known: m, cm, .*psi"),
        ('topic = "/dvl"', 'topic = "/dvl"\nframe = "fdr"',
         r"\[velocity\] frame: 'fdr' is none of flu, frd"),
    ],
)  # fmt: skip
def test_a_profile_that_no_log_could_be_read_with_is_refused(
    old: str, new: str, problem: str, tmp_path: Path
) -> None:
    assert old in TEXT
    with pytest.raises(ConfigError, match=problem):
        load_profile(written(tmp_path, TEXT.replace(old, new)))


def test_velocity_needs_its_three_fields(tmp_path: Path) -> None:
    lines = [line for line in TEXT.splitlines() if not line.startswith("velocity =")]
    with pytest.raises(ConfigError, match=r"\[velocity\] needs velocity, three fields"):
        load_profile(written(tmp_path, "\n".join(lines)))


def test_a_profile_that_is_not_there_is_named_with_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no profile 'defualt'; nearest: default"):
        load_profile("defualt")
    with pytest.raises(ConfigError, match=r"none\.toml: cannot be read"):
        load_profile(tmp_path / "none.toml")


def test_a_vehicle_that_does_not_count_its_pings_has_a_profile(tmp_path: Path) -> None:
    text = TEXT.replace('topic = "/lbl"', 'topic = "/lbl"\nping_id = ""')
    assert "ping_id" not in quantities(load_profile(written(tmp_path, text)).travel_time)


def test_the_profile_in_the_docs_loads_as_it_is_printed(tmp_path: Path) -> None:
    page = Path(__file__).parent.parent / "docs" / "how_to" / "my_topics.md"
    text = page.read_text(encoding="utf-8").split("```toml")[1].split("```")[0]
    profile = load_profile(written(tmp_path, text))
    assert profile.name == "our_auv"
    assert set(profile.roles()) == set(REQUIRED)
