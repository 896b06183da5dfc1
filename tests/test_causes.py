# SPDX-License-Identifier: Apache-2.0
"""The short form of `make verdicts`: faults planted alone are named, with no filter run."""

from dataclasses import replace
from functools import cache

import pytest
from verdicts import FAULTS, Fault, scenario_with, times

from abyssnav.align import align
from abyssnav.config import Config
from abyssnav.diagnose.cause import Cause
from abyssnav.diagnose.causes import find_causes
from abyssnav.diagnose.conventions import conventions
from abyssnav.simulate import Simulation, simulate, stated_settings, to_log
from abyssnav.tables import Dive

_LISTED = (
    "heading_constant", "heading_sense", "heading_reference", "heading_degrees", "heading_25",
    "dvl_mount", "dvl_earth", "dvl_sign", "dvl_knots", "water_track", "zeros", "one_way",
    "turn_around_removed", "milliseconds", "ids", "beacon_200m", "sound_speed", "lever_arm",
    "depth_feet", "depth_30m", "clock_30s", "replies_1h", "replies_15min",
)  # fmt: skip


@cache
def simulated(scenario: str, keys: tuple[str, ...], fault: str) -> Simulation:
    """One dive for all faults that are planted into its log."""
    assert FAULTS[fault].scenario == scenario
    return simulate(scenario_with(FAULTS[fault]), 1001)


def planted(name: str) -> tuple[Dive, Config]:
    """The dive with one fault, and its settings."""
    fault = FAULTS[name]
    same = next(other for other, f in FAULTS.items() if (f.scenario, f.keys) == (
        fault.scenario, fault.keys))  # fmt: skip
    simulation = simulated(fault.scenario, tuple(fault.keys), same)
    log, config = to_log(simulation), stated_settings(simulation)
    return align(replace(log, roles=fault.change(dict(log.roles))), config), config


@cache
def first_cause(name: str) -> Cause:
    """The likeliest cause of one fault."""
    return find_causes(*planted(name))[0]


@pytest.mark.parametrize("name", _LISTED)
def test_a_fault_planted_alone_is_named(name: str) -> None:
    assert first_cause(name).name in FAULTS[name].names


def test_replies_of_another_time_zone_are_put_back_not_further_away() -> None:
    cause = first_cause("replies_15min")
    assert cause.mend.line == "latency_s.travel_time = 900.0"
    assert "15 min late" in cause.seen


def test_a_sound_speed_that_is_stated_too_high_is_mended_downwards() -> None:
    cause = first_cause("sound_speed")  # 30 m/s of some 1,500
    assert cause.value == "-2.0 %"


def test_times_one_way_that_hold_the_turn_around_are_named_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    halved = Fault(("time_one_way",), {}, times(lambda t_s, _: t_s / 2))
    monkeypatch.setitem(FAULTS, "halved", halved)
    cause = find_causes(*planted("halved"))[0]
    assert (cause.name, cause.value) == ("time_one_way", "one-way times")
    assert cause.mend.line == "one_way = true"


def test_a_wait_that_is_wrong_at_all_beacons_is_known_in_milliseconds() -> None:
    cause = first_cause("turn_arounds_5ms")
    assert cause.name == "turn_around"
    assert 4.0 < float(cause.value.removesuffix(" ms")) < 7.0  # 5 ms, told from sound speed
    assert f"come {cause.value.removeprefix('+')} too late" in cause.seen


def test_a_displaced_beacon_is_placed_by_its_own_replies() -> None:
    """200 m off: where it lies, to metres, by the fixes of the others."""
    cause = first_cause("beacon_200m")
    assert cause.value.startswith("beacon ")
    far_m = float(cause.value.split()[-2])
    assert abs(far_m - 200.0) < 3.0
    assert "give or take" in cause.seen
    assert cause.mend.line.startswith("position_m = [")


def test_a_sound_dive_has_no_cause_and_knows_its_clocks() -> None:
    contradicted, late = conventions(*planted("sound_voyage_1"))
    assert contradicted == []
    assert late
    assert all(abs(one["late_s"]) < 3 * one["sigma_s"] for one in late)


def test_a_turned_dvl_has_the_line_that_mends_it() -> None:
    (convention,), late = conventions(*planted("dvl_mount"))
    assert str(convention["mend"]).startswith("mount_rpy_deg = [0, 0, ")
    assert convention["log_likelihood_ratio"] > 10
    assert {"role", "name", "value", "runner_up"} <= convention.keys()
    assert late == []  # no clock is judged by a way that is read wrongly
