# SPDX-License-Identifier: Apache-2.0
"""The short form of `make verdicts`: faults planted alone are named, with no filter run."""

from dataclasses import replace

import pytest
from verdicts import FAULTS, scenario_with

from abyssnav.align import align
from abyssnav.diagnose.causes import find_causes
from abyssnav.diagnose.conventions import conventions
from abyssnav.simulate import simulate, stated_settings, to_log

_LISTED = (
    "heading_constant", "heading_sense", "heading_reference", "heading_degrees", "heading_25",
    "dvl_mount", "dvl_earth", "dvl_sign", "dvl_knots", "water_track", "zeros", "one_way",
    "turn_around_removed", "milliseconds", "ids", "beacon_200m", "sound_speed", "lever_arm",
    "depth_feet", "clock_30s", "replies_1h", "replies_15min",
)  # fmt: skip


@pytest.mark.parametrize("name", _LISTED)
def test_a_fault_planted_alone_is_named(name: str) -> None:
    fault = FAULTS[name]
    simulation = simulate(scenario_with(fault), 1001)
    log = to_log(simulation)
    config = stated_settings(simulation)
    dive = align(replace(log, roles=fault.change(dict(log.roles))), config)
    assert find_causes(dive, config)[0].name in fault.names


def test_a_sound_dive_has_no_cause_and_a_turned_dvl_the_line_that_mends_it() -> None:
    for name, mends in (("sound_voyage_1", []), ("dvl_mount", ["mount_rpy_deg = [0, 0, "])):
        simulation = simulate(scenario_with(FAULTS[name]), 1002)
        config = stated_settings(simulation)
        said, late = conventions(align(to_log(simulation), config), config)
        assert bool(late) == (not mends)  # no clock is judged by a way that is read wrongly
        assert all(abs(one["late_s"]) < 3 * one["sigma_s"] for one in late)
        assert len(said) == len(mends)
        for convention, mend in zip(said, mends, strict=True):
            assert str(convention["mend"]).startswith(mend)
            assert convention["log_likelihood_ratio"] > 10
            assert {"role", "name", "value", "runner_up"} <= convention.keys()
