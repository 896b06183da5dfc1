# SPDX-License-Identifier: Apache-2.0
"""What the smoother learned, judged: by hypotheses and parameters made by hand."""

from dataclasses import replace

import numpy as np
import pytest

from abyssnav.config import Config
from abyssnav.diagnose.cause import Cause, Evidence, Mend
from abyssnav.diagnose.parameters import (
    Stated,
    learned_causes,
    needs_detective,
    overruled,
    significance,
    suspicion,
    without_dead_reckoning,
)
from abyssnav.run import Result
from abyssnav.tables import CauseWeight, Learned, Solution

SAID, UNSAID = Stated(arm=True, beacons=True), Stated(arm=False, beacons=False)


def weights(**gains: float) -> tuple[CauseWeight, ...]:
    """Hypotheses by name, `_` and number of the beacon, with their log gains."""
    causes = [CauseWeight("", None, 0.5, 0.0)]
    for key, gain in gains.items():
        name, _, number = key.rpartition("_")
        beacon = int(number) if number.isdigit() else None
        causes.append(CauseWeight(name if number.isdigit() else key, beacon, 0.1, gain))
    return tuple(causes)


SOUND = {"lever_arm": -6.0, "turn_around": -4.5, "beacon_moved_1": -4.8, "turn_around_1": -4.6}


def test_nothing_is_suspected_where_no_hypothesis_gains_anything() -> None:
    assert suspicion(weights(**SOUND), SAID) is None
    assert suspicion(weights(**SOUND), UNSAID) is None
    assert suspicion((), SAID) is None


def test_one_beacon_of_several_is_named_with_those_it_cannot_be_told_from() -> None:
    gains = SOUND | {"beacon_moved_2": 2.0, "turn_around_2": 1.0, "beacon_moved_3": 1.5}
    found = suspicion(weights(**gains), SAID)
    assert found is not None
    assert found.name == "beacon_moved"
    assert found.beacon_ids == (2, 3)
    assert found.rivals == ("turn_around",)
    wrong = sum(np.exp(gain) for gain in gains.values())
    assert found.probability == pytest.approx(wrong / (wrong + 1))


def test_many_small_doubts_add_up_where_no_single_one_is_enough() -> None:
    doubts = SOUND | {f"turn_around_{k}": -1.0 for k in range(1, 5)}
    assert suspicion(weights(**doubts), UNSAID) is not None
    assert suspicion(weights(**SOUND | {"turn_around_1": -1.0}), UNSAID) is None


def test_an_arm_that_nobody_gave_needs_less_evidence_than_one_that_was_measured() -> None:
    gains = SOUND | {"lever_arm": -1.8}
    assert suspicion(weights(**gains), SAID) is None
    found = suspicion(weights(**gains), UNSAID)
    assert found is not None
    assert found.name == "lever_arm"


def test_significance_is_nothing_where_the_data_say_nothing() -> None:
    told = Learned("heading_offset", 6.0, 0.1, 0.0, 2.0, "deg")
    assert significance(told) == pytest.approx(36 / (4 - 0.01))
    assert significance(replace(told, sigma=1.99)) == 0.0


def changed(solution: Solution, **values: float) -> Solution:
    """The solution with some parameters of another value."""
    return replace(
        solution,
        learned=tuple(
            replace(one, value=values.get(one.name, one.value)) for one in solution.learned
        ),
    )


def test_a_sound_dive_needs_no_detective_and_each_slow_error_beyond_its_limit_is_named(
    result: Result,
) -> None:
    solution, config = result.solution, Config()
    stated = Stated.of_dive(solution.dive, config)
    assert not needs_detective(solution, stated)
    assert learned_causes(solution, config) == []
    assert without_dead_reckoning(solution) == ""
    for name, value, cause in (
        ("slow_heading_sigma", 4.0, "noise"),
        ("slow_dvl_velocity_sigma", 0.03, "noise"),
        ("slow_earth_velocity_sigma", 0.02, "noise"),
        ("slow_earth_velocity_sigma", 0.1, "water_track"),
        ("travel_time_sigma", 0.009, "noise"),
        ("heading_offset", 20.0, "heading_offset"),
        ("dvl_scale", 0.15, "dvl_scale"),
    ):
        other = changed(solution, **{name: value})
        assert needs_detective(other, stated), name
        assert [one.name for one in learned_causes(other, config)] == [cause]
    assert without_dead_reckoning(changed(solution, slow_heading_sigma=28.0)) == "the compass"
    lost = changed(solution, slow_earth_velocity_sigma=0.9)
    assert without_dead_reckoning(lost) == "compass and DVL"


@pytest.mark.parametrize(
    ("deviation_deg", "of_the_compass"), [(1.0, False), (5.0, True), (22.0, False)]
)
def test_other_axes_of_the_dvl_are_not_named_where_a_compass_deviates(
    result: Result, deviation_deg: float, of_the_compass: bool
) -> None:
    frame = Cause("velocity", "dvl_frame", "frd", Evidence(9.0, 9.0), Mend("frame", ""), "")
    solution = changed(result.solution, deviation_sin_1=0.0, deviation_cos_1=deviation_deg)
    assert overruled(solution, frame) is of_the_compass
