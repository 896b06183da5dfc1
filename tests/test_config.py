# SPDX-License-Identifier: Apache-2.0
import json
import math
from pathlib import Path
from typing import Any, get_args, get_origin

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from abyssnav.config import (
    BeaconSetting,
    Config,
    Gate,
    load_config,
    plain,
    schemas,
)
from abyssnav.errors import ConfigError
from abyssnav.profile import Profile
from abyssnav.settings import settings_from_tables, settings_from_toml
from abyssnav.simulate import Scenario

#: Section 5 of the contract, to the letter.
CONTRACT = """
[acoustics]
sound_speed_mps = 1500.0
sound_speed_sigma_mps = 1.0
travel_time_sigma_s = 0.002
[vehicle]
transducer_offset_m = [0.0, 0.0, 0.0]
[start]
m = 4
n = 6
v_min_mps = 0.0
v_max_mps = 4.0
a_max_mps2 = 0.5
[fix]
max_cycle_s = 60.0
[gate]
gamma = 9.21
[process]
position_m2_per_s = 0.3
[output]
rate_hz = 1.0
methods = ["all"]
"""


def from_text(folder: Path, text: str) -> Config:
    path = folder / "settings.toml"
    path.write_text(text, encoding="utf-8")
    return load_config(path)


def test_the_defaults_are_the_contracts(tmp_path: Path) -> None:
    stated, config = from_text(tmp_path, CONTRACT), Config()
    assert load_config(None) == config
    assert stated.vehicle.lever_arm_m == config.vehicle.lever_arm_m
    assert (stated.vehicle.lever_sigma_m, config.vehicle.lever_sigma_m) == (0.1, 1.0)
    acoustics = msgspec.structs.replace(
        stated.acoustics, sound_speed_mps=None, sound_speed_sigma_mps=None
    )
    vehicle = msgspec.structs.replace(stated.vehicle, transducer_offset_m=None)
    assert msgspec.structs.replace(stated, acoustics=acoustics, vehicle=vehicle) == config


def test_what_a_file_does_not_name_keeps_its_default(tmp_path: Path) -> None:
    config = from_text(tmp_path, "[acoustics]\ntravel_time_sigma_s = 0.001\n")
    assert config.acoustics.travel_time_sigma_s == 0.001
    assert config.acoustics.sound_speed_mps is None
    assert config.start == Config().start


