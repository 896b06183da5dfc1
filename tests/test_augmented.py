# SPDX-License-Identifier: Apache-2.0
import dataclasses
from datetime import UTC, datetime
from functools import cache

import numpy as np
import pytest
from oracles_best import cached, changed, simulated

from abyssnav.align import align
from abyssnav.config import Config
from abyssnav.estimation.fixes import repeated
from abyssnav.navigate import navigate
from abyssnav.simulate import load_scenario, simulate, to_log
from abyssnav.tables import DECISIONS

DUPLICATE = DECISIONS.index("duplicate")
USBL = {"usbl_period_s": 30.0, "usbl_gross": 0.05}


def settled_m(simulation, track, after_s=300.0):
    """RMS of a track from some minutes after its beginning."""
    late = track[track.t_s > track.t_s[0] + after_s]
    off_m = (late.position_enu_m - simulation.position_at(late.t_s))[:, :2]
    return float(np.sqrt(np.mean(np.sum(off_m**2, axis=1))))


@cache
def with_usbl():
    scenario = changed(
        load_scenario("voyage_1"), {"duration_s": 3600.0, "seed": 3, "position": USBL}
    )
    simulation = simulate(scenario)
    return simulation, to_log(simulation, name="dive")


def without(log, *roles):
    return dataclasses.replace(log, roles={k: v for k, v in log.roles.items() if k not in roles})


def thrice(replies):
    return replies[np.repeat(np.arange(len(replies)), 3)]


def test_a_reply_recorded_again_is_a_repetition_and_a_later_arrival_is_none():
    replies = cached().dive.replies[:20]
    again = repeated(thrice(replies))
    assert again.tolist() == [False, True, True] * 20
    late = dataclasses.replace(replies, travel_time_s=replies.travel_time_s + 0.03)
    both = dataclasses.replace(
        thrice(replies)[::3],
        **{
            name: np.concatenate([column, late.columns()[name]])
            for name, column in replies.columns().items()
        },
    )
    assert not repeated(both).any()


def test_every_reply_three_times_gives_the_same_tracks_and_counts_once():
    dive = simulated(3, 1800.0, "voyage_2").dive
    once = navigate(dive, Config())
    many = navigate(dataclasses.replace(dive, replies=thrice(dive.replies)), Config())
    for method in ("ekf", "smoother", "ekf_gated"):
        np.testing.assert_allclose(
            many.tracks[method].position_enu_m, once.tracks[method].position_enu_m, atol=1e-9
        )
    decision = many.innovations["ekf"].decision
    assert len(decision) == 3 * len(dive.replies)
    assert np.sum(decision == DUPLICATE) >= 2 * np.sum(dive.replies.beacon >= 0)


def test_position_fixes_start_and_correct_the_filter_and_are_gated():
    simulation, log = with_usbl()
    solution = navigate(align(log, Config()), Config())
    assert solution.starts["ekf"].how == "position"
    assert solution.starts["ekf_gated"].how == "m_of_n"
    assert settled_m(simulation, solution.tracks["ekf"]) < 1.8
    table = solution.positions["ekf"]
    assert len(table) == len(align(log, Config()).positions)
    refused = table.decision == DECISIONS.index("gated")
    assert 0 < refused.sum() < 0.15 * len(table)
    assert np.all(table.nis[refused] > 13.8)
    assert np.all(table.nis[table.decision == 0] <= 13.8)


def test_the_papers_methods_never_see_position_fixes():
    _, log = with_usbl()
    seen, unseen = (
        navigate(align(one, Config()), Config()) for one in (log, without(log, "position"))
    )
    for method in ("kf_fix", "ekf_ungated", "ekf_gated"):
        np.testing.assert_array_equal(
            seen.tracks[method].position_enu_m, unseen.tracks[method].position_enu_m
        )


def test_a_dive_with_position_fixes_and_no_beacons_is_navigated():
    simulation, log = with_usbl()
    solution = navigate(align(without(log, "travel_time", "beacons"), Config()), Config())
    assert settled_m(simulation, solution.tracks["ekf"]) < 5.0
    assert settled_m(simulation, solution.tracks["smoother"]) < 3.0


def test_a_long_way_down_is_navigated_from_the_first_replies_on():
    heard = simulated(3, 4800.0, vehicle={"descent_s": 2400.0}, floor={"depth_m": 3000.0})
    velocity = heard.dive.velocity
    first_s = float(velocity.t_s[np.argmax(velocity.valid)])
    solution = navigate(heard.dive, Config())
    track = solution.tracks["ekf"]
    assert track.t_s[0] < 400.0 < first_s
    error_m = track.position_enu_m[:, :2] - heard.true_m(track.t_s)
    down = (track.t_s > track.t_s[0] + 300) & (track.t_s < first_s)
    e, cov_m2 = error_m[down], track.position_cov_m2[down]
    assert np.sqrt(np.mean(np.sum(e**2, axis=1))) < 12.0
    nees = np.mean(np.einsum("ni,nij,nj->n", e, np.linalg.inv(cov_m2), e))
    assert 0.2 < nees < 4.0


@pytest.mark.parametrize("stated", [False, True])
def test_a_known_start_serves_ekf_smoother_and_dead_reckoning(stated):
    heard = cached()
    instant, t_s = None, float(heard.replies.t_ping_s[0])
    if stated:
        instant = datetime.fromtimestamp(heard.dive.start_ns // 10**9 + 300, UTC)
        t_s = instant.timestamp() - heard.dive.start_ns / 1e9
    e, n = heard.true_m(np.array([t_s]))[0].tolist()
    start = {"position_m": (e, n), "sigma_m": 5.0, "at": instant}
    solution = navigate(heard.dive, changed(Config(), {"start": start}))
    for method in ("ekf", "smoother", "dead_reckoning"):
        begun = solution.starts[method]
        assert begun.how == "settings"
        assert (begun.east_m, begun.north_m) == (e, n)
        assert begun.t_s == pytest.approx(t_s, abs=1e-5)
    assert solution.starts["ekf_gated"].how == "m_of_n"
    assert solution.tracks["ekf"].t_s[0] == pytest.approx(t_s, abs=1.0)


def test_two_beacons_and_a_known_start_give_a_track():
    heard = simulated(1, 3600.0, acoustics={"detection": 1.0, "gross": 0.0})
    kept = heard.dive.replies.beacon < 2
    dive = dataclasses.replace(heard.dive, replies=heard.dive.replies[kept])
    e, n = heard.true_m(dive.replies.t_ping_s[:1])[0].tolist()
    start = {"position_m": (e, n), "sigma_m": 5.0}
    solution = navigate(dive, changed(Config(), {"start": start}))
    assert settled_m(heard.simulation, solution.tracks["smoother"]) < 6.0
    assert not [c for c in solution.checks if c.name == "mirrored_starts"]


def test_two_beacons_without_a_start_name_both_where_the_replies_choose_neither():
    heard = simulated(1, 300.0, acoustics={"detection": 1.0, "gross": 0.0})
    replies = heard.dive.replies
    early = (replies.beacon < 2) & (replies.t_ping_s < replies.t_ping_s[0] + 110.0)
    dive = dataclasses.replace(heard.dive, replies=replies[early])
    solution = navigate(dive, Config())
    assert not {"ekf", "smoother"} & set(solution.tracks)
    (check,) = [c for c in solution.checks if c.name == "mirrored_starts"]
    assert not check.ok
    assert check.detail.count("(") == 2
