# SPDX-License-Identifier: Apache-2.0
"""Anybody's track against a log's reference: closed forms, other times, frames, gaps, refusals."""

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from msgspec.structs import replace

from abyssnav.align import reference
from abyssnav.geometry import enu_to_geodetic
from abyssnav.profile import load_profile
from abyssnav.read import read_optional
from abyssnav.score import score
from abyssnav.simulate import load_scenario, record, simulate, write_log
from abyssnav.simulate import scenario as settings
from abyssnav.simulate.dive import roles

SAMPLES = Path(__file__).parent.parent / "sample_logs" / "profiles"
DIVE = simulate(
    replace(load_scenario("clean"), duration_s=600.0, acoustics=settings.Acoustics(sigma_s=0.0))
)
TRUE_S = np.arange(20.0, 580.0)
TRUE_M = DIVE.position_at(TRUE_S)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("logs") / "dive.mcap"
    write_log(DIVE, path)
    return path


@pytest.fixture
def scored(abyssnav, log):
    """The score of a track as the command prints it for programs."""

    def command(track):
        ended = abyssnav("score", log, track, "--json")
        assert ended.status == 0, ended.err
        return json.loads(ended.out)

    return command


def table(east_m=3.0, north_m=4.0, **columns):
    """The true track, displaced."""
    start = pd.Timestamp(DIVE.start_ns, tz="UTC")
    return pd.DataFrame(
        {
            "time": start + pd.to_timedelta(TRUE_S, unit="s"),
            "east_m": TRUE_M[:, 0] + east_m,
            "north_m": TRUE_M[:, 1] + north_m,
            **columns,
        }
    )


def written(frame, path):
    if path.suffix == ".parquet":
        frame.to_parquet(path)
    else:
        frame.to_csv(path, index=False)
    return path


COVARIANCE = {"sigma_east_m": 3.0, "sigma_north_m": 2.0, "cov_east_north_m2": 0.0}


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_track_five_metres_off_scores_five_metres(scored, tmp_path, suffix):
    result = scored(written(table(**COVARIANCE), tmp_path / f"mine{suffix}"))
    assert result["n"] == len(TRUE_S)
    for name in ("mean_m", "rms_m", "median_m", "p95_m", "max_m"):
        assert result[name] == pytest.approx(5.0, abs=2e-3)
    assert result["std_m"] < 2e-3
    # (3 / 3)² + (4 / 2)²: inside an ellipse of 5.99
    assert result["nees"] == pytest.approx(5.0, abs=5e-3)
    assert result["inside_95"] == 1.0
    assert result["remarks"] == ["covers 93 % of the reference's time"]


def test_correlated_axes_count(scored, tmp_path):
    columns = {"sigma_east_m": 2.0, "sigma_north_m": 2.0, "cov_east_north_m2": 3.0}
    result = scored(written(table(1.0, -1.0, **columns), tmp_path / "mine.csv"))
    # along (1, -1) the variance is 1, and the squared error 2
    assert result["nees"] == pytest.approx(2.0, rel=5e-3)


def test_without_a_covariance_there_is_no_nees_and_it_is_said(scored, tmp_path):
    result = scored(written(table(), tmp_path / "mine.csv"))
    assert "nees" not in result
    assert "inside_95" not in result
    assert "no covariance" in result["remarks"]


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_numbers_of_time_are_taken_by_their_size(scored, tmp_path, unit):
    frame = table()
    ns = frame["time"].astype("int64")
    frame["time"] = ns / 1e9 if unit == "s" else ns // {"ms": 10**6, "us": 1000, "ns": 1}[unit]
    assert scored(written(frame, tmp_path / "mine.csv"))["rms_m"] == pytest.approx(5.0, abs=5e-3)


def test_a_track_in_tum_is_read_to_the_nanosecond(scored, tmp_path):
    lines = ["# timestamp x y z qx qy qz qw"]
    for t_s, (east, north, up) in zip(TRUE_S, TRUE_M, strict=True):
        ns = DIVE.start_ns + round(t_s * 1e9)
        stamp = f"{ns // 10**9}.{ns % 10**9:09d}"
        lines.append(f"{stamp} {east + 3:.4f} {north + 4:.4f} {up:.4f} 0 0 0 1")
    path = tmp_path / "mine.tum"
    path.write_text("\n".join(lines), encoding="ascii")
    assert scored(path)["rms_m"] == pytest.approx(5.0, abs=2e-3)


def test_latitudes_and_longitudes_are_placed_by_the_logs_origin(scored, tmp_path):
    scenario = DIVE.scenario
    latitude, longitude, _ = enu_to_geodetic(
        scenario.origin_latitude_deg,
        scenario.origin_longitude_deg,
        TRUE_M + np.array([3.0, 4.0, 0.0]),
    )
    frame = table(latitude_deg=latitude, longitude_deg=longitude, depth_m=-TRUE_M[:, 2])
    frame = frame.drop(columns=["east_m", "north_m"])
    assert scored(written(frame, tmp_path / "mine.csv"))["rms_m"] == pytest.approx(5.0, abs=5e-3)


