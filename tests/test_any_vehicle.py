# SPDX-License-Identifier: Apache-2.0
"""What a profile can say, read from files: arrays, slots, lists of topics, other units."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_profile import TEXT
from vehicles import json_channel, ros_roles, short_dive

from abyssnav.config import BeaconSetting
from abyssnav.errors import ConfigError, ReadError
from abyssnav.formats.mcap.writer import Channel, ros2_channel, write_mcap
from abyssnav.geometry import body_to_body
from abyssnav.profile import Profile, load_profile, profile_from_toml
from abyssnav.read import inspect, read
from abyssnav.read.beacon_file import beacons_from_file
from abyssnav.tables import Columns, Finding, Log

START_NS = 1_700_000_000_000_000_000
SENSORS = """
[heading]
topic = "h"
time = "log_time"
heading = { field = "deg", unit = "deg" }
[velocity]
topic = "v"
time = "log_time"
velocity = ["v[0]", "v[1]", "v[2]"]
frame = "frd"
[depth]
topic = "d"
time = "log_time"
"""


def log_of(tmp_path: Path, text: str, **topics: list[dict[str, Any]]) -> Log:
    """A JSON log under a profile: three sensors, and the topics given at a second each."""
    seconds = START_NS + 10**9 * np.arange(4)
    rows = {
        "h": [{"deg": 90.0 + k} for k in range(4)],
        "v": [{"v": [1.0, 0.5, 0.1], "dt": 200, "mode": 1} for _ in range(4)],
        "d": [{"depth": 100.0 + k} for k in range(4)],
        **topics,
    }
    write_mcap(
        tmp_path / "a.mcap",
        [json_channel(topic, seconds[: len(one)], one) for topic, one in rows.items()],
    )
    return read([tmp_path / "a.mcap"], profile_from_toml(text, "test"))


def replies(tmp_path: Path, keys: str, rows: list[dict[str, Any]]) -> Columns:
    text = SENSORS + f'[travel_time]\ntopic = "r"\ntime = "log_time"\n{keys}'
    return log_of(tmp_path, text, r=rows).roles["travel_time"]


# --- replies ------------------------------------------------------------------------------------

ASKED = 'ping_time = { field = "asked", unit = "s" }\nping_id = ""\n'


def test_an_array_of_replies_is_one_row_an_element(tmp_path: Path) -> None:
    rows = [
        {"asked": 1.7e9, "replies": [{"id": 3, "t": 1.5}, {"id": 1, "t": 2.5}]},
        {"asked": 1.7e9 + 10, "replies": []},
        {"asked": 1.7e9 + 20, "replies": [{"id": 2, "t": 2.0}]},
    ]
    found = replies(tmp_path, ASKED + 'beacon_id = "replies.id"\ntravel_time = "replies.t"', rows)
    assert found["beacon_id"].tolist() == [3, 1, 2]
    assert found["travel_time_s"].tolist() == [1.5, 2.5, 2.0]
    assert ((found["ping_time_ns"] - START_NS) // 10**9).tolist() == [0, 0, 20]
    assert found["derived"].tolist() == [2, 2, 2]
    first = replies(
        tmp_path, ASKED + 'beacon_id = "replies[0].id"\ntravel_time = "replies[0].t"', rows[::2]
    )
    assert first["beacon_id"].tolist() == [3, 2]


def test_elements_with_times_of_their_own_keep_them(tmp_path: Path) -> None:
    rows = [{"asked": 1.7e9, "replies": [{"id": 3, "t": 1.5, "at": 1.7e9 + 1.5}]}]
    keys = ASKED + 'beacon_id = "replies.id"\ntravel_time = "replies.t"'
    text = SENSORS + '[travel_time]\ntopic = "r"\ntime = { field = "replies.at", unit = "s" }\n'
    found = log_of(tmp_path, text + keys, r=rows).roles["travel_time"]
    assert ((found["time_ns"] - START_NS) / 1e9).tolist() == [1.5]
    assert "derived" not in found


def test_slots_are_replies_but_for_those_without_one(tmp_path: Path) -> None:
    keys = ASKED + (
        "beacon_id = [7, 9]\none_way = true\n"
        'travel_time = [{ field = "a", unit = "ms", sentinel = -1.0 }, '
        '{ field = "b", unit = "ms", sentinel = -1.0 }]'
    )
    rows = [{"asked": 1.7e9, "a": 800, "b": 900}, {"asked": 1.7e9 + 9, "a": -1, "b": 700}]
    found = replies(tmp_path, keys, rows)
    assert found["beacon_id"].tolist() == [7, 9, 9]
    np.testing.assert_allclose(found["travel_time_s"], [1.6, 1.8, 1.4])
    assert found["without_turn_around"].all()
    assert found["ping_id"].tolist() == [0, 0, 1]


@pytest.mark.parametrize(
    ("keys", "row", "expected_s", "without"),
    [
        ('travel_time = { field = "t", unit = "us" }', {"t": 2_500_000}, 2.5, False),
        ('travel_time = "t"\nturn_around = "removed"', {"t": 2.4}, 2.4, True),
        ('travel_time = "t"\none_way = true', {"t": 1.2}, 2.4, True),
        ('range = "m"\nrange_sound_speed = 1500', {"m": 1800.0}, 2.4, True),
        ('range = { field = "m", unit = "km" }\nrange_sound_speed = { field = "c", scale = 0.1 }',
         {"m": 1.8, "c": 15_000}, 2.4, True),
    ],
)  # fmt: skip
def test_what_a_reply_measures_becomes_a_two_way_time(
    keys: str, row: dict[str, Any], expected_s: float, without: bool, tmp_path: Path
) -> None:
    found = replies(tmp_path, f'ping_time = ""\nping_id = ""\nbeacon_id = "id"\n{keys}',
                    [{"id": 4, **row}])  # fmt: skip
    np.testing.assert_allclose(found["travel_time_s"], [expected_s])
    assert ("without_turn_around" in found) == without
    assert found["derived"].tolist() == [1]


def test_a_turn_around_of_each_reply_is_read_in_its_unit(tmp_path: Path) -> None:
    keys = ASKED + 'beacon_id = "id"\ntravel_time = "t"\n'
    keys += 'turn_around_field = { field = "tat", unit = "ms" }'
    rows = [{"id": 1, "asked": 1.7e9, "t": 2.0, "tat": tat} for tat in (250, None)]
    np.testing.assert_allclose(replies(tmp_path, keys, rows)["turn_around_s"], [0.25, np.nan])


def test_replies_that_are_not_valid_are_left_out_aloud(tmp_path: Path) -> None:
    keys = ASKED + 'beacon_id = "id"\ntravel_time = "t"\nvalid = { field = "kind", equals = 2 }'
    rows = [{"id": k, "asked": 1.7e9, "t": 2.0, "kind": 1 + k % 2} for k in range(4)]
    text = SENSORS + f'[travel_time]\ntopic = "r"\ntime = "log_time"\n{keys}'
    log = log_of(tmp_path, text, r=rows)
    assert log.roles["travel_time"]["beacon_id"].tolist() == [1, 3]
    assert (
        Finding("replies not valid", "r", "2 of 4 replies are not valid: left out") in log.findings
    )


def test_arrays_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    keys = ASKED + 'beacon_id = "ids"\ntravel_time = "times"'
    rows = [{"asked": 1.7e9, "ids": [1, 2], "times": [1.0, 2.0, 3.0]}]
    with pytest.raises(ReadError, match=r"r: arrays differ in length: \d \w+, \d \w+"):
        replies(tmp_path, keys, rows)
    with pytest.raises(ReadError, match=r"r: several replies a message need ping_time"):
        replies(
            tmp_path, 'ping_time = ""\nping_id = ""\nbeacon_id = "ids"\ntravel_time = "ids"', rows
        )


def test_samples_in_a_batch_need_times_of_their_own(tmp_path: Path) -> None:
    text = SENSORS.replace('field = "deg"', 'field = "s.deg"')
    text = text.replace('"log_time"', '{ field = "s.t", unit = "s" }', 1)
    text += f'[travel_time]\ntopic = "r"\ntime = "log_time"\n{ASKED}'
    text += 'beacon_id = "id"\ntravel_time = "t"'
    batches = [{"s": [{"t": 1.7e9 + k, "deg": 10.0}, {"t": 1.7e9 + k + 0.5, "deg": 20.0}]}
               for k in range(3)]  # fmt: skip
    row = [{"asked": 1.7e9, "id": 1, "t": 1.0}]
    heading = log_of(tmp_path, text, h=batches, r=row).roles["heading"]
    np.testing.assert_allclose(np.diff(heading["time_ns"]) / 1e9, 0.5)
    np.testing.assert_allclose(np.degrees(heading["heading_rad"][:2]), [10.0, 20.0])
    bare = text.replace('{ field = "s.t", unit = "s" }', '"log_time"')
    with pytest.raises(
        ReadError, match=r"s\.deg of h is an array; s\.deg\[k\] is one of its items"
    ):
        log_of(tmp_path, bare, h=batches, r=row)


# --- topics -------------------------------------------------------------------------------------

ONE_REPLY = 'beacon_id = "id"\ntravel_time = "t"\n'


@pytest.mark.parametrize("topic", ['"lbl/*/reply"', '["lbl/2/reply", "lbl/1/reply"]'])
def test_several_topics_of_a_role_are_one_table_in_order_of_time(
    topic: str, tmp_path: Path
) -> None:
    text = SENSORS + f'[travel_time]\ntopic = {topic}\ntime = "log_time"\n{ASKED}{ONE_REPLY}'
    rows = {
        f"lbl/{b}/reply": [{"id": b, "asked": 1.7e9, "t": 1.0 + k} for k in range(3)]
        for b in (1, 2)
    }
    log = log_of(tmp_path, text, **rows, **{"lbl/other": [{"id": 9, "asked": 1.7e9, "t": 1.0}]})
    assert log.roles["travel_time"]["beacon_id"].tolist() == [1, 2, 1, 2, 1, 2]


def channels_of(log: Log) -> list[Channel]:
    return list(ros_roles(log).values())


def test_a_dive_split_by_topic_by_time_and_by_both_is_the_same_dive(tmp_path: Path) -> None:
    channels = channels_of(short_dive())
    middle = int(np.median(channels[0].log_time_ns))

    def part(channel: Channel, late: bool) -> Channel:
        rows = np.flatnonzero((channel.log_time_ns > middle) == late)
        return dataclasses.replace(
            channel, log_time_ns=channel.log_time_ns[rows], payloads=channel.payloads[rows]
        )

    ways: dict[str, list[list[Channel]]] = {
        "whole": [channels],
        "by_topic": [channels[:2], channels[2:4], channels[4:]],
        "by_time": [[part(c, late) for c in channels] for late in (True, False)],
        "by_both": [[part(c, late) for c in some] for late in (True, False)
                    for some in (channels[3:], channels[:3])],
    }  # fmt: skip
    logs = {}
    for way, files in ways.items():
        folder = tmp_path / way / "dive"
        folder.mkdir(parents=True)
        for k, some in enumerate(files):
            write_mcap(folder / f"{k}.mcap", [c for c in some if len(c.log_time_ns)])
        logs[way] = read([folder], load_profile())
    for way, log in logs.items():
        assert log.name == "dive"
        for role, columns in logs["whole"].roles.items():
            for name, column in columns.items():
                other = log.roles[role][name]
                nan = column.dtype.kind == "f"
                assert np.array_equal(other, column, equal_nan=nan), (way, role, name)


# --- velocity, heading --------------------------------------------------------------------------

REPLY = f'[travel_time]\ntopic = "r"\ntime = "log_time"\n{ASKED}{ONE_REPLY}'
ROW = [{"id": 1, "asked": 1.7e9, "t": 1.0}]


def velocity(tmp_path: Path, keys: str, rows: list[dict[str, Any]] | None = None) -> Columns:
    text = SENSORS.replace('frame = "frd"', keys) + REPLY
    more = {"v": rows} if rows else {}
    return log_of(tmp_path, text, r=ROW, **more).roles["velocity"]


def test_frames_of_the_vehicle_and_of_the_earth(tmp_path: Path) -> None:
    for frame, name, expected in (
        ("frd", "velocity_body_mps", [1.0, 0.5, 0.1]),
        ("flu", "velocity_body_mps", [1.0, -0.5, -0.1]),
        ("enu", "velocity_enu_mps", [1.0, 0.5, 0.1]),
        ("ned", "velocity_enu_mps", [0.5, 1.0, -0.1]),
    ):
        np.testing.assert_allclose(velocity(tmp_path, f'frame = "{frame}"')[name][0], expected)


def test_a_turned_instrument_is_turned_back(tmp_path: Path) -> None:
    """Mounted 90 degrees to starboard, its ahead is the vehicle's starboard."""
    found = velocity(tmp_path, 'frame = "frd"\nmount_rpy_deg = [0, 0, 90]')
    np.testing.assert_allclose(found["velocity_body_mps"][0], [-0.5, 1.0, 0.1], atol=1e-12)
    angles = np.radians([3.0, -4.0, 45.0])
    cos, sin = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, cos[0], -sin[0]], [0, sin[0], cos[0]]])
    about_y = np.array([[cos[1], 0, sin[1]], [0, 1, 0], [-sin[1], 0, cos[1]]])
    about_z = np.array([[cos[2], -sin[2], 0], [sin[2], cos[2], 0], [0, 0, 1]])
    vector = np.array([0.3, -1.0, 2.0])
    np.testing.assert_allclose(
        body_to_body(vector, *angles), about_z @ about_y @ about_x @ vector, atol=1e-12
    )


