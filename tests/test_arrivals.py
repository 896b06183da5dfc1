# SPDX-License-Identifier: Apache-2.0
"""How replies came: each class made by hand from geometry, and counted on a simulated voyage."""

from dataclasses import replace

import numpy as np
import pytest

from abyssnav.acoustics.travel_time import ray_geometry
from abyssnav.align import align
from abyssnav.config import Config
from abyssnav.estimation.arrivals import Environment, Places, Received, classify
from abyssnav.navigate import navigate
from abyssnav.simulate import LABELS, load_scenario, simulate, to_log
from abyssnav.tables import ARRIVALS, EXPLANATIONS, Beacons, Replies, SoundSpeed

SPEED, DEPTH, FLOOR = 1500.0, 4900.0, 5000.0
BEACONS = Beacons(
    np.array([1, 2, 3]),
    np.array(["a", "b", "c"]),
    np.array([[2000.0, 100, -4950], [-1500, 1400, -4940], [300, -2500, -4960]]),
    np.array([0.2, 0.3, 0.4]),
    np.zeros(3),
)
SOUND = SoundSpeed(np.array([0.0, 12000.0]), np.array([SPEED, SPEED]))


def leg_s(beacon, mirror=""):
    """One-way time from (0, 0, -DEPTH) to a beacon or to its image."""
    place = BEACONS.position_enu_m[beacon].copy()
    place[2] = {"": place[2], "surface": -place[2], "floor": -2 * FLOOR - place[2]}[mirror]
    return float(np.linalg.norm(place - [0, 0, -DEPTH])) / SPEED


def answer_s(beacon, out="", back=""):
    return leg_s(beacon, out) + leg_s(beacon, back) + float(BEACONS.turn_around_s[beacon])


def classes_of(times_s, beacon=0, floor_depth_m=FLOOR, sigma_s=0.002, beacons=BEACONS):
    """Class and explanation of travel times heard by a vehicle at rest, a ping each 24 s."""
    times_s = np.atleast_1d(np.asarray(times_s, dtype=float))
    n = len(times_s)
    t_ping_s = 24.0 * np.arange(n)
    still, depth_m, whole = np.zeros((n, 3)), np.full(n, DEPTH), np.arange(n)
    replies = Replies(
        whole, np.full(n, BEACONS.id[beacon]), np.full(n, beacon), t_ping_s, t_ping_s + times_s,
        times_s, np.full(n, np.nan), depth_m, depth_m, still, still,
        np.tile(beacons.position_enu_m[beacon], (n, 1)),
        np.full(n, beacons.turn_around_s[beacon]), np.zeros(n),
    )  # fmt: skip
    cov_m2 = np.repeat(0.25 * np.eye(2)[None], n, axis=0)
    rest = np.zeros((n, 2))
    at = Places(rest, rest, rest, cov_m2, np.zeros(n))
    arrival, why = classify(
        at,
        Received(replies, ray_geometry(replies, SOUND), sigma_s),
        Environment(beacons, SOUND, np.broadcast_to(floor_depth_m, n)),
        gamma=9.21,
    )
    return [(ARRIVALS[a], EXPLANATIONS[e]) for a, e in zip(arrival, why, strict=True)]


def test_the_straight_answer_is_direct():
    assert classes_of([answer_s(0), answer_s(0) + 0.0005]) == [("direct", "direct")] * 2


@pytest.mark.parametrize(("out", "back"), [("surface", ""), ("", "surface"), ("surface",) * 2])
def test_a_bounce_off_the_surface_is_told_by_its_image(out, back):
    assert classes_of(answer_s(0, out, back)) == [("multipath", "surface")]


def test_a_bounce_off_the_floor_is_told_where_the_floor_is_known():
    """With a short sigma, since the floor's image is only a few milliseconds away."""
    late = answer_s(0, "floor", "floor")
    assert 0.002 < late - answer_s(0) < 0.02
    assert classes_of(late, sigma_s=0.0003) == [("multipath", "bottom")]
    unknown = classes_of(late, floor_depth_m=np.nan, sigma_s=0.0003)
    assert unknown == [("multipath", "late_copy")]


def test_the_floor_may_be_known_for_some_replies_only():
    late = answer_s(0, "floor", "floor")
    floor_m = np.array([FLOOR, np.nan, FLOOR])
    classes = classes_of([late] * 3, floor_depth_m=floor_m, sigma_s=0.0003)
    assert [why for _, why in classes] == ["bottom", "late_copy", "bottom"]


def test_the_dvls_altitude_tells_where_the_floor_is():
    """The simulated vehicle keeps its altitude; a fifth of the time the echo is lost."""
    simulation = simulate(load_scenario("voyage_2"))
    log, label = to_log(simulation), np.array(LABELS)[simulation.replies.label]
    velocity = log.roles["velocity"]
    altitude_m = np.full(len(velocity["time_ns"]), load_scenario("voyage_2").vehicle.altitude_m)
    altitude_m[len(altitude_m) * 4 // 5 :] = np.nan
    echoed = replace(log, roles={**log.roles, "velocity": {**velocity, "altitude_m": altitude_m}})
    shares = []
    for known in (log, echoed):
        dive = align(known, Config())
        why = np.array(EXPLANATIONS)[navigate(dive, Config()).innovations["ekf"].explanation]
        share = dive.replies.t_reply_s / dive.replies.t_reply_s[-1]
        shares.append(float(np.mean(why[(label == "bottom") & (share < 0.78)] == "bottom")))
        assert not np.any(why[share > 0.82] == "bottom")
    assert shares[0] == 0.0
    assert shares[1] > 0.5


def test_a_late_copy_comes_within_half_a_second():
    assert classes_of([answer_s(0) + 0.2]) == [("multipath", "late_copy")]
    assert classes_of([answer_s(0) + 0.7]) == [("outlier", "")]
    assert classes_of([answer_s(0) - 0.2]) == [("outlier", "")]


def test_the_answer_of_another_beacon_is_told():
    assert classes_of(answer_s(1), beacon=0) == [("outlier", "wrong_beacon")]


def test_an_answer_to_the_ping_before_is_told():
    """A beacon that answers after 24 s more than the others is heard after the next ping."""
    slow = replace(BEACONS, turn_around_s=BEACONS.turn_around_s + np.array([24.0, 0, 0]))
    on_time = leg_s(0) * 2 + float(slow.turn_around_s[0])
    heard = classes_of([on_time, on_time - 24.0], beacons=slow)
    assert heard == [("direct", "direct"), ("outlier", "previous_ping")]


def test_a_voyage_in_bad_acoustics_is_classed_as_it_was_made():
    simulation = simulate(load_scenario("voyage_2"))
    dive = align(to_log(simulation, name="voyage_2"), Config())
    found = navigate(dive, Config()).innovations["ekf_gated"]
    label = np.array(LABELS)[simulation.replies.label]
    arrival = np.array(ARRIVALS)[found.arrival]
    why = np.array(EXPLANATIONS)[found.explanation]
    assert np.mean(arrival[label == "direct"] == "direct") > 0.99
    assert np.mean(why[label == "surface"] == "surface") > 0.9
    assert np.mean(why[label == "wrong_beacon"] == "wrong_beacon") > 0.9
    assert np.mean(arrival[label == "uniform"] == "outlier") > 0.9
    late = (label == "late") & (
        simulation.replies.travel_time_s > simulation.replies.direct_s + 0.02
    )
    assert np.mean(arrival[late] == "multipath") > 0.9