def test_a_track_with_gaps_and_holes_is_scored_on_what_is_there(scored, tmp_path):
    frame = table(north_m=np.where(np.arange(len(TRUE_S)) < 280, 0.0, 40.0))
    frame.loc[100:109, "east_m"] = np.nan
    result = scored(written(frame.drop(index=range(280, 420)), tmp_path / "mine.csv"))
    assert result["n"] == len(TRUE_S) - 150
    said = " | ".join(result["remarks"])
    assert "10 rows without a position: left out" in said
    assert re.search(r"covers 6\d % of the reference's time", said)


def test_positions_outside_the_reference_are_left_out_and_counted(scored, tmp_path):
    frame = table()
    frame["time"] += pd.Timedelta(100, unit="s")
    result = scored(written(frame, tmp_path / "mine.csv"))
    assert result["n"] == 481
    assert "79 of 560 positions where no reference is: left out" in result["remarks"]


def test_a_track_out_of_order_is_sorted_and_said(scored, tmp_path):
    result = scored(written(table().iloc[::-1], tmp_path / "mine.csv"))
    assert result["rms_m"] == pytest.approx(5.0, abs=2e-3)
    assert "rows out of order: sorted by time" in result["remarks"]


def test_a_track_in_another_frame_is_named(scored, tmp_path):
    result = scored(written(table(500_000.0, 0.0), tmp_path / "mine.csv"))
    assert any("+500,000 m east and +0 m north" in remark for remark in result["remarks"])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda e, n: (n, e), "east and north exchanged"),
        (lambda e, n: (-e, n), "east reversed"),
        (lambda e, n: (e, -n), "north reversed"),
        (lambda e, n: (-e, -n), "both axes reversed"),
    ],
)
def test_axes_that_are_another_frames_are_named(scored, tmp_path, change, said):
    frame = table(0.0, 0.0)
    frame["east_m"], frame["north_m"] = change(frame["east_m"], frame["north_m"])
    result = scored(written(frame, tmp_path / "mine.csv"))
    assert f"fits the reference with {said}: another frame?" in result["remarks"]
    assert result["n"] == len(TRUE_S)


def test_another_origin_nearby_is_named(scored, tmp_path):
    result = scored(written(table(80.0, -60.0), tmp_path / "mine.csv"))
    assert any("+80 m east and -60 m north" in remark for remark in result["remarks"])


def test_a_track_by_a_late_clock_is_scored_and_said(scored, tmp_path):
    frame = table(0.0, 0.0)
    frame["time"] += pd.Timedelta(18, unit="s")
    result = scored(written(frame, tmp_path / "mine.csv"))
    assert any(re.fullmatch(r"as if its times were 1[78]\.\d s late", r) for r in result["remarks"])
    assert result["rms_m"] > 10.0


@pytest.mark.parametrize("rows", [[100], np.repeat(np.arange(len(TRUE_S)), 2)], ids=len)
def test_rows_that_have_no_velocity_are_scored_and_of_no_other_clock(scored, tmp_path, rows):
    """A single one, and instants that stand twice: a quotient of differences would be none."""
    result = scored(written(table().iloc[rows], tmp_path / "mine.csv"))
    assert result["n"] == len(rows)
    assert result["rms_m"] == pytest.approx(5.0, abs=2e-3)
    assert not any("its times" in remark for remark in result["remarks"])


def test_rows_without_a_time_or_with_words_for_numbers_are_left_out(scored, tmp_path):
    frame = table().astype({"east_m": object})
    frame.loc[5:9, "time"] = pd.NaT
    frame.loc[20:22, "east_m"] = "lost"
    result = scored(written(frame, tmp_path / "mine.csv"))
    assert result["n"] == len(TRUE_S) - 8
    assert {"5 rows without a time: left out", "3 rows without a position: left out"} <= set(
        result["remarks"]
    )


def test_part_of_the_rows_may_have_a_covariance(scored, tmp_path):
    frame = table(**COVARIANCE)
    frame.loc[:99, "sigma_east_m"] = np.nan
    result = scored(written(frame, tmp_path / "mine.csv"))
    assert "100 positions without a covariance" in result["remarks"]
    assert result["nees"] == pytest.approx(5.0, abs=5e-3)


def test_the_claimed_ellipse_is_as_sharp_as_its_errors_say(scored, tmp_path):
    columns = {"sigma_east_m": 2.0, "sigma_north_m": 2.0, "cov_east_north_m2": 0.0}
    result = scored(written(table(**columns), tmp_path / "mine.csv"))
    assert result["radius_95_m"] == pytest.approx(2.0 * np.sqrt(5.991464547107979))
    assert result["sharpness"] == pytest.approx(result["radius_95_m"] / 5.0, rel=1e-3)