def test_increments_are_velocities_of_the_middle_of_their_interval(tmp_path: Path) -> None:
    found = velocity(tmp_path, 'frame = "frd"\nper = { field = "dt", unit = "ms" }')
    np.testing.assert_allclose(found["velocity_body_mps"][0], [5.0, 2.5, 0.5])
    assert found["time_ns"][0] == START_NS - 100_000_000
    rows = [{"v": [1.0, 0.0, 0.0], "dt": dt} for dt in (0, 200)]
    found = velocity(tmp_path, 'frame = "frd"\nper = { field = "dt", unit = "ms" }', rows)
    assert found["valid"].tolist() == [False, True]


def test_water_track_does_not_count_and_is_told_from_no_lock(tmp_path: Path) -> None:
    rows = [{"v": [1.0, 0.0, None if k == 3 else 0.0], "mode": 1 + (k == 2)} for k in range(4)]
    keys = 'frame = "frd"\nbottom_track = { field = "mode", equals = 1 }'
    found = velocity(tmp_path, keys, rows)
    assert found["valid"].tolist() == [True, True, False, False]
    assert found["water_track"].tolist() == [False, False, True, False]


def test_declination_is_added_to_a_magnetic_heading(tmp_path: Path) -> None:
    text = SENSORS.replace("[velocity]", "declination_deg = -100.5\n[velocity]") + REPLY
    found = log_of(tmp_path, text, r=ROW).roles["heading"]["heading_rad"]
    np.testing.assert_allclose(np.degrees(found), [349.5, 350.5, 351.5, 352.5])


