# SPDX-License-Identifier: Apache-2.0
"""The verdict of a dive, and where it appears."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pandas as pd
import pytest
from verdicts import FAULTS, Fault, judge, scenario_with, stated_settings

from abyssnav.align import align
from abyssnav.config import Calibration, Config, Latency, Output
from abyssnav.diagnose.clocks import replies_beyond
from abyssnav.diagnose.evidence import misfit, stretches
from abyssnav.diagnose.verdict import contradicted, with_verdict
from abyssnav.formats.mcap.writer import Channel, ros2_channel
from abyssnav.navigate import navigate
from abyssnav.profile import load_profile
from abyssnav.read import read
from abyssnav.run import Result, Setup, run_dive
from abyssnav.simulate import Simulation, load_scenario, simulate, to_log, write_log
from abyssnav.tables import CAUSES, Int, Log


@pytest.fixture(scope="module")
def short_dive() -> Simulation:
    """Twenty minutes of good acoustics."""
    return simulate(msgspec.structs.replace(load_scenario("clean"), duration_s=1200.0))


@pytest.mark.parametrize(
    ("fault", "levels"),
    [
        ("sound_foreign", ("good",)),
        ("heading_constant", ("unusable",)),
        ("heading_radians", ("unusable",)),
        ("dvl_mount", ("check",)),
        ("velocity_lost", ("check",)),
        ("two_beacons", ("check",)),
        ("geometry", ("check",)),
        ("beacon_5m", ("check",)),
        ("beacon_30m", ("check",)),  # the smoother has it estimated: its track is good
        ("times_noisy", ("check",)),
        ("depth_sign", ("unusable",)),
    ],
)
def test_a_dive_with_one_fault_is_judged_and_its_cause_named_first(
    fault: str, levels: tuple[str, ...]
) -> None:
    judged = judge(fault, 1004)
    assert judged.level in levels
    assert judged.named, judged.causes
    assert not judged.lie


@pytest.mark.parametrize(
    ("fault", "seed"),
    [
        ("dvl_millimetres", 5360),  # equations of seventeen decades, in numbers of sixteen
        ("beacon_30m", 5366),  # the fixes look like those of a compass that turns the other way
        ("clock_8s", 5400),
        ("sound_voyage_2", 5425),  # three fixes of wrong replies in a stretch of eighteen good ones
        ("clock_30s_on_a_circle", 5440),  # a compass 4 degrees off fits as well
    ],
)
def test_dives_whose_fault_was_once_missed(
    monkeypatch: pytest.MonkeyPatch, fault: str, seed: int
) -> None:
    circle = {**FAULTS["clock_30s"].keys, "vehicle.pattern": "circle"}
    late = Fault(("clock_offset",), circle, scenario="nominal")
    monkeypatch.setitem(FAULTS, "clock_30s_on_a_circle", late)
    judged = judge(fault, seed)
    assert judged.named, judged.causes
    assert not judged.lie


def test_beside_a_beacon_that_the_track_leaves_out_only_what_the_others_say_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    both = {"beacons.one_moved_m": 30.0, "compass.bias_deg": 10.0}
    monkeypatch.setitem(FAULTS, "both", Fault((), both, scenario="nominal"))
    # Fixes and ranges made with its replies too would have a late turn-around, or a current.
    assert judge("both", 5).causes == ("beacon_moved", "heading_offset")


def with_late_replies(dive: Simulation, late_s: float) -> Simulation:
    replies = replace(dive.replies, t_ping_s=dive.replies.t_ping_s + late_s)
    return replace(dive, replies=replies)


def test_a_sound_dive_is_good_and_keeps_its_radius(result: Result) -> None:
    summary = json.loads((result.folder / "summary.json").read_text("utf-8"))
    assert summary["verdict"] == {"level": "good", "reasons": []}
    assert np.isfinite(pd.read_parquet(result.folder / "accuracy.parquet").uncertainty_95_m).all()


def test_fixes_say_no_more_against_a_track_than_the_places_of_the_beacons_let_them(
    result: Result,
) -> None:
    solution = result.solution
    dive, track = solution.dive, solution.tracks["smoother"]
    rows = misfit(dive, track)
    fixes = replace(
        solution.fixes, position_enu_m=solution.fixes.position_enu_m + np.array([10.0, 10.0, 0.0])
    )
    surveyed_to_5m = replace(dive.beacons, sigma_m=np.full(len(dive.beacons), 5.0))
    doubted = stretches(dive, track, fixes, rows, Config())
    believed = stretches(replace(dive, beacons=surveyed_to_5m), track, fixes, rows, Config())
    assert contradicted(doubted).mean() > 0.9
    assert not contradicted(believed).any()
    # Both parts of a fix's covariance have one geometry: σ_b goes in as ½ c σ does.
    time_m = 0.5 * dive.sound_speed.sound_speed_mps.mean() * 0.002
    ratio = np.hypot(time_m, 5.0) / np.hypot(time_m, dive.beacons.sigma_m[0])
    assert believed.fix_scatter_m == pytest.approx(ratio * doubted.fix_scatter_m, nan_ok=True)
    # One more, that never answers and of which hardly the place is known, says nothing of fixes.
    more = dive.beacons[[*range(len(dive.beacons)), 0]]
    more = replace(more, sigma_m=np.append(dive.beacons.sigma_m, 100.0))
    believed = stretches(replace(dive, beacons=more), track, fixes, rows, Config())
    assert believed.fix_scatter_m == pytest.approx(doubted.fix_scatter_m, nan_ok=True)


def test_replies_of_another_time_zone_are_named_and_leave_no_radius(
    abyssnav: Callable[..., Any], short_dive: Simulation, tmp_path: Path
) -> None:
    write_log(with_late_replies(short_dive, 3600.0), tmp_path / "late.mcap")
    ended = abyssnav("run", tmp_path / "late.mcap", "-o", tmp_path)
    summary = json.loads((tmp_path / "late" / "summary.json").read_text("utf-8"))
    verdict = summary["verdict"]
    assert ended.status == 3
    assert verdict["level"] == "unusable"
    assert verdict["reasons"][0]["name"] == "no_overlap"
    assert "60 min later" in verdict["reasons"][0]["seen"]
    assert all(r["advice"].startswith("Mend the first reason") for r in verdict["reasons"][1:])
    assert {reason["name"] for reason in verdict["reasons"]} <= set(CAUSES)
    assert pd.read_parquet(tmp_path / "late" / "accuracy.parquet").uncertainty_95_m.isna().all()


@pytest.mark.parametrize("hours", [-1.0, 1.0])
def test_replies_of_one_ping_stamped_an_hour_off_do_not_stretch_the_dive(
    short_dive: Simulation, hours: float
) -> None:
    t_ping_s = short_dive.replies.t_ping_s
    wrong = t_ping_s == t_ping_s[len(t_ping_s) // 2]
    assert 1 < wrong.sum() <= 4
    moved_s = t_ping_s + 3600.0 * hours * wrong
    moved = replace(short_dive, replies=replace(short_dive.replies, t_ping_s=moved_s))
    dive = align(to_log(moved), Config())
    assert len(dive.replies) == len(t_ping_s) - wrong.sum()
    assert 0 < dive.replies.t_ping_s.min() < dive.replies.t_reply_s.max() < 1210


def read_logged_at(log_ns_by_topic: Callable[[str, Int], Int], dive: Simulation, path: Path) -> Log:
    """The dive as read from a log whose recorder's times are what a topic's true instants give."""

    def channel(topic: str, kind: str, true_ns: Int, columns: dict[str, Any]) -> Channel:
        return ros2_channel(topic, kind, log_ns_by_topic(topic, true_ns), columns)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("abyssnav.simulate.record.ros2_channel", channel)
        write_log(dive, path)
    return read([path], load_profile())


def ahead_of_recorder(log: Log, config: Config) -> list[float]:
    checks = align(log, config).checks
    return [check.value for check in checks if check.name == "replies_ahead_of_recorder"]


def in_blocks(topic: str, true_ns: Int) -> Int:
    """All but acoustics is written in blocks of ten seconds, at the end of each."""
    block_ns = 10_000_000_000
    return true_ns if topic.startswith("/lbl") else (true_ns // block_ns + 1) * block_ns


@pytest.mark.parametrize(
    "log_ns",
    [
        pytest.param(in_blocks, id="sensors in blocks"),
        pytest.param(lambda t, ns: ns + (t[1:4] != "lbl") * 4_000_000_000, id="sensors held back"),
        pytest.param(lambda t, ns: ns + (t[1:4] == "lbl") * 30_000_000_000, id="replies held back"),
        pytest.param(lambda _, ns: ns - 100_000_000_000, id="recorder's clock behind"),
        pytest.param(lambda _, ns: 0 * ns + 1_900_000_000_000_000_000, id="converted later"),
        pytest.param(lambda _, ns: 0 * ns, id="no log time"),
    ],
)
def test_no_way_of_recording_makes_replies_of_the_same_clock_come_ahead(
    short_dive: Simulation, tmp_path: Path, log_ns: Callable[[str, Int], Int]
) -> None:
    t_s = short_dive.replies.t_ping_s
    late_half = replace(short_dive, replies=short_dive.replies[t_s > np.median(t_s)])
    assert not ahead_of_recorder(read_logged_at(log_ns, late_half, tmp_path / "log.mcap"), Config())


def test_replies_that_the_recorder_had_before_their_pings_are_of_another_clock(
    short_dive: Simulation, tmp_path: Path
) -> None:
    def true_ns(topic: str, stamp_ns: Int) -> Int:
        return stamp_ns - (topic == "/lbl/travel_time") * 8_000_000_000

    path = tmp_path / "late.mcap"
    log = read_logged_at(true_ns, with_late_replies(short_dive, 8.0), path)
    assert ahead_of_recorder(log, Config()) == [pytest.approx(8.0)]
    mended = Config(calibration=Calibration(latency_s=Latency(travel_time=8.0)))
    assert not ahead_of_recorder(log, mended)

    setup = Setup(Config(output=Output(methods=("smoother",))), load_profile())
    verdict = run_dive([path], setup, tmp_path).solution.verdict
    assert verdict.level != "good"
    assert verdict.reasons[0].name == "clock_offset"
    assert "8.0 s later" in verdict.reasons[0].seen
    assert "latency_s.travel_time = 8.0" in verdict.reasons[0].advice


def test_how_late_replies_are_is_what_fixes_say_not_how_far_they_run_past_the_sensors() -> None:
    dive = simulate(scenario_with(FAULTS["clock_30s"]), 5706)
    config = stated_settings(dive)
    solution = navigate(align(to_log(dive), config), config)
    beyond = replies_beyond(solution.dive)
    assert beyond is not None
    assert beyond.late_s < 20.0
    reason = with_verdict(solution, config).verdict.reasons[0]
    assert reason.name == "clock_offset"
    line = re.search(r"latency_s\.travel_time = ([\d.]+)", reason.advice)
    assert line is not None
    assert float(line[1]) == pytest.approx(30.0, abs=2.0)


def test_a_batch_with_an_unusable_dive_ends_3_and_its_table_says_why(
    abyssnav: Callable[..., Any], short_dive: Simulation, tmp_path: Path
) -> None:
    logs, out = tmp_path / "logs", tmp_path / "out"
    logs.mkdir()
    write_log(short_dive, logs / "a.mcap")
    write_log(with_late_replies(short_dive, 900.0), logs / "b.mcap")
    assert abyssnav("batch", logs, "-o", out, "-j", 1).status == 3
    table = pd.read_parquet(out / "dives.parquet").set_index("dive")
    assert table.verdict.to_dict() == {"a": "good", "b": "unusable"}
    assert table.cause.to_dict() == {"a": "", "b": "no_overlap"}
    assert np.isfinite(table.uncertainty_95_m["a"])
    assert np.isnan(table.uncertainty_95_m["b"])
    assert set(pd.read_parquet(out / "comparison.parquet").dives) == {1}
    assert abyssnav("batch", logs, "-o", out, "-j", 1).status == 3  # those of before count too
    (logs / "c.mcap").write_bytes(b"")
    assert abyssnav("batch", logs, "-o", out, "-j", 1).status == 1
