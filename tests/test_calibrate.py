# SPDX-License-Identifier: Apache-2.0
"""From dives with known errors to settings that take them out."""

import tomllib
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner
from voyages import evidence, right_values, voyage

from abyssnav.batch import Recording
from abyssnav.calibrate import calibrate, estimate, page, settings_text, write_calibration
from abyssnav.calibrate.campaign import CalibrationResult, LeftOut
from abyssnav.calibrate.unknowns import Group
from abyssnav.calibrate.verdicts import DETERMINED, NOT_DETERMINED, WEAK
from abyssnav.calibrate.words import estimate_table, headline, remarks, straightness
from abyssnav.cli import app
from abyssnav.config import Config, Vehicle, load_config
from abyssnav.errors import SolveError
from abyssnav.profile import load_profile
from abyssnav.simulate import Simulation, write_log

#: One vehicle, three dives of which each turns, and one beacon that its table has 6 m off.
_KEYS = {
    "duration_s": 3600.0,
    "acoustics.sigma_s": 0.001,
    "acoustics.stated_sigma_s": 0.001,
    "beacons.survey_sigma_m": 0.1,
    "beacons.one_displaced_m": 6.0,
    "beacons.turn_around_sigma_s": 0.0,
    "compass.bias_deg": 5.0,
    "compass.deviation_sigma_deg": (2.0, 0.5),
    "dvl.scale": 0.02,
    "dvl.mount_deg": 0.0,
    "sound.error_mps": 0.3,
    "vehicle.transducer_offset_m": (4.0, -3.0, 0.0),
    "vehicle.offset_stated": False,
}
_PATTERNS = [{"vehicle.pattern": p} for p in ("lawn_mower", "meander", "circle")]


@pytest.fixture(scope="module")
def dives() -> list[Simulation]:
    return voyage(_KEYS, _PATTERNS, seed=4)


@pytest.fixture(scope="module")
def config() -> Config:
    acoustics = msgspec.structs.replace(Config().acoustics, travel_time_sigma_s=0.001)
    return Config(acoustics=acoustics, vehicle=Vehicle())


@pytest.fixture(scope="module")
def gathered(dives: list[Simulation], config: Config):
    return [evidence(dive, f"dive_{i}", config) for i, dive in enumerate(dives)]


@pytest.fixture(scope="module")
def result(gathered, config: Config) -> CalibrationResult:
    return estimate(gathered, config)


def test_what_is_determined_is_right_and_what_is_not_stays(
    dives: list[Simulation], result: CalibrationResult
) -> None:
    right = right_values(dives[0], Config())
    determined = [e for e in result.estimates if e.verdict == DETERMINED]
    names = {e.kind.name for e in determined}
    assert {"heading_bias", "dvl_scale", "lever_arm_starboard"} <= names
    assert names & {"beacon_east", "beacon_north"}
    for e in determined:
        error = e.value - right[e.kind.name, e.unknown.beacon_id]
        assert abs(error) < 3.5 * e.sigma + 1e-9, e
        assert e.data_sigma <= e.kind.limit
    for e in result.estimates:
        if e.verdict == NOT_DETERMINED and e.kind.group != "latency of heading":
            assert e.value == 0.0
            assert e.sigma >= e.prior_sigma * (1 - 1e-9)


def test_the_beacon_that_stands_elsewhere_is_named(
    dives: list[Simulation], result: CalibrationResult
) -> None:
    number = int(dives[0].beacons.id[dives[0].truth.odd_beacon])
    (sentence,) = [s for s in remarks(result) if "from where its table has it" in s]
    assert sentence.startswith(f"Beacon {number} stands")
    assert result.adjustment.layout.own == frozenset()


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory, result: CalibrationResult) -> Config:
    path = tmp_path_factory.mktemp("calibration") / "calibration.toml"
    write_calibration(result, path)
    base = path.with_name("base.toml")
    base.write_text("[acoustics]\ntravel_time_sigma_s = 0.001\n")
    return load_config(base, path)


def test_the_settings_take_the_errors_out(
    dives: list[Simulation], result: CalibrationResult, calibrated: Config
) -> None:
    again = estimate(
        [evidence(d, f"dive_{i}", calibrated) for i, d in enumerate(dives)], calibrated
    )
    before = {(e.kind.name, e.unknown.beacon_id): e for e in result.estimates}
    for e in again.estimates:
        first = before[e.kind.name, e.unknown.beacon_id]
        if first.verdict == DETERMINED:
            assert abs(e.value) < max(1.0 * first.sigma, 0.15 * abs(first.value)), e
            assert e.prior_sigma == pytest.approx(first.sigma, rel=1.0)
    assert not [s for s in remarks(again) if "from where its table has it" in s]