# --- position, altitude, sound ------------------------------------------------------------------


def test_position_fixes_by_latitude_and_by_place(tmp_path: Path) -> None:
    text = SENSORS + '[position]\ntopic = "p"\ntime = "log_time"\n'
    geodetic = (
        'latitude = { field = "lat", scale = 1e-7 }\nlongitude = { field = "lon", scale = 1e-7 }\n'
    )
    rows = [{"lat": 35e7, "lon": -1201234567, "n": 4.0, "e": 3.0, "s": 2.0, "ok": k != 1,
             "c": [4.0, 1.0, 1.0, 9.0]} for k in range(3)]  # fmt: skip
    log = log_of(tmp_path, text + geodetic + 'sigma = "s"\nvalid = "ok"\n', p=rows)
    found = log.roles["position"]
    np.testing.assert_allclose(found["latitude_deg"], [35.0, 35.0])
    np.testing.assert_allclose(found["longitude_deg"], [-120.1234567] * 2)
    np.testing.assert_allclose(found["cov_m2"][0], 4.0 * np.eye(2))
    assert any("1 of 3 fixes without place or sigma" in f.detail for f in log.findings)
    local = 'position = ["n", "e"]\nframe = "ned"\ncovariance = "c"\noffset_m = [1, 2, 3]\n'
    found = log_of(tmp_path, text + local, p=rows).roles["position"]
    np.testing.assert_allclose(found["position_enu_m"][0], [3.0, 4.0])
    np.testing.assert_allclose(found["cov_m2"][0], [[9.0, 1.0], [1.0, 4.0]])
    np.testing.assert_allclose(found["offset_m"][0], [1.0, 2.0, 3.0])


