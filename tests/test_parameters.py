# SPDX-License-Identifier: Apache-2.0
"""What the smoother learned, judged: by hypotheses and parameters made by hand."""

from dataclasses import replace

import numpy as np
import pytest

from abyssnav.config import Config
from abyssnav.diagnose.cause import CERTAIN, Cause, Evidence, Mend
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
    """Likelier than seven to three, where it is as likely as not and gains hold one in twenty."""
    gains = SOUND | {"lever_arm": np.log(2.5) - np.log(20)}
    assert suspicion(weights(**gains), SAID) is None
    assert suspicion(weights(**SOUND | {"lever_arm": np.log(2.1) - np.log(20)}), UNSAID) is None
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


def drifting(solution: Solution, sigma_deg: float, most_deg: float) -> Solution:
    """The solution with a compass whose error is learned to drift, from end to end by so much."""
    known = solution.estimates["smoother"]
    drift_rad = np.linspace(0.0, np.radians(most_deg), len(known))
    error = replace(known, heading_error_rad=known.heading_error_rad + drift_rad)
    estimates = {**solution.estimates, "smoother": error}
    return replace(changed(solution, slow_heading_sigma=sigma_deg), estimates=estimates)


def test_a_sound_dive_needs_no_detective_and_each_slow_error_beyond_its_limit_is_named(
    result: Result,
) -> None:
    solution, config = result.solution, Config()
    stated = Stated.of_dive(solution.dive, config)
    assert not needs_detective(solution, stated)
    assert learned_causes(solution, config) == []
    assert without_dead_reckoning(solution) == ""
    for values, cause in (
        ({"slow_dvl_velocity_sigma": 0.03}, "noise"),
        ({"slow_earth_velocity_sigma": 0.02, "slow_earth_velocity_time": 200.0}, "noise"),
        ({"slow_earth_velocity_sigma": 0.02, "slow_earth_velocity_time": 2500.0}, "water_track"),
        ({"slow_earth_velocity_sigma": 0.1, "slow_earth_velocity_time": 200.0}, "water_track"),
        ({"travel_time_sigma": 0.009}, "noise"),
        ({"heading_offset": 20.0}, "heading_offset"),
        ({"dvl_scale": 0.15}, "dvl_scale"),
    ):
        other = changed(solution, **values)
        assert needs_detective(other, stated), values
        assert [one.name for one in learned_causes(other, config)] == [cause]
    lost = changed(solution, slow_earth_velocity_sigma=0.9)
    assert without_dead_reckoning(lost) == "compass and DVL"


def test_a_compass_drifts_by_what_its_error_changes_within_the_dive(result: Result) -> None:
    """A sigma alone says nothing where the error changes slower than the dive lasts."""
    solution, config = result.solution, Config()
    assert needs_detective(drifting(solution, 4.0, 8.0), Stated.of_dive(solution.dive, config))
    (cause,) = learned_causes(drifting(solution, 4.0, 8.0), config)
    assert cause.name == "noise"
    assert float(cause.value.split()[0]) == pytest.approx(8.0, abs=1.0)
    assert learned_causes(drifting(solution, 4.0, 0.0), config) == []
    assert without_dead_reckoning(drifting(solution, 28.0, 90.0)) == "the compass"
    assert without_dead_reckoning(drifting(solution, 28.0, 15.0)) == ""


@pytest.mark.parametrize(
    ("learned", "of_a_sensor"),
    [
        ({"deviation_cos_1": 5.0}, True),
        ({"deviation_cos_1": 22.0}, False),
        ({"heading_offset": -46.0}, False),
        ({"slow_earth_velocity_sigma": 0.04}, True),
        ({"slow_dvl_velocity_sigma": 0.6}, False),
    ],
)
def test_other_axes_of_the_dvl_are_named_only_where_no_sensor_errs_so(
    result: Result, learned: dict[str, float], of_a_sensor: bool
) -> None:
    frame = Cause("velocity", "dvl_frame", "frd", Evidence(9.0, 9.0), Mend("frame", ""), "")
    assert overruled(changed(result.solution, **learned), frame) is of_a_sensor


@pytest.mark.parametrize("name", ["lever_arm", "clock_offset"])
def test_an_arm_that_fixes_show_is_named_only_where_all_replies_have_a_use_for_it(
    result: Result, name: str
) -> None:
    """A compass that drifts looks like one to dead reckoning with a fixed heading."""
    cause = Cause("travel_time", name, "", Evidence(20.0, 3.0), Mend("", ""), "")
    solution = result.solution
    assert overruled(replace(solution, causes=weights(lever_arm=-5.7)), cause)
    assert not overruled(replace(solution, causes=weights(lever_arm=40.0)), cause)
    stamped = replace(cause, evidence=CERTAIN)
    assert overruled(replace(solution, causes=weights(lever_arm=-5.7)), stamped) is (
        name == "lever_arm"
    )


@pytest.mark.parametrize(
    ("sigma_mps", "lasts_s", "drift_deg", "is_overruled"),
    [
        (0.02, 200.0, 0.4, True),  # a DVL that errs for minutes
        (0.02, 2000.0, 0.4, False),
        (0.04, 200.0, 0.4, False),
        (0.001, 3600.0, 0.4, False),  # the smoother says nothing of it
        (0.001, 3600.0, 6.0, True),  # a compass that drifts
    ],
)
def test_a_current_that_fixes_show_is_the_smoothers_too(
    result: Result, sigma_mps: float, lasts_s: float, drift_deg: float, is_overruled: bool
) -> None:
    learned = {"slow_earth_velocity_sigma": sigma_mps, "slow_earth_velocity_time": lasts_s}
    solution = changed(result.solution, **learned, slow_heading_sigma=drift_deg)
    current = Cause("velocity", "water_track", "", Evidence(20.0, 3.0), Mend("", ""), "")
    assert overruled(solution, current) is is_overruled


def test_times_that_err_slowly_are_named_where_they_do_by_as_much_as_their_noise(
    result: Result,
) -> None:
    for sigma_s, names in ((0.0019, []), (0.0035, ["noise"])):
        slow = (
            Learned("slow_travel_time_sigma", sigma_s, 5e-4, 0.002, 8e-4, "s"),
            Learned("slow_travel_time_time", 600.0, 300.0, 600.0, 600.0, "s"),
        )
        solution = replace(result.solution, learned=(*result.solution.learned, *slow))
        causes = learned_causes(solution, Config())
        assert [cause.name for cause in causes] == names
        assert all("3.5 ms for 10 min" in cause.seen for cause in causes)
