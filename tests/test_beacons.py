# SPDX-License-Identifier: Apache-2.0
"""Beacons that move, are corrected, or come with every reply."""

import dataclasses
from datetime import UTC, datetime, timedelta

import msgspec
import numpy as np
import pytest
from small_logs import PLACES, START_NS, beacon_rows, check, small_log

from abyssnav.align import align
from abyssnav.config import BeaconSetting, Config, OriginSetting
from abyssnav.errors import ConfigError
from abyssnav.geometry import enu_to_geodetic


def drifting_rows(t_s, rate_mps, sigma_m=0.0, noise_m=0.0, seed=5):
    """Beacon 1 drifts east, the others stay; a message at each time."""
    rng = np.random.default_rng(seed)
    parts = []
    for k, t in enumerate(t_s):
        places = PLACES.copy()
        places[0, 0] += rate_mps * t
        places[:1] += rng.normal(0, noise_m, (1, 3)) * [1, 1, 0]
        parts.append(beacon_rows([1, 2, 3], places, message=k, t_s=t))
    rows = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return rows | {"sigma_m": np.where(rows["id"] == 1, sigma_m, 0.0)}


def test_a_drifting_beacon_is_where_it_answered():
    dive = align(small_log(beacons=drifting_rows(np.arange(0.0, 101.0, 5.0), 0.3)), Config())
    mine = dive.replies.beacon_id == 1
    answered_s = 0.5 * (dive.replies.t_ping_s + dive.replies.t_reply_s)[mine]
    np.testing.assert_allclose(dive.replies.beacon_enu_m[mine, 0], 0.3 * answered_s, atol=1e-9)
    assert dive.beacons.moving.tolist() == [True, False, False]
    first_s = float(dive.replies.t_reply_s.min())
    assert dive.beacons.position_enu_m[0, 0] == pytest.approx(0.3 * first_s, abs=1e-9)
    assert "B1 over 30 m, 21 places" in check(dive, "beacons_moving").detail
    others = dive.replies.beacon_enu_m[dive.replies.beacon_id == 2]
    np.testing.assert_array_equal(others, np.tile(PLACES[1], (len(others), 1)))


@pytest.mark.parametrize(("stated_m", "within_m"), [(0.7, 0.35), (0.0, 0.8)])
def test_a_line_through_many_places_has_less_of_their_noise_and_says_how_much(stated_m, within_m):
    """Of places whose sigma nobody states, it is measured, and they are interpolated."""
    errors, sigmas = [], []
    for seed in range(6):
        rows = drifting_rows(np.arange(0.0, 101.0, 1.0), 1.0, stated_m, 0.7, seed)
        replies = align(small_log(beacons=rows), Config()).replies
        mine = replies.beacon_id == 1
        answered_s = 0.5 * (replies.t_ping_s + replies.t_reply_s)[mine]
        errors.append(replies.beacon_enu_m[mine, 0] - answered_s)
        sigmas.append(replies.beacon_sigma_m[mine])
        assert np.all(replies.beacon_sigma_m[~mine] == 0)
    assert np.sqrt(np.mean(np.square(errors))) < within_m
    assert 0.6 < np.sqrt(np.mean(np.square(errors) / np.square(sigmas))) < 1.5


@pytest.mark.parametrize("sigma_m", [0.0, 0.5])
def test_a_beacon_that_swings_is_interpolated_between_its_places(sigma_m):
    t_s = np.arange(0.0, 101.0, 5.0)
    rows = drifting_rows(t_s, 0.0, sigma_m)
    swing_m = 40.0 * np.sin(0.5 * t_s)
    rows["position_enu_m"][rows["id"] == 1, 0] = swing_m
    replies = align(small_log(beacons=rows), Config()).replies
    mine = replies.beacon_id == 1
    answered_s = 0.5 * (replies.t_ping_s + replies.t_reply_s)[mine]
    np.testing.assert_allclose(
        replies.beacon_enu_m[mine, 0], np.interp(answered_s, t_s, swing_m), atol=1e-9
    )


def test_noise_within_its_sigma_is_no_motion():
    rows = drifting_rows(np.arange(0.0, 101.0, 1.0), 0.0, 2.0, 1.0)
    dive = align(small_log(beacons=rows), Config())
    assert not dive.beacons.moving.any()
    assert not any(c.name == "beacons_moving" for c in dive.checks)


def test_two_places_are_a_correction_and_the_later_one_counts_for_all():
    moved = PLACES.copy()
    moved[2] += [0.0, 40.0, 0.0]
    parts = [beacon_rows([1, 2, 3], PLACES), beacon_rows([1, 2, 3], moved, message=1, t_s=60.0)]
    rows = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    dive = align(small_log(beacons=rows), Config())
    np.testing.assert_array_equal(dive.beacons.position_enu_m, moved)
    told = check(dive, "beacons_corrected")
    assert not told.ok
    assert told.detail == "beacon 3 by 40.0 m: the later place is taken for the whole dive"
    assert not dive.beacons.moving.any()