def test_what_comes_before_an_instant_does_not_count(abyssnav, log, tmp_path):
    frame = table(np.where(TRUE_S < 300.0, 100.0, 3.0))
    path = written(frame, tmp_path / "mine.csv")
    result = json.loads(abyssnav("score", log, path, "--from-s", "300", "--json").out)
    assert result["max_m"] == pytest.approx(5.0, abs=2e-3)
    assert result["start_s"] == 20.0
    assert result["n"] == 280
    assert "no position from 590 s on" in abyssnav("score", log, path, "--from-s", "590").err


def test_of_many_methods_the_smoother_is_scored(scored, tmp_path):
    both = pd.concat([table().assign(method="ekf"), table(0.0, 1.0).assign(method="smoother")])
    result = scored(written(both, tmp_path / "tracks.parquet"))
    assert result["rms_m"] == pytest.approx(1.0, abs=2e-3)
    assert "of its methods ekf, smoother, smoother is scored" in result["remarks"]


def test_a_method_can_be_asked_for(abyssnav, log, tmp_path):
    both = pd.concat([table().assign(method="ekf"), table(0.0, 1.0).assign(method="smoother")])
    path = written(both, tmp_path / "tracks.parquet")
    result = json.loads(abyssnav("score", log, path, "--method", "ekf", "--json").out)
    assert result["rms_m"] == pytest.approx(5.0, abs=2e-3)
    assert "no track by 'fix'; nearest: " in abyssnav("score", log, path, "--method", "fix").err


def test_our_own_tracks_are_scored_as_the_comparison_has_them(abyssnav, result, dive_log):
    ended = abyssnav("score", dive_log, result.folder / "tracks.parquet", "--json")
    ours = json.loads(ended.out)
    row = (result.comparison.method == "smoother") & (result.comparison.reference == "truth")
    assert ours["rms_m"] == pytest.approx(result.comparison.rms_m[row][0], abs=1e-6)
    assert ours["n"] == result.comparison.n[row][0]
    assert 0.5 < ours["nees"] < 6.0


def test_a_person_is_shown_the_score_and_what_was_left_out(abyssnav, log, tmp_path):
    ended = abyssnav("score", log, written(table(**COVARIANCE), tmp_path / "mine.csv"))
    assert "560 positions: rms 5.00" in ended.out
    assert "NEES 5.00" in ended.out
    assert "! covers 93 %" in ended.out


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda f: f.drop(columns="time"), "no column 'time'; columns: east_m, north_m"),
        (lambda f: f.drop(columns="east_m"), "neither east_m and north_m nor latitude_deg"),
        (lambda f: f.assign(time=pd.NaT), "column 'time' holds no times"),
        (lambda f: f.assign(time="soon"), "column 'time' holds no times"),
        (lambda f: f.assign(east_m=np.nan), "no row holds a position"),
        (
            lambda f: f.assign(time=f["time"] + pd.Timedelta(1, unit="D")),
            "no position between 2013-06-05T02:00:00 and 2013-06-05T02:10:00",
        ),
    ],
)
def test_what_is_no_track_is_refused_by_name(abyssnav, log, tmp_path, change, said):
    ended = abyssnav("score", log, written(change(table()), tmp_path / "mine.csv"))
    assert ended.status == 1
    assert said in ended.err
    assert "mine.csv" in ended.err


def test_a_reference_on_a_topic_of_another_shipped_profile_serves_too(tmp_path):
    path = SAMPLES / "protobuf_vehicle.mcap"
    truth = reference(read_optional([path], load_profile("protobuf_vehicle"), ("reference",)))
    east_m, north_m, _ = truth.position_enu_m.T
    frame = pd.DataFrame({"time": truth.time_ns, "east_m": east_m + 3.0, "north_m": north_m - 4.0})
    assert score(path, written(frame, tmp_path / "mine.csv")).rms_m == pytest.approx(5.0, abs=1e-6)


def test_a_log_without_a_reference_and_a_file_that_is_not_there_are_refused(
    abyssnav, log, tmp_path, monkeypatch
):
    kept = {role: columns for role, columns in roles(DIVE).items() if role != "reference"}
    monkeypatch.setattr(record, "roles", lambda _: kept)
    bare = tmp_path / "bare.mcap"
    write_log(DIVE, bare)
    track = written(table(), tmp_path / "mine.csv")
    assert "no reference to score against" in abyssnav("score", bare, track).err
    assert "no such file" in abyssnav("score", log, tmp_path / "none.csv").err


@pytest.mark.parametrize("text", ["", "1 2 3", "a b c d e f g h"])
def test_what_is_not_tum_is_refused(abyssnav, log, tmp_path, text):
    path = tmp_path / "mine.tum"
    path.write_text(text, encoding="ascii")
    assert "not TUM" in abyssnav("score", log, path).err
