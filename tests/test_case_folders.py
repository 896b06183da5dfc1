# SPDX-License-Identifier: Apache-2.0
"""Logs of real layouts, rough ones and foreign dives: the right answer, or its cause is named.

The logs are no part of the project: `ABYSSNAV_CASES` names the folder that holds them.  The same
layouts and faults, made by the tests themselves, are in test_cases, test_vehicles and test_verdict.
"""

import os
from pathlib import Path
from typing import NamedTuple

import pytest
from test_cases import error_m

from abyssnav.align import align, reference
from abyssnav.config import Config, load_config
from abyssnav.diagnose import with_verdict
from abyssnav.navigate import navigate
from abyssnav.profile import load_profile, profile_from_toml
from abyssnav.read import inspect, read
from abyssnav.tables import Solution

FOLDER = Path(os.environ.get("ABYSSNAV_CASES", ""))
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not os.environ.get("ABYSSNAV_CASES"), reason="ABYSSNAV_CASES is not set"),
]


class Right(NamedTuple):
    """The right answer for a log."""

    level: str
    cause: str = ""  #: of the first reason
    most_m: float = 0.6  #: error of the smoothed track; inf: it may be anything


ANY = float("inf")
#: Logs that share another one's settings.
SETTINGS_OF = {"ros1": "json_mavlink.settings.toml"}
CASES = {
    "base": Right("good"),
    "dvl_covariance_minus1": Right("good"),
    "dvl_increments": Right("good"),
    "dvl_pd6_frames": Right("good"),
    "dvl_turned_45": Right("check", "dvl_mount"),
    "imu_identity": Right("unusable", "heading_constant", ANY),
    "json_mavlink": Right("good"),
    "one_way_four_slots": Right("good"),
    "slant_range_m": Right("good"),
    "topic_a_beacon": Right("good"),
    "ros1": Right("good"),
    "own_messages": Right("good", most_m=ANY),  # another dive than the others'
    "two_of_four_reply": Right("unusable", "too_few_beacons", ANY),
    "rough/sound": Right("good"),
    "rough/replies_x3": Right("good"),
    "rough/reference_1e200": Right("good", most_m=ANY),
    "rough/depth_one_1e77": Right("good"),
    "rough/beacon_sigma_inf": Right("good"),
    "rough/velocity_ends_at_quarter": Right("check", "sensor_lost"),
    "rough/depth_ends_at_tenth": Right("check", "sensor_lost"),
    "rough/depth_1h_late": Right("check", "sensor_lost"),
    "rough/replies_15min_late": Right("unusable", "no_overlap", ANY),
    "rough/replies_1h_late": Right("unusable", "no_overlap", ANY),
    "foreign/voyage_2_like": Right("good", most_m=1.0),
    "foreign/no_profile": Right("good", most_m=1.0),
    "foreign/beacons_3m_told_3m": Right("good", most_m=3.0),
    "foreign/beacons_3m_told_0_eight": Right("check", "beacon_moved", 2.0),
    "foreign/lever_arm_5m_untold": Right("check", "lever_arm", 1.0),
    "foreign/turn_arounds_5ms_common_off_centre": Right("check", "turn_around", 2.0),
    "foreign/water_track_15min": Right("check", "water_track", 1.5),
    "foreign/heading_drift_5deg_600s": Right("check", "noise", 1.5),
    "foreign/deviation_4deg": Right("check", "noise", 1.5),
    "foreign/dvl_slow_2cms_120s": Right("check", "noise", 1.5),
}


def judged(path: Path) -> tuple[Solution, float]:
    """The solution of a log with the profile that fits or is proposed, and its error."""
    named = FOLDER / SETTINGS_OF.get(path.stem, f"{path.stem}.settings.toml")
    settings = (named, path.with_suffix(".toml"))
    config: Config = load_config(next((p for p in settings if p.exists()), None))
    inspection = inspect([path], load_profile(), config)
    profile = load_profile()
    if not inspection.profile_fits:
        profile = profile_from_toml(inspection.proposal, "proposal")
    log = read([path], profile)
    solution = with_verdict(navigate(align(log, config), config), config)
    truth = reference(log)
    if truth is None:  # the dive of the default layout, written otherwise
        truth = reference(read([FOLDER / "base.mcap"], load_profile()))
    smoothed = "smoother" in solution.tracks
    return solution, error_m(solution, truth) if smoothed else ANY


@pytest.mark.parametrize("name", CASES)
def test_a_case_has_its_right_answer_or_its_cause_is_named(name: str) -> None:
    solution, error = judged(FOLDER / f"{name}.mcap")
    level, cause, most_m = CASES[name]
    assert solution.verdict.level == level
    assert [reason.name for reason in solution.verdict.reasons][:1] == ([cause] if cause else [])
    assert error <= most_m