def test_a_fix_that_states_no_sigma_is_taken_as_five_metres_aloud(tmp_path: Path) -> None:
    text = SENSORS + '[position]\ntopic = "p"\ntime = "log_time"\nposition = ["e", "n"]\n'
    log = log_of(tmp_path, text, p=[{"e": 1.0, "n": 2.0}] * 3)
    np.testing.assert_allclose(log.roles["position"]["cov_m2"], np.tile(25 * np.eye(2), (3, 1, 1)))
    assert any(f.what == "position without sigma" for f in log.findings)


def test_a_covariance_that_is_no_matrix_costs_the_role_alone(tmp_path: Path) -> None:
    text = SENSORS + REPLY + '[position]\ntopic = "p"\ntime = "log_time"\nposition = ["e", "n"]\n'
    log = log_of(tmp_path, text + 'covariance = "c"\n', r=ROW, p=[{"e": 1, "n": 2, "c": [1, 2, 3]}])
    assert "position" not in log.roles
    assert any("is no matrix" in f.detail for f in log.findings)


def test_altitude_of_its_own_topic_and_sound_speed_of_every_kind(tmp_path: Path) -> None:
    text = SENSORS + REPLY + '[altitude]\ntopic = "a"\ntime = "log_time"\n'
    sound = '[sound_speed]\ntopic = "s"\ntime = "log_time"\nsound_speed = "c"\n'
    more = {"r": ROW, "a": [{"altitude": x} for x in (20.0, -1.0, 30.0)],
            "s": [{"c": 1500.0 + k, "d": 10.0 * k} for k in range(4)]}  # fmt: skip
    log = log_of(tmp_path, text + sound + 'kind = "samples"\ndepth = "d"\n', **more)
    assert log.roles["altitude"]["altitude_m"].tolist() == [20.0, 30.0]
    assert log.roles["sound_speed"]["depth_m"].tolist() == [0.0, 10.0, 20.0, 30.0]
    mean = log_of(tmp_path, text + sound + 'kind = "mean"\n', **more).roles["sound_speed"]
    assert set(mean) == {"sound_speed_mps", "time_ns"}
    profile = log_of(tmp_path, text + sound + 'depth = "d"\n', **more)
    assert "sound_speed" not in profile.roles
    assert any('kind = "samples" makes' in f.detail for f in profile.findings)


