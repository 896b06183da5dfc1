# SPDX-License-Identifier: Apache-2.0
"""Beacons surveyed from a ship that knows where it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from real_logs import SETTINGS, UnavailableError, survey, write_survey_log
from typer.testing import CliRunner
from voyages import voyage

from abyssnav.align import align
from abyssnav.batch import Recording
from abyssnav.calibrate import CalibrationResult, calibrate, page, settings_text
from abyssnav.calibrate.survey import box_in, is_survey
from abyssnav.calibrate.verdicts import DETERMINED
from abyssnav.calibrate.words import remarks
from abyssnav.cli import app
from abyssnav.config import Config, load_config, schemas
from abyssnav.profile import Profile, load_profile
from abyssnav.read import read
from abyssnav.simulate import Simulation, settings_toml, write_log

#: A ship circles a single instrument, then crosses it; its table is 200 m wrong.
_SHIP = {
    "duration_s": 3600.0, "floor.depth_m": 3000.0, "floor.relief_m": 0.0,
    "vehicle.altitude_m": 2996.0, "vehicle.speed_mps": (2.0, 2.2), "vehicle.radius_m": 1000.0,
    "vehicle.leg_m": (2500.0, 2500.0), "vehicle.spacing_m": 300.0,
    "vehicle.transducer_offset_m": (3.0, -2.0, 4.0), "dvl.lock_range_m": 1e4,
    "beacons.count": 1, "beacons.distance_m": 1.0, "beacons.survey_sigma_m": 0.0,
    "beacons.one_displaced_m": 200.0, "beacons.stated_sigma_m": 0.0,
    "beacons.turn_around_sigma_s": 0.0, "sound.error_mps": 0.4,
    "position.gnss_period_s": 2.0, "position.gnss_sigma_m": 1.0, "position.gnss_above_m": 10.0,
    "acoustics.sigma_s": 5e-4, "acoustics.stated_sigma_s": 5e-4, "acoustics.ping_period_s": 10.0,
    "acoustics.gross": 0.1,
}  # fmt: skip
_GNSS = """
[position]
topic = "/gnss/fix"
latitude = "latitude"
longitude = "longitude"
covariance = "position_covariance"
"""


@pytest.fixture(scope="module")
def ships() -> list[Simulation]:
    return voyage(_SHIP, [{"vehicle.pattern": "circle"}, {"vehicle.pattern": "lawn_mower"}], seed=6)


@pytest.fixture(scope="module")
def logs(tmp_path_factory, ships: list[Simulation]) -> list[Path]:
    folder = tmp_path_factory.mktemp("survey")
    paths = [folder / f"{name}.mcap" for name in ("circle", "cross")]
    for path, ship in zip(paths, ships, strict=True):
        write_log(ship, path)
    (folder / "ship.toml").write_text(settings_toml(ships[0]))
    default = (schemas() / "profiles" / "default.toml").read_text(encoding="utf-8")
    (folder / "gnss.toml").write_text(default + _GNSS)
    return paths


@pytest.fixture(scope="module")
def setting(logs: list[Path]) -> tuple[Config, Profile]:
    folder = logs[0].parent
    return load_config(folder / "ship.toml"), load_profile(str(folder / "gnss.toml"))


@pytest.fixture(scope="module")
def result(logs: list[Path], setting: tuple[Config, Profile]) -> CalibrationResult:
    return calibrate([Recording(path.stem, str(path)) for path in logs], *setting, jobs=1)


def test_the_first_places_are_good_to_metres(
    ships: list[Simulation], logs: list[Path], setting: tuple[Config, Profile]
) -> None:
    config, profile = setting
    dive = align(read([logs[0]], profile), config)
    assert is_survey(dive)
    true_m = ships[0].truth.beacons.position_enu_m
    assert np.linalg.norm(dive.beacons.position_enu_m - true_m) == pytest.approx(200.0, abs=1.0)
    np.testing.assert_allclose(box_in(dive), true_m, atol=5.0)


def test_a_single_instrument_is_found_from_200_m_away(
    ships: list[Simulation], result: CalibrationResult
) -> None:
    off_m = ships[0].truth.beacons.position_enu_m - ships[0].beacons.position_enu_m
    found = {e.kind.name: e for e in result.estimates if e.unknown.beacon_id == 1}
    for axis, right in zip(("east", "north", "up"), off_m[0].tolist(), strict=True):
        e = found[f"beacon_{axis}"]
        assert abs(e.value - right) < 3 * e.sigma
    assert found["beacon_east"].verdict == found["beacon_north"].verdict == DETERMINED
    sound = next(e for e in result.estimates if e.kind.name == "sound_speed_scale")
    assert abs(sound.value - ships[0].truth.water.scale) < 3 * sound.sigma


def test_the_page_has_the_residuals_by_azimuth(result: CalibrationResult) -> None:
    assert set(result.surveys) == {"circle", "cross"}
    residuals = result.surveys["circle"]
    used_m = residuals.residual_m[residuals.used]
    assert np.sqrt(np.mean(used_m**2)) == pytest.approx(0.375, rel=0.15)  # half of 0.5 ms of sound
    assert np.ptp(residuals.azimuth_deg) > 330
    html = page(result, settings_text(result))
    assert html.count('aria-label="Residuals by azimuth"') == 2
    assert "Survey of the beacons" in html
    assert not [sentence for sentence in remarks(result) if "mirrored" in sentence]


def test_a_vehicle_with_fixes_at_the_surface_only_is_no_survey(
    ships: list[Simulation], logs: list[Path], setting: tuple[Config, Profile]
) -> None:
    config, profile = setting
    dive = align(read([logs[0]], profile), config)
    assert dive.positions is not None
    early = dive.positions[dive.positions.t_s < 600.0]
    assert not is_survey(replace(dive, positions=early))


@pytest.mark.network
def test_a_published_survey_finds_its_beacons_from_200_m_away(tmp_path: Path) -> None:
    """SAGA.1903: four transponders at 1,340 m, published to 3 m."""
    try:
        survey()
    except UnavailableError as reason:
        pytest.skip(str(reason))
    published = {
        11: (-47.005, 408.645, -1345.044), 12: (486.643, 48.128, -1354.312),
        13: (-26.358, -506.143, -1335.817), 14: (-538.119, -22.748, -1330.488),
    }  # fmt: skip
    write_survey_log(tmp_path / "saga.mcap")
    (tmp_path / "saga.toml").write_text(SETTINGS)
    default = (schemas() / "profiles" / "default.toml").read_text(encoding="utf-8")
    as_gnss = default[: default.index("[reference]")] + (
        '[position]\ntopic = "/reference"\ntype = "nav_msgs/msg/Odometry"\n'
        'position = ["pose.pose.position.x", "pose.pose.position.y"]\nframe = "enu"\nsigma = 0.1\n'
    )
    (tmp_path / "gnss.toml").write_text(as_gnss)
    generator = np.random.default_rng(1903)
    lines = ["id east_m north_m up_m turn_around_s"]
    for number, (east, north, up) in published.items():
        side = generator.uniform(0, 2 * np.pi)
        place = (east + 200 * np.sin(side), north + 200 * np.cos(side), up)
        lines.append(f"{number} " + " ".join(f"{value:.3f}" for value in place) + " 1.061507")
    (tmp_path / "wrong.txt").write_text("\n".join(lines) + "\n")
    ended = CliRunner().invoke(
        app,
        ["calibrate", str(tmp_path / "saga.mcap"), "-o", str(tmp_path / "cal.toml"),
         "-c", str(tmp_path / "saga.toml"), "-p", str(tmp_path / "gnss.toml"),
         "--beacons", str(tmp_path / "wrong.txt")],
    )  # fmt: skip
    assert ended.exit_code == 0, ended.output
    config = load_config(tmp_path / "saga.toml", tmp_path / "cal.toml")
    dive = align(read([tmp_path / "saga.mcap"], load_profile()), config)
    for row, number in enumerate(dive.beacons.id.tolist()):
        sigma_m = np.hypot(3.001, dive.beacons.sigma_m[row])
        apart_m = np.abs(dive.beacons.position_enu_m[row] - published[number])
        assert np.all(apart_m < 3 * sigma_m)
        assert np.all(apart_m[:2] < 0.5)  # measured: 0.16 m