def test_beacons_and_sound_speed_take_the_place_of_the_logs(tmp_path: Path) -> None:
    text = """
    [[beacon]]
    id = 7
    position_m = [1, 2.5, -3000]
    turn_around_s = 0.25
    [[beacon]]
    id = 8
    latitude_deg = 34.5
    longitude_deg = 139.5
    depth_m = 1340.0
    turn_around_s = 0.0
    [sound_speed_profile]
    depth_m = [0.0, 100.0]
    sound_speed_mps = [1510.0, 1490.0]
    """
    config = from_text(tmp_path, text)
    assert config.beacon[0] == BeaconSetting(id=7, turn_around_s=0.25, position_m=(1, 2.5, -3000))
    assert config.beacon[1].depth_m == 1340.0
    assert config.sound_speed_profile is not None
    assert config.sound_speed_profile.sound_speed_mps == (1510.0, 1490.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[gate]\ngama = 9\n", r"unknown key \[gate\] gama; nearest: gamma"),
        ("[gates]\ngamma = 9\n", "unknown key gates; nearest: gate"),
        ("[[beacon]]\nid = 1\nturnaround_s = 1.0\n", "unknown key .*nearest: turn_around_s"),
        ("[gate]\ngamma = 'wide'\n", r"gate\.gamma"),
        ("[gate\n", "not TOML"),
        ("[[beacon]]\nid = 1\n", "turn_around_s"),
        ("[acoustics]\nsound_speed_mps = 0.0\n", r"\[acoustics\] sound_speed_mps"),
        ("[acoustics]\ntravel_time_sigma_s = 0.0\n", r"\[acoustics\] travel_time_sigma_s"),
        ("[acoustics]\nsound_speed_sigma_mps = -1.0\n", r"\[acoustics\] sound_speed_sigma_mps"),
        ("[acoustics]\nfloor_depth_m = -inf\n", r"\[acoustics\] floor_depth_m = -inf"),
        ("[start]\nm = 7\n", r"\[start\] needs 3 <= m <= n"),
        ("[start]\nm = 2\n", r"\[start\] m = 2: must be at least 3"),
        ("[start]\nv_min_mps = 5.0\n", r"\[start\] needs 0 <= v_min_mps < v_max_mps"),
        ("[start]\na_max_mps2 = 0.0\n", r"\[start\] a_max_mps2"),
        ("[start]\nsigma_m = 0.0\n", r"\[start\] sigma_m"),
        ("[fix]\nmax_cycle_s = 0.0\n", r"\[fix\] max_cycle_s"),
        ("[gate]\ngamma = 0.0\n", r"\[gate\] gamma = 0.0: must be above 0"),
        ("[gate]\nprobability = 0.0\n", r"\[gate\] probability = 0.0: must be above 0"),
        ("[gate]\ngamma = nan\n", r"\[gate\] gamma = nan"),
        ("[acoustics]\nsound_speed_mps = inf\n", r"\[acoustics\] sound_speed_mps = inf"),
        ("[errors]\nheading_sigma_deg = -1\n", r"\[errors\] heading_sigma_deg = -1: must be at"),
        ("[errors]\ndeviation_sigma_deg = [1, nan]\n", r"\[errors\] deviation_sigma_deg = nan"),
        ("[errors]\nheading_time_s = 0\n", r"\[errors\] heading_time_s = 0: must be above 0"),
        ("[output]\nmethods = []\n", "methods"),
        ("[output]\nrate_hz = 1e-9\n", r"\[output\] rate_hz = 1e-09: must be at least 0.0001"),
        ("[start]\nekf = 'luck'\n", r"\[start\] ekf: 'luck' is none of consensus, m_of_n"),
        ("[vehicle]\ntransducer_offset_m = [1, 2]\n", "transducer_offset_m"),
        ("[origin]\nlatitude_deg = 91\nlongitude_deg = 0\n", r"\[origin\] latitude_deg = 91"),
        ("[[beacon]]\nid = 1\nturn_around_s = nan\n", r"\[beacon\] turn_around_s = nan"),
        ("[gate]\nprobability = 1.0\n", r"\[gate\] probability"),
        ("[process]\nposition_m2_per_s = -0.1\n", r"\[process\] position_m2_per_s"),
        ("[process]\ngap_sigma_mps = 0.0\n", r"\[process\] gap_sigma_mps"),
        ("[process]\nmax_gap_s = 0.0\n", r"\[process\] max_gap_s"),
        ("[output]\nrate_hz = 0.0\n", r"\[output\] rate_hz"),
        (
            "[sound_speed_profile]\ndepth_m = [10.0, 0.0]\nsound_speed_mps = [1500.0, 1490.0]\n",
            r"\[sound_speed_profile\] needs rising depth_m",
        ),
    ],
)
def test_a_setting_no_dive_can_use_is_refused_with_its_name(
    tmp_path: Path, text: str, said: str
) -> None:
    with pytest.raises(ConfigError, match=said) as refusal:
        from_text(tmp_path, text)
    assert str(refusal.value).startswith(str(tmp_path / "settings.toml"))
    assert "\n" not in str(refusal.value)


def test_a_settings_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: cannot be read"):
        load_config(tmp_path / "none.toml")


def test_a_probability_sets_the_gate_of_one_degree_of_freedom() -> None:
    # Eqs. 10-11: P(χ²₁ ≤ 4) = 0.9545, P(χ²₁ ≤ 9.5495) = 0.998.
    assert Gate(probability=0.9544997361).threshold == pytest.approx(4.0, abs=1e-6)
    assert Gate(probability=0.998).threshold == pytest.approx(9.5495, abs=1e-3)
    assert Gate().threshold == 9.21


