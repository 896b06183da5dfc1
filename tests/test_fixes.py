# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from oracles import chain_is_a_track, two_way_time
from worlds import motion_of, steady

from abyssnav.acoustics.travel_time import ray_geometry
from abyssnav.estimation.fixes import (
    StartRule,
    circle_intersections,
    confirm_start,
    cycles,
    fix_positions,
    ping_numbers,
)
from abyssnav.tables import Beacons, Fixes, Replies, SoundSpeed

SIGMA_S, SPEED_MPS = 0.002, 1500.0
ISOVELOCITY = SoundSpeed(np.array([0.0, 12_000.0]), np.array([SPEED_MPS, SPEED_MPS]))
EXACT_M = 1e-5


def array_of(places_m, depth_m=4950.0):
    n = len(places_m)
    return Beacons(
        id=np.arange(1, n + 1),
        name=np.array([f"B{i}" for i in range(n)]),
        position_enu_m=np.column_stack([places_m, -depth_m + 20.0 * np.arange(n)]),
        turn_around_s=0.1 + 0.05 * np.arange(n),
        sigma_m=np.zeros(n),
    )


def ring(count, distance_m=2000.0):
    angle = 0.4 + 2 * np.pi * np.arange(count) / count
    return array_of(distance_m * np.column_stack([np.sin(angle), np.cos(angle)]))


def heard(beacons, asked, position_at, depth_m=4900.0, late_s=0.0):
    """Replies to `asked`: (ping time, id, beacon row) each, from a vehicle on `position_at`."""
    rows = []
    for k, (t_ping_s, ping_id, b) in enumerate(asked):
        place = lambda t: (*position_at(t), -depth_m)  # noqa: E731
        time_s = two_way_time(place, beacons.position_enu_m[b], SPEED_MPS, t_ping_s,
                              beacons.turn_around_s[b])  # fmt: skip
        rows.append((t_ping_s, ping_id, b, time_s + np.broadcast_to(late_s, len(asked))[k]))
    rows.sort(key=lambda row: row[0] + row[3])
    t_ping, ping_id, b, time = (np.array(column) for column in zip(*rows, strict=True))
    n = len(rows)
    return Replies(
        ping_id=ping_id,
        beacon_id=beacons.id[b],
        beacon=b,
        t_ping_s=t_ping,
        t_reply_s=t_ping + time,
        travel_time_s=time,
        snr_db=np.zeros(n),
        depth_ping_m=np.full(n, depth_m),
        depth_reply_m=np.full(n, depth_m),
        lever_ping_enu_m=np.zeros((n, 3)),
        lever_reply_enu_m=np.zeros((n, 3)),
        beacon_enu_m=beacons.position_enu_m[b],
        turn_around_s=beacons.turn_around_s[b],
        beacon_sigma_m=np.zeros(n),
    )


def fixes_of(replies, beacons, motion=None, max_cycle_s=60.0):
    usable = np.full(len(replies), True)
    motion = motion or steady()
    cycle = cycles(replies, usable, max_cycle_s)
    return fix_positions(replies, ray_geometry(replies, ISOVELOCITY), cycle, motion, SIGMA_S)


def one_ping(beacons, here_m, depth_m=4900.0, late_s=0.0):
    asked = [(0.0, 1, b) for b in range(len(beacons))]
    return heard(beacons, asked, lambda _: here_m, depth_m, late_s)


# --- least squares ----------------------------------------------------------------------------


@pytest.mark.parametrize("count", [3, 4, 6, 8])
@pytest.mark.parametrize(
    "here_m",
    [(0.0, 0.0), (312.0, -845.0), (-2300.0, 1900.0), (9000.0, 7000.0)],
    ids=["centre", "inside", "outside", "far outside"],
)
def test_exact_times_give_the_exact_position(count, here_m):
    beacons = ring(count)
    fixes = fixes_of(one_ping(beacons, here_m), beacons)
    np.testing.assert_allclose(fixes.position_enu_m[0], [*here_m, -4900.0], atol=EXACT_M)
    assert fixes.n_replies.tolist() == [count]
    assert fixes.rms_s[0] < 1e-8