def test_replies_far_from_any_logged_place_of_a_moving_beacon_are_told():
    rows = drifting_rows(np.arange(0.0, 12.0, 1.0), 1.0)
    late = align(small_log(beacons=rows), Config())
    unseen = check(late, "moving_beacons_unseen")
    last_s = float(late.replies.t_reply_s[late.replies.beacon_id == 1].max())
    assert unseen.value == pytest.approx(last_s - 11.0, abs=3.0)
    assert not unseen.ok


def test_beacons_with_every_reply_are_put_together():
    """A message each: nobody's array holds them all."""
    order, times = [3, 1, 2, 3, 1, 2], [8.0, 8.1, 8.2, 32.0, 32.1, 32.2]
    parts = [
        beacon_rows([i], PLACES[[i - 1]], message=k, t_s=t)
        for k, (i, t) in enumerate(zip(order, times, strict=True))
    ]
    rows = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    dive = align(small_log(beacons=rows), Config())
    assert dive.beacons.id.tolist() == [1, 2, 3]
    np.testing.assert_array_equal(dive.beacons.position_enu_m, PLACES)


def test_logged_latitude_longitude_and_depth_are_places_and_the_first_the_origin():
    latitude, longitude, _ = enu_to_geodetic(-23.5, 179.999, PLACES)
    rows = beacon_rows([1, 2, 3], PLACES)
    del rows["position_enu_m"]
    rows |= {"latitude_deg": latitude, "longitude_deg": longitude, "depth_m": -PLACES[:, 2]}
    log = small_log()
    log = dataclasses.replace(log, roles={**log.roles, "beacons": rows})
    with_origin = msgspec.structs.replace(Config(), origin=OriginSetting(-23.5, 179.999))
    dive = align(log, with_origin)
    np.testing.assert_allclose(dive.beacons.position_enu_m, PLACES, atol=1e-3)
    alone = align(log, Config())
    np.testing.assert_allclose(alone.beacons.position_enu_m[0, :2], 0.0, atol=1e-6)
    assert alone.origin.source == "beacon"
    assert check(alone, "origin").detail.endswith("of the beacon")


def test_a_beacon_of_the_settings_stands_where_its_from_and_until_say():
    start = datetime.fromtimestamp(START_NS / 1e9, UTC)
    ours = [
        BeaconSetting(id=i, turn_around_s=0.1, position_m=tuple(PLACES[i - 1].tolist()))
        for i in (2, 3)
    ]
    ours += [
        BeaconSetting(id=1, turn_around_s=0.1, position_m=(0.0, 0.0, -10.0)),
        BeaconSetting(
            id=1, turn_around_s=0.4, position_m=(5.0, 0.0, -10.0),
            from_=start + timedelta(seconds=50),
        ),
    ]  # fmt: skip
    dive = align(small_log(), msgspec.structs.replace(Config(), beacon=tuple(ours)))
    mine = dive.replies.beacon_id == 1
    late = dive.replies.t_ping_s[mine] > 50
    np.testing.assert_array_equal(dive.replies.beacon_enu_m[mine, 0], np.where(late, 5.0, 0.0))
    np.testing.assert_array_equal(dive.replies.turn_around_s[mine], np.where(late, 0.4, 0.1))
    assert len(dive.beacons) == 3
    gone = msgspec.structs.replace(ours[2], until=start + timedelta(seconds=20))
    dive = align(small_log(), msgspec.structs.replace(Config(), beacon=(*ours[:2], gone)))
    mine = dive.replies.beacon_id == 1
    np.testing.assert_array_equal(dive.replies.beacon[mine] >= 0, dive.replies.t_ping_s[mine] < 20)
    assert not dive.beacons.moving.any()
    with pytest.raises(ConfigError, match=r"\[\[beacon\]\] 2 is there 2 times; with from"):
        align(small_log(), msgspec.structs.replace(Config(), beacon=(*ours[:1], *ours[:2])))


@pytest.mark.parametrize("sigma_m", [np.inf, -1.0, 1e9])
def test_a_sigma_of_no_place_is_left_out_and_told(sigma_m):
    rows = beacon_rows([1, 2, 3], PLACES) | {"sigma_m": np.array([0.5, sigma_m, 0.5])}
    dive = align(small_log(beacons=rows), Config())
    assert dive.beacons.sigma_m.tolist() == [0.5, 0.0, 0.5]
    told = check(dive, "beacon_sigma_of_no_place")
    assert (told.ok, told.value) == (False, 1)
    assert "beacon 2: sigma of" in told.detail


def test_two_beacons_are_navigated_with_a_check():
    dive = align(small_log(beacons=beacon_rows([1, 3], PLACES[:2])), Config())
    told = check(dive, "beacons")
    assert (told.ok, told.value) == (False, 2)
    assert check(align(small_log(), Config()), "beacons").ok
