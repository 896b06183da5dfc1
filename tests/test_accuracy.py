# SPDX-License-Identifier: Apache-2.0
"""The short form of `make accuracy`: two seeds of a few sets, and the arithmetic of its table."""

import numpy as np
import pytest
from accuracy import (
    METHOD_SETS,
    SETS,
    chosen,
    measure,
    missed,
    scenario_of,
    shown,
    summarise,
    write_logs,
)
from msgspec.structs import replace
from scoring import radius, score

from abyssnav.config import load_config
from abyssnav.simulate import simulate, stated_settings
from abyssnav.simulate.scenario import draw
from abyssnav.tables import LegAccuracy, Solution, Track

SEEDS = (900, 901)


@pytest.fixture(scope="module")
def rows():
    """Two nominal dives, measured."""
    return [measure("nominal", seed) for seed in SEEDS]


@pytest.mark.parametrize("name", [*SETS, *METHOD_SETS])
def test_every_set_is_a_scenario_that_a_dive_can_be_drawn_of(name):
    assert draw(scenario_of(name)).duration_s >= 3600.0


def test_a_key_that_a_set_gives_is_no_longer_drawn():
    scale = draw(scenario_of("scale_15")).dvl.scale
    assert scale == 0.15
    currents = {
        draw(replace(scenario_of("water_track_whole"), seed=seed)).dvl.water_track[0].current_mps
        for seed in range(20)
    }
    assert len(currents) > 3


def test_a_part_of_a_name_chooses_its_sets_and_a_whole_name_only_its_own():
    assert chosen("nominal", "trust") == ["nominal"]
    assert chosen("water_track_", "trust") == [n for n in SETS if n.startswith("water_track_")]
    assert chosen("", "methods") == list(METHOD_SETS)


@pytest.mark.parametrize("method", ["ekf", "smoother"])
def test_nominal_dives_are_navigated_near_their_bound_and_say_how_near(rows, method):
    row = summarise(rows, method)
    assert row["x"] < 1.5
    assert 0.3 < row["nees"] < 4.0
    assert row["held"] > 0.9
    assert row["started"] == 2
    assert f"{row['x']:5.2f}" in shown(row)


@pytest.mark.parametrize("name", ["voyage_2", "foreign", "beacons_3m_stated"])
def test_other_dives_are_not_lost(name):
    row = summarise([measure(name, SEEDS[0])], "smoother")
    assert row["lost"] == 0
    assert row["max_m"] < 20.0


def test_figures_outside_their_limits_are_named(rows):
    row = summarise(rows, "ekf")
    assert missed(row | {"x": 1.0, "x_worst": 1.2, "nees": 2.0}) == []
    assert missed(row | {"x": 1.31, "x_worst": 1.2, "nees": 2.0}) == ["x 1.31 not in 0..1.15"]


def test_a_method_that_never_starts_has_no_row(rows):
    assert summarise(rows, "no_such_method") is None


def test_the_sets_logs_can_be_given_to_anybody(tmp_path):
    write_logs(["nominal", "nominal_no_profile"], range(3, 4), tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {
        "nominal_3.mcap",
        "nominal_no_profile_3.mcap",
        "nominal_no_profile_3.toml",
    }
    settings = load_config(tmp_path / "nominal_no_profile_3.toml")
    stated = stated_settings(simulate(scenario_of("nominal_no_profile"), 3))
    assert settings.acoustics.sound_speed_mps == stated.acoustics.sound_speed_mps
    assert 1490 < settings.acoustics.sound_speed_mps < 1570


# --- the score of one track ---------------------------------------------------------------------


def straight(error_m, sigma_m):
    """Track along a line at 1 m/s that is off to the north, and its truth."""
    t_s = np.arange(0.0, 100.0)
    true = np.column_stack([t_s, np.zeros((100, 2))])
    covariance = np.broadcast_to(np.eye(2) * sigma_m**2, (100, 2, 2))
    columns = {name: np.zeros(100) for name in Track.__dataclass_fields__}
    columns |= {"t_s": t_s, "position_cov_m2": covariance}
    columns["position_enu_m"] = true + np.column_stack([0 * t_s, error_m + 0 * t_s, 0 * t_s])
    return Track(**columns), (t_s, true)


def test_errors_and_nees_of_a_track_that_is_off_by_a_metre():
    track, truth = straight(1.0, 0.5)
    result = score(track, truth, 10.0, 50.0)
    assert (result.rms_m, result.max_m, result.p95_m) == (1.0, 1.0, 1.0)
    assert result.nees == pytest.approx(4.0)
    assert result.lost == 0.0


def test_errors_are_counted_between_the_two_instants_only():
    track, truth = straight(np.where(np.arange(100.0) < 60, 0.0, 30.0), 1.0)
    assert score(track, truth, 0.0, 50.0).rms_m == 0.0
    assert score(track, truth, 0.0, 99.0).lost == pytest.approx(0.4)


def test_a_radius_holds_for_the_share_of_the_track_that_lies_within_it():
    track, truth = straight(np.where(np.arange(100.0) < 25, 3.0, 1.0), 1.0)
    legs = {name: np.zeros(2) for name in LegAccuracy.__dataclass_fields__}
    legs |= {"t_begin_s": np.array([0.0, 50.0]), "t_end_s": np.array([50.0, 99.0])}
    legs |= {"n_replies": np.zeros(2, int), "uncertainty_95_m": np.array([2.0, 2.0])}
    solution = Solution(
        dive=None,
        tracks={"smoother": track},
        fixes=None,
        innovations={},
        statistics={},
        starts={},
        gamma=9.21,
        accuracy=LegAccuracy(**legs),
    )
    result = radius(solution, truth)
    assert result.held == pytest.approx(0.75)
    assert result.median_m == 2.0
    assert result.over_p95 == pytest.approx((2 / 3 + 2) / 2)
