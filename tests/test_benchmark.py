# SPDX-License-Identifier: Apache-2.0
"""The open benchmark: the same dives anywhere, their truth beside them, tables of anybody's."""

import json
from dataclasses import replace

import msgspec
import numpy as np
import pandas as pd
import pytest

from abyssnav.config import load_config
from abyssnav.errors import ConfigError
from abyssnav.profile import load_profile
from abyssnav.read import read
from abyssnav.simulate import SETS, benchmark_dives, bound, simulate, write_benchmark
from abyssnav.simulate.benchmark import load_benchmark

SHORT_S = 600.0


def shortened(dive):
    scenario = msgspec.structs.replace(dive.scenario, duration_s=SHORT_S)
    return replace(dive, scenario=scenario)


@pytest.fixture(scope="module")
def dives():
    every = benchmark_dives("benchmark", ["outliers_50", "usbl"])
    return [shortened(dive) for dive in every[::3]]


@pytest.fixture(scope="module")
def logs(dives, tmp_path_factory):
    folder = tmp_path_factory.mktemp("benchmark")
    write_benchmark(folder, dives)
    return folder


@pytest.fixture
def tracks(dives, tmp_path):
    """The truth, 3 m east and 4 m north of itself, and a gate that knows what it lets in."""
    for dive in dives:
        simulation = simulate(dive.scenario)
        motion = simulation.truth.motion[::10]
        frame = pd.DataFrame({"time": simulation.start_ns + np.round(motion.t_s * 1e9).astype(int)})
        frame["east_m"], frame["north_m"] = (motion.position_enu_m[:, :2] + [3.0, 4.0]).T
        frame.to_csv(tmp_path / f"{dive.name}.csv", index=False)
        replies = simulation.replies
        wrong = np.abs(replies.travel_time_s - replies.direct_s) > 0.010
        decisions = pd.DataFrame(
            {
                "ping_id": replies.ping_id,
                "beacon_id": simulation.beacons.id[replies.beacon],
                "travel_time_s": replies.travel_time_s,
                "accepted": ~wrong,
            }
        )
        decisions.to_csv(tmp_path / f"{dive.name}.decisions.csv", index=False)
    return tmp_path


def test_the_kinds_are_those_that_the_page_names():
    names = [kind.name for kind in load_benchmark().kind]
    assert len(names) == len(set(names)) == 15
    assert {"nominal", "voyage_1", "voyage_2", "outliers_50", "two_beacons", "gnss"} <= set(names)


def test_what_is_scored_shares_no_seed_with_what_may_be_tuned_on():
    seeds = load_benchmark().seeds
    assert not set(seeds.open) & set(seeds.scored)
    drawn = [{dive.name for dive in benchmark_dives(name)} for name in SETS]
    assert not drawn[0] & drawn[1]
    assert len(drawn[0]) == len(drawn[1]) == 45


def test_every_kind_is_a_scenario_that_can_be_drawn():
    for dive in benchmark_dives()[::3]:
        simulate(msgspec.structs.replace(dive.scenario, duration_s=2400.0))


def test_an_unknown_kind_is_named():
    with pytest.raises(ConfigError, match="no kind 'fog' in the benchmark; known: nominal"):
        benchmark_dives("benchmark", ["fog"])


def test_the_same_dive_is_made_again_to_the_byte(dives, logs, tmp_path):
    write_benchmark(tmp_path, dives[:1])
    for made in tmp_path.iterdir():
        assert made.read_bytes() == (logs / made.name).read_bytes()


def test_the_profile_beside_a_dive_with_fixes_reads_them(logs):
    profile = next(logs.glob("usbl_*.profile.toml"))
    log = read([profile.with_name(profile.name.replace(".profile.toml", ".mcap"))],
               load_profile(str(profile)))  # fmt: skip
    assert len(log.roles["position"]["time_ns"]) == SHORT_S / 60


def test_the_start_beside_a_dive_is_as_good_as_it_says(dives, logs):
    for dive in dives:
        start = load_config(logs / f"{dive.name}.start.toml").start
        simulation = simulate(dive.scenario)
        t_s = start.at.timestamp() - simulation.start_ns / 1e9
        off_m = simulation.position_at(np.array([t_s]))[0, :2] - start.position_m
        assert 0 < np.hypot(*off_m) < 4 * start.sigma_m


def test_a_gate_that_knows_the_truth_lets_in_nothing_and_throws_out_nothing(
    abyssnav, logs, tracks, dives
):
    dive = dives[0]
    ended = abyssnav(
        "score", logs / f"{dive.name}.mcap", tracks / f"{dive.name}.csv", "--json", "--from-s", 120
    )
    result = json.loads(ended.out)
    assert result["outliers_accepted"] == 0.0
    assert result["good_rejected"] == 0.0
    limit = bound(simulate(dive.scenario))
    assert result["rms_m"] == pytest.approx(5.0, abs=0.01)
    assert result["x_filter"] == pytest.approx(5.0 / limit.rms_m(120.0)[0], rel=0.02)
    assert result["x_smoother"] == pytest.approx(5.0 / limit.rms_m(120.0)[1], rel=0.02)


def test_a_gate_that_lets_all_in_is_seen_through(abyssnav, logs, tracks, dives):
    name = dives[0].name
    path = tracks / f"{name}.decisions.csv"
    pd.read_csv(path).assign(accepted=True).to_csv(path, index=False)
    ended = abyssnav("score", logs / f"{name}.mcap", tracks / f"{name}.csv")
    assert "100.0 % of the wrong replies let in, 0.0 % of the others thrown out" in ended.out


def test_a_folder_of_tracks_makes_a_table(abyssnav, logs, tracks, dives):
    (tracks / f"{dives[1].name}.csv").unlink()
    costs = pd.DataFrame({"dive": [dives[0].name], "seconds": [7.5], "memory_mb": [123.0]})
    costs.to_csv(tracks / "costs.csv", index=False)
    result = json.loads(abyssnav("score", logs, tracks, "--json").out)
    scored, missing = result["kinds"]
    assert (scored["kind"], scored["scored"], scored["seconds"]) == ("outliers_50", 1, 7.5)
    assert scored["rms_m"] == pytest.approx(5.0, abs=0.01)
    assert (missing["kind"], missing["scored"]) == ("usbl", 0)
    shown = abyssnav("score", logs, tracks)
    assert f"! {dives[1].name}: no track {dives[1].name}.csv" in shown.out
    assert "outliers_50" in shown.out


def test_folders_without_logs_or_tracks_are_refused(abyssnav, logs, tmp_path):
    assert "no log (*.mcap)" in abyssnav("score", tmp_path, tmp_path).err
    assert "no track of any dive" in abyssnav("score", logs, tmp_path).err
    assert "against a folder of tracks" in abyssnav("score", logs, tmp_path / "none").err


def test_decisions_that_are_no_table_of_decisions_are_refused(abyssnav, logs, tracks, dives):
    name = dives[0].name
    path = tracks / f"{name}.decisions.csv"
    pd.read_csv(path).drop(columns="accepted").to_csv(path, index=False)
    ended = abyssnav("score", logs / f"{name}.mcap", tracks / f"{name}.csv")
    assert ended.status == 1
    assert "no column 'accepted'" in ended.err