def test_the_settings_say_each_value_with_its_verdict(result: CalibrationResult) -> None:
    text = settings_text(result)
    tables = tomllib.loads(text)
    assert {"vehicle", "calibration", "errors", "acoustics", "beacon"} <= set(tables)
    assert len(tables["beacon"]) == 4
    assert all("from" not in beacon for beacon in tables["beacon"])
    bias = next(e for e in result.estimates if e.kind.name == "heading_bias")
    assert tables["calibration"]["heading_bias_deg"] == pytest.approx(bias.value, abs=1e-4)
    assert tables["errors"]["heading_offset_sigma_deg"] == pytest.approx(bias.sigma, rel=0.01)
    assert f"heading_bias_deg = {bias.value:.4f}  # determined" in text


def test_the_page_opens_without_a_network(result: CalibrationResult) -> None:
    html = page(result, settings_text(result))
    assert "default-src 'none'" in html
    assert "http" not in html.replace("http-equiv", "")
    for word in (DETERMINED, WEAK, NOT_DETERMINED):
        assert f">{word}</b>" in html
    assert len(estimate_table(result).rows) == len(result.estimates)
    assert headline(result).startswith(f"Of {len(result.estimates)} unknowns 3 dives determine")


def test_what_is_too_much_for_a_compass_is_the_dvls_mounting(tmp_path: Path) -> None:
    (dive,) = voyage(
        {"duration_s": 2700.0, "vehicle.pattern": "lawn_mower", "dvl.mount_deg": 45.0,
         "compass.bias_deg": 0.0}, [{}], seed=5,
    )  # fmt: skip
    result = estimate([evidence(dive, "turned", Config())], Config())
    tables = tomllib.loads(settings_text(result))["calibration"]
    assert tables["heading_bias_deg"] == 0.0
    assert tables["mount_rpy_deg"][2] == pytest.approx(-45.0, abs=4.0)
    assert any("taken for the DVL's mounting" in sentence for sentence in remarks(result))
    path = tmp_path / "turned.toml"
    write_calibration(result, path)
    again = estimate([evidence(dive, "turned", load_config(path))], load_config(path))
    bias = next(e for e in again.estimates if e.kind.name == "heading_bias")
    assert abs(bias.value) < 3.0


# --- what dives do not share --------------------------------------------------------------------


def moved_beacon(dive, row: int, east_m: float):
    """The dive's evidence as if a beacon stood elsewhere: its table moves instead."""
    observations = dive.setting.problem.observations
    chosen = observations.times.beacon == row
    legs = [
        replace(leg, virtual_beacon=leg.virtual_beacon + chosen * east_m)
        for leg in (observations.leg_ping, observations.leg_reply)
    ]
    observations = observations._replace(leg_ping=legs[0], leg_reply=legs[1])
    problem = dive.setting.problem._replace(observations=observations)
    constant = dive.states.constant.copy()
    constant[12 + 4 * row] -= east_m
    return replace(
        dive,
        setting=dive.setting._replace(problem=problem),
        states=dive.states._replace(constant=constant),
    )


def test_a_beacon_that_moved_between_dives_is_named_and_each_has_its_own(
    gathered, config: Config
) -> None:
    dives = [*gathered[:2], moved_beacon(gathered[2], 1, 8.0)]
    result = estimate(dives, config)
    assert Group("place", 2) in result.adjustment.layout.own
    assert len(result.adjustment.layout.own) == 1
    (sentence,) = [s for s in remarks(result) if "stands elsewhere" in s]
    assert sentence.startswith("Beacon 2 stands elsewhere in different dives (by up to ")
    tables = tomllib.loads(settings_text(result))
    entries = [beacon for beacon in tables["beacon"] if beacon["id"] == 2]
    assert len(entries) == 3
    assert "from" not in entries[0]
    assert "until" not in entries[2]
    assert entries[0]["until"] == entries[1]["from"]
    east = [e.value for e in result.estimates if e.kind.name == "beacon_east" and e.unknown.dive]
    assert east[0] - east[2] == pytest.approx(8.0, abs=1.0)


def test_tables_that_are_all_worse_than_they_say_do_not_accuse_single_beacons() -> None:
    (dive,) = voyage(
        {"duration_s": 3600.0, "vehicle.pattern": "lawn_mower", "beacons.count": 8,
         "beacons.survey_sigma_m": 3.0, "beacons.stated_sigma_m": 0.0}, [{}], seed=12,
    )  # fmt: skip
    result = estimate([evidence(dive, "dive", Config())], Config())
    sigma_m = {e.sigma for e in result.estimates if e.kind.name in ("beacon_east", "beacon_north")}
    assert min(sigma_m) > 0.6
    right = right_values(dive, Config())
    for e in result.estimates:
        if e.kind.name in ("beacon_east", "beacon_north"):
            assert abs(e.value - right[e.kind.name, e.unknown.beacon_id]) < 4 * e.sigma


def test_two_vehicles_are_told_apart(gathered, config: Config) -> None:
    other = voyage(
        {**_KEYS, "compass.bias_deg": -4.0, "dvl.scale": -0.01,
         "vehicle.transducer_offset_m": (0.0, 0.0, 0.0)},
        [{"vehicle.pattern": "meander"}], seed=4,
    )  # fmt: skip
    result = estimate([*gathered[:2], evidence(other[0], "other", config)], config)
    names = {group.name for group in result.adjustment.layout.own}
    assert {"compass", "DVL"} <= names
    (sentence,) = [s for s in remarks(result) if "Two vehicles" in s]
    assert "Only the beacons are common" in sentence
    tables = tomllib.loads(settings_text(result))
    assert tables["calibration"]["heading_bias_deg"] == 0.0
    assert len(tables["beacon"]) == 4