# --- what a profile refuses ---------------------------------------------------------------------


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
        ("beacons", 'topic = "b"\nturn_around = -1.0', "turn_around is below 0"),
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


# --- beacons of a table -------------------------------------------------------------------------


def table(tmp_path: Path, text: str) -> tuple[BeaconSetting, ...]:
    path = tmp_path / "beacons.txt"
    path.write_text(text, encoding="utf-8")
    return beacons_from_file(path)


@pytest.mark.parametrize(
    "text",
    [
        "# name lat lon depth_m turnaround_ms\nT1 9.5 -154.25 4949.5 200\n"
        "T12 9.6 -154.5 5000 260\n",
        "id,name,latitude_deg,longitude_deg,depth,tat\n1,T1,9.5,-154.25,4949.5,0.2\n"
        "12,T12,9.6,-154.5,5000,0.26\n",
        "name;turn_around_s;depth_m;lon;lat\nT1;0.2;4949.5;-154.25;9.5\n\n# far\n"
        "T12;0.26;5000;-154.5;9.6",
    ],
)  # fmt: skip
def test_a_table_of_beacons_in_any_of_its_forms(text: str, tmp_path: Path) -> None:
    first, second = table(tmp_path, text)
    assert (first.id, first.name, first.turn_around_s, first.depth_m) == (1, "T1", 0.2, 4949.5)
    assert (second.id, second.latitude_deg, second.longitude_deg) == (12, 9.6, -154.5)
    assert second.turn_around_s == pytest.approx(0.26)


