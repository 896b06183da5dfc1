# SPDX-License-Identifier: Apache-2.0
"""Every cause of the contract's list in the surveyor's words, with the line that mends it."""

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from verdicts import FAULTS, scenario_with

from abyssnav.align import align
from abyssnav.config import Config
from abyssnav.diagnose import reasons
from abyssnav.diagnose.acoustics import Assumption, ScoredAssumption
from abyssnav.diagnose.cause import MEANING, Cause, Evidence
from abyssnav.diagnose.clocks import Apart, Loss, apart_cause, zone_cause
from abyssnav.diagnose.motion import READINGS, SOUND, Scored
from abyssnav.diagnose.motion_causes import Case, lever_arm_cause, motion_cause, turned_cause
from abyssnav.diagnose.parameters import Suspicion
from abyssnav.diagnose.sensors import compass_stands_still, zeros_for_lost_lock
from abyssnav.diagnose.suspects import doubt_words
from abyssnav.diagnose.times_causes import (
    acoustic_cause,
    common_wait_cause,
    displaced_cause,
    one_wait_cause,
    several_moved_cause,
)
from abyssnav.settings import settings_from_toml
from abyssnav.simulate import simulate, stated_settings, to_log
from abyssnav.tables import CAUSES, Fixes, Reason

EVIDENCE = Evidence(50.0, 40.0)
#: Causes that no line of profile or settings mends: something is to be looked for, or be left.
NO_LINE = {
    "heading_constant", "beacon_moved", "sensor_lost", "geometry", "noise", "no_acoustics",
}  # fmt: skip
#: Words that are ours, not a surveyor's.
DIALECT = re.compile(
    r"\b(gate|inert|starving|captured|prior|posterior|nats|likelihood|sigma|innovation|"
    r"hypothes[ie]s|mixture|node|row|residual)\b"
)


@pytest.fixture(scope="module")
def case() -> Case:
    """A dive, and the settings that it was read by."""
    return dive_of("sound_voyage_1")


def dive_of(fault: str) -> Case:
    simulation = simulate(scenario_with(FAULTS[fault]), 1003)
    log, config = to_log(simulation), stated_settings(simulation)
    roles = FAULTS[fault].change(dict(log.roles))
    return Case(align(replace(log, roles=roles), config), config)


def by_reading(case: Case, size: complex) -> list[Cause]:
    """Causes of every reading of compass and DVL."""
    value = {name: np.full(14 if name == "slow_current" else 7, 0.5) for name in SOUND}
    value |= {
        "scale": np.array([size.real - 1]), "turn": np.array([size.imag]),
        "current": np.array([0.2, 0.1]), "lever": np.array([4.0, 1.0]),
        "clock": np.array([5.0]), "compass_clock": np.array([2.0]),
        "deviation_1": np.array([0.2, 0.1]),
    }  # fmt: skip
    as_given = Scored(READINGS[0], 0.0, value, (0.0, 1.0))
    causes = [
        motion_cause(case, [Scored(reading, 50.0, value, (0.0, 1.0)), as_given])
        for reading in READINGS[1:]
    ]
    return [cause for cause in causes if cause is not None]


def by_assumption(case: Case) -> list[Cause]:
    """Causes of every reading of the travel times."""
    fixes = Fixes(*[np.zeros(0)] * 9)
    assumptions = [
        ("time_one_way", "one-way times"), ("turn_around_removed", "turn-around taken off"),
        ("time_unit", "ms"), ("sound_speed", "+2.0 %"), ("turn_around", "+20 ms"),
        ("depth", "positive up"), ("depth", "feet"), ("depth", "-30 m"),
        ("beacon_ids", "1 is 2, 2 is 1"), ("beacon_moved", "2"),
    ]  # fmt: skip
    order = tuple(np.roll(np.arange(len(case.dive.beacons)), 1).tolist())
    given = ScoredAssumption(Assumption("", "as given", lambda r: r), 0.0, fixes, 0.1)
    causes = [
        acoustic_cause(
            case,
            [
                ScoredAssumption(
                    Assumption(name, value, lambda r: r, beacon=1, order=order), 50.0, fixes, 0.9
                ),
                given,
            ],
        )
        for name, value in assumptions
    ]
    return [cause for cause in causes if cause is not None]


