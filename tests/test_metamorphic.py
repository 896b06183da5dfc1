# SPDX-License-Identifier: Apache-2.0
"""What must change nothing of a dive changes nothing: order, cuts, clocks, places, names.

The whole of read, align and navigate, before and after; `make fuzz` tries many more.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from vehicles import ros_roles

from abyssnav.align import align
from abyssnav.config import BeaconSetting, Config, OriginSetting
from abyssnav.formats.mcap.writer import Channel, write_mcap
from abyssnav.geometry import enu_to_geodetic, interpolate
from abyssnav.navigate import navigate
from abyssnav.profile import load_profile
from abyssnav.read import inspect, read
from abyssnav.simulate import load_scenario, simulate, to_log
from abyssnav.tables import DECISIONS, Log, Solution

#: The same dive at another place on earth or under another clock.
MILLIMETRE = 1e-3
METHODS = ("ekf", "smoother", "ekf_gated", "kf_fix", "dead_reckoning")
fuzz = settings(
    max_examples=max(2, int(os.environ.get("ABYSSNAV_FUZZ", "0")) // 50),
    deadline=None,
    derandomize="ABYSSNAV_FUZZ" not in os.environ,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


class Dived(NamedTuple):
    """A dive in bad acoustics, and what is made of it."""

    log: Log
    solution: Solution

    def __repr__(self) -> str:  # Hypothesis shows what failed
        return "the dive"


@pytest.fixture(scope="module")
def dived() -> Dived:
    scenario = msgspec.structs.replace(load_scenario("voyage_2"), duration_s=900.0)
    log = to_log(simulate(scenario))
    return Dived(log, navigated(log))


def navigated(log: Log, config: Config | None = None) -> Solution:
    config = config or Config()
    return navigate(align(log, config), config)


def with_columns(log: Log, role: str, **columns: Any) -> Log:
    return replace(log, roles={**log.roles, role: {**log.roles[role], **columns}})


def same_to_the_bit(one: Solution, other: Solution) -> None:
    assert one.tracks.keys() == other.tracks.keys()
    for method, track in one.tracks.items():
        for name, column in track.columns().items():
            np.testing.assert_array_equal(column, other.tracks[method].columns()[name])
    for method, innovations in one.innovations.items():
        np.testing.assert_array_equal(innovations.decision, other.innovations[method].decision)


def same_within(
    one: Solution, other: Solution, limit_m: float, turn: complex = 1, alike: float = 1e-6
) -> None:
    """Assert that tracks are the same, of `other` turned back by a complex factor."""
    for method in METHODS:
        track, second = one.tracks[method], other.tracks[method]
        place_m = second.position_enu_m[:, :2] @ [1, 1j] / turn
        apart_m = np.abs(place_m - track.position_enu_m[:, :2] @ [1, 1j])
        np.testing.assert_array_less(apart_m, limit_m, err_msg=method)
        radius_m = [np.sqrt(np.linalg.eigvalsh(t.position_cov_m2)) for t in (track, second)]
        np.testing.assert_allclose(*radius_m, rtol=alike, err_msg=method)
    for method, innovations in one.innovations.items():
        np.testing.assert_array_equal(innovations.decision, other.innovations[method].decision)


# --- of the file --------------------------------------------------------------------------------


@fuzz
@given(seed=st.integers(0, 1 << 32))
def test_the_order_of_messages_in_the_file_changes_nothing(
    dived: Dived, tmp_path: Path, seed: int
) -> None:
    """They are recorded by a shuffled log time, and sorted by their own stamps."""
    generator = np.random.default_rng(seed)
    channels = [
        replace(channel, log_time_ns=generator.permutation(channel.log_time_ns))
        for channel in ros_roles(dived.log).values()
    ]
    write_mcap(tmp_path / "straight.mcap", list(ros_roles(dived.log).values()))
    write_mcap(tmp_path / "shuffled.mcap", channels)
    logs = [read([tmp_path / f"{name}.mcap"], load_profile()) for name in ("straight", "shuffled")]
    same_to_the_bit(*(navigated(log) for log in logs))


@fuzz
@given(st.lists(st.floats(0, 1), min_size=1, max_size=4))
def test_a_recording_cut_into_files_anywhere_is_the_same_dive(
    dived: Dived, tmp_path: Path, cuts: list[float]
) -> None:
    channels = list(ros_roles(dived.log).values())
    first_ns = min(int(channel.log_time_ns[0]) for channel in channels)
    last_ns = max(int(channel.log_time_ns[-1]) for channel in channels)
    edges = sorted({first_ns + int(cut * (last_ns - first_ns)) for cut in cuts})
    parts = [*zip([0, *edges], [*edges, last_ns + 1], strict=True)]
    files = [write_part(tmp_path / f"part_{k}.mcap", channels, *p) for k, p in enumerate(parts)]
    write_mcap(tmp_path / "whole.mcap", channels)
    whole = navigated(read([tmp_path / "whole.mcap"], load_profile()))
    same_to_the_bit(navigated(read([file for file in files if file], load_profile())), whole)


def test_a_stretch_that_was_recorded_twice_changes_no_track_and_is_told(
    dived: Dived, tmp_path: Path
) -> None:
    channels = []
    for channel in ros_roles(dived.log).values():
        rows = np.arange(len(channel.log_time_ns))
        rows = np.sort(np.r_[rows, rows[len(rows) // 3 : len(rows) // 2]])
        again = {"log_time_ns": channel.log_time_ns[rows], "payloads": channel.payloads[rows]}
        channels.append(replace(channel, **again))
    files = [tmp_path / "twice.mcap"]
    write_mcap(files[0], channels)
    twice = navigated(read(files, load_profile()))
    for method in METHODS:
        one, other = (run.tracks[method].position_enu_m for run in (twice, dived.solution))
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)
    decisions = twice.innovations["smoother"].decision
    assert (decisions == DECISIONS.index("duplicate")).sum() > 20
    told = {check.name for check in twice.dive.checks if not check.ok}
    found = inspect(files, load_profile()).findings
    assert told >= {f"{role}_repeated_stamps" for role in ("heading", "velocity", "depth")}
    repeats = [finding.where for finding in found if finding.what == "clock: stamps repeat"]
    assert sorted(repeats) == ["/depth", "/dvl", "/imu"]


def write_part(path: Path, channels: Sequence[Channel], begin_ns: int, end_ns: int) -> Path | None:
    """What was recorded between two instants; None where that is nothing."""
    parts = []
    for channel in channels:
        inside = (channel.log_time_ns >= begin_ns) & (channel.log_time_ns < end_ns)
        if inside.any():
            rows = channel.payloads[slice(*np.flatnonzero(inside)[[0, -1]] + [0, 1])]
            parts.append(replace(channel, log_time_ns=channel.log_time_ns[inside], payloads=rows))
    if parts:
        write_mcap(path, parts)
    return path if parts else None


# --- of its clock and its place -----------------------------------------------------------------


@fuzz
@given(shift_ns=st.integers(-(10**16), 10**16))
def test_another_hour_of_another_day_moves_no_estimate(dived: Dived, shift_ns: int) -> None:
    """Tracks stand on whole seconds of UTC, so those of shifted dives are compared in between."""
    shifted = dived.log
    for role, columns in shifted.roles.items():
        stamps = [name for name in columns if name in {"time_ns", "ping_time_ns"}]
        later = {name: columns[name] + shift_ns for name in stamps}
        shifted = with_columns(shifted, role, **later)
    solution = navigated(shifted)
    assert solution.dive.start_ns - dived.solution.dive.start_ns == shift_ns
    for method, innovations in dived.solution.innovations.items():
        other = solution.innovations[method]
        np.testing.assert_array_equal(other.decision, innovations.decision)
        np.testing.assert_array_equal(other.innovation_s, innovations.innovation_s)
    whole = shift_ns // 10**9 * 10**9
    if whole == shift_ns:
        same_to_the_bit(solution, dived.solution)
    for method in ("ekf", "smoother"):
        track, moved = dived.solution.tracks[method], solution.tracks[method]
        t_s = moved.t_s[5:-5]
        expected_m = interpolate(t_s, track.t_s, track.position_enu_m[:, :2])
        between_m = np.abs(moved.position_enu_m[5:-5, :2] - expected_m)
        assert np.median(between_m) < 0.05


@fuzz
@given(east_m=st.floats(-9e5, 9e5), north_m=st.floats(-9e6, 9e6))
def test_beacons_of_any_grid_give_the_same_dive_to_a_millimetre(
    dived: Dived, east_m: float, north_m: float
) -> None:
    """UTM's eastings and northings are millions of metres; float64 has 10⁻⁹ of them."""
    moved_m = np.array([east_m, north_m, 0.0])
    log = dived.log
    for role in ("beacons", "reference"):
        place_m = log.roles[role]["position_enu_m"]
        log = with_columns(log, role, position_enu_m=place_m + moved_m)
    solution = navigated(log)
    back = {
        method: replace(track, position_enu_m=track.position_enu_m - moved_m)
        for method, track in solution.tracks.items()
    }
    same_within(dived.solution, replace(solution, tracks=back), MILLIMETRE)