@pytest.mark.parametrize("aside_m", [0.5, 5.0, 40.0, 400.0])
@pytest.mark.parametrize("side", [-1, 1])
def test_the_mirror_across_a_base_line_is_not_taken(aside_m, side):
    """Three beacons, two of them near: the vehicle on either side of the line between those."""
    beacons = array_of([(-1000.0, 0.0), (1000.0, 0.0), (150.0, 2500.0)])
    here_m = (200.0, side * aside_m)
    fixes = fixes_of(one_ping(beacons, here_m), beacons)
    np.testing.assert_allclose(fixes.position_enu_m[0, :2], here_m, atol=1e-3)


def test_many_places_all_around_get_their_exact_fix():
    rng = np.random.default_rng(0)
    beacons = ring(4)
    places = rng.uniform(-6000, 6000, (200, 2))
    asked = [(24.0 * k, k, b) for k in range(200) for b in range(4)]
    replies = heard(beacons, asked, lambda t: places[min(int(t // 24), 199)])
    fixes = fixes_of(replies, beacons)
    np.testing.assert_allclose(fixes.position_enu_m[:, :2], places, atol=1e-3)


@pytest.mark.parametrize("count", [3, 4, 5])
def test_beacons_in_a_line_give_no_consistent_fix(count):
    east_m = np.linspace(-2000, 2000, count)
    beacons = dataclasses.replace(
        array_of(np.column_stack([east_m, np.zeros(count)])),
        position_enu_m=np.column_stack([east_m, np.zeros(count), np.full(count, -4950.0)]),
    )
    for here_m in [(300.0, 800.0), (300.0, -60.0), (300.0, 0.0), (2900.0, 0.0)]:
        fixes = fixes_of(one_ping(beacons, here_m), beacons)
        assert fixes.consistent.tolist() == [False], here_m
        assert np.all(np.isfinite(fixes.position_cov_m2))
        assert abs(fixes.position_enu_m[0, 1]) == pytest.approx(abs(here_m[1]), abs=1.0)


def test_beacons_north_and_south_of_the_vehicle_do_not_divide_by_zero():
    beacons = array_of([(0.0, -2000.0), (0.0, 500.0), (0.0, 2000.0)])
    fixes = fixes_of(one_ping(beacons, (0.0, 0.0)), beacons)
    assert not fixes.consistent[0]
    np.testing.assert_allclose(fixes.position_enu_m[0, :2], 0.0, atol=1.0)


def test_one_late_reply_of_four_makes_a_fix_inconsistent():
    beacons = ring(4)
    fixes = fixes_of(one_ping(beacons, (100.0, 200.0), late_s=[0.0, 0.03, 0.0, 0.0]), beacons)
    assert not fixes.consistent[0]
    assert fixes.rms_s[0] > 3 * SIGMA_S


def test_least_squares_is_the_minimum_that_a_dense_search_finds():
    rng = np.random.default_rng(5)
    beacons = ring(5)
    replies = one_ping(beacons, (700.0, -300.0), late_s=0.01 * rng.normal(size=5))
    found = fixes_of(replies, beacons)

    def cost(place):
        ranges = np.linalg.norm([*place, -4900.0] - beacons.position_enu_m[replies.beacon], axis=1)
        time = 2 * ranges / SPEED_MPS + beacons.turn_around_s[replies.beacon]
        return np.sum((time - replies.travel_time_s) ** 2)

    best, span = np.zeros(2), 4000.0
    while span > 1e-5:
        grid = best + span * np.stack(np.meshgrid(*[np.linspace(-1, 1, 21)] * 2), -1).reshape(-1, 2)
        best, span = grid[np.argmin([cost(place) for place in grid])], span / 4
    np.testing.assert_allclose(found.position_enu_m[0, :2], best, atol=1e-3)
    assert found.rms_s[0] == pytest.approx(np.sqrt(cost(best) / 5), rel=1e-6)


def test_the_covariance_is_what_noise_does_to_many_fixes():
    rng = np.random.default_rng(1)
    beacons = ring(4)
    asked = [(24.0 * k, k, b) for k in range(600) for b in range(4)]
    replies = heard(beacons, asked, lambda _: (500.0, 900.0),
                    late_s=SIGMA_S * rng.normal(size=len(asked)))  # fmt: skip
    fixes = fixes_of(replies, beacons)
    error_m = fixes.position_enu_m[:, :2] - [500.0, 900.0]
    nees = np.einsum("ni,nij,nj->n", error_m, np.linalg.inv(fixes.position_cov_m2), error_m)
    assert nees.mean() == pytest.approx(2.0, abs=0.25)  # three sigma of the mean of 600
    assert fixes.consistent.mean() > 0.99


def test_two_beacons_give_no_fix():
    beacons = ring(4)
    replies = heard(beacons, [(0.0, 1, 0), (0.0, 1, 1)], lambda _: (0.0, 0.0))
    assert len(fixes_of(replies, beacons)) == 0


def test_no_reply_gives_no_fix():
    beacons = ring(3)
    nothing = one_ping(beacons, (0.0, 0.0))[:0]
    assert len(fixes_of(nothing, beacons)) == 0


def test_of_two_replies_of_a_beacon_the_first_takes_part():
    beacons = ring(4)
    asked = [(0.0, 1, b) for b in (0, 1, 2, 3, 1, 2)]
    replies = heard(beacons, asked, lambda _: (50.0, 60.0), late_s=[0, 0, 0, 0, 0.02, 0.3])
    fixes = fixes_of(replies, beacons)
    assert fixes.n_replies.tolist() == [4]
    np.testing.assert_allclose(fixes.position_enu_m[0, :2], [50.0, 60.0], atol=EXACT_M)
    twice_of_two = heard(beacons, [(0.0, 1, b) for b in (0, 0, 1, 1)], lambda _: (50.0, 60.0),
                         late_s=[0, 0.02, 0, 0.02])  # fmt: skip
    assert len(fixes_of(twice_of_two, beacons)) == 0


def test_a_fix_does_not_change_by_a_bit_with_what_other_cycles_hold():
    """Wider cycles, later cycles and slower neighbours leave each fix as it is."""
    rng = np.random.default_rng(3)
    beacons = ring(8)
    asked = [
        (24.0 * k, k, b)
        for k in range(60)
        for b in rng.permutation(8)[: 3 if k < 20 else rng.integers(3, 9)]
    ]
    noise = SIGMA_S * rng.standard_t(2, len(asked))
    replies = heard(beacons, asked, lambda t: (3.0 * t - 900, 500.0), late_s=noise)
    whole = fixes_of(replies, beacons)
    for pings in (1, 7, 20, 35):
        part = fixes_of(replies[replies.ping_id < pings], beacons)
        for name, column in part.columns().items():
            assert np.array_equal(column, getattr(whole, name)[: len(column)]), (pings, name)


def test_a_fix_is_stamped_at_its_last_reply_and_fits_at_mid_flight():
    beacons = ring(4)
    velocity_mps = np.array([1.2, -0.9])
    replies = heard(beacons, [(0.0, 7, b) for b in range(4)], lambda t: velocity_mps * t)
    fixes = fixes_of(replies, beacons)
    assert fixes.t_s[0] == replies.t_reply_s.max()
    assert fixes.ping_id[0] == 7
    middle_s = np.mean(0.5 * (replies.t_ping_s + replies.t_reply_s))
    assert fixes.t_mid_s[0] == pytest.approx(middle_s)
    here_m = fixes.position_enu_m[0, :2]
    assert np.linalg.norm(here_m - velocity_mps * fixes.t_mid_s[0]) < 0.3
    assert np.linalg.norm(here_m - velocity_mps * fixes.t_s[0]) > 1.5


def test_fixes_come_in_the_order_in_which_their_last_replies_were_heard():
    beacons = ring(4)
    asked = [(24.0 * k, k, b) for k in range(3) for b in range(4)]
    late_s = np.zeros(12)
    late_s[0] = 60.0  # a reply to the first ping that comes after the third
    fixes = fixes_of(heard(beacons, asked, lambda _: (0.0, 0.0), late_s=late_s), beacons)
    assert np.all(np.diff(fixes.t_s) > 0)
    assert fixes.cycle.tolist() == [1, 2, 0]


# --- one beacon a ping ------------------------------------------------------------------------


def stop_and_go(step_m):
    """Still while a ping is out, then on to the next place: what the fix takes a vehicle for."""
    times, places = [-100.0], [np.zeros(2)]
    for k in range(60):
        times += [15.0 * k - 1.0, 15.0 * k, 15.0 * k + 13.0]
        places += [places[-1], np.multiply(k, step_m), np.multiply(k, step_m)]
        places[-3] = np.multiply(max(k - 1, 0), step_m)
    return motion_of(times, np.array(places, dtype=float))


def test_pings_of_one_beacon_each_make_a_cycle_that_dead_reckoning_shifts_together():
    beacons = ring(4)
    motion = stop_and_go((18.0, -7.0))
    begin_m = np.array([250.0, 400.0])

    def place(t):
        return begin_m + motion.interpolate(np.array([t])).displacement_m[0]

    asked = [(15.0 * k, k, k % 4) for k in range(40)]
    replies = heard(beacons, asked, place)
    fixes = fixes_of(replies, beacons, motion)
    assert fixes.n_replies.tolist() == [4] * 10
    assert fixes.ping_id.tolist() == list(range(3, 40, 4))
    np.testing.assert_allclose(
        fixes.position_enu_m[:, :2], [place(t) for t in fixes.t_s], atol=EXACT_M
    )


def test_a_moving_vehicle_that_asks_one_beacon_a_ping_gets_fixes_right_at_mid_flight():
    beacons = ring(4)
    velocity_mps = np.array([1.5, 0.8])
    motion = steady(velocity_mps)
    asked = [(15.0 * k, k, k % 4) for k in range(40)]
    fixes = fixes_of(heard(beacons, asked, lambda t: velocity_mps * t), beacons, motion)
    error_m = fixes.position_enu_m[:, :2] - np.outer(fixes.t_mid_s, velocity_mps)
    assert np.abs(error_m).max() < 0.01


@pytest.mark.parametrize(
    ("period_s", "beacons_asked", "cycle"),
    [
        (15.0, [0, 1, 2, 3, 0, 1, 2, 3, 0], [0, 0, 0, 0, 1, 1, 1, 1, 2]),
        (15.0, [0, 1, 2, 1, 3, 0], [0, 0, 0, 1, 1, 1]),  # a beacon would come twice
        (25.0, [0, 1, 2, 3, 0, 1], [0, 0, 0, 1, 1, 1]),  # 75 s is longer than a cycle
        (70.0, [0, 1, 2], [0, 1, 2]),
    ],
)
def test_a_cycle_ends_before_a_beacon_comes_twice_and_after_its_longest_time(
    period_s, beacons_asked, cycle
):
    beacons = ring(4)
    asked = [(period_s * k, k, b) for k, b in enumerate(beacons_asked)]
    replies = heard(beacons, asked, lambda _: (0.0, 0.0))
    found = cycles(replies, np.full(len(replies), True), 60.0)
    assert found.tolist() == cycle


def test_replies_of_no_use_split_no_cycle():
    beacons = ring(4)
    asked = [(15.0 * k, k, b) for k, b in enumerate([0, 1, 0, 2, 3])]
    replies = heard(beacons, asked, lambda _: (0.0, 0.0))
    found = cycles(replies, np.array([True, True, False, True, True]), 70.0)
    assert found[[0, 1, 3, 4]].tolist() == [0, 0, 0, 0]


def test_pings_that_ask_all_beacons_are_a_cycle_each_also_when_few_answer():
    beacons = ring(4)
    asked = [(24.0 * k, k, b) for k, answer in enumerate([[0, 1, 2], [3], [0], [1, 2]])
             for b in answer]  # fmt: skip
    replies = heard(beacons, asked, lambda _: (0.0, 0.0))
    found = cycles(replies, np.full(len(replies), True), 60.0)
    order = np.argsort(found, kind="stable")
    assert found[order].tolist() == replies.ping_id[order].tolist()


@pytest.mark.parametrize(
    "ids",
    [[1, 2, 3, 4, 5, 6], [5, 6, 1, 2, 5, 6], [0] * 6, [9, 8, 7, 6, 5, 4]],
    ids=["counted", "restarted", "unset", "falling"],
)
def test_a_ping_is_told_by_its_id_and_its_instant(ids):
    beacons = ring(4)
    asked = [(24.0 * k, ids[k], b) for k in range(6) for b in range(4)]
    replies = heard(beacons, asked, lambda _: (0.0, 0.0))
    np.testing.assert_array_equal(ping_numbers(replies), np.round(replies.t_ping_s / 24.0))
    np.testing.assert_array_equal(
        cycles(replies, np.full(len(replies), True), 60.0), ping_numbers(replies)
    )


def test_no_replies_make_no_pings():
    assert len(ping_numbers(one_ping(ring(3), (0.0, 0.0))[:0])) == 0


# --- circles ----------------------------------------------------------------------------------


def test_intersections_lie_on_both_circles():
    rng = np.random.default_rng(8)
    here, one, other = rng.uniform(-3000, 3000, (3, 100, 2))
    radius, other_radius = np.hypot(*(here - one).T), np.hypot(*(here - other).T)
    both = circle_intersections(one, radius, other, other_radius)
    for k in (0, 1):
        np.testing.assert_allclose(np.hypot(*(both[:, k] - one).T), radius, rtol=1e-8)
        np.testing.assert_allclose(np.hypot(*(both[:, k] - other).T), other_radius, rtol=1e-6)
    nearest = np.min(np.linalg.norm(both - here[:, None], axis=-1), axis=1)
    assert nearest.max() < 1e-3


def test_circles_that_do_not_meet_give_the_point_between_them():
    apart = circle_intersections(
        np.array([0.0, 0.0]), np.array(100.0), np.array([1000.0, 0.0]), np.array(100.0)
    )
    np.testing.assert_allclose(apart[0], apart[1])
    assert apart[0, 1] == 0.0
    assert -100 <= apart[0, 0] <= 900
    same = circle_intersections(np.zeros(2), np.array(5.0), np.zeros(2), np.array(5.0))
    assert np.all(np.isfinite(same))


# --- start ------------------------------------------------------------------------------------


def fixes_at(cycle, east_m, north_m=None, period_s=24.0):
    cycle = np.asarray(cycle)
    n = len(cycle)
    t_s = period_s * cycle + 5.0
    north_m = np.zeros(n) if north_m is None else np.asarray(north_m, float)
    return Fixes(
        t_s, t_s, cycle, cycle,
        np.column_stack([np.asarray(east_m, float), north_m, np.zeros(n)]),
        np.tile(np.eye(2), (n, 1, 1)), np.full(n, 4), np.zeros(n), np.full(n, True),
    )  # fmt: skip


def confirm(fixes, m=4, n=6, v_min=0.0, v_max=4.0, a_max=0.5):
    return confirm_start(fixes, StartRule(m, n, v_min, v_max, a_max))


def test_four_good_fixes_running_confirm_at_the_fourth():
    start = confirm(fixes_at(range(6), 30.0 * np.arange(6)))
    assert (start.t_s, start.east_m, start.north_m) == (24 * 3 + 5.0, 90.0, 0.0)
    assert (start.cycles, start.how) == (4, "m_of_n")


def test_missing_cycles_are_bridged_with_the_true_time_between_fixes():
    cycle = np.array([0, 3, 4, 5])
    start = confirm(fixes_at(cycle, 36.0 * cycle))  # 108 m from the first to the second
    assert start.east_m == 180.0
    assert start.cycles == 6


def test_a_window_of_six_cycles_does_not_reach_a_seventh():
    cycle = np.array([0, 2, 4, 6])
    assert confirm(fixes_at(cycle, 30.0 * cycle)) is None
    assert confirm(fixes_at(cycle, 30.0 * cycle), n=7) is not None


@pytest.mark.parametrize("count", [0, 1, 3])
def test_fewer_than_m_fixes_never_confirm(count):
    assert confirm(fixes_at(np.arange(count), np.zeros(count))) is None


@pytest.mark.parametrize(("speed_mps", "found"), [(3.99, True), (4.01, False), (0.49, False)])
def test_speeds_outside_equation_4_do_not_confirm(speed_mps, found):
    start = confirm(fixes_at(range(4), 24.0 * speed_mps * np.arange(4)), v_min=0.5)
    assert (start is not None) == found


def test_equation_5_compares_vectors_not_speeds():
    """A vehicle that turns back at 1 m/s: speeds agree, velocities differ by 2 m/s in 24 s."""
    back = fixes_at(range(4), [0.0, 24.0, 0.0, 24.0])
    assert confirm(back, a_max=0.083) is None
    assert confirm(back, a_max=0.084) is not None


def test_an_outlier_among_the_fixes_is_stepped_over():
    start = confirm(fixes_at(range(5), [0.0, 30.0, 900.0, 90.0, 120.0]))
    assert start.east_m == 120.0
    assert start.cycles == 5


def test_of_several_returns_of_one_cycle_the_least_acceleration_starts_the_track():
    cycle = [0, 1, 2, 3, 3]
    for order in ([60.0, 90.0], [90.0, 60.0]):
        start = confirm(fixes_at(cycle, [0.0, 30.0, 60.0, *order]))
        assert start.east_m == 90.0


def test_two_returns_of_one_cycle_are_never_two_of_the_m():
    assert confirm(fixes_at([0, 1, 2, 2], [0.0, 30.0, 60.0, 61.0])) is None


def test_two_fixes_of_one_instant_are_no_step_of_a_track():
    fixes = fixes_at(range(4), 30.0 * np.arange(4))
    together = dataclasses.replace(fixes, t_s=np.array([5.0, 29.0, 29.0, 77.0]))
    assert confirm(together) is None


@pytest.mark.parametrize("seed", range(30))
def test_the_rule_agrees_with_equations_4_and_5_taken_chain_by_chain(seed):
    from itertools import combinations

    rng = np.random.default_rng(seed)
    cycle = np.flatnonzero(rng.random(14) < 0.7)
    n = len(cycle)
    east = 30.0 * cycle + np.where(rng.random(n) < 0.3, rng.normal(0, 80, n), rng.normal(0, 5, n))
    fixes = fixes_at(cycle, east, rng.normal(0, 20, n))
    rule = {"v_min": 0.3, "v_max": 3.0, "a_max": 0.05}
    expected = next(
        (
            chain[-1]
            for last in range(n)
            for chain in [
                c for c in combinations(range(last + 1), 4)
                if c[-1] == last and cycle[last] - cycle[c[0]] < 6
            ]
            if chain_is_a_track(fixes.t_s[list(chain)], fixes.position_enu_m[list(chain), :2],
                                **rule)
        ),
        None,
    )  # fmt: skip
    start = confirm(fixes, **rule)
    assert (None if start is None else start.t_s) == (
        None if expected is None else fixes.t_s[expected]
    )
