# SPDX-License-Identifier: Apache-2.0
"""Profiles of drivers that people use, each on a log that such a driver writes."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
from drivers import DRIVERS, settings
from vehicles import ALTITUDE_M, FOLDER, short_dive

from abyssnav.align import align
from abyssnav.config import Config
from abyssnav.formats.mcap.writer import write_mcap
from abyssnav.profile import load_profile, profile_from_toml
from abyssnav.read import inspect, read
from abyssnav.tables import Dive, Log

#: Half a unit of the last place of what a driver logs of a two-way time, or a float32's.
COARSE_S = {"ping_transponders": 2e-6, "acoustic_range": 1e-6, "seatrac": 2e-7, "evologics": 2e-6,
            "imc_json": 1e-6}  # fmt: skip
#: Drivers whose logs hold no beacons with turn-arounds.
WITHOUT_BEACONS = ("blueos_mavlink", "lbl_aqualoc")


@pytest.fixture(scope="module")
def truth() -> Log:
    return short_dive()


def config_for(name: str, truth: Log) -> Config:
    whole = settings(truth)
    return whole if name in WITHOUT_BEACONS else msgspec.structs.replace(whole, beacon=())


def assert_same(dive: Dive, right: Dive, name: str) -> None:
    np.testing.assert_allclose(
        np.exp(1j * dive.heading.heading_rad), np.exp(1j * right.heading.heading_rad), atol=1e-6
    )
    np.testing.assert_allclose(dive.depth.depth_m, right.depth.depth_m, atol=1e-3)
    valid = np.isin(right.velocity.t_s.round(6), dive.velocity.t_s[dive.velocity.valid].round(6))
    assert valid.mean() > 0.85
    assert not np.any(valid & ~right.velocity.valid)
    np.testing.assert_allclose(
        dive.velocity.velocity_body_mps[dive.velocity.valid],
        right.velocity.velocity_body_mps[valid],
        atol=1e-6,
    )
    order, other = (np.lexsort((d.replies.beacon_id, d.replies.ping_id)) for d in (dive, right))
    ours, theirs = dive.replies[order], right.replies[other]
    coarse_s = COARSE_S.get(name, 1e-9)
    np.testing.assert_array_equal(ours.beacon_id, theirs.beacon_id)
    np.testing.assert_allclose(ours.travel_time_s, theirs.travel_time_s, atol=coarse_s)
    np.testing.assert_allclose(ours.t_ping_s, theirs.t_ping_s, atol=2 * coarse_s + 1e-6)
    np.testing.assert_allclose(ours.t_reply_s, theirs.t_reply_s, atol=2 * coarse_s + 1e-6)
    np.testing.assert_array_equal(np.diff(ours.ping_id) > 0, np.diff(theirs.ping_id) > 0)
    np.testing.assert_allclose(ours.beacon_enu_m, theirs.beacon_enu_m, atol=1e-3)
    np.testing.assert_allclose(ours.turn_around_s, theirs.turn_around_s, atol=1e-9)


@pytest.mark.parametrize("name", DRIVERS)
def test_every_driver_gives_the_same_dive_under_its_profile(
    name: str, truth: Log, tmp_path: Path
) -> None:
    write_mcap(tmp_path / "a.mcap", DRIVERS[name](truth))
    log = read([tmp_path / "a.mcap"], load_profile(name))
    assert_same(align(log, config_for(name, truth)), align(truth, settings(truth)), name)


@pytest.mark.parametrize("name", DRIVERS)
def test_every_drivers_sample_is_of_that_dive(name: str, truth: Log) -> None:
    log = read([FOLDER / f"{name}.mcap"], load_profile(name))
    assert_same(align(log, config_for(name, truth)), align(truth, settings(truth)), name)


@pytest.mark.parametrize("name", DRIVERS)
def test_inspect_proposes_what_reads_every_drivers_log(name: str, truth: Log) -> None:
    sample = FOLDER / f"{name}.mcap"
    proposed = profile_from_toml(inspect([sample], load_profile()).proposal, "proposal")
    dive = align(read([sample], proposed), config_for(name, truth))
    assert_same(dive, align(truth, settings(truth)), name)


def test_water_track_is_no_velocity_and_is_told(truth: Log, tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", DRIVERS["ds_dvl"](truth))
    dive = align(read([tmp_path / "a.mcap"], load_profile("ds_dvl")), Config())
    (water,) = [c for c in dive.checks if c.name == "velocity_of_water_track"]
    assert water.value == pytest.approx(0.1, abs=0.02)
    assert not water.ok
    assert "not over ground" in water.detail
    assert np.abs(dive.velocity.velocity_body_mps).max() < 5


def test_altitude_of_the_simulators_dvl_is_the_floors(truth: Log, tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", DRIVERS["uuv_dvl"](truth))
    dive = align(read([tmp_path / "a.mcap"], load_profile("uuv_dvl")), Config())
    assert dive.floor is not None
    over_m = dive.floor.depth_m - np.interp(dive.floor.t_s, dive.depth.t_s, dive.depth.depth_m)
    np.testing.assert_allclose(over_m, ALTITUDE_M)
