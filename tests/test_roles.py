# SPDX-License-Identifier: Apache-2.0
"""What a profile can say, read from files: arrays, slots, lists of topics, other units."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from json_logs import SENSORS, START_NS, log_of
from vehicles import ros_roles, short_dive

from abyssnav.errors import ReadError
from abyssnav.formats.mcap.writer import Channel, write_mcap
from abyssnav.geometry import body_to_body
from abyssnav.profile import load_profile
from abyssnav.read import read
from abyssnav.tables import Columns, Finding, Log


def replies(tmp_path: Path, keys: str, rows: list[dict[str, Any]]) -> Columns:
    text = SENSORS + f'[travel_time]\ntopic = "r"\ntime = "log_time"\n{keys}'
    return log_of(tmp_path, text, r=rows).roles["travel_time"]


# --- replies ---

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


# --- topics ---

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


# --- velocity, heading ---

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


# --- position, altitude, sound ---


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
