# SPDX-License-Identifier: Apache-2.0
"""Shipped profiles, each on its vehicle's log; Protobuf and JSON twins under the default one."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drivers import DRIVERS
from mcap_ros2._dynamic import generate_dynamic
from twins import SCHEMAS, json_schema, proto_files, twin_files
from vehicles import (
    ALTITUDE_M,
    FOLDER,
    LATITUDE_DEG,
    VEHICLES,
    json_channel,
    protobuf_channel,
    ros_roles,
    short_dive,
)

from abyssnav.formats.mcap.writer import Channel, write_mcap
from abyssnav.formats.schema import our_definition
from abyssnav.geometry import depth_of_pressure
from abyssnav.profile import load_profile, profile_names
from abyssnav.read import read
from abyssnav.tables import Log

#: What a vehicle does not log, or logs more coarsely than float64 of our unit.
MISSING = {"protobuf_vehicle": {"sound_speed"}, "json_vehicle": {"reference"}}
ABSENT = {
    "protobuf_vehicle": {"sigma_m", "origin_latitude_deg", "origin_longitude_deg"},
    "json_vehicle": {"snr_db"},
    "float64": {"roll_rad", "pitch_rad"},
}
#: Vehicles that log their altitude.
ALTIMETERS = {"marine_dvl", "waterlinked"}


@pytest.fixture(scope="module")
def dive() -> Log:
    return short_dive()


def assert_same_dive(log: Log, truth: Log, name: str = "default") -> None:
    assert log.findings == ()
    assert log.roles.keys() == truth.roles.keys() - MISSING.get(name, set())
    for role, told in log.roles.items():
        columns = dict(told)
        if name in ALTIMETERS and role == "velocity":
            altitude_m = np.where(truth.roles[role]["valid"], ALTITUDE_M, np.nan)
            np.testing.assert_array_equal(columns.pop("altitude_m"), altitude_m)
        if "pressure_dbar" in columns:  # the latitude is the log's to say
            pressure_dbar = columns.pop("pressure_dbar")
            columns["depth_m"] = depth_of_pressure(pressure_dbar, LATITUDE_DEG)
        assert columns.keys() == truth.roles[role].keys()
        valid = truth.roles[role].get("valid", slice(None))
        for column, values in columns.items():
            if column in ABSENT.get(name, set()):
                assert not np.any(np.nan_to_num(values))
                continue
            true = truth.roles[role][column]
            if column == "time_ns" and name == "waterlinked" and role == "velocity":
                true = true // 1000 * 1000  # microseconds
            if true.dtype.kind == "f":
                loose = 1e-6 if column == "depth_m" else 1e-9
                expected = pytest.approx(true[valid], rel=1e-9, abs=loose, nan_ok=True)
                assert values[valid] == expected, column
            else:
                assert np.array_equal(values, true), (role, column)


def test_every_profile_has_a_vehicle_and_a_sample() -> None:
    assert set(profile_names()) == {*VEHICLES, *DRIVERS}
    samples = {path.stem for path in FOLDER.glob("*.mcap")}
    assert samples | {"default"} == {*VEHICLES, *DRIVERS}
    assert all(path.stat().st_size < 200_000 for path in FOLDER.glob("*.mcap"))


@pytest.mark.parametrize("name", VEHICLES)
def test_every_vehicle_gives_the_same_dive_under_its_profile(
    name: str, dive: Log, tmp_path: Path
) -> None:
    write_mcap(tmp_path / "a.mcap", VEHICLES[name](dive))
    assert_same_dive(read([tmp_path / "a.mcap"], load_profile(name)), dive, name)


@pytest.mark.parametrize("name", sorted(set(VEHICLES) - {"default", "twist"}))
def test_the_shipped_samples_are_all_of_one_dive(name: str) -> None:
    truth = read([FOLDER / "twist.mcap"], load_profile("twist"))
    log = read([FOLDER / f"{name}.mcap"], load_profile(name))
    assert_same_dive(log, truth, name)


# --- twins --------------------------------------------------------------------------------------


def test_the_twins_in_schemas_are_fresh() -> None:
    files = twin_files()
    assert {path: (SCHEMAS / path).read_text("utf-8") for path in files} == files
    there = {path.relative_to(SCHEMAS) for path in SCHEMAS.rglob("*") if path.is_file()}
    assert {path for path in there if path.parts[0] in ("proto", "json")} == set(files)


def plain(value: Any, times: bool) -> Any:
    """A decoded message as dictionaries; times as nanoseconds, or as they are."""
    if hasattr(value, "nanosec") and times:
        return value.sec * 1_000_000_000 + value.nanosec
    if hasattr(value, "__slots__"):
        return {name: plain(getattr(value, name), times) for name in value.__slots__}
    if isinstance(value, list | tuple):
        return [plain(item, times) for item in value]
    return value


def without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: without_nan(item) for name, item in value.items()}
    if isinstance(value, list):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def twins(channel: Channel) -> tuple[Channel, Channel]:
    """A ROS 2 topic in Protobuf and in JSON, by way of the official decoder."""
    decoders = generate_dynamic(channel.type, channel.definition.decode())
    messages = [decoders[channel.type](row) for row in channel.payloads.row_bytes()]
    times = channel.log_time_ns
    proto = protobuf_channel(
        channel.topic, channel.type.replace("/msg/", "."), proto_files([channel.type]), times,
        [plain(message, times=True) for message in messages],
    )  # fmt: skip
    rows = [without_nan(plain(message, times=False)) for message in messages]
    return proto, json_channel(channel.topic, times, rows)


def test_protobuf_and_json_twins_give_the_same_dive_under_the_default_profile(
    dive: Log, tmp_path: Path
) -> None:
    short = {
        role: {name: column[:40] for name, column in columns.items()}
        for role, columns in dive.roles.items()
    }
    truth = Log(dive.name, (), dive.profile, dive.topics, short)
    pairs = [twins(channel) for channel in ros_roles(truth).values()]
    for number in range(2):
        path = tmp_path / f"{number}.mcap"
        write_mcap(path, [pair[number] for pair in pairs])
        assert_same_dive(read([path], load_profile()), truth)


def test_a_json_schema_names_every_member_of_its_message() -> None:
    schema = json_schema(our_definition("abyssnav_msgs/msg/BeaconArray"))
    beacon = schema["properties"]["beacons"]["items"]
    assert list(beacon["properties"]) == [
        "id", "name", "position", "turn_around_time", "position_sigma",
    ]  # fmt: skip
    stamp = schema["properties"]["header"]["properties"]["stamp"]
    assert list(stamp["properties"]) == ["sec", "nanosec"]
    assert json.loads(json.dumps(schema)) == schema