def every_reason(case: Case) -> list[Reason]:
    """One reason or more of each cause, as a verdict would have it."""
    dive = case.dive
    moved_m = np.zeros((len(dive.beacons), 3))
    moved_m[1] = 4.0, -3.0, 0.0
    causes = [
        *by_reading(case, 1 + 0.3j), *by_reading(case, 0.5144 + 0j), *by_reading(case, 1.15 + 0j),
        *by_assumption(case),
        zeros_for_lost_lock(dive_of("zeros").dive).cause,
        compass_stands_still(dive_of("heading_constant").dive),
        turned_cause(dive_of("dvl_mount"), 45.0, EVIDENCE),
        motion_cause_of_reversed(),
        lever_arm_cause(case, np.array([5.0, 0.0]), EVIDENCE),
        common_wait_cause(dive, 0.005, EVIDENCE),
        one_wait_cause(dive, 1, 0.004, EVIDENCE),
        displaced_cause(dive, 1, moved_m[1], EVIDENCE),
        several_moved_cause(dive, moved_m, EVIDENCE),
        apart_cause(Apart(0.0, (0.0, 1.0), (3600.0, 3601.0), 3600.0), 3600.0), zone_cause(-900.0),
    ]  # fmt: skip
    assert all(causes)
    return [
        *(cause.reason() for cause in causes if cause is not None),
        reasons.sensor_lost(Loss("depth", 600.0, 0.4, True, 900.0)),
        reasons.sensor_lost(Loss("compass", 600.0, 1.0, False, 3600.0)),
        reasons.no_track(dive, 2), reasons.no_track(dive, 4), reasons.mirrored(dive, 2),
        reasons.unsupported(0.3), reasons.weak_geometry(12.0, 0.6),
        reasons.without_dead_reckoning("the compass"),
    ]  # fmt: skip


def motion_cause_of_reversed() -> Cause | None:
    case = dive_of("dvl_sign")
    value = {name: np.zeros(1) for name in SOUND} | {"scale": np.array([-2.0])}
    readings = [r for r in READINGS if r.name in ("turn", "")]
    return motion_cause(case, [Scored(r, 50.0, value, (0.0, 1.0)) for r in readings[::-1]])


@pytest.fixture(scope="module")
def spoken(case: Case) -> list[Reason]:
    """All reasons."""
    return every_reason(case)


def test_every_cause_of_the_contract_has_words(spoken: list[Reason]) -> None:
    # The compass's constant error and the declination look the same: the first names both.
    assert {reason.name for reason in spoken} == set(CAUSES) - {"declination"}
    assert set(MEANING) <= set(CAUSES)


def test_a_reason_is_three_sentences_with_numbers_and_no_dialect(spoken: list[Reason]) -> None:
    for reason in spoken:
        for text in (reason.cause, reason.seen, reason.advice):
            assert text[0].isupper() or text[0].isdigit(), reason
            assert text.endswith("."), reason
            assert not DIALECT.search(re.sub(r"\w+_\w+", "", text)), reason


def line_of(advice: str) -> str:
    """The line of TOML in an advice: what stands between `Put` and where it goes."""
    found = re.match(
        r"Put (.+?)(?: in the settings|, with| \(| under| for beacon| in the f)", advice
    )
    assert found, advice
    return found.group(1)


def test_the_advice_has_a_line_that_parses_where_one_mends_it(spoken: list[Reason]) -> None:
    with_line = {reason.name for reason in spoken if reason.advice.startswith("Put ")}
    assert with_line | NO_LINE >= {reason.name for reason in spoken}
    for reason in spoken:
        if reason.advice.startswith("Put "):
            assert tomllib.loads(line_of(reason.advice)), reason


def test_beacons_and_sound_speed_are_written_out_as_settings_that_mend_the_dive(
    case: Case, tmp_path: Path
) -> None:
    """The line of the advice, put into a file, is read as settings."""
    for cause in by_assumption(case):
        if cause.name in ("beacon_ids", "turn_around", "sound_speed"):
            path = tmp_path / f"{cause.name}.toml"
            path.write_text(cause.mend.line, encoding="utf-8")
            config = settings_from_toml(path.read_text("utf-8"), path.name, Config)
            assert config.beacon or config.sound_speed_profile
            if cause.name == "beacon_ids":
                assert [b.id for b in config.beacon] == case.dive.beacons.id.tolist()
                swapped_m = np.roll(case.dive.beacons.position_enu_m, 1, axis=0)
                for beacon, place_m in zip(config.beacon, swapped_m, strict=True):
                    np.testing.assert_allclose(beacon.position_m, place_m, atol=0.06)


def test_the_line_for_the_clock_of_the_replies_is_read_as_settings_that_move_pings_too() -> None:
    # latency_s of the profile moves the replies only, which then come before their pings.
    mend = zone_cause(-900.0).mend
    assert "[calibration] of the settings" in mend.where
    config = settings_from_toml(f"[calibration]\n{mend.line}", "line", Config)
    assert config.calibration.latency_s.travel_time == 900.0


def test_what_is_suspected_names_the_beacons_among_which_it_is() -> None:
    words = doubt_words(Suspicion("beacon_moved", (3, 1), 0.9, 2.0, ("turn_around",)))
    assert "one of beacons 3 and 1" in words
    assert "turn-around" in words


@pytest.mark.parametrize(("offset_s", "word"), [(-900.0, "late"), (900.0, "early")])
def test_stamps_that_come_late_are_called_late(offset_s: float, word: str) -> None:
    assert f"15 min {word}, are put right" in zone_cause(offset_s).seen
    apart = Apart(0.0, (0.0, 1.0), (3600.0, 3601.0), offset_s)
    further = {"late": "later", "early": "earlier"}[word]
    assert f"15 min {further}." in apart_cause(apart, offset_s).seen
