# SPDX-License-Identifier: Apache-2.0
import dataclasses
from functools import cache

import msgspec
import numpy as np
import pytest
from oracles import linear_filter, step_by_step, textbook_filter
from worlds import motion_of, steady

from abyssnav.acoustics.travel_time import is_physical, ray_geometry
from abyssnav.align import align
from abyssnav.config import Config
from abyssnav.estimation.dead_reckoning import dead_reckon
from abyssnav.estimation.fixes import StartRule, confirm_start, cycles, fix_positions
from abyssnav.estimation.two_state import (
    EkfConfig,
    TravelTimes,
    filter_fixes,
    filter_travel_times,
    propagate,
)
from abyssnav.simulate import load_scenario, simulate, to_log
from abyssnav.tables import (
    DECISIONS,
    Beacons,
    Fixes,
    Replies,
    SoundSpeed,
    Start,
)

SIGMA_S = 0.002
ISOVELOCITY = SoundSpeed(np.array([0.0, 12_000.0]), np.array([1500.0, 1500.0]))
GATED, UNGATED = EkfConfig(10.0, 0.3, SIGMA_S, 9.21), EkfConfig(10.0, 0.3, SIGMA_S, np.inf)


# --- a real-looking dive against the textbook --------------------------------------------------


@cache
def voyage():
    """An hour of voyage_2 with a lever arm and one beacon nobody knows, ready for the filters."""
    scenario = load_scenario("voyage_2")
    scenario = msgspec.structs.replace(
        scenario,
        duration_s=3600.0,
        vehicle=msgspec.structs.replace(scenario.vehicle, transducer_offset_m=(3.0, -1.0, 0.5)),
    )
    log = to_log(simulate(scenario), name="voyage_2")
    columns = {name: column.copy() for name, column in log.roles["travel_time"].items()}
    columns["beacon_id"][::17] = 99
    columns["travel_time_s"][::23] = np.nan
    log = dataclasses.replace(log, roles={**log.roles, "travel_time": columns})
    config = msgspec.structs.replace(
        Config(),
        vehicle=msgspec.structs.replace(Config().vehicle, transducer_offset_m=(3, -1, 0.5)),
    )
    dive = align(log, config)
    motion = dead_reckon(dive.velocity, dive.heading, (-1.0, 3700.0), 0.1, 1.0)
    usable = dive.replies.beacon >= 0
    paths = ray_geometry(dive.replies[usable], dive.sound_speed)
    physical = is_physical(paths, dive.replies[usable].travel_time_s, SIGMA_S)
    usable[usable] = physical
    paths = paths[physical]
    cycle = cycles(dive.replies, usable, 60.0)[usable]
    fixes = fix_positions(dive.replies[usable], paths, cycle, motion, SIGMA_S)
    start = confirm_start(fixes[fixes.consistent], StartRule(4, 6, 0.0, 4.0, 0.5))
    return dive, motion, usable, paths, fixes, start


@cache
def reckoned_by_steps():
    dive = voyage()[0]
    # beyond the last sample the last velocity goes on, second by second
    stamps = np.concatenate([[-1.0], dive.velocity.t_s, dive.velocity.t_s[-1] + np.arange(1.0, 60)])
    place_m, variance_m2 = step_by_step(dive.velocity, dive.heading, stamps, 0.1, 1.0)

    def at(t_s):
        east, north, variance = (
            np.interp(t_s, stamps, column) for column in (*place_m.T, variance_m2)
        )
        return np.array([east, north]), variance

    return at