def test_dives_without_a_beacon_in_common_are_said_so(gathered, config: Config) -> None:
    strangers = replace(gathered[1].beacons, id=gathered[1].beacons.id + 100)
    result = estimate([gathered[0], replace(gathered[1], beacons=strangers)], config)
    (sentence,) = [s for s in remarks(result) if "No beacon answered in both" in s]
    assert "dive_0; dive_1" in sentence
    assert {e.unknown.beacon_id for e in result.estimates} == {None, 1, 2, 3, 4, 101, 102, 103, 104}


def test_tables_that_changed_between_dives_are_said_so(gathered, config: Config) -> None:
    beacons = gathered[1].beacons
    position_m = beacons.position_enu_m + np.array([5.0, 0.0, 0.0]) * (beacons.id == 3)[:, None]
    changed = replace(gathered[1], beacons=replace(beacons, position_enu_m=position_m))
    said = remarks(estimate([gathered[0], changed], config))
    assert any("have beacon 3 5.0 m apart: values count from the first" in s for s in said)


def test_beacons_that_were_set_anew_elsewhere_are_each_dives_own(gathered, config: Config) -> None:
    away_m = np.array([40_000.0, -9_000.0, 0.0])
    beacons = replace(
        gathered[1].beacons, position_enu_m=gathered[1].beacons.position_enu_m + away_m
    )
    moved = replace(gathered[1], beacons=beacons)
    result = estimate([gathered[0], moved], config)
    assert result.adjustment.layout.own == {Group("place", number) for number in (1, 2, 3, 4)}
    values = [e.value for e in result.estimates if e.kind.name == "beacon_east"]
    assert np.abs(values).max() < 15
    tables = tomllib.loads(settings_text(result))["beacon"]
    assert len(tables) == 8
    first, second = (b["longitude_deg"] for b in tables if b["id"] == 3)
    assert second - first == pytest.approx(40_000 / 109_640, rel=2e-3)


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"vehicle.pattern": "hover"}, "hardly moves"),
        (
            {"vehicle.pattern": "transit", "vehicle.transit_turn_deg": 0.01,
             "vehicle.leg_m": (3000.0, 4000.0)},
            "runs one way only",
        ),
    ],
)  # fmt: skip
def test_a_dive_that_moves_too_little_determines_no_sensor(keys, sentence) -> None:
    (dive,) = voyage({"duration_s": 1800.0, **keys}, [{}], seed=2)
    result = estimate([evidence(dive, "still", Config())], Config())
    assert any(sentence in s for s in remarks(result))
    names = {e.kind.name for e in result.estimates if e.verdict == DETERMINED}
    if sentence == "hardly moves":
        assert not names
    else:
        assert not {n for n in names if n.startswith(("heading", "deviation", "lever", "latency"))}
        assert straightness(result.dives[0]) > 0.9


def test_a_dive_that_was_left_out_is_said_so(result: CalibrationResult) -> None:
    other = replace(result, left_out=(LeftOut("broken", "no messages"),))
    assert remarks(other)[0] == "broken is left out: no messages"


# --- the command --------------------------------------------------------------------------------


def test_the_command_reads_logs_and_writes_settings_and_page(
    tmp_path: Path, dives: list[Simulation]
) -> None:
    for number, dive in enumerate(dives[:2]):
        write_log(dive, tmp_path / f"dive_{number}.mcap")
    (tmp_path / "broken.mcap").write_bytes(b"no log")
    target = tmp_path / "cal.toml"
    ended = CliRunner().invoke(app, ["calibrate", str(tmp_path), "-o", str(target), "-j", "1"])
    assert ended.exit_code == 0, ended.output
    assert "2 dives determine" in ended.output
    assert "broken is left out" in ended.output
    assert "lever_arm_forward" not in ended.output
    assert load_config(target).calibration.heading_bias_deg == pytest.approx(5.0, abs=1.0)
    assert (tmp_path / "cal.html").read_text().startswith("<!DOCTYPE html>")


def test_without_any_dive_it_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "broken.mcap"
    path.write_bytes(b"no log")
    with pytest.raises(SolveError, match="no dive can be used: broken: "):
        calibrate([Recording("broken", str(path))], Config(), load_profile("default"))


def test_a_log_at_a_url_is_refused_by_its_url() -> None:
    fsspec = pytest.importorskip("fsspec", reason="needs the extra `cloud`")
    fsspec.filesystem("memory").pipe("/voyage/broken.mcap", b"no log")
    place = "memory://voyage/broken.mcap"
    with pytest.raises(SolveError, match=f"no dive can be used: broken: {place}: not MCAP"):
        calibrate([Recording("broken", place)], Config(), load_profile("default"))
