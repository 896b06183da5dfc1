# SPDX-License-Identifier: Apache-2.0
"""Combinations that no log could be read with."""

from pathlib import Path

import pytest
from json_logs import SENSORS
from test_profile import TEXT

from abyssnav.errors import ConfigError
from abyssnav.profile import profile_from_toml


@pytest.mark.parametrize(
    ("role", "keys", "problem"),
    [
        ("travel_time", 'range = "r"', "range needs range_sound_speed"),
        ("travel_time", 'range_sound_speed = 1500', "range_sound_speed without range"),
        ("travel_time", 'range = "r"\nrange_sound_speed = 150', "150 m/s is of no water"),
        ("travel_time", 'range = "r"\nrange_sound_speed = 1500\none_way = true', "one_way is of"),
        ("travel_time", 'range = "r"\nrange_sound_speed = 1500\ntravel_time = "t"',
         "has travel_time and range"),
        ("travel_time", 'travel_time = ["a", "b"]\nbeacon_id = [1]', "2 slots of travel_time need"),
        ("travel_time", "beacon_id = [1]", "beacon_id is a list"),
        ("travel_time", 'travel_time = ["a"]\nbeacon_id = [1]\nping_time = ""', "slots need ping"),
        ("travel_time", 'turn_around = "remove"', "'remove' is none of included, removed"),
        ("travel_time", 'range = { field = "r", unit = "s" }\nrange_sound_speed = 1500',
         "s is a unit of time, not of length"),
        ("velocity", 'frame = "enu"\nmount_rpy_deg = [0, 0, 45]', "has no mount_rpy_deg"),
        ("velocity", 'per = { field = "dt", unit = "m" }', "m is a unit of length, not of time"),
        ("velocity", 'bottom_trak = "b"', r"unknown key .velocity. bottom_trak; nearest: bottom_t"),
        ("heading", 'orientation_xyzw = ["x", "y", "z", "w"]', "has orientation_xyzw and heading"),
        ("beacons", 'topic = "b"\nlatitude = "lat"', "latitude without longitude and depth"),
        ("beacons", 'topic = "b"\nposition = ["x", "y", "z"]\nlatitude = "a"', "has position and"),
        ("beacons", 'topic = "b"\nturn_around = -1.0', "turn_around = -1.0: must be at least 0"),
        ("position", 'topic = "p"', "needs latitude and longitude, or position"),
        ("position", 'topic = "p"\nlatitude = "a"', "latitude without longitude"),
        ("position", 'topic = "p"\nposition = ["a"]', "position has 1 components"),
        ("position", 'topic = "p"\nposition = ["a", "b"]\nsigma = 1.0\ncovariance = "c"',
         "has sigma and covariance"),
        ("position", 'topic = "p"\nposition = ["a", "b"]\nsigma = 0.0', "sigma is not above 0"),
        ("sound_speed", 'topic = "s"\nkind = "mean"\ndepth = "d"', "kind = 'mean' has no depth"),
        ("sound_speed", 'topic = "s"\nkind = "series"', "'series' is none of profile, samples"),
        ("altitude", 'topic = "a"\naltitude = { field = "a", unit = "bar" }', "bar is a unit of"),
    ],
)  # fmt: skip
def test_impossible_combinations_are_refused_by_name(role: str, keys: str, problem: str) -> None:
    text = SENSORS + '[travel_time]\ntopic = "r"\n'
    text = text.replace(f"[{role}]\n", f"[{role}]\n{keys}\n")
    if f"[{role}]" not in text:
        text += f"[{role}]\n{keys}\n"
    if role == "velocity" and "frame" in keys:
        text = text.replace('frame = "frd"\n', "")
    if role == "velocity" and "per" in keys.split(" ", maxsplit=1)[0]:
        text = text.replace('"v[0]"', '{ field = "v[0]", unit = "m" }')
    with pytest.raises(ConfigError, match=problem):
        profile_from_toml(text, "test")


def test_without_travel_times_there_must_be_positions() -> None:
    with pytest.raises(
        ConfigError, match=r"test: needs \[travel_time\]; only a log with \[position\]"
    ):
        profile_from_toml(SENSORS, "test")
    text = SENSORS + '[position]\ntopic = "p"\nposition = ["e", "n"]\n'
    assert profile_from_toml(text, "test").required()[-1] == "position"


def test_increments_are_lengths(tmp_path: Path) -> None:
    text = TEXT.replace("[depth]", 'per = { field = "dt", unit = "us" }\n[depth]')
    with pytest.raises(ConfigError, match="cm/s is a unit of speed, not of length"):
        profile_from_toml(text, "test")