@pytest.mark.parametrize("noise", [GATED, UNGATED], ids=["gated", "ungated"])
def test_the_filter_is_the_textbooks_in_every_decision_and_position(noise):
    dive, motion, usable, paths, _, start = voyage()
    assert start is not None
    nodes, found = filter_travel_times(
        TravelTimes(dive.replies, usable, paths), motion, start, noise
    )
    known = dive.replies.beacon >= 0
    of_known = ray_geometry(dive.replies[known], dive.sound_speed)
    speeds_mps = np.full((len(dive.replies), 2), np.nan)  # proved by themselves elsewhere
    speeds_mps[known] = np.column_stack([of_known.speed_ping_mps, of_known.speed_reply_mps])
    fates, expected = textbook_filter(
        dive, start, noise.gamma, q=0.3, sigma_t=SIGMA_S, start_sigma=10.0,
        reckoned=reckoned_by_steps(), speeds_mps=speeds_mps,
    )  # fmt: skip
    decisions = [DECISIONS[d] for d in found.decision]
    assert decisions == [fate.decision for fate in fates]
    assert set(decisions) >= {"accepted", "unknown_beacon", "not_physical", "before_start"}
    assert ("gated" in decisions) == (noise is GATED)
    t_s, position_m, cov_m2 = zip(*expected, strict=True)
    assert nodes.t_s.tolist() == list(t_s)
    np.testing.assert_allclose(nodes.position_m, position_m, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(nodes.position_cov_m2, cov_m2, rtol=1e-10, atol=1e-9)
    for column, values in (
        (found.predicted_s, [f.predicted_s for f in fates]),
        (found.innovation_s, [f.innovation_s for f in fates]),
        (found.innovation_sigma_s**2, [f.variance_s2 for f in fates]),
    ):
        np.testing.assert_allclose(column, values, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(found.nis, found.innovation_s**2 / found.innovation_sigma_s**2)


def test_there_is_a_row_for_every_reply_in_the_order_heard():
    dive, motion, usable, paths, _, start = voyage()
    _, found = filter_travel_times(TravelTimes(dive.replies, usable, paths), motion, start, GATED)
    for name in ("ping_id", "beacon_id", "t_ping_s", "t_reply_s"):
        np.testing.assert_array_equal(getattr(found, name), getattr(dive.replies, name))
    judged = np.isfinite(found.nis)
    names = np.array(DECISIONS)[found.decision]
    np.testing.assert_array_equal(judged, np.isin(names, ["accepted", "gated", "duplicate"]))


def test_without_a_start_nothing_moves_and_every_reply_says_so():
    dive, motion, usable, paths, _, _ = voyage()
    nodes, found = filter_travel_times(
        TravelTimes(dive.replies, usable, paths), motion, None, GATED
    )
    assert nodes is None
    names = np.array(DECISIONS)[found.decision]
    assert set(names[usable]) == {"before_start"}
    assert set(names[~usable]) == {"unknown_beacon", "not_physical"}
    assert np.all(np.isnan(found.nis))


# --- small worlds ------------------------------------------------------------------------------


def ring(count, distance_m=2000.0, depth_m=50.0):
    angle = 0.7 + 2 * np.pi * np.arange(count) / count
    return Beacons(
        id=np.arange(1, count + 1),
        name=np.array([f"B{i}" for i in range(count)]),
        position_enu_m=np.column_stack(
            [distance_m * np.sin(angle), distance_m * np.cos(angle), np.full(count, -depth_m)]
        ),
        turn_around_s=np.full(count, 0.2),
        sigma_m=np.zeros(count),
    )


def direct_replies(beacons, asked, here_m=(0.0, 0.0), depth_m=20.0, late_s=0.0):
    """Replies of a vehicle at rest to (ping time, id, beacon row); `late_s` is added to each."""
    t_ping, ping_id, b = (np.array(column) for column in zip(*asked, strict=True))
    range_m = np.linalg.norm([*here_m, -depth_m] - beacons.position_enu_m[b], axis=1)
    time_s = 2 * range_m / 1500.0 + beacons.turn_around_s[b] + late_s
    n = len(b)
    replies = Replies(
        ping_id=ping_id, beacon_id=beacons.id[b], beacon=b,
        t_ping_s=t_ping.astype(float), t_reply_s=t_ping + time_s, travel_time_s=time_s,
        snr_db=np.zeros(n), depth_ping_m=np.full(n, depth_m), depth_reply_m=np.full(n, depth_m),
        lever_ping_enu_m=np.zeros((n, 3)), lever_reply_enu_m=np.zeros((n, 3)),
        beacon_enu_m=beacons.position_enu_m[b], turn_around_s=beacons.turn_around_s[b],
        beacon_sigma_m=np.zeros(n),
    )  # fmt: skip
    return replies[np.argsort(replies.t_reply_s, kind="stable")]


def run(beacons, replies, start, noise=GATED, motion=None):
    usable = np.full(len(replies), True)
    paths = ray_geometry(replies, ISOVELOCITY)
    return filter_travel_times(
        TravelTimes(replies, usable, paths), motion or steady(), start, noise
    )


def at(east_m, north_m, t_s=-1.0):
    return Start(t_s, east_m, north_m, 4, "m_of_n")


@pytest.mark.parametrize("count", [4, 5, 7])
def test_the_filters_jacobian_agrees_with_central_differences_of_its_prediction(count):
    """H from the first update of each beacon, K = P H / S, against predictions about the start."""
    beacons, motion = ring(count), steady((1.3, -0.4))
    noise = EkfConfig(3.0, 0.0, SIGMA_S, np.inf)
    for b in range(count):
        replies = direct_replies(beacons, [(0.0, 1, b)], (210.0, -340.0), late_s=0.01)
        nodes, found = run(beacons, replies, at(200.0, -350.0), noise, motion)
        drift_m = np.multiply((1.3, -0.4), replies.t_reply_s[0] + 1.0)
        moved_m = nodes.position_m[1] - nodes.position_m[0] - drift_m
        S, nu = found.innovation_sigma_s[0] ** 2, found.innovation_s[0]
        H = moved_m * S / (nu * noise.start_sigma_m**2)
        h = 0.05
        difference = [
            (
                run(beacons, replies, at(200.0 + h * e, -350.0 + h * n), noise, motion)[1]
                .predicted_s[0]
                - run(beacons, replies, at(200.0 - h * e, -350.0 - h * n), noise, motion)[1]
                .predicted_s[0]
            ) / (2 * h)
            for e, n in ((1, 0), (0, 1))
        ]  # fmt: skip
        np.testing.assert_allclose(H, difference, rtol=1e-6, atol=1e-10)
        assert pytest.approx(noise.start_sigma_m**2 * H @ H + SIGMA_S**2) == S


def test_on_a_linear_case_the_filter_is_the_joint_least_squares():
    """Beacons so far away that ranges are linear in the position."""
    beacons = ring(5, distance_m=1e9)
    rng = np.random.default_rng(4)
    asked = [(24.0 * k, k, b) for k in range(4) for b in range(5)]
    late_s = SIGMA_S * rng.normal(size=20)
    replies = direct_replies(beacons, asked, (30.0, -20.0), late_s=late_s)
    nodes, _ = run(beacons, replies, at(0.0, 0.0), EkfConfig(10.0, 0.0, SIGMA_S, np.inf))
    away = -beacons.position_enu_m[:, :2] / 1e9
    H = 2 * away[replies.beacon] / 1500.0
    noise_free = 2 * np.linalg.norm(
        [30.0, -20.0, -20.0] - beacons.position_enu_m[replies.beacon], axis=1
    ) / 1500.0 + 0.2  # fmt: skip
    z = H @ [30.0, -20.0] + (replies.travel_time_s - noise_free)
    information = np.eye(2) / 100.0 + H.T @ H / SIGMA_S**2
    expected_m = np.linalg.solve(information, H.T @ z / SIGMA_S**2)
    np.testing.assert_allclose(nodes.position_m[-1], expected_m, atol=1e-3)  # ulp of 1e6 s of time
    np.testing.assert_allclose(nodes.position_cov_m2[-1], np.linalg.inv(information), atol=1e-6)


def test_a_reply_outside_the_gate_moves_nothing_and_one_inside_does():
    beacons = ring(4)
    replies = direct_replies(beacons, [(0.0, 1, 0), (24.0, 2, 1)], late_s=[0.5, 0.0])
    nodes, found = run(beacons, replies, at(0.0, 0.0))
    assert [DECISIONS[d] for d in found.decision] == ["gated", "accepted"]
    assert nodes.t_s.tolist() == [-1.0, replies.t_reply_s[1]]


def test_the_gate_is_the_threshold_to_the_bit():
    beacons = ring(4)
    replies = direct_replies(beacons, [(0.0, 1, 0)], late_s=0.03)
    nis = run(beacons, replies, at(0.0, 0.0))[1].nis[0]
    for gamma, decision in ((nis, "accepted"), (np.nextafter(nis, 0), "gated")):
        noise = dataclasses.replace(GATED, gamma=gamma)
        assert DECISIONS[run(beacons, replies, at(0.0, 0.0), noise)[1].decision[0]] == decision


def test_a_second_reply_of_a_beacon_to_a_ping_takes_no_part():
    beacons = ring(4)
    asked = [(0.0, 1, 0), (0.0, 1, 0), (0.0, 1, 1)]
    replies = direct_replies(beacons, asked, late_s=[0.0, 0.004, 0.01])
    nodes, found = run(beacons, replies, at(0.0, 0.0))
    assert [DECISIONS[d] for d in found.decision] == ["accepted", "duplicate", "accepted"]
    assert len(nodes) == 3
    without, _ = run(beacons, replies[[0, 2]], at(0.0, 0.0))
    np.testing.assert_allclose(nodes.position_m, without.position_m, atol=1e-12)


def test_the_first_reply_inside_the_gate_counts_not_the_first_heard():
    beacons = ring(4)
    replies = direct_replies(beacons, [(0.0, 1, 0)] * 3, late_s=[-0.4, 0.0, 0.004])
    _, found = run(beacons, replies, at(0.0, 0.0))
    assert [DECISIONS[d] for d in found.decision] == ["gated", "accepted", "duplicate"]


def test_a_late_copy_of_a_reply_that_made_the_start_is_a_duplicate():
    beacons = ring(4)
    replies = direct_replies(beacons, [(0.0, 1, 0), (0.0, 1, 0)], late_s=[0.0, 0.004])
    start = at(0.0, 0.0, t_s=float(replies.t_reply_s[0]))
    _, found = run(beacons, replies, start)
    assert [DECISIONS[d] for d in found.decision] == ["before_start", "duplicate"]


def test_ids_that_start_anew_make_no_duplicates():
    beacons = ring(4)
    replies = direct_replies(beacons, [(24.0 * k, k % 3, 0) for k in range(9)])
    _, found = run(beacons, replies, at(0.0, 0.0))
    assert {DECISIONS[d] for d in found.decision} == {"accepted"}


def test_without_a_gate_the_filter_is_the_one_whose_gate_nothing_meets():
    beacons = ring(4)
    asked = [(24.0 * k, k, b) for k in range(10) for b in range(4)]
    replies = direct_replies(beacons, asked, late_s=1e-4)
    gated, told = run(beacons, replies, at(0.0, 0.0), GATED)
    ungated, _ = run(beacons, replies, at(0.0, 0.0), UNGATED)
    assert np.all(told.decision == 0)
    assert np.array_equal(gated.position_m, ungated.position_m)


def test_process_noise_and_gap_variance_grow_between_replies():
    beacons = ring(4)
    t_s = np.array([-100.0, 0.0, 1000.0])
    gap_m2 = np.array([0.0, 0.0, 500.0])
    motion = motion_of(t_s, np.zeros((3, 2)), gap_variance_m2=gap_m2)
    replies = direct_replies(beacons, [(100.0, 1, 0)])
    usable, paths = np.array([True]), ray_geometry(replies, ISOVELOCITY)
    noise = EkfConfig(2.0, 0.3, SIGMA_S, np.inf)
    _, found = filter_travel_times(
        TravelTimes(replies, usable, paths), motion, at(0.0, 0.0, 0.0), noise
    )
    heard_s = replies.t_reply_s[0]
    variance_m2 = 4.0 + 0.3 * heard_s + 0.5 * heard_s
    slope = 2 * np.hypot(*beacons.position_enu_m[0, :2]) / np.linalg.norm(
        beacons.position_enu_m[0] - [0, 0, -20.0]
    ) / 1500.0  # fmt: skip
    assert found.innovation_sigma_s[0] ** 2 == pytest.approx(slope**2 * variance_m2 + SIGMA_S**2)


@pytest.mark.parametrize("seed", range(5))
def test_a_cut_record_gives_the_same_nodes_to_the_bit(seed):
    dive, motion, usable, paths, _, start = voyage()
    rng = np.random.default_rng(seed)
    cut = int(rng.integers(100, len(dive.replies)))
    whole, _ = filter_travel_times(TravelTimes(dive.replies, usable, paths), motion, start, GATED)
    part, found = filter_travel_times(
        TravelTimes(dive.replies[:cut], usable[:cut], paths[: usable[:cut].sum()]),
        motion,
        start,
        GATED,
    )
    assert np.array_equal(part.position_m, whole.position_m[: len(part)])
    assert len(found) == cut


# --- the filter on fixes -----------------------------------------------------------------------


def test_the_filter_on_fixes_is_the_linear_kalman_filter():
    _, motion, _, _, fixes, start = voyage()
    noise = EkfConfig(10.0, 0.3, 2.0, 13.8)
    nodes = filter_fixes(fixes, motion, start, noise)
    steps, t_before = [], start.t_s
    reckoned = reckoned_by_steps()
    for i in np.flatnonzero(fixes.t_s > start.t_s):
        t = fixes.t_s[i]
        (now, gap), (before, gap_before) = reckoned(t), reckoned(t_before)
        z = fixes.position_enu_m[i, :2] + now - reckoned(fixes.t_mid_s[i])[0]
        Q = (0.3 * (t - t_before) + gap - gap_before) * np.eye(2)
        steps.append((now - before, Q, z, fixes.position_cov_m2[i] + 4.0 * np.eye(2), 13.8))
        t_before = t
    kept = linear_filter(np.array([start.east_m, start.north_m]), 100.0 * np.eye(2), steps)
    assert 10 < len(kept) < len(steps)  # some were gated
    assert len(nodes) == len(kept) + 1
    np.testing.assert_allclose(nodes.position_m[1:], [x for x, _ in kept], atol=1e-8)
    np.testing.assert_allclose(nodes.position_cov_m2[1:], [P for _, P in kept], atol=1e-8)


def test_no_later_fix_leaves_the_start_alone():
    _, motion, _, _, fixes, start = voyage()
    nodes = filter_fixes(fixes[fixes.t_s <= start.t_s], motion, start, EkfConfig(10, 0.3, 2, 13.8))
    assert len(nodes) == 1
    assert nodes.position_m[0].tolist() == [start.east_m, start.north_m]


# --- carry -------------------------------------------------------------------------------------


def test_carrying_a_track_on_is_predicting_step_by_step():
    dive, motion, usable, paths, _, start = voyage()
    nodes, _ = filter_travel_times(TravelTimes(dive.replies, usable, paths), motion, start, GATED)
    t_s = np.arange(np.ceil(start.t_s), 3000.0, 7.3)
    position_m, cov_m2 = propagate(nodes, motion, motion.interpolate(t_s), 0.3)
    reckoned = reckoned_by_steps()
    for t, place_m, P in zip(t_s, position_m, cov_m2, strict=True):
        last = max(k for k in range(len(nodes)) if nodes.t_s[k] <= t)
        (now, gap), (then, gap_then) = reckoned(t), reckoned(nodes.t_s[last])
        np.testing.assert_allclose(place_m, nodes.position_m[last] + now - then, atol=1e-9)
        grown = 0.3 * (t - nodes.t_s[last]) + gap - gap_then
        np.testing.assert_allclose(P, nodes.position_cov_m2[last] + grown * np.eye(2), atol=1e-9)


def test_at_a_node_the_track_is_the_node_and_of_two_at_one_instant_the_last():
    from abyssnav.estimation.two_state import Nodes

    nodes = Nodes(np.array([0.0, 5.0, 5.0]), np.array([[0.0, 0], [1, 1], [2, 2]]),
                  np.tile(np.eye(2), (3, 1, 1)))  # fmt: skip
    motion = steady((1.0, 0.0))
    here = motion.interpolate(np.array([0.0, 4.0, 5.0, 6.0]))
    position_m, _ = propagate(nodes, motion, here, 0.3)
    np.testing.assert_allclose(position_m, [[0, 0], [4, 0], [2, 2], [3, 2]], atol=1e-9)


def test_fixes_of_the_hour_are_where_the_vehicle_was():
    """Guards the world above: a fixture that is wrong would prove nothing."""
    _, _, _, _, fixes, _ = voyage()
    assert isinstance(fixes, Fixes)
    assert fixes.consistent.sum() > 20