@fuzz
@given(turn_rad=st.floats(0, 6.3))
def test_beacons_and_compass_turned_together_turn_the_dive(dived: Dived, turn_rad: float) -> None:
    turn = np.exp(1j * turn_rad)
    log = dived.log
    for role in ("beacons", "reference"):
        place_m = log.roles[role]["position_enu_m"]
        turned = (place_m[:, :2] @ [1, 1j]) * turn
        place_m = np.column_stack([turned.real, turned.imag, place_m[:, 2]])
        log = with_columns(log, role, position_enu_m=place_m)
    heading_rad = (log.roles["heading"]["heading_rad"] - turn_rad) % (2 * np.pi)
    solution = navigated(with_columns(log, "heading", heading_rad=heading_rad))
    same_within(dived.solution, solution, MILLIMETRE, turn)


@fuzz
@given(order=st.permutations(range(4)), numbers=st.lists(
    st.integers(0, 65_535), min_size=4, max_size=4, unique=True))  # fmt: skip
def test_other_numbers_and_names_of_the_beacons_change_nothing(
    dived: Dived, order: list[int], numbers: list[int]
) -> None:
    beacons, replies = dived.log.roles["beacons"], dived.log.roles["travel_time"]
    assert len(beacons["id"]) == len(order)
    number = dict(zip(beacons["id"].tolist(), numbers, strict=True))
    listed = {name: column[list(order)] for name, column in beacons.items()}
    listed["id"] = np.array([number[i] for i in listed["id"].tolist()])
    listed["name"] = np.array([f"T{k}" for k in range(4)])
    log = with_columns(dived.log, "beacons", **listed)
    asked = np.array([number[i] for i in replies["beacon_id"].tolist()])
    same_within(
        dived.solution, navigated(with_columns(log, "travel_time", beacon_id=asked)), MILLIMETRE
    )


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg"),
    [(70.0, 20.0), (0.0, 179.9999), (-45.0, -180.0), (70.0, 180.0), (89.0, 0.0)],
)
def test_the_same_dive_anywhere_on_earth_is_the_same_to_a_millimetre(
    dived: Dived, latitude_deg: float, longitude_deg: float
) -> None:
    """Beacons by latitude and longitude, as far north as boats go, and across the date line."""
    beacons = dived.log.roles["beacons"]
    # What is measured of a beacon's height is its depth: that of a place, below the tangent's.
    place_m = beacons["position_enu_m"]
    level = [enu_to_geodetic(latitude_deg, longitude_deg, m) for m in place_m]
    origin = OriginSetting(latitude_deg, longitude_deg)
    given_places = tuple(
        BeaconSetting(
            id=int(number),
            latitude_deg=float(latitude),
            longitude_deg=float((longitude + 180) % 360 - 180),
            depth_m=float(-up_m),
            turn_around_s=float(turn_around_s),
        )
        for number, (latitude, longitude, _), up_m, turn_around_s in zip(
            beacons["id"], level, place_m[:, 2], beacons["turn_around_s"], strict=True
        )
    )
    plain_places = tuple(
        BeaconSetting(
            id=int(number), position_m=tuple(m.tolist()), turn_around_s=float(turn_around_s)
        )
        for number, m, turn_around_s in zip(
            beacons["id"], place_m, beacons["turn_around_s"], strict=True
        )
    )
    one = navigated(dived.log, Config(beacon=plain_places, origin=origin))
    other = navigated(dived.log, Config(beacon=given_places, origin=origin))
    np.testing.assert_allclose(
        one.dive.beacons.position_enu_m, other.dive.beacons.position_enu_m, atol=2e-3
    )
    same_within(one, other, MILLIMETRE, alike=1e-5)