def test_no_gate_survives_the_way_through_json_and_back() -> None:
    settings = plain(Config(gate=Gate(gamma=math.inf)))
    text = json.dumps(settings, allow_nan=False)
    assert float(json.loads(text)["gate"]["gamma"]) == math.inf
    assert settings_from_toml("[gate]\ngamma = inf\n", "here", Config).gate.gamma == math.inf


def test_the_schemas_lie_where_the_package_finds_them() -> None:
    assert (schemas() / "msg").is_dir()


def test_of_several_files_the_later_wins_key_by_key(tmp_path: Path) -> None:
    first, second = tmp_path / "ship.toml", tmp_path / "dive.toml"
    first.write_text("[gate]\ngamma = 5\nstretch_s = 60\n[[beacon]]\nid = 1\nturn_around_s = 1\n")
    second.write_text("[gate]\ngamma = 6\n[[beacon]]\nid = 2\nturn_around_s = 1\n")
    config = load_config(first, second)
    assert (config.gate.gamma, config.gate.stretch_s) == (6.0, 60.0)
    assert [beacon.id for beacon in config.beacon] == [2]
    second.write_text("[start]\nm = 9\n")
    with pytest.raises(ConfigError, match=r"ship\.toml: \[start\] needs 3 <= m <= n"):
        load_config(second, first)


@given(st.data())
def test_every_number_of_the_settings_has_its_range(data: st.DataObject) -> None:
    """No number that TOML can hold is taken where it could not be navigated with."""
    tables = [f for f in msgspec.structs.fields(Config) if is_struct(f) and numbers_of(f.type)]
    table = data.draw(st.sampled_from(tables))
    key = data.draw(st.sampled_from(numbers_of(table.type)))
    high = [] if key == "gamma" else [1e300]  # no gate
    odd = data.draw(st.sampled_from([math.nan, -math.inf, -1e300, *high]))
    with pytest.raises(ConfigError, match=key):
        settings_from_tables({table.name: {key: odd}}, "here", Config)


@given(st.data())
def test_every_number_of_a_scenario_has_its_range(data: st.DataObject) -> None:
    tables = {f.name: f.type for f in msgspec.structs.fields(Scenario) if is_struct(f)}
    tables = {name: kind for name, kind in tables.items() if numbers_of(kind)}
    name = data.draw(st.sampled_from(["", *tables]))
    key = data.draw(st.sampled_from(numbers_of(tables.get(name, Scenario))))
    odd = data.draw(st.sampled_from([math.nan, math.inf, -math.inf, 1e300, -1e300]))
    with pytest.raises(ConfigError, match=key):
        settings_from_tables({name: {key: odd}} if name else {key: odd}, "here", Scenario)


@pytest.mark.parametrize("odd", [math.nan, math.inf, -math.inf, 1e300, -1e300])
@pytest.mark.parametrize(
    ("role", "key"),
    [
        ("heading", "latency_s"), ("heading", "declination_deg"), ("velocity", "latency_s"),
        ("depth", "latitude_deg"), ("depth", "atmosphere_pa"), ("beacons", "turn_around"),
        ("position", "sigma"), ("travel_time", "range_sound_speed"),
    ],
)  # fmt: skip
def test_every_number_of_a_profile_has_its_range(role: str, key: str, odd: float) -> None:
    with pytest.raises(ConfigError, match=key):
        settings_from_tables({role: {"topic": "/a", key: odd}}, "here", Profile)
    conversion = {"topic": "/a", "depth": {"field": "d", "scale": odd}}
    with pytest.raises(ConfigError, match="scale"):
        settings_from_tables({"depth": conversion}, "here", Profile)


def is_struct(field: Any) -> bool:
    return isinstance(field.type, type) and issubclass(field.type, msgspec.Struct)


def numbers_of(kind: Any) -> list[str]:
    """Fields that hold one number, of optional ones too."""
    return [f.name for f in msgspec.structs.fields(kind) if is_number(f.type)]


def is_number(hint: Any) -> bool:
    return hint in (int, float) or (
        get_origin(hint) is not tuple and any(is_number(part) for part in get_args(hint))
    )
