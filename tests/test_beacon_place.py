# SPDX-License-Identifier: Apache-2.0
"""A beacon sought by its own replies, along the true way."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from abyssnav.align import align
from abyssnav.diagnose.beacon_place import along, by_fixes, locate
from abyssnav.simulate import Simulation, load_scenario, simulate, stated_settings, to_log
from abyssnav.tables import Dive, Fixes, Track


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    """Forty minutes of good acoustics."""
    return simulate(msgspec.structs.replace(load_scenario("clean"), duration_s=2400.0))


@pytest.fixture(scope="module")
def dive(simulation: Simulation) -> Dive:
    """The same, aligned."""
    return align(to_log(simulation), stated_settings(simulation))


def true_track(simulation: Simulation) -> Track:
    t_s = np.arange(0.0, 2400.0)
    blank = np.zeros(len(t_s))
    return Track(t_s, simulation.position_at(t_s), np.zeros((len(t_s), 2, 2)), *[blank] * 6)


@pytest.mark.parametrize("moved_m", [(5.0, -3.0, 0.0), (-140.0, 90.0, 0.0)])
def test_a_beacon_that_lies_elsewhere_is_placed(
    simulation: Simulation, dive: Dive, moved_m: tuple[float, float, float]
) -> None:
    given_m = dive.beacons.position_enu_m.copy()
    given_m[1] -= moved_m
    shifted = dive.replies.beacon_enu_m - np.where(
        (dive.replies.beacon == 1)[:, None], moved_m, 0.0
    )
    other = replace(
        dive,
        beacons=replace(dive.beacons, position_enu_m=given_m),
        replies=replace(dive.replies, beacon_enu_m=shifted),
    )
    place = locate(other, 1, along(true_track(simulation)))
    assert place is not None
    assert place.place_gain > 3  # another place explains more than a late answer
    assert place.sigma_m < 1.0
    np.testing.assert_allclose(place.moved_m, moved_m[:2], atol=max(4 * place.sigma_m, 0.5))


def test_a_beacon_that_answers_late_is_not_moved(simulation: Simulation, dive: Dive) -> None:
    late_s = np.where(dive.replies.beacon == 2, 0.02, 0.0)
    replies = replace(dive.replies, travel_time_s=dive.replies.travel_time_s + late_s)
    place = locate(replace(dive, replies=replies), 2, along(true_track(simulation)))
    assert place is not None
    assert place.place_gain < 0
    assert place.late_s == pytest.approx(0.02, abs=1e-3)


def test_without_enough_replies_near_known_places_there_is_no_place(
    simulation: Simulation, dive: Dive
) -> None:
    few = replace(dive, replies=dive.replies[:10])
    assert locate(few, 1, along(true_track(simulation))) is None
    assert locate(dive, 1, by_fixes(Fixes(*[np.zeros(0)] * 8, np.zeros(0, dtype=bool)))) is None  # type: ignore[call-arg]