def test_a_table_of_local_places_with_sigma(tmp_path: Path) -> None:
    text = "id\teast_m\tnorth_m\tup_m\tturn_around_s\tsigma_m\n7\t1.5\t-2\t-300\t0.1\t0.4\n"
    (beacon,) = table(tmp_path, text)
    assert beacon.position_m == (1.5, -2.0, -300.0)
    assert (beacon.id, beacon.sigma_m, beacon.latitude_deg) == (7, 0.4, None)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "no line names the columns"),
        ("id lat lon depth tat\n", "no beacon below"),
        ("id lat lon depth\n1 2 3 4\n", "no column turn_around_s"),
        ("lat lon depth tat\n1 2 3 4\n", "no column id or name"),
        (
            "id lat lon tat\n1 2 3 4\n",
            "no columns latitude_deg, longitude_deg, depth_m, nor east_m",
        ),
        ("id lat lon depht tat\n1 2 3 4 5\n", "unknown column 'depht'; nearest: depth_m"),
        ("id lat lon depth_ms tat\n1 2 3 4 5\n", "depth_m is not in ms"),
        ("id lat lon depth tat\n1 2 3 4\n", "line 2: 4 values for 5 columns"),
        ("id lat lon depth tat\n1 2 x 4 5\n", "line 2: longitude_deg: 'x' is no number"),
        ("id lat lon depth tat\n1 95 3 4 5\n", "line 2: 95.0, 3.0 is no latitude"),
        ("name lat lon depth tat\nnorth 5 3 4 5\n", "'north' has not one number in it"),
        ("id lat lon depth tat\n1 5 3 4 5\n1 5 3 4 5\n", "beacon 1 is there 2 times"),
    ],
)
def test_a_table_that_cannot_be_is_refused_with_its_line(
    text: str, problem: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=problem):
        table(tmp_path, text)
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        beacons_from_file(tmp_path / "none.txt")


# --- inspect ------------------------------------------------------------------------------------


def proposed(tmp_path: Path, channels: list[Channel]) -> tuple[str, Profile]:
    write_mcap(tmp_path / "a.mcap", channels)
    text = inspect([tmp_path / "a.mcap"], load_profile()).proposal
    return text, profile_from_toml(text, "proposal")


def test_neither_the_reference_nor_another_navigator_is_a_sensor(tmp_path: Path) -> None:
    channels = {c.topic: c for c in channels_of(short_dive())}
    velocity = channels.pop("/dvl")
    for topic in ("/reference/velocity", "/filtered/dvl"):
        channels[topic] = dataclasses.replace(velocity, topic=topic)
    write_mcap(tmp_path / "a.mcap", list(channels.values()))
    text = inspect([tmp_path / "a.mcap"], load_profile()).proposal
    assert '[velocity]\ntopic = "?"' in text
    with pytest.raises(ConfigError, match=r"\[velocity\] topic"):
        profile_from_toml(text, "proposal")


def test_a_compass_that_never_was_one_is_not_proposed(tmp_path: Path) -> None:
    channels = {c.topic: c for c in channels_of(short_dive())}
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
    channels = {c.topic: c for c in channels_of(short_dive())}
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
    channels = {c.topic: c for c in channels_of(short_dive())}
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
    channels = {c.topic: c for c in channels_of(short_dive())}
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
    channels = {c.topic: c for c in channels_of(log)}
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
    channels = {c.topic: c for c in channels_of(log)}
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
    channels = {c.topic: c for c in channels_of(short_dive())}
    imu = channels["/imu"]
    since_boot = imu.log_time_ns - imu.log_time_ns[0] + 35 * 10**9
    columns = {"header.stamp": since_boot, "orientation.w": 1.0, "orientation.x": 0.001}
    channels["/imu"] = ros2_channel("/imu", imu.type, imu.log_time_ns, columns)
    write_mcap(tmp_path / "a.mcap", list(channels.values()))
    found = inspect([tmp_path / "a.mcap"], load_profile())
    (clock,) = [f for f in found.findings if f.what == "clock: unset stamps"]
    assert clock.detail.endswith('time = "log_time" takes the recorder\'s')
    profile = profile_from_toml(found.proposal, "proposal")
    assert profile.heading.time == "log_time"
    assert profile.depth.time == "header.stamp"


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
    channels = {c.topic: c for c in channels_of(short_dive())}
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
