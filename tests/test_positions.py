# SPDX-License-Identifier: Apache-2.0
"""Position fixes in the local frame, and dives that have nothing else."""

import dataclasses
import json

import msgspec
import numpy as np
import pytest
from oracles import rotation_enu_body
from small_logs import check, small_log, stamps, without

from abyssnav.align import align
from abyssnav.config import Config, OriginSetting
from abyssnav.errors import SolveError
from abyssnav.geometry import enu_to_geodetic
from abyssnav.profile import PositionRole, Profile, load_profile
from abyssnav.run import Setup, run_dive
from abyssnav.simulate import load_scenario, simulate, write_log


def position_columns(place_m, t_s, sigma_m=2.0):
    n = len(t_s)
    return {
        "time_ns": stamps(t_s), "position_enu_m": np.array(place_m, float),
        "cov_m2": np.tile(sigma_m**2 * np.eye(2), (n, 1, 1)),
    }  # fmt: skip


def with_positions(columns, log=None):
    log = log or small_log()
    return dataclasses.replace(
        log, roles={**log.roles, "position": columns}, topics={**log.topics, "position": "/usbl"}
    )


def test_position_fixes_have_their_lever_arm_with_the_attitude_of_their_instant():
    columns = position_columns([[1.0, 2.0], [3.0, 4.0]], [10.0, 50.0])
    columns["offset_m"] = np.broadcast_to(np.array([1.0, 2.0, -3.0]), (2, 3))
    dive = align(with_positions(columns), Config())
    fixes = dive.positions
    np.testing.assert_array_equal(fixes.position_enu_m, [[1.0, 2.0], [3.0, 4.0]])
    np.testing.assert_allclose(fixes.t_s, [10.0, 50.0])
    heading = dive.heading
    for k, t in enumerate(fixes.t_s):
        angles = [np.interp(t, heading.t_s, c) for c in
                  (heading.roll_rad, heading.pitch_rad, heading.heading_rad)]  # fmt: skip
        np.testing.assert_allclose(
            fixes.lever_enu_m[k], rotation_enu_body(*angles) @ [1.0, 2.0, -3.0], atol=1e-9
        )


def test_geodetic_fixes_need_an_origin_and_are_the_places_from_it():
    place = np.array([[100.0, -50.0, 0.0], [200.0, 30.0, 0.0]])
    latitude, longitude, _ = enu_to_geodetic(35.0, 140.0, place)
    columns = position_columns(place[:, :2], [10.0, 50.0])
    del columns["position_enu_m"]
    columns |= {"latitude_deg": latitude, "longitude_deg": longitude}
    nowhere = align(with_positions(columns), Config())
    assert nowhere.positions is None
    assert not check(nowhere, "positions").ok
    placed = msgspec.structs.replace(Config(), origin=OriginSetting(35.0, 140.0))
    found = align(with_positions(columns), placed).positions
    np.testing.assert_allclose(found.position_enu_m, place[:, :2], atol=1e-6)


def test_a_dive_with_fixes_needs_no_acoustics_and_its_origin_is_the_first_fix():
    place = np.array([[0.0, 0.0, 0.0], [20.0, 30.0, 0.0]])
    latitude, longitude, _ = enu_to_geodetic(35.0, 140.0, place)
    columns = position_columns(place[:, :2], [10.0, 50.0])
    del columns["position_enu_m"]
    columns |= {"latitude_deg": latitude, "longitude_deg": longitude}
    silent = without(without(small_log(), "travel_time"), "beacons")
    dive = align(with_positions(columns, silent), Config())
    assert (len(dive.replies), len(dive.beacons)) == (0, 0)
    assert dive.origin.source == "position"
    np.testing.assert_allclose(dive.positions.position_enu_m, place[:, :2], atol=1e-6)
    with pytest.raises(SolveError, match=r"no messages on /lbl/travel_time \(travel_time\)"):
        align(silent, Config())


def test_a_fix_on_the_other_side_of_the_world_is_left_out_and_told():
    columns = position_columns([[1.0, 2.0], [3e6, 4.0]], [10.0, 50.0])
    dive = align(with_positions(columns), Config())
    assert len(dive.positions) == 1
    assert (check(dive, "positions_far_away").value, check(dive, "positions_far_away").ok) == (
        1,
        False,
    )


def test_a_dive_with_usbl_and_no_beacons_is_navigated_whole(tmp_path):
    """By `ekf` and `smoother`; the paper's methods are absent, and say why."""
    scenario = load_scenario("clean")
    usbl = msgspec.structs.replace(scenario.position, usbl_period_s=20.0, usbl_sigma_m=5.0)
    scenario = msgspec.structs.replace(scenario, duration_s=1200.0, position=usbl)
    write_log(simulate(scenario), tmp_path / "dive.mcap")
    roles = load_profile().roles()
    position = PositionRole(
        topic="/usbl",
        position=("pose.pose.position.x", "pose.pose.position.y"),
        covariance="pose.covariance",
    )
    profile = Profile(
        heading=roles["heading"], velocity=roles["velocity"], depth=roles["depth"],
        position=position, reference=roles["reference"], name="usbl",
    )  # fmt: skip
    result = run_dive([tmp_path / "dive.mcap"], Setup(Config(), profile), tmp_path / "out")
    summary = json.loads((result.folder / "summary.json").read_text(encoding="utf-8"))
    assert not {"kf_fix", "ekf_gated", "ekf_ungated"} & set(result.solution.tracks)
    assert "no kf_fix, ekf_ungated and ekf_gated" in json.dumps(summary["checks"])
    for method, most_m in (("ekf", 5.0), ("smoother", 3.0)):
        assert summary["starts"][method]["how"] == "position"
        assert summary["methods"][method]["errors"]["truth"]["rms_m"] < most_m
    assert summary["verdict"]["level"] == "good"
